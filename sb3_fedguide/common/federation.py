"""The parts of every federation, for any learner: clients, random streams, an offline stage, a server and rounds."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback
from stable_baselines3.common.type_aliases import MaybeCallback

from fed_envs import FederatedVecEnv
from fed_envs.faults import ClientError
from sb3_fedguide.common.callbacks import ExchangeCallback, RoundCallback, RoundProgressCallback, round_callbacks
from sb3_fedguide.common.ddpg_policy import StackedDDPGPolicy
from sb3_fedguide.common.environments import FederatedEnvironments
from sb3_fedguide.common.episodes import EpisodeStatistics
from sb3_fedguide.common.exchange import Exchange
from sb3_fedguide.common.faults import check_policies, in_round, warn_of_new_episodes
from sb3_fedguide.common.keywords import CheckedKeywords
from sb3_fedguide.common.normalization import FederatedNormalizer
from sb3_fedguide.common.parameters import ParameterFiles
from sb3_fedguide.common.participation import ParticipationAdam
from sb3_fedguide.common.ppo_policy import StackedMlpPolicy
from sb3_fedguide.common.resumable import Resumable
from sb3_fedguide.common.warm_start import WarmStart
from sb3_fedguide.offline.pretraining import PretrainingConfig
from sb3_fedguide.seeding import Role, stream
from sb3_fedguide.server.participants import draw_participants
from sb3_fedguide.server.strategy import Strategy
from sb3_fedguide.settings.arguments import FederationArguments
from sb3_fedguide.settings.participants import n_participants
from sb3_fedguide.settings.ranges import check_normalize

if TYPE_CHECKING:
    from sb3_fedguide.engines.engine import Engine

SelfFederation = TypeVar("SelfFederation", bound="Federation")


class Federation(CheckedKeywords, FederatedEnvironments, EpisodeStatistics, Exchange, WarmStart, ParameterFiles, Resumable):
    """Mixin for SB3 algorithms that train all clients of a family in lockstep.

    The registry names a method's server (or its class makes the strategy, in :meth:`_make_strategy`); the class defines the
    client's with :meth:`upload` and :meth:`receive`, and its part of the offline stage with :meth:`_pretrain`.
    """

    policy: StackedMlpPolicy | StackedDDPGPolicy  # type: ignore[assignment]
    normalizer: FederatedNormalizer
    rollout_size: int
    gamma: float

    def _init_federation(self, env: FederatedVecEnv | None, given: FederationArguments) -> None:
        """Called by a subclass's constructor, before SB3's."""
        check_normalize(given.normalize)
        self.client_ids: list[int] = [] if env is None else list(env.client_ids)
        self.n_envs_per_client = 1 if env is None else env.n_envs_per_client
        self.family = None if env is None else env.family
        self.raw_observation_space = None if env is None else env.raw_observation_space
        self.normalize = given.normalize
        self.bc_weight = given.bc_weight
        self.pretraining_config = PretrainingConfig.model_validate(given.pretraining or {})
        self.cache_dir = given.cache_dir
        self.client_fraction = given.client_fraction
        self.upload_bound = given.upload_bound
        #: environment steps that count for one step of a round; by default those of this process's participants
        self.steps_at_once: int | None = None
        #: engine that trains the clients in other processes; ``None`` for this process
        self.engine: Engine | None = None
        #: participants of the current round, ``(n_clients,)`` bool
        self.present = np.ones(self.n_clients, dtype=bool)
        #: clients that missed the last exchange and receive the last broadcast before they train again
        self.outdated = np.zeros(self.n_clients, dtype=bool)
        #: clients that have trained before: a newcomer begins with the whole broadcast
        self.has_trained = np.zeros(self.n_clients, dtype=bool)
        self.round = 0
        #: environment steps of tests (:mod:`sb3_fedguide.common.screening`); ``num_timesteps`` does not count them
        self.test_steps = 0
        self.pretrained = False
        #: bytes sent and received by all clients together in the offline stage
        self.pretraining_bytes = (0, 0)
        self.strategy: Strategy | None = None
        self._streams: dict[Role, list[np.random.Generator]] = {}

    @property
    def n_clients(self) -> int:
        """Clients that live here."""
        return len(self.client_ids)

    @property
    def n_participants(self) -> int:
        """Clients that take part in each round."""
        return n_participants(self.client_fraction, self.n_clients)

    @property
    def partial(self) -> bool:
        """Whether some clients may be absent from a round: the optimiser then counts each client's own steps."""
        return self.client_fraction < 1.0 or (self.delays is not None and self.delays.keep_busy)

    def _active_steps(self, env: FederatedVecEnv) -> int:
        """Environment steps that one step of this round counts."""
        return int(env.active.sum()) if self.steps_at_once is None else self.steps_at_once

    def _draw_participants(self) -> None:
        """Draw the participants of the next round; the others neither step nor train, and keep all of their state."""
        if self.n_participants == self.n_clients:
            return
        assert self.seed is not None
        self.take_part(draw_participants(self.seed, self.round, self.n_clients, self.n_participants))

    def take_part(self, present: np.ndarray) -> None:
        """Let only the clients ``present``, ``(n_clients,)`` bool, train in the next round."""
        self.present = present
        env = self.get_env()
        assert isinstance(env, FederatedVecEnv)
        env.active = np.repeat(self.present, self.n_envs_per_client)
        if self.partial:
            for optimizer in self._optimizers():
                assert isinstance(optimizer, ParticipationAdam)
                optimizer.present = self.present
                optimizer.make_state()

    def _optimizers(self) -> list[th.optim.Optimizer]:
        """All optimisers of stacked parameters."""
        return [self.policy.optimizer]

    def present_streams(self, role: Role) -> Iterator[tuple[int, np.random.Generator]]:
        """Position and generator of each client that takes part in the current round."""
        for index in np.flatnonzero(self.present).tolist():
            yield index, self.streams(role)[index]

    def streams(self, role: Role) -> list[np.random.Generator]:
        """Each local client's own generator for one purpose."""
        if role not in self._streams:
            assert self.seed is not None
            self._streams[role] = [stream(self.seed, role, client) for client in self.client_ids]
        return self._streams[role]

    def learn(
        self: SelfFederation,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfFederation:
        """Train for ``total_timesteps`` steps of all clients together, rounded up to whole rounds; otherwise as in SB3.

        :raises ValueError: if there are no environments, as in a model that was loaded without
        """
        if self.env is None:
            raise ValueError(f"this {type(self).__name__} has no environments to train in; give it some with set_env()")
        self._setup_state()  # settings may be other ones now
        self.pretrain(progress_bar)
        total_timesteps, callbacks, rounds = self.start_learning(
            total_timesteps, callback, tb_log_name, reset_num_timesteps, progress_bar
        )
        while self.num_timesteps < total_timesteps:
            with in_round(self.round + 1):
                if not self.play_round(callbacks, rounds, log_interval):
                    break
        callbacks.on_training_end()
        return self

    def start_learning(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback, list[RoundCallback]]:
        """Prepare the first :meth:`play_round`, after :meth:`pretrain`; arguments are those of :meth:`learn`.

        :return: the value of ``num_timesteps`` at which the training ends, all callbacks, and the round callbacks of them
        """
        reset = reset_num_timesteps or self._last_obs is None
        # SB3 has no event after train(), and off policy it has no rounds, so the loop is our own: train, exchange, log.
        with in_round(1 if reset_num_timesteps else self.round + 1):
            total_timesteps, callbacks = self._setup_learn(
                total_timesteps,
                self._round_callbacks(callback, progress_bar),
                reset_num_timesteps,
                tb_log_name or type(self).__name__,
            )
        if reset_num_timesteps:
            self.round = self.test_steps = 0
        self._begin_learning(environments_were_reset=reset)
        rounds = list(round_callbacks(callbacks))
        self._resume_callbacks(rounds)
        callbacks.on_training_start(locals(), globals())
        return total_timesteps, callbacks, rounds

    def play_round(self, callbacks: BaseCallback, rounds: list[RoundCallback], log_interval: int | None) -> bool:
        """Train, exchange, log; false if a callback ended the training."""
        self._draw_participants()
        for hook in rounds:
            hook.on_round_start()
        if self.engine is None:
            warn_of_new_episodes(self.begin_lost_episodes())
        if not (self.train_locally(callbacks) if self.engine is None else self.engine.train_round(self, callbacks)):
            return False
        check_policies(self.client_ids, self.policy)
        self.has_trained |= self.present
        for hook in rounds:
            hook.on_local_training_end()
        self.round += 1
        for hook in rounds:
            hook.on_round_end()
        if log_interval is not None and self.round % log_interval == 0:
            self.dump_logs(self.round)
        return all([hook.on_round_logged() for hook in rounds])

    def train_locally(self, callbacks: BaseCallback) -> bool:
        """One round's training in this process; false if a callback ended it.

        :raises ClientError: if a client's environment or policy failed
        """
        self.normalizer.begin_round(self.present)
        try:
            return self._train_round(callbacks)
        except BaseException as error:
            try:
                if isinstance(error, ClientError):
                    self._check_experience()  # non-finite values of an environment explain a non-finite action
            finally:
                self._last_obs = None  # the environments are in the middle of a step: the next learn() resets them
            raise

    @abstractmethod
    def _check_experience(self) -> None:
        """:raises ClientError: if an environment returned a non-finite value in this round"""

    @abstractmethod
    def _train_round(self, callbacks: BaseCallback) -> bool:
        """One round's experience and gradient steps of the participants; false if a callback ended the training."""

    def _round_callbacks(self, callback: MaybeCallback, progress_bar: bool) -> CallbackList:
        """The exchange first, then the user's callbacks, which see its result, then the progress bar."""
        chain: list[BaseCallback] = [ExchangeCallback()]
        for item in callback if isinstance(callback, list) else [callback]:
            if item is not None:
                chain.append(item if isinstance(item, BaseCallback) else ConvertCallback(item))
        if progress_bar:
            chain.append(RoundProgressCallback())
        return CallbackList(chain)

    def _begin_learning(self, environments_were_reset: bool) -> None:
        if environments_were_reset:
            self.normalizer.reset_returns()
            self.normalizer.update_obs(self._last_obs.reshape(self.n_clients, self.n_envs_per_client, -1))  # type: ignore
        if environments_were_reset or not hasattr(self, "episode_infos"):
            self.begin_episodes()
        self.gather_episodes()

    def predict(  # type: ignore[override]
        self,
        observation: np.ndarray,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Actions of all clients for raw observations, ``(n_clients * batch, obs_dim)``, client-major.

        :raises ValueError: if the observations cannot be divided among the clients, or come with an info
        """
        if isinstance(observation, tuple) and len(observation) == 2 and isinstance(observation[1], dict):
            raise ValueError(
                "predict() takes an array of observations, but got a tuple (observation, info): this is mixing Gym API, "
                "`observation, info = env.reset()`, with SB3's VecEnv API, `observations = vec_env.reset()`"
            )
        observation = np.asarray(observation)
        if observation.ndim != 2 or len(observation) % self.n_clients:
            raise ValueError(
                f"predict() takes flat observations of all {self.n_clients} clients, client by client, but got shape "
                f"{observation.shape}; take one client's own model with client(k)"
            )
        split = observation.reshape(self.n_clients, -1, observation.shape[-1])
        normalized = self.normalizer.normalize_obs(split).reshape(observation.shape)
        return self.policy.predict(normalized, state, episode_start, deterministic)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "normalizer", "episode_infos", "engine"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer", "normalizer"], []
