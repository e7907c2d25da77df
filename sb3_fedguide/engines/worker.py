"""One group of clients in a separate process: it receives their state and trains them for a round."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import cloudpickle
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.logger import Logger

from fed_envs import FederatedVecEnv
from fed_envs.faults import ClientError
from fed_envs.plain_data import State
from sb3_fedguide.common.federation import Federation
from sb3_fedguide.state.held import held_by


class Round(NamedTuple):
    """The request of a round to a worker.

    :param state: of its clients
    :param total_timesteps: of the whole training, all clients together
    :param steps_at_once: environment steps of all clients together in one step of the round
    """

    state: State
    total_timesteps: int
    steps_at_once: int


class Trained(NamedTuple):
    """A worker's reply.

    :param state: of its clients, after the round
    :param metrics: the logged values, each with the outputs that exclude it
    :param restarted: clients whose episodes had to restart
    :param observations: the actors' inputs, ``(n_steps, n_clients, n_envs, obs_dim)``; ``None`` off policy
    """

    state: State
    metrics: dict[str, tuple[float, Any]]
    observations: np.ndarray | None
    restarted: list[int]


class Worker:
    """Keeps nothing between two rounds, except environments that give no state: any worker can train any group.

    In another worker such environments begin new episodes.

    :param blob: what :func:`describe` returned for its clients
    """

    def __init__(self, blob: bytes) -> None:
        th.set_num_threads(1)
        kind, policy_class, source, positions, attributes = cloudpickle.loads(blob)
        self.model: Federation = kind(policy_class, None, _init_setup_model=False)
        env = FederatedVecEnv(source, attributes["n_envs_per_client"], [attributes["client_ids"][k] for k in positions])
        vars(self.model).update(attributes)
        vars(self.model).update(env=env, client_ids=env.client_ids)
        env.seed(self.model.seed)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
            self.model._setup_model()  # type: ignore[attr-defined]
        self.model.strategy = None
        self.callbacks = CallbackList([])

    def ready(self) -> bool:
        """Answers as soon as the worker is made."""
        return True

    def train(self, round: Round) -> Trained | ClientError:
        """One round of its clients; a fault of a client is returned, not raised."""
        model = self.model
        model.set_logger(Logger(None, []))
        self.callbacks.init_callback(model)  # type: ignore[arg-type]
        model.load_state(round.state)
        model.take_part(model.present)
        model._total_timesteps, model.steps_at_once = round.total_timesteps, round.steps_at_once
        try:
            restarted = model.begin_lost_episodes()
            model.train_locally(self.callbacks)
        except ClientError as error:
            return error
        excluded = model.logger.name_to_excluded
        metrics = {key: (value, excluded[key]) for key, value in model.logger.name_to_value.items()}
        buffer = getattr(model, "rollout_buffer", None)
        return Trained(model.save_state(), metrics, None if buffer is None else buffer.observations, restarted)


def describe(model: Federation, positions: Sequence[int]) -> bytes:
    """The arguments of a :class:`Worker` for the clients at ``positions``; their state comes with each round.

    :raises ValueError: if the environments' functions cannot be sent to another process
    """
    env = model._federated_env()
    source = env.family if env.family is not None else env._factories
    per_round = {*model._excluded_save_params(), "strategy", "present", "outdated", "_last_obs", "_last_episode_starts"}
    learned = held_by(model).keys() - {"seed"}
    attributes = {
        name: value
        for name, value in vars(model).items()
        if name not in per_round | learned and not isinstance(value, (th.nn.Module, th.optim.Optimizer))
    }
    try:
        return cloudpickle.dumps((type(model), model.policy_class, source, list(positions), attributes))
    except Exception as error:
        raise ValueError(f"this federation cannot be sent to another process: {error}") from error
