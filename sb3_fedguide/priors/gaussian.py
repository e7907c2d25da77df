"""A Gaussian prior in closed form, for tasks whose actions do not depend on the observation (Bandit2D)."""

from __future__ import annotations

import math

import numpy as np
import torch as th

from sb3_fedguide.priors.base import HeadStatistics, Prior


class GaussianPrior(Prior):
    """``N(mu, Lambda^-1)`` for every observation, in natural parameters: features ``a``, head ``[-Lambda, Lambda mu]``.

    ``head @ [a; 1] = -Lambda (a - mu)`` is the score, so averaging heads averages scores exactly and gives a Gaussian again.

    :param obs_dim: length of an observation (ignored otherwise)
    :param action_dim: length of an action
    :param min_std: floor under the standard deviation of a fitted prior in every direction
    """

    def __init__(self, obs_dim: int, action_dim: int, min_std: float = 0.02) -> None:
        super().__init__(obs_dim, action_dim, n_features=action_dim)
        if not min_std > 0.0:
            raise ValueError(f"min_std must be positive, got {min_std}.")
        self.min_std = float(min_std)

    def head_statistics(
        self,
        obs: np.ndarray,
        actions: np.ndarray,
        rng: np.random.Generator,
        weights: np.ndarray | None = None,
        n_draws: int | None = None,
    ) -> HeadStatistics:
        """Weighted moments of the actions; nothing is random here, ``rng`` and ``n_draws`` are not used."""
        _, actions, weights = self.check_data(obs, actions, weights)
        features = _with_one(actions)
        gram = (features * weights[:, None]).T @ features
        return HeadStatistics(gram, np.zeros((self.n_features + 1, self.action_dim)), float(weights.sum()))

    def solve_head(self, statistics: HeadStatistics) -> np.ndarray:
        """Natural parameters of the weighted mean and covariance, the latter with its floor."""
        self._check_statistics(statistics)
        moment = statistics.gram / statistics.weight
        mean = moment[:-1, -1]
        values, vectors = np.linalg.eigh(moment[:-1, :-1] - np.outer(mean, mean))
        precision = (vectors / np.maximum(values, self.min_std**2)) @ vectors.T
        return np.column_stack([-precision, precision @ mean]).astype(np.float32)

    def feature_moment(self, obs: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """``E[[a; 1][a; 1]^T]``: the head's output is the score itself."""
        _, actions, _ = self.check_data(obs, actions, None)
        features = _with_one(actions)
        return features.T @ features / len(features)

    def mean_and_covariance(self, head: np.ndarray | th.Tensor) -> tuple[np.ndarray, np.ndarray]:
        """Mean ``(action_dim,)`` and covariance ``(action_dim, action_dim)`` of a head, float64.

        :raises ValueError: when the head's precision is not positive definite, so that it describes no Gaussian
        """
        heads, single = self._check_heads(head)
        if not single:
            raise ValueError("mean_and_covariance takes one head; loop over several.")
        return self._moments(heads[0])

    def describes_density(self, heads: np.ndarray | th.Tensor) -> np.ndarray:
        """Those whose precision is positive definite."""
        return np.linalg.eigvalsh(_precision(np.asarray(heads, dtype=np.float64))).min(axis=1) > 0.0

    def log_prob(
        self, head: np.ndarray | th.Tensor, obs: th.Tensor, actions: th.Tensor, n_steps: int | None = None
    ) -> th.Tensor:
        """Exact; ``n_steps`` is not used."""
        heads, single = self._check_heads(head)
        obs, actions = self._check_batch(obs, actions)
        x = actions.double().numpy()
        rows = []
        for expert in heads:
            mean, covariance = self._moments(expert)
            cholesky = np.linalg.cholesky(covariance)
            whitened = np.linalg.solve(cholesky, (x - mean).T)
            log_norm = np.log(np.diag(cholesky)).sum() + 0.5 * self.action_dim * math.log(2.0 * math.pi)
            rows.append(th.as_tensor(-0.5 * (whitened**2).sum(axis=0) - log_norm, dtype=th.float32))
        return rows[0] if single else th.stack(rows)

    def sample(
        self,
        head: np.ndarray | th.Tensor,
        obs: th.Tensor,
        rng: np.random.Generator,
        assignment: np.ndarray | None = None,
        n_steps: int | None = None,
    ) -> th.Tensor:
        """Exact; ``n_steps`` is not used."""
        heads, _ = self._check_heads(head)
        batch = len(obs)
        assignment = self._check_assignment(assignment, len(heads), batch)
        noise = rng.standard_normal((batch, self.action_dim))
        actions = np.empty_like(noise)
        for m in np.unique(assignment):
            mean, covariance = self._moments(heads[m])
            rows = assignment == m
            actions[rows] = mean + noise[rows] @ np.linalg.cholesky(covariance).T
        return th.as_tensor(actions, dtype=th.float32)

    def _moments(self, head: th.Tensor) -> tuple[np.ndarray, np.ndarray]:
        values = head.double().cpu().numpy()
        precision = _precision(values)
        smallest = np.linalg.eigvalsh(precision).min()
        if smallest <= 0.0:
            raise ValueError(
                f"This head is no Gaussian: its precision has the eigenvalue {smallest:.3g} <= 0. Heads must be convex "
                "combinations of heads from fit_head; a jittered copy needs less jitter."
            )
        covariance = np.linalg.inv(precision)
        return covariance @ values[:, -1], 0.5 * (covariance + covariance.T)


def _precision(heads: np.ndarray) -> np.ndarray:
    """Symmetrised precision of one head or of several, ``(..., action_dim, action_dim)``."""
    matrix = heads[..., :-1]
    return -0.5 * (matrix + np.swapaxes(matrix, -1, -2))


def _with_one(actions: np.ndarray) -> np.ndarray:
    return np.column_stack([actions.astype(np.float64), np.ones(len(actions))])
