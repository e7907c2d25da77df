"""What a federation can be made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import VecEnv

from fed_envs import FederatedVecEnv

FederationLike = str | Path | Any | Sequence[Callable[[], gym.Env]]


def as_federated_env(
    env: FederationLike | None,
    n_envs_per_client: int = 1,
    clients: Sequence[int] | None = None,
    num_threads: int = 1,
) -> FederatedVecEnv | None:
    """A ``FederatedVecEnv`` from a family name, metadata file, ``Family`` or list of factories.

    :raises ValueError: for an environment that holds a single client
    """
    if env is None or isinstance(env, FederatedVecEnv):
        return env
    if isinstance(env, VecEnv | gym.Env):
        raise ValueError(
            f"a federation needs one environment per client, but got a single {type(env).__name__}; pass a family name, "
            "a metadata file, a fed_envs.FederatedVecEnv or a list of environment factories"
        )
    return FederatedVecEnv(env, n_envs_per_client=n_envs_per_client, clients=clients, num_threads=num_threads)
