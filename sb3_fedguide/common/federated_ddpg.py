"""Deep deterministic policy gradient of N clients in lockstep: one SB3 algorithm is a whole federation."""

from __future__ import annotations

import io
import time
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from fed_envs import FederatedVecEnv
from sb3_fedguide.common.ddpg_policy import StackedDDPGPolicy, check_ddpg_actions
from sb3_fedguide.common.ddpg_settings import check_settings
from sb3_fedguide.common.environments import as_federated_env
from sb3_fedguide.common.faults import check_experience
from sb3_fedguide.common.federation import Federation
from sb3_fedguide.common.keywords import check_policy, check_policy_keywords
from sb3_fedguide.common.noise import OrnsteinUhlenbeckNoise
from sb3_fedguide.common.normalization import FederatedNormalizer
from sb3_fedguide.common.participation import ParticipationAdam
from sb3_fedguide.common.replay_buffer import FederatedReplayBuffer
from sb3_fedguide.common.training_log import RoundStatistics
from sb3_fedguide.offline.pretraining import Pretraining
from sb3_fedguide.seeding import Role, integer_seed
from sb3_fedguide.settings.arguments import FederatedDDPGArguments
from sb3_fedguide.settings.ranges import check_values
from sb3_fedguide.settings.signatures import takes, types_of
from sb3_fedguide.state.held import Held


class FederatedDDPG(Federation, DDPG):
    """DDPG for every client of a family at once; the base class of off-policy methods.

    ``rollout_size`` environment steps per client, with gradient steps in between, are one communication round. Each client
    has its own replay buffer, exploration noise and random streams, and one stacked gradient step serves them all. Without
    a server ``strategy``, N clients learn exactly as N federations of one, and a gradient step is SB3's.

    The replay buffer is not part of a saved model, as in SB3: a loaded model first collects ``learning_starts`` transitions
    again, with its own policy, unless ``load_replay_buffer`` restores them.

    Paper: https://arxiv.org/abs/1509.02971 (DDPG)

    :param policy: ``"MlpPolicy"``
    :param env: as for :class:`FederatedPPO`
    :param learning_rate: of actor and critic
    :param rollout_size: environment steps per client and round
    :param buffer_size: capacity of each client's replay buffer
    :param learning_starts: transitions of each client before its first gradient step; its first steps are random
    :param batch_size: minibatch size per client
    :param tau: fraction by which target networks follow at each gradient step
    :param gamma: discount factor
    :param train_freq: steps of every environment between trainings; must divide ``rollout_size / n_envs_per_client``
    :param gradient_steps: gradient steps each time; -1 for as many as there were new transitions per client
    :param noise_theta: rate of mean reversion of the Ornstein-Uhlenbeck exploration noise, in units of actions in [-1, 1]
    :param noise_sigma: its scale
    :param noise_dt: its time step; 1 in the paper, 0.01 in SB3
    :param n_envs_per_client: environments per client; must divide ``rollout_size``
    :param clients: ids of the clients that live here; all by default
    :param num_threads: upper bound on the threads that step the simulators, see :class:`fed_envs.FederatedVecEnv`
    :param normalize: running normalisation of observations and rewards, as ``VecNormalize``, per client; with ``"shared"`` the
        clients pool their observation statistics through the server after every round
    :param bc_weight: alpha of ``theta_0 = (1 - alpha) theta_rand + alpha theta_BC`` for the actor (paper: 0.3)
    :param client_fraction: share of the clients that take part in each round, as for :class:`FederatedPPO`
    :param upload_bound: as for :class:`FederatedPPO`
    :param pretraining: settings of the offline stage, a ``PretrainingConfig`` or a dict of its fields
    :param cache_dir: folder of the offline stage's results; by default the user's cache folder
    :param stats_window_size: finished episodes per client over which returns are averaged
    :param tensorboard_log: as in SB3, like ``policy_kwargs``, ``verbose`` and ``device``
    :param seed: the federation's seed; drawn and stored if ``None``
    :raises ValueError: for settings that do not fit, with the remedy in the message
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = dict.fromkeys(FederatedDDPGArguments.policies, StackedDDPGPolicy)
    #: the algorithm whose settings a user's own algorithm takes if it has none
    base_settings: ClassVar[str | None] = None
    replay_buffer: FederatedReplayBuffer | None  # type: ignore[assignment]
    policy: StackedDDPGPolicy
    train_freq: int
    state_attributes: ClassVar[tuple[str | Held, ...]] = ("client_steps", "noise.state", "replay_buffer")

    @takes(FederatedDDPGArguments)
    def __init__(self, given: FederatedDDPGArguments) -> None:
        check_policy(given.policy, self.policy_aliases, type(self))
        env = as_federated_env(given.env, given.n_envs_per_client, given.clients, given.num_threads)
        self._init_federation(env, given)
        if env is not None:
            check_ddpg_actions(env.action_space)
        self.rollout_size = given.rollout_size
        self.noise_theta, self.noise_sigma, self.noise_dt = given.noise_theta, given.noise_sigma, given.noise_dt
        #: steps that each client has taken so far, ``(n_clients,)``
        self.client_steps = np.zeros(self.n_clients, dtype=int)
        super().__init__(
            given.policy,  # type: ignore[arg-type]
            env,  # type: ignore[arg-type]
            learning_rate=given.learning_rate,
            buffer_size=given.buffer_size,
            learning_starts=given.learning_starts,
            batch_size=given.batch_size,
            tau=given.tau,
            gamma=given.gamma,
            train_freq=given.train_freq,
            gradient_steps=given.gradient_steps,
            tensorboard_log=given.tensorboard_log,
            policy_kwargs=dict(given.policy_kwargs or {}),  # SB3 adds to it
            verbose=given.verbose,
            seed=int(np.random.SeedSequence().generate_state(1)[0] >> 1) if given.seed is None else given.seed,
            device=given.device,
            _init_setup_model=False,
        )
        self._stats_window_size = given.stats_window_size
        check_settings(self)
        if given._init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        assert self.seed is not None
        check_values(types_of(type(self)), vars(self))  # those of subclasses, and of load()
        check_policy_keywords(self.policy_class, self.policy_kwargs)
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        if self.replay_buffer is None:
            self.replay_buffer = FederatedReplayBuffer(
                self.buffer_size,
                self.observation_space,  # type: ignore[arg-type]
                self.action_space,  # type: ignore[arg-type]
                self.n_clients,
                self.n_envs_per_client,
                self.device,
            )
        kwargs = {**self.policy_kwargs, "n_clients": self.n_clients, "init_seed": integer_seed(self.seed, Role.INIT)}
        if self.partial:
            kwargs["optimizer_class"] = ParticipationAdam
        self.policy = self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **kwargs).to(self.device)  # type: ignore
        self._create_aliases()
        self.normalizer = FederatedNormalizer(
            self.n_clients,
            self.n_envs_per_client,
            self.observation_space.shape[0],  # type: ignore[index]
            self.gamma,
            norm_obs=bool(self.normalize),
            norm_reward=bool(self.normalize),
            shared=self.normalize == "shared",
        )
        self._fit_copies()
        self._start_server()
        self._setup_state()

    def _fit_copies(self) -> None:
        assert self.replay_buffer is not None
        check_settings(self)
        self.n_envs = self.n_clients * self.n_envs_per_client
        self.normalizer.reset_returns(self.n_envs_per_client)
        self._fit_replay_buffer()
        shape = (self.n_clients, self.n_envs_per_client, self.action_space.shape[0])  # type: ignore[index]
        self.noise = OrnsteinUhlenbeckNoise(shape, self.noise_theta, self.noise_sigma, self.noise_dt)

    def _fit_replay_buffer(self) -> None:
        assert self.replay_buffer is not None
        self.replay_buffer.client_ids = list(self.client_ids)
        self.replay_buffer.n_envs_per_client, self.replay_buffer.n_envs = self.n_envs_per_client, self.n_envs

    def load_replay_buffer(self, path: str | Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """As in SB3, whose file is unpickled: load only files that you trust.

        :raises ValueError: for other clients' transitions
        """
        own = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        clients = getattr(self.replay_buffer, "client_ids", None)
        if clients != self.client_ids:
            self.replay_buffer = own
            raise ValueError(f"the replay buffer in {path} is of the clients {clients}, not of {self.client_ids}")
        self._fit_replay_buffer()

    def _optimizers(self) -> list[th.optim.Optimizer]:
        return [self.actor.optimizer, self.critic.optimizer]

    def _actors(self) -> nn.Module:
        return self.policy.bounded_actors()

    def _initialize_from_behavior_cloning(self, stage: Pretraining) -> None:
        super()._initialize_from_behavior_cloning(stage)
        self.policy.copy_to_targets()

    def _begin_learning(self, environments_were_reset: bool) -> None:
        super()._begin_learning(environments_were_reset)
        if environments_were_reset:
            self.noise.reset()

    def _train_round(self, callbacks: BaseCallback) -> bool:
        started = time.perf_counter()
        self._statistics, self._training_seconds = RoundStatistics(), 0.0
        if not self.collect_rollouts(self.env, callbacks, self.rollout_size // self.n_envs_per_client):  # type: ignore
            return False
        self._check_experience()
        self.logger.record("time/rollout", time.perf_counter() - started - self._training_seconds)
        self.logger.record("time/train", self._training_seconds)
        self._record_training()
        return True

    def collect_rollouts(  # type: ignore[override]
        self, env: FederatedVecEnv, callback: BaseCallback, n_rollout_steps: int
    ) -> bool:
        """One round: steps of all environments, with gradient steps in between."""
        assert self._last_obs is not None and self.replay_buffer is not None
        shape = (self.n_clients, self.n_envs_per_client)
        gradient_steps = self.gradient_steps if self.gradient_steps > 0 else self.train_freq * self.n_envs_per_client
        present = None if self.present.all() else self.present
        callback.on_rollout_start()
        noise = self._noise_draws(n_rollout_steps)
        n_active = self._active_steps(env)
        raw_obs = self._last_obs.reshape(*shape, -1)  # type: ignore[union-attr]
        for step in range(n_rollout_steps):
            scaled_actions = self._explore(raw_obs, noise[step])
            buffer_actions = scaled_actions.reshape(env.num_envs, -1)
            actions = self.policy.unscale_action(buffer_actions)
            new_obs, rewards, dones, infos = env.step(actions)  # names as in SB3, whose callbacks read them
            self.num_timesteps += n_active
            self.client_steps[self.present] += self.n_envs_per_client
            callback.update_locals(locals())
            goes_on = callback.on_step()
            next_raw, ends, raw_rewards = new_obs.reshape(*shape, -1), dones.reshape(shape), rewards.reshape(shape)  # type: ignore[union-attr]
            self.normalizer.update_obs(next_raw, present)
            self.normalizer.scale_reward(raw_rewards, ends, present)  # for its statistics: the buffer keeps raw rewards
            final_obs, terminations = self._ends(next_raw, ends, infos)
            self.replay_buffer.add(raw_obs, final_obs, scaled_actions, raw_rewards, terminations, present)
            self.noise.reset(ends)
            raw_obs, self._last_obs = next_raw, new_obs  # type: ignore[assignment]
            if not goes_on:
                return False
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
            if (step + 1) % self.train_freq == 0 and self._ready().any():
                started = time.perf_counter()
                self.train(gradient_steps, self.batch_size)
                self._training_seconds += time.perf_counter() - started
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def _noise_draws(self, n_steps: int) -> np.ndarray:
        """Standard normal draws for a whole round, from each client's own stream: ``(n_steps, n_clients, n_envs, dim)``."""
        draws = np.zeros((n_steps, *self.noise.state.shape))
        for index, rng in self.present_streams(Role.ACTION):
            draws[:, index] = rng.standard_normal((n_steps, *draws.shape[2:]))
        return draws

    @th.no_grad()
    def _explore(self, raw_obs: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Actions in [-1, 1], ``(n_clients, n_envs, dim)``: uniform during the warm-up, then the actors'; plus noise."""
        obs = th.as_tensor(self.normalizer.normalize_obs(raw_obs), device=self.device)
        actions = self.policy.actions(obs).cpu().numpy()
        warming_up = self.client_steps < self.learning_starts
        if warming_up.any():
            for index, rng in self.present_streams(Role.ACTION):
                if warming_up[index]:
                    actions[index] = rng.uniform(-1.0, 1.0, normal.shape[1:])
        noise = self.noise(normal, None if self.present.all() else self.present)
        return np.clip(actions + noise, -1.0, 1.0).astype(np.float32)

    def _ready(self) -> np.ndarray:
        """The participants with enough transitions to learn from, ``(n_clients,)`` bool."""
        assert self.replay_buffer is not None
        return self.present & (self.replay_buffer.sizes > self.learning_starts)

    def _ends(self, next_obs: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
        """Next observations, before any reset, and whether they are terminal; keeps finished episodes' infos."""
        terminations = dones.copy()
        if dones.any():
            next_obs = next_obs.copy()
            for client, env in np.argwhere(dones):
                info = infos[client * self.n_envs_per_client + env]
                next_obs[client, env] = info["terminal_observation"]
                terminations[client, env] = not info.get("TimeLimit.truncated", False)
                self.note_episode(int(client), info)
        return next_obs, terminations

    def train(self, gradient_steps: int, batch_size: int = FederatedDDPGArguments.batch_size) -> None:
        """SB3's DDPG update for all clients at once; their losses are summed, so that no gradient mixes two clients."""
        assert self.replay_buffer is not None
        actor_parameters = self.policy.actor_parameters
        self._update_learning_rate(self._optimizers())
        ready = self._ready()
        learners: th.Tensor | None = None
        if self.partial:
            learners = th.as_tensor(np.flatnonzero(ready), device=self.device)
            for optimizer in self._optimizers():
                optimizer.present = ready  # type: ignore[attr-defined]
        counted = th.as_tensor(ready, device=self.device).float()
        for _ in range(gradient_steps):
            self._n_updates += 1
            streams = [(index, rng) for index, rng in self.present_streams(Role.MINIBATCH) if ready[index]]
            data = self.replay_buffer.sample(batch_size, streams, self.normalizer)
            with th.no_grad():
                next_values = self.policy.target_values(
                    data.next_observations, self.policy.target_actions(data.next_observations)
                )
                targets = data.rewards + (1 - data.terminations) * self.gamma * next_values
            critic_loss = ((self.policy.values(data.observations, data.actions) - targets) ** 2).mean(dim=1)
            self.critic.optimizer.zero_grad()
            critic_loss.sum().backward()
            self.critic.optimizer.step()

            actor_loss = -self.policy.values(data.observations, self.policy.actions(data.observations)).mean(dim=1)
            # Only the actors' gradients: those of the critics' weights are not needed.
            gradients = th.autograd.grad(actor_loss.sum(), actor_parameters)
            for parameter, gradient in zip(actor_parameters, gradients, strict=True):
                parameter.grad = gradient
            self.actor.optimizer.step()
            self.policy.update_targets(self.tau, learners)
            self._statistics.add(critic_loss=critic_loss * counted, actor_loss=actor_loss * counted, updates=counted)

    def _check_experience(self) -> None:
        assert self.replay_buffer is not None
        count = min(self.rollout_size, self.buffer_size)
        recent = (self.replay_buffer.positions + np.arange(-count, 0)[:, None]) % self.buffer_size, np.arange(self.n_clients)
        names = {"an observation": "next_observations", "a reward": "rewards"}
        check_experience(self.client_ids, {name: getattr(self.replay_buffer, array)[recent] for name, array in names.items()})

    def _record_training(self) -> None:
        means = self._statistics.means()
        share = means.pop("updates", np.zeros(self.n_clients))
        learned = np.flatnonzero(share)
        for name, per_client in means.items():
            per_client = per_client[learned] / share[learned]
            self.logger.record(f"train/{name}", float(np.mean(per_client)))
            for index, value in zip(learned, per_client, strict=True):
                self.record_client(self.client_ids[index], name, float(value))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def begin_lost_episodes(self) -> list[int]:
        ended = self._federated_env().lost
        clients = super().begin_lost_episodes()
        self.noise.reset(ended.reshape(self.n_clients, self.n_envs_per_client))
        return clients

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_statistics"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "actor.optimizer", "critic.optimizer", "normalizer"], []
