"""Every client's replay buffer, in arrays with a client axis."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer

from fed_envs.plain_data import State
from sb3_fedguide.common.normalization import FederatedNormalizer

_ARRAYS = ("observations", "next_observations", "actions", "rewards", "terminations")


class FederatedReplaySamples(NamedTuple):
    """A minibatch per client; float32 tensors with the client dimension first.

    :param observations: ``(n_clients, batch, obs_dim)``; ``next_observations`` alike
    :param actions: in [-1, 1], ``(n_clients, batch, action_dim)``
    :param terminations: 1 where the next state is terminal, ``(n_clients, batch)``; ``rewards`` alike
    """

    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    terminations: th.Tensor
    rewards: th.Tensor


class FederatedReplayBuffer(ReplayBuffer):
    """One ring of transitions per client; a client samples only its own, by its own random stream.

    Observations and rewards are stored raw and normalised when they are sampled, as SB3 does with ``VecNormalize``. The
    end of a truncated episode is not a termination: its last transition bootstraps from the final observation.

    :param buffer_size: transitions per client
    :param observation_space: flat ``Box``, like ``action_space``
    :param n_clients: clients in lockstep
    :param n_envs_per_client: transitions that every client adds at a time
    :param device: of the samples
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        n_clients: int,
        n_envs_per_client: int = 1,
        device: th.device | str = "cpu",
    ) -> None:
        # Not ReplayBuffer's constructor: its arrays have no client axis, and its capacity is divided among environments.
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_clients * n_envs_per_client)
        self.n_clients, self.n_envs_per_client = n_clients, n_envs_per_client
        #: owners of the transitions, in the order of the arrays
        self.client_ids = list(range(n_clients))
        self.optimize_memory_usage, self.handle_timeout_termination = False, True
        #: each client's number of transitions, and the position of its next one, ``(n_clients,)``
        self.sizes, self.positions = np.zeros(n_clients, dtype=int), np.zeros(n_clients, dtype=int)
        rows = (buffer_size, n_clients)
        self.observations = np.zeros((*rows, *observation_space.shape), dtype=np.float32)
        self.next_observations = np.zeros_like(self.observations)
        self.actions = np.zeros((*rows, *action_space.shape), dtype=np.float32)
        self.rewards = np.zeros(rows, dtype=np.float32)
        self.terminations = np.zeros(rows, dtype=np.float32)

    def add(  # type: ignore[override]
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        actions: np.ndarray,
        rewards: np.ndarray,
        terminations: np.ndarray,
        present: np.ndarray | None = None,
    ) -> None:
        """Store one step of all environments; every array is ``(n_clients, n_envs_per_client, ...)``.

        :param present: ``(n_clients,)`` bool, clients that took the step; all if ``None``
        """
        clients = np.arange(self.n_clients) if present is None else np.flatnonzero(present)
        for copy in range(self.n_envs_per_client):
            rows = (self.positions[clients], clients)
            self.observations[rows] = obs[clients, copy]
            self.next_observations[rows] = next_obs[clients, copy]
            self.actions[rows] = actions[clients, copy]
            self.rewards[rows] = rewards[clients, copy]
            self.terminations[rows] = terminations[clients, copy]
            self.positions[clients] = (self.positions[clients] + 1) % self.buffer_size
            self.sizes[clients] = np.minimum(self.sizes[clients] + 1, self.buffer_size)

    def size(self) -> int:
        """Transitions of the client that holds the fewest."""
        return int(self.sizes.min())

    def reset(self) -> None:
        """Forget all transitions."""
        self.sizes[:], self.positions[:] = 0, 0

    def save_state(self) -> State:
        """The stored transitions, and the positions of the next ones."""
        transitions = [
            {name: getattr(self, name)[:size, client].copy() for name in _ARRAYS} for client, size in enumerate(self.sizes)
        ]
        return {"sizes": self.sizes.copy(), "positions": self.positions.copy(), "transitions": transitions}

    def load_state(self, state: State) -> None:
        """Take the transitions of :meth:`save_state`.

        :raises ValueError: if they do not fit, such as those of a larger buffer
        """
        for client, transitions in enumerate(state["transitions"]):
            for name in _ARRAYS:
                array, own = transitions[name], getattr(self, name)
                if len(array) > self.buffer_size or array.shape[1:] != own.shape[2:]:
                    raise ValueError(f"{name} of shape {array.shape} do not fit into a replay buffer of shape {own.shape}")
                own[: len(array), client] = array
        self.sizes[:], self.positions[:] = state["sizes"], state["positions"]

    def sample(  # type: ignore[override]
        self, batch_size: int, streams: Iterable[tuple[int, np.random.Generator]], normalizer: FederatedNormalizer
    ) -> FederatedReplaySamples:
        """Transitions drawn with replacement, ``batch_size`` per client.

        :param streams: position and generator of each client that samples; the samples of the others are arbitrary
        :param normalizer: normalises with its current statistics, not with those at the time of storing
        """
        index = np.zeros((self.n_clients, batch_size), dtype=int)
        for position, rng in streams:
            index[position] = rng.integers(0, self.sizes[position], batch_size)
        client = np.arange(self.n_clients)[:, None]
        rewards = self.rewards[index, client]
        if normalizer.norm_reward:
            scaled = rewards / normalizer.reward_std[:, None]
            rewards = np.clip(scaled, -normalizer.CLIP, normalizer.CLIP).astype(np.float32)
        arrays = (
            normalizer.normalize_obs(self.observations[index, client]),
            self.actions[index, client],
            normalizer.normalize_obs(self.next_observations[index, client]),
            self.terminations[index, client],
            rewards,
        )
        return FederatedReplaySamples(*(th.as_tensor(array, device=self.device) for array in arrays))
