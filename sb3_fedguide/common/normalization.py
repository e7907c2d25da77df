"""Running normalisation of observations and rewards: ``VecNormalize``'s semantics, with statistics per client.

The statistics are private to their client, unless those of observations are shared: then each client uploads its round's
moments, and the server sends the moments of all clients' observations. They are part of the model, not of an environment
wrapper, so that ``predict``, ``save`` and ``client(k)`` take raw observations, and priors and DICE values see them raw.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch as th

from sb3_fedguide.server.payload import OBSERVATION_COUNT, OBSERVATION_MEAN, OBSERVATION_VAR, Payload
from sb3_fedguide.settings.arguments import Normalize as Normalize


class RunningMoments:
    """Mean and variance of a stream per client, updated batch by batch (Chan's parallel formula, as in SB3).

    :param n_clients: leading dimension of every array
    :param shape: shape of one sample
    """

    def __init__(self, n_clients: int, shape: tuple[int, ...], epsilon: float = 1e-4) -> None:
        self.mean = np.zeros((n_clients, *shape))
        self.var = np.ones((n_clients, *shape))
        self.count = np.full((n_clients, *([1] * len(shape))), epsilon)

    def update(self, batch: np.ndarray, present: np.ndarray | None = None) -> None:
        """:param batch: ``(n_clients, n_samples, *shape)``
        :param present: ``(n_clients,)`` bool, clients to update; all if ``None``
        """
        if present is not None:
            before = {name: getattr(self, name)[~present].copy() for name in ("mean", "var", "count")}
            self.update(batch)
            for name, rows in before.items():
                getattr(self, name)[~present] = rows
        elif batch.shape[1] == 1:  # the usual case in a rollout: the batch is its own mean
            self._merge(batch[:, 0], 0.0, 1)
        else:
            self._merge(batch.mean(axis=1), batch.var(axis=1), batch.shape[1])

    def _merge(self, mean: np.ndarray, var: np.ndarray | float, count: int) -> None:
        delta = mean - self.mean
        total = self.count + count
        self.mean += delta * (count / total)
        m2 = self.var * self.count + var * count + np.square(delta) * (self.count * count / total)
        self.var = m2 / total
        self.count = total


class FederatedNormalizer:
    """Per-client normalisation with the defaults of ``VecNormalize``.

    :param n_clients: clients in lockstep
    :param n_envs_per_client: environments of each
    :param obs_dim: observation size
    :param gamma: discount of the running return whose standard deviation scales rewards
    :param norm_obs: normalise observations
    :param norm_reward: normalise rewards
    :param shared: also keep the moments of each round's observations separately, for the server
    """

    CLIP = 10.0
    EPSILON = 1e-8

    def __init__(
        self,
        n_clients: int,
        n_envs_per_client: int,
        obs_dim: int,
        gamma: float,
        norm_obs: bool = True,
        norm_reward: bool = True,
        shared: bool = False,
    ) -> None:
        self.gamma, self.norm_obs, self.norm_reward, self.shared = gamma, norm_obs, norm_reward, shared
        self.obs = RunningMoments(n_clients, (obs_dim,))
        #: of the observations since :meth:`begin_round`
        self.round_obs = RunningMoments(n_clients, (obs_dim,), epsilon=0.0)
        self.ret = RunningMoments(n_clients, ())
        self.returns = np.zeros((n_clients, n_envs_per_client))

    def update_obs(self, obs: np.ndarray, present: np.ndarray | None = None) -> None:
        """:param obs: raw, ``(n_clients, n_envs_per_client, obs_dim)``
        :param present: ``(n_clients,)`` bool, clients to update; all if ``None``
        """
        if self.norm_obs:
            self.obs.update(obs, present)
            if self.shared:
                self.round_obs.update(obs.astype(np.float64), present)

    def begin_round(self, present: np.ndarray) -> None:
        """Forget the last round's moments of the clients ``present``, ``(n_clients,)`` bool: they are uploaded, or lost."""
        for array in (self.round_obs.mean, self.round_obs.var, self.round_obs.count):
            array[present] = 0.0

    def round_moments(self, index: int) -> Payload:
        """Client ``index``'s upload of its round's moments; empty if statistics are not shared."""
        if not self.shared:
            return {}
        moments = self.round_obs
        return {
            OBSERVATION_COUNT: moments.count[index, 0].copy(),
            OBSERVATION_MEAN: moments.mean[index].copy(),
            OBSERVATION_VAR: moments.var[index].copy(),
        }

    def receive(self, index: int, broadcast: Payload) -> None:
        """Take the observation statistics of all clients, if ``broadcast`` holds them."""
        if OBSERVATION_COUNT in broadcast:
            self.obs.count[index] = broadcast[OBSERVATION_COUNT]
            self.obs.mean[index], self.obs.var[index] = broadcast[OBSERVATION_MEAN], broadcast[OBSERVATION_VAR]

    def normalize_obs(self, obs: np.ndarray, index: int | None = None) -> np.ndarray:
        """Normalised float32 observations.

        :param obs: ``(n_clients, batch, obs_dim)``, or ``(..., obs_dim)`` of the client at position ``index``
        """
        if not self.norm_obs:
            return obs.astype(np.float32, copy=False)
        if index is None:
            mean, var = self.obs.mean[:, None], self.obs.var[:, None]
        else:
            mean, var = self.obs.mean[index], self.obs.var[index]
        scaled = (obs - mean) / np.sqrt(var + self.EPSILON)
        return np.clip(scaled, -self.CLIP, self.CLIP).astype(np.float32)

    def scale_reward(self, rewards: np.ndarray, dones: np.ndarray, present: np.ndarray | None = None) -> np.ndarray:
        """Update the statistics by one step's rewards and scale these; both ``(n_clients, n_envs_per_client)``.

        :param present: ``(n_clients,)`` bool, clients that took the step; all if ``None``
        """
        if not self.norm_reward:
            return rewards
        returns = self.returns * self.gamma + rewards
        self.returns = returns if present is None else np.where(present[:, None], returns, self.returns)
        self.ret.update(self.returns, present)
        scaled = np.clip(rewards / self.reward_std[:, None], -self.CLIP, self.CLIP)
        self.returns[dones] = 0.0
        return scaled

    @property
    def reward_std(self) -> np.ndarray:
        """The divisor of rewards, ``(n_clients,)``; ones if rewards are not normalised."""
        return np.sqrt(self.ret.var + self.EPSILON) if self.norm_reward else np.ones_like(self.ret.var)

    def reset_returns(self, n_envs_per_client: int | None = None) -> None:
        """Forget the running returns: the environments have been reset, or are ``n_envs_per_client`` new ones."""
        self.returns = np.zeros((len(self.returns), n_envs_per_client or self.returns.shape[1]))

    def warm_start(self, index: int, mean: np.ndarray, var: np.ndarray, count: int) -> None:
        """Start client ``index``'s observation statistics from its own offline data."""
        for moments in (self.obs, self.round_obs):
            moments.mean[index], moments.var[index], moments.count[index] = mean, var, count

    def _arrays(self) -> dict[str, tuple[object, str]]:
        kinds = ("obs", "ret", "round_obs") if self.shared else ("obs", "ret")
        named = {f"{kind}.{name}": (getattr(self, kind), name) for kind in kinds for name in ("mean", "var", "count")}
        return {**named, "returns": (self, "returns")}

    def state_dict(self) -> dict[str, th.Tensor]:
        """Copies of all statistics as tensors, for SB3's ``save``."""
        return {name: th.as_tensor(getattr(owner, key).copy()) for name, (owner, key) in self._arrays().items()}

    def load_state_dict(self, state: Mapping[str, th.Tensor], strict: bool = True) -> None:
        """:raises KeyError: if ``strict`` and an entry is missing"""
        for name, (owner, key) in self._arrays().items():
            if name == "returns" and name in state and state[name].shape != self.returns.shape:
                continue  # loaded for another number of environments: they begin new episodes
            if strict or name in state:
                setattr(owner, key, state[name].numpy().copy())
