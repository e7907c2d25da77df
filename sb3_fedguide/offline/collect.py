"""Generates a client's offline data by acting in the client's own MDP."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import gymnasium as gym
import numpy as np

from fed_envs import Family, FederatedVecEnv
from fed_envs.registration import environment_class
from fed_envs.world import ScriptedPolicy
from sb3_fedguide.offline.behavior import BehaviorPolicy, behavior_policy
from sb3_fedguide.offline.data import OfflineData
from sb3_fedguide.seeding import Role, stream

__all__ = ["DATA_VERSION", "behavior_name", "check_source", "collect", "default_size", "source_key"]

DATA_VERSION = 1
"""Raised whenever the same inputs give other data, so that old cache entries are not taken for new ones."""

N_COPIES = 8
DEFAULT_SIZES = {"bandit2d": 1_000}


def default_size(family: Family) -> int:
    """Rows per client: 1,000 for Bandit2D, 20,000 elsewhere."""
    return DEFAULT_SIZES.get(family.world, 20_000)


def source_key(family: Family, client: int, policy: BehaviorPolicy | None = None) -> dict[str, Any]:
    """Everything except size and seed on which the data of one client depend; nothing of the other clients."""
    world = environment_class(family.world)
    if policy is None and world.scripted_policy(family, client) is not None:
        source: dict[str, Any] = {"script_version": world.script_version}
    else:
        source = {"policy": (policy or behavior_policy(family.backbone)).content_hash}
    return {
        "data_version": DATA_VERSION,
        "mujoco": version("mujoco"),
        **({"metaworld": version("metaworld")} if family.world == "metaworld" else {}),
        "world": family.world,
        "backbone": family.backbone,
        "max_episode_steps": family.max_episode_steps,
        "client": family.client(client).model_dump(mode="json", exclude_defaults=True),
        "copies": N_COPIES,
        **source,
    }


def check_source(family: Family, client: int) -> None:
    """:raises ValueError: if the package has no behaviour policy for the client's data"""
    if family.world == "gymnasium":
        raise ValueError(
            f"{family.client(client).id} brings no offline data: give a Minari dataset with --dataset ID_OR_PATH, in Python "  # type: ignore[attr-defined]
            "pretraining={'dataset': 'ID_OR_PATH'} ({client} in it stands for the client's number); `fedguide dataset` makes "
            "one from logs"
        )
    if environment_class(family.world).scripted_policy(family, client) is None:
        behavior_policy(family.backbone)


def behavior_name(family: Family, client: int, policy: BehaviorPolicy | None = None) -> str:
    """The name of the behaviour policy of a client's data."""
    scripted = policy is None and environment_class(family.world).scripted_policy(family, client) is not None
    return f"scripted policy of {family.backbone}" if scripted else "squashed PPO, medium"


def collect(
    family: Family, client: int, size: int, seed: int, policy: BehaviorPolicy | None = None
) -> tuple[OfflineData, gym.spaces.Box, gym.spaces.Box]:
    """Roll out a client's behaviour in its own MDP.

    The world's scripted policy acts if it has one, else the backbone's shipped policy. Stored actions are the environment's
    inputs, strictly inside the bounds.

    :param size: rows
    :param seed: with ``client`` it determines everything that is random
    :param policy: another behaviour policy than the shipped one
    :return: the data, the observation space and the action space
    """
    n_copies = min(N_COPIES, size)
    env = FederatedVecEnv(family, n_envs_per_client=n_copies, clients=[client], role=int(Role.DATA))
    try:
        observation_space, action_space = env.observation_space, env.action_space
        if not isinstance(observation_space, gym.spaces.Box) or not isinstance(action_space, gym.spaces.Box):
            raise ValueError(f"offline data needs Box spaces, {family.name} has {observation_space} and {action_space}")
        act = _action_source(family, client, policy)
        rng = stream(seed, Role.DATA, client)
        env.seed(seed)
        data = _roll_out(env, act, rng, size, n_copies)
    finally:
        env.close()
    return data, observation_space, action_space


def _action_source(family: Family, client: int, policy: BehaviorPolicy | None) -> ScriptedPolicy:
    if policy is not None:
        return policy
    scripted: ScriptedPolicy | None = environment_class(family.world).scripted_policy(family, client)
    return scripted or behavior_policy(family.backbone)


def _roll_out(env: FederatedVecEnv, act: ScriptedPolicy, rng: np.random.Generator, size: int, n_copies: int) -> OfflineData:
    n_steps = -(-size // n_copies)
    observations = np.asarray(env.reset())
    shape = (n_copies, n_steps)
    columns = {
        "observations": np.empty((*shape, observations.shape[1]), dtype=np.float32),
        "actions": np.empty((*shape, *env.action_space.shape), dtype=np.float32),  # type: ignore[misc]
        "rewards": np.empty(shape, dtype=np.float32),
        "next_observations": np.empty((*shape, observations.shape[1]), dtype=np.float32),
        "terminations": np.zeros(shape, dtype=bool),
    }
    for step in range(n_steps):
        actions = act(observations, rng)
        columns["observations"][:, step] = observations
        columns["actions"][:, step] = actions
        observations, rewards, dones, infos = env.step(actions)  # type: ignore[assignment]
        columns["rewards"][:, step] = rewards
        columns["next_observations"][:, step] = observations
        for copy in np.flatnonzero(dones):
            columns["next_observations"][copy, step] = infos[copy]["terminal_observation"]
            columns["terminations"][copy, step] = not infos[copy].get("TimeLimit.truncated", False)
    # Copy after copy, so that rows of one episode stay neighbours; the first copies give a row more where it does not divide.
    steps = [size // n_copies + (copy < size % n_copies) for copy in range(n_copies)]
    return OfflineData(
        **{name: np.concatenate([column[copy, : steps[copy]] for copy in range(n_copies)]) for name, column in columns.items()}
    )
