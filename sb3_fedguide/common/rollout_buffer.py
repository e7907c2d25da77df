"""Rollout storage that keeps the client axis."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_fedguide.common.environments import check_copies


class FederatedSamples(NamedTuple):
    """One minibatch of every client: leading dimensions ``(n_clients, batch)``."""

    observations: th.Tensor
    actions: th.Tensor
    old_values: th.Tensor
    old_log_prob: th.Tensor
    advantages: th.Tensor
    returns: th.Tensor
    extras: dict[str, th.Tensor]


def check_sizes(rollout_size: int, batch_size: int, n_envs_per_client: int) -> None:
    """:raises ValueError: if sizes of a client's rollout do not fit together"""
    check_copies(rollout_size, n_envs_per_client)
    if not 1 < batch_size <= rollout_size:
        raise ValueError(f"batch_size={batch_size} must lie between 2 and rollout_size={rollout_size}; both are per client")


def generalized_advantage(
    rewards: np.ndarray,
    values: np.ndarray,
    last_values: np.ndarray,
    episode_starts: np.ndarray,
    last_dones: np.ndarray,
    gamma: float,
    gae_lambda: float,
) -> np.ndarray:
    """Generalized advantage estimation (paper, Eq. 13) with any baseline, in SB3's operations and order.

    Rewards of truncated steps already contain ``gamma * V(final observation)``, as in SB3.

    :param rewards: ``(n_steps, n_envs)``, like ``values`` and ``episode_starts``
    :param last_values: baseline of the state after the rollout, ``(n_envs,)``; ``last_dones`` alike
    :return: advantages, ``(n_steps, n_envs)``
    """
    advantages = np.zeros_like(rewards)
    last_gae_lam: np.ndarray | float = 0.0
    next_non_terminal = 1.0 - last_dones.astype(np.float32)
    next_values = last_values
    for step in reversed(range(len(rewards))):
        delta = rewards[step] + gamma * next_values * next_non_terminal - values[step]
        last_gae_lam = delta + gamma * gae_lambda * next_non_terminal * last_gae_lam
        advantages[step] = last_gae_lam
        next_non_terminal = 1.0 - episode_starts[step]
        next_values = values[step]
    return advantages


class FederatedRolloutBuffer:
    """One round's rollout of all clients.

    Arrays are ``(n_steps, n_clients, n_envs_per_client, ...)`` while it is collected. A client's rows have the numbers
    ``env * n_steps + step``, as in the flattened ``stable_baselines3.RolloutBuffer``.

    :param n_steps: steps per environment
    :param action_dim: entries of an action
    """

    def __init__(
        self, n_steps: int, n_clients: int, n_envs_per_client: int, observation_space: spaces.Box, action_dim: int
    ) -> None:
        self.n_steps, self.n_clients, self.n_envs_per_client = n_steps, n_clients, n_envs_per_client
        shape = (n_steps, n_clients, n_envs_per_client)
        self.raw_observations = np.zeros((*shape, *observation_space.shape), dtype=np.float32)
        self.observations = np.zeros_like(self.raw_observations)
        self.actions = np.zeros((*shape, action_dim), dtype=np.float32)  # a choice's number is exact up to 2^24
        self.rewards = np.zeros(shape, dtype=np.float32)
        self.episode_starts = np.zeros(shape, dtype=np.float32)
        self.values = np.zeros(shape, dtype=np.float32)
        self.log_probs = np.zeros(shape, dtype=np.float32)
        self.advantages = np.zeros(shape, dtype=np.float32)
        self.returns = np.zeros(shape, dtype=np.float32)
        self.reset()

    def reset(self) -> None:
        """Begin a new rollout."""
        self.pos = 0
        self.truncations: list[tuple[int, int, int, np.ndarray, np.ndarray]] = []
        self.extras: dict[str, th.Tensor] = {}

    @property
    def n_rows(self) -> int:
        """Rows per client."""
        return self.n_steps * self.n_envs_per_client

    def add(
        self,
        raw_obs: np.ndarray,
        obs: np.ndarray,
        actions: np.ndarray,
        rewards: np.ndarray,
        episode_starts: np.ndarray,
    ) -> None:
        """Append one step, arrays ``(n_clients, n_envs_per_client, ...)``; values and log-probabilities are added later."""
        pos = self.pos
        self.raw_observations[pos] = raw_obs
        self.observations[pos] = obs
        self.actions[pos] = actions
        self.rewards[pos] = rewards
        self.episode_starts[pos] = episode_starts
        self.pos += 1

    def add_truncation(self, client: int, env: int, raw_obs: np.ndarray, obs: np.ndarray) -> None:
        """Store the final observation of an episode that was truncated in the last added step."""
        self.truncations.append((self.pos - 1, client, env, raw_obs, obs))

    def rows(self, array: np.ndarray) -> np.ndarray:
        """``(n_steps, n_clients, n_envs_per_client, ...)`` to ``(n_clients, n_rows, ...)``."""
        return np.moveaxis(array, 0, 2).reshape(self.n_clients, self.n_rows, *array.shape[3:])

    def unrows(self, array: np.ndarray) -> np.ndarray:
        """The inverse of :meth:`rows`."""
        split = array.reshape(self.n_clients, self.n_envs_per_client, self.n_steps, *array.shape[2:])
        return np.moveaxis(split, 2, 0)

    def bootstrapped_rewards(self, gamma: float, truncation_values: np.ndarray) -> np.ndarray:
        """Rewards plus, for truncated episodes, ``gamma * V`` of the final observation.

        :param truncation_values: the baseline at the final observations, in the order they were added
        """
        rewards = self.rewards.copy()
        for (step, client, env, _, _), value in zip(self.truncations, truncation_values, strict=True):
            rewards[step, client, env] += gamma * value
        return rewards

    def get(
        self, batch_size: int, rngs: Iterable[tuple[int, np.random.Generator]], device: th.device | str = "cpu"
    ) -> Iterator[FederatedSamples]:
        """One epoch of minibatches.

        :param rngs: position and generator of each client that trains, to shuffle its rows; the others' rows keep their order
        """
        rows = np.tile(np.arange(self.n_rows), (self.n_clients, 1))
        for index, rng in rngs:
            rows[index] = rng.permutation(self.n_rows)
        order = th.as_tensor(rows, device=device)
        client = th.arange(self.n_clients, device=device).unsqueeze(1)
        arrays = (self.observations, self.actions, self.values, self.log_probs, self.advantages, self.returns)
        tensors = [th.as_tensor(self.rows(array), device=device)[client, order] for array in arrays]
        extras = {name: tensor[client, order] for name, tensor in self.extras.items()}
        for start in range(0, self.n_rows, batch_size):
            part = slice(start, start + batch_size)
            observations, actions, *others = (tensor[:, part] for tensor in tensors)
            values, log_probs, advantages, returns = others
            more = {name: tensor[:, part] for name, tensor in extras.items()}
            yield FederatedSamples(observations, actions, values, log_probs, advantages, returns, more)
