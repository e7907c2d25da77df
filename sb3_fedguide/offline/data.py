"""One client's offline data as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sb3_fedguide.offline.cache import arrays_hash

__all__ = ["OfflineData", "normalize_observations"]

_FIELDS = {"observations": 2, "actions": 2, "rewards": 1, "next_observations": 2, "terminations": 1}


@dataclass(frozen=True, eq=False)
class OfflineData:
    """Transitions of one client, in the order in which they happened.

    :param observations: raw, float32, ``(n, obs_dim)``
    :param actions: as executed, float32, ``(n, action_dim)``
    :param rewards: in the environment's own scale, float32, ``(n,)``
    :param next_observations: float32, ``(n, obs_dim)``; the final observation where an episode ends
    :param terminations: bool, ``(n,)``; a time limit is not a termination
    :param truncations: bool, ``(n,)``, where a time limit or the end of the record cut an episode; ``None`` if the
        observations tell: a row that does not lead to the next one is its episode's last
    :raises ValueError: for arrays that do not fit together, are empty or not finite
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    next_observations: np.ndarray
    terminations: np.ndarray
    truncations: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name, n_dims in _FIELDS.items():
            dtype = np.bool_ if name == "terminations" else np.float32
            array: np.ndarray = np.ascontiguousarray(getattr(self, name), dtype=dtype)
            if array.ndim != n_dims:
                raise ValueError(f"offline data: {name} needs {n_dims} dimension(s), got shape {array.shape}")
            if not np.isfinite(array).all():
                wrong = ~np.isfinite(array).reshape(len(array), -1).all(axis=1)
                raise ValueError(
                    f"offline data: {name} has non-finite entries in {wrong.sum()} of {len(array)} rows, first in row "
                    f"{wrong.argmax()}: leave these episodes out"
                )
            object.__setattr__(self, name, array)
        shapes = {name: getattr(self, name).shape for name in _FIELDS}
        if len({shape[0] for shape in shapes.values()}) != 1 or len(self) == 0:
            raise ValueError(f"offline data: every array needs the same number of rows, at least one; got {shapes}")
        if self.observations.shape != self.next_observations.shape:
            raise ValueError(f"offline data: observations and next_observations differ in shape: {shapes}")
        if self.truncations is not None:
            cut = np.ascontiguousarray(self.truncations, dtype=bool)
            if cut.shape != (len(self),):
                raise ValueError(f"offline data: truncations need shape {(len(self),)}, got {cut.shape}")
            # Truncations that follow from the observations are not kept, so that the same data have the same hash.
            object.__setattr__(self, "truncations", cut if (cut & ~self._seen_ends()).any() else None)

    def __len__(self) -> int:
        return len(self.rewards)

    @cached_property
    def episode_ends(self) -> np.ndarray:
        """Bool ``(n,)``: the row is the last of its episode, by termination, time limit or end of the record."""
        return self._seen_ends() if self.truncations is None else self._seen_ends() | self.truncations

    def _seen_ends(self) -> np.ndarray:
        ends = self.terminations.copy()
        ends[:-1] |= (self.next_observations[:-1] != self.observations[1:]).any(axis=1)
        ends[-1] = True
        return ends

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 of the arrays; results of the data are cached under it."""
        return arrays_hash(self.arrays())

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by name; truncations only if they do not follow from the observations."""
        arrays = {name: getattr(self, name) for name in _FIELDS}
        return arrays if self.truncations is None else {**arrays, "truncations": self.truncations}

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance of the observations, float64, ``(obs_dim,)`` each."""
        observations = self.observations.astype(np.float64)
        return observations.mean(axis=0), observations.var(axis=0)

    def discounted_returns(self, gamma: float, bootstrap: np.ndarray | None = None) -> np.ndarray:
        """Return-to-go of every row, float64, ``(n,)``.

        :param bootstrap: values ``(n,)`` of ``next_observations``, used if an episode was cut by a time limit or the
            end of the record; by default the infinite-horizon return of the data's mean reward
        """
        if bootstrap is None:
            bootstrap = np.full(len(self), self.rewards.mean(dtype=np.float64) / (1.0 - gamma))
        rewards = self.rewards.astype(np.float64)
        returns = np.empty(len(self))
        following = 0.0
        for row in range(len(self) - 1, -1, -1):
            if self.episode_ends[row]:
                following = 0.0 if self.terminations[row] else float(bootstrap[row])
            following = returns[row] = rewards[row] + gamma * following
        return returns


def normalize_observations(
    observations: np.ndarray, mean: np.ndarray, var: np.ndarray, clip: float = 10.0, epsilon: float = 1e-8
) -> np.ndarray:
    """``VecNormalize``'s observation transform, float32, same shape as ``observations``."""
    scaled = (observations.astype(np.float64) - mean) / np.sqrt(var + epsilon)
    return np.clip(scaled, -clip, clip).astype(np.float32)
