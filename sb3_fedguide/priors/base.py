"""The base class of action priors: features, a linear head, and the distance between two heads.

A prior's (scaled) score is linear in its head, ``head @ [features; 1]``. So averaging heads averages scores, and the squared
distance between two clients' scores is a quadratic form in the difference of their heads.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch as th
from torch import nn


@dataclass(frozen=True)
class HeadStatistics:
    """Sufficient statistics of a head: the normal equations of its least-squares problem, in float64.

    They add up over data sets and scale with the weight of the data, so "offline data plus decayed recent rollouts" is
    ``offline + 0.5 * recent`` followed by one :meth:`Prior.solve_head`.

    :param gram: ``sum_t w_t f_t f_t^T`` with ``f = [features; 1]``, shape ``(p + 1, p + 1)``
    :param cross: ``sum_t w_t f_t y_t^T`` with the regression targets ``y``, shape ``(p + 1, action_dim)``
    :param weight: ``sum_t w_t``; a row counts once, however many noise levels it was drawn at
    """

    gram: np.ndarray
    cross: np.ndarray
    weight: float

    def __add__(self, other: HeadStatistics) -> HeadStatistics:
        if self.gram.shape != other.gram.shape or self.cross.shape != other.cross.shape:
            raise ValueError(
                f"Head statistics of different priors cannot be added: gram {self.gram.shape} and {other.gram.shape}, "
                f"cross {self.cross.shape} and {other.cross.shape}. Compute both with the same prior."
            )
        return HeadStatistics(self.gram + other.gram, self.cross + other.cross, self.weight + other.weight)

    def __mul__(self, factor: float) -> HeadStatistics:
        if not (np.isfinite(factor) and factor >= 0.0):
            raise ValueError(f"Head statistics can only be scaled by a finite factor >= 0, got {factor}.")
        return HeadStatistics(self.gram * factor, self.cross * factor, self.weight * float(factor))

    __rmul__ = __mul__


class Prior(nn.Module, ABC):
    """A density over actions given an observation, with a linear head (the only part that a client uploads).

    Randomness always comes from the ``numpy.random.Generator`` that is passed in. Nothing here needs gradients.

    :param obs_dim: length of an observation
    :param action_dim: length of an action
    :param n_features: number ``p`` of features
    """

    def __init__(self, obs_dim: int, action_dim: int, n_features: int) -> None:
        super().__init__()
        self.obs_dim = int(obs_dim)
        self.action_dim = int(action_dim)
        self.n_features = int(n_features)

    @property
    def head_shape(self) -> tuple[int, int]:
        """Shape ``(action_dim, p + 1)`` of a head; the last column is the bias."""
        return (self.action_dim, self.n_features + 1)

    @abstractmethod
    def head_statistics(
        self,
        obs: np.ndarray,
        actions: np.ndarray,
        rng: np.random.Generator,
        weights: np.ndarray | None = None,
        n_draws: int | None = None,
    ) -> HeadStatistics:
        """The data's contribution to the head fit.

        :param obs: ``(n, obs_dim)``, raw
        :param actions: ``(n, action_dim)``
        :param weights: ``(n,)``, >= 0; default all one
        :param n_draws: noise draws per row, where the prior needs any
        :raises ValueError: for empty data, wrong shapes, non-finite values or weights that are negative or sum to zero
        """

    @abstractmethod
    def solve_head(self, statistics: HeadStatistics) -> np.ndarray:
        """The head that fits ``statistics`` best, float32, shape :attr:`head_shape`."""

    def fit_head(
        self, obs: np.ndarray, actions: np.ndarray, rng: np.random.Generator, weights: np.ndarray | None = None
    ) -> np.ndarray:
        """The head of one client's data in closed form: :meth:`solve_head` of :meth:`head_statistics`."""
        return self.solve_head(self.head_statistics(obs, actions, rng, weights))

    @abstractmethod
    def feature_moment(self, obs: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """``S = E[f f^T]`` of the score cost, with the factor from the head's output to a score: see :func:`score_cost`.

        :return: float64, ``(p + 1, p + 1)``. It never leaves the client.
        """

    def describes_density(self, heads: np.ndarray | th.Tensor) -> np.ndarray:
        """Whether each of the heads ``(n, action_dim, p + 1)`` gives a density, ``(n,)`` bool."""
        return np.ones(len(heads), dtype=bool)

    @abstractmethod
    def log_prob(
        self, head: np.ndarray | th.Tensor, obs: th.Tensor, actions: th.Tensor, n_steps: int | None = None
    ) -> th.Tensor:
        """Log-density of ``actions`` given raw ``obs``.

        :param head: one head ``(action_dim, p + 1)``, or several ``(n_experts, action_dim, p + 1)``
        :param obs: ``(batch, obs_dim)``
        :param actions: ``(batch, action_dim)``
        :param n_steps: integration steps, where the prior integrates
        :return: ``(batch,)``, or ``(n_experts, batch)`` for several heads
        """

    @abstractmethod
    def sample(
        self,
        head: np.ndarray | th.Tensor,
        obs: th.Tensor,
        rng: np.random.Generator,
        assignment: np.ndarray | None = None,
        n_steps: int | None = None,
    ) -> th.Tensor:
        """One action per observation.

        :param head: one head ``(action_dim, p + 1)``, or several ``(n_experts, action_dim, p + 1)``
        :param obs: ``(batch, obs_dim)``
        :param assignment: ``(batch,)`` integers: the head that each row is drawn from; needed with several heads
        :param n_steps: denoising steps, where the prior denoises
        :return: ``(batch, action_dim)``, not clipped
        """

    # Shared checks and conversions

    def check_data(
        self, obs: np.ndarray, actions: np.ndarray, weights: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The data as float32 and the weights as float64, or a ``ValueError`` that says what is wrong."""
        obs = np.asarray(obs, dtype=np.float32)
        actions = np.asarray(actions, dtype=np.float32)
        if obs.ndim != 2 or actions.ndim != 2 or obs.shape[1] != self.obs_dim or actions.shape[1] != self.action_dim:
            raise ValueError(
                f"The prior needs observations (n, {self.obs_dim}) and actions (n, {self.action_dim}), "
                f"got {obs.shape} and {actions.shape}."
            )
        if len(obs) != len(actions) or len(obs) == 0:
            raise ValueError(
                f"The prior needs as many observations as actions and at least one, got {len(obs)} and {len(actions)}."
            )
        if not (np.isfinite(obs).all() and np.isfinite(actions).all()):
            raise ValueError("Observations or actions are not finite; remove those rows before fitting a prior.")
        if weights is None:
            return obs, actions, np.ones(len(obs))
        weights = np.asarray(weights, dtype=np.float64)
        if weights.shape != (len(obs),):
            raise ValueError(f"Weights need shape ({len(obs)},), got {weights.shape}.")
        if not np.isfinite(weights).all() or (weights < 0.0).any() or weights.sum() <= 0.0:
            raise ValueError("Weights must be finite and >= 0, and at least one must be positive.")
        return obs, actions, weights

    def _check_statistics(self, statistics: HeadStatistics) -> None:
        size = self.n_features + 1
        if statistics.gram.shape != (size, size) or statistics.cross.shape != (size, self.action_dim):
            raise ValueError(
                f"These head statistics belong to another prior: gram {statistics.gram.shape} and cross "
                f"{statistics.cross.shape}, but this one needs {(size, size)} and {(size, self.action_dim)}."
            )
        if not statistics.weight > 0.0:
            raise ValueError(f"Head statistics of total weight {statistics.weight} determine no head; add data to them.")

    def _check_heads(self, head: np.ndarray | th.Tensor) -> tuple[th.Tensor, bool]:
        """Heads as a float32 tensor ``(n_experts, action_dim, p + 1)``, and whether only one was given."""
        heads = th.as_tensor(head, dtype=th.float32)
        single = heads.dim() == 2
        if single:
            heads = heads.unsqueeze(0)
        if heads.dim() != 3 or tuple(heads.shape[1:]) != self.head_shape:
            raise ValueError(f"A head of this prior has shape {self.head_shape}, got {tuple(heads.shape[1:])}.")
        if not bool(th.isfinite(heads).all()):
            raise ValueError("A head contains values that are not finite.")
        return heads, single

    def _check_batch(self, obs: np.ndarray | th.Tensor, actions: np.ndarray | th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        obs = th.as_tensor(obs, dtype=th.float32)
        actions = th.as_tensor(actions, dtype=th.float32)
        if tuple(obs.shape[1:]) != (self.obs_dim,) or tuple(actions.shape) != (len(obs), self.action_dim):
            raise ValueError(
                f"Expected observations (batch, {self.obs_dim}) and actions (batch, {self.action_dim}), "
                f"got {tuple(obs.shape)} and {tuple(actions.shape)}."
            )
        return obs, actions

    def _check_assignment(self, assignment: np.ndarray | None, n_experts: int, batch: int) -> np.ndarray:
        if assignment is None:
            if n_experts != 1:
                raise ValueError(f"With {n_experts} heads, `assignment` must say which one each row is drawn from.")
            return np.zeros(batch, dtype=np.int64)
        assignment = np.asarray(assignment)
        if assignment.shape != (batch,) or not np.issubdtype(assignment.dtype, np.integer):
            raise ValueError(f"`assignment` needs {batch} integers, got {assignment.dtype} of shape {assignment.shape}.")
        if batch and (assignment.min() < 0 or assignment.max() >= n_experts):
            raise ValueError(f"`assignment` must lie in 0..{n_experts - 1}.")
        return assignment.astype(np.int64)


def score_cost(head: np.ndarray, experts: np.ndarray, moment: np.ndarray) -> np.ndarray:
    """A client's row of the transport cost, ``C_im = E_{D_i} |score_i - score_m|^2`` (paper, Eq. 7).

    With a common trunk it is ``tr(dW S_i dW^T)``, without error.

    :param head: the client's own head, ``(action_dim, p + 1)``
    :param experts: ``(n_experts, action_dim, p + 1)``
    :param moment: the client's :meth:`Prior.feature_moment`, ``(p + 1, p + 1)``
    :return: float64, ``(n_experts,)``
    :raises ValueError: when the shapes do not fit each other
    """
    head = np.asarray(head, dtype=np.float64)
    experts = np.asarray(experts, dtype=np.float64)
    moment = np.asarray(moment, dtype=np.float64)
    size = head.shape[-1]
    if head.ndim != 2 or experts.ndim != 3 or experts.shape[1:] != head.shape or moment.shape != (size, size):
        raise ValueError(
            f"score_cost needs a head (d, p + 1), experts (n_experts, d, p + 1) and a moment (p + 1, p + 1), "
            f"got {head.shape}, {experts.shape} and {moment.shape}."
        )
    difference = experts - head
    # A moment is positive semi-definite: values below zero are rounding errors.
    return np.maximum(np.einsum("mdp,pq,mdq->m", difference, moment, difference, optimize=True), 0.0)
