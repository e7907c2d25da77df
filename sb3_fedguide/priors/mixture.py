"""A client's personal prior: the mixture of the experts' densities with its row of the transport plan as weights."""

from __future__ import annotations

import numpy as np
import torch as th

from sb3_fedguide.priors.base import Prior

MIN_WEIGHT = 1e-3


def mixture_log_prob(
    prior: Prior,
    experts: np.ndarray | th.Tensor,
    row: np.ndarray,
    obs: th.Tensor,
    actions: th.Tensor,
    min_weight: float = MIN_WEIGHT,
    n_steps: int | None = None,
) -> th.Tensor:
    """``log sum_m R_m p_m(a|s)`` of one client (paper, Eq. 10).

    :param experts: heads, ``(n_experts, action_dim, p + 1)``
    :param row: the client's weights ``R_i``, ``(n_experts,)``, summing to one
    :param obs: ``(batch, obs_dim)``, raw
    :param actions: ``(batch, action_dim)``
    :param min_weight: experts with less weight are left out and the others renormalised (an expert costs a density evaluation)
    :param n_steps: integration steps per density; default the prior's
    :return: ``(batch,)``; far off the experts' support very negative, callers clip
    :raises ValueError: for a row that is no probability vector, or when no weight reaches ``min_weight``
    """
    active, weights = active_experts(row, len(experts), min_weight, prior.describes_density(experts))
    heads = th.as_tensor(experts, dtype=th.float32)[th.from_numpy(active)]
    log_probs = prior.log_prob(heads, obs, actions, n_steps)
    return th.logsumexp(log_probs + th.as_tensor(np.log(weights), dtype=th.float32).unsqueeze(1), dim=0)


def mixture_sample(
    prior: Prior,
    experts: np.ndarray | th.Tensor,
    row: np.ndarray,
    obs: th.Tensor,
    rng: np.random.Generator,
    min_weight: float = MIN_WEIGHT,
    n_steps: int | None = None,
) -> th.Tensor:
    """One action per observation from the density of :func:`mixture_log_prob`: ``m ~ Categorical(R_i)``, then expert ``m``.

    :return: ``(batch, action_dim)``, not clipped
    """
    active, weights = active_experts(row, len(experts), min_weight, prior.describes_density(experts))
    heads = th.as_tensor(experts, dtype=th.float32)[th.from_numpy(active)]
    assignment = rng.choice(len(active), size=len(obs), p=weights)
    return prior.sample(heads, obs, rng, assignment, n_steps)


def active_experts(
    row: np.ndarray, n_experts: int, min_weight: float = MIN_WEIGHT, usable: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the experts that a row uses, and their renormalised weights (float64).

    :param usable: ``(n_experts,)`` bool, which experts are densities: the server cannot check this, and a malicious client
        may have made one that is not; all if ``None``
    :raises ValueError: see :func:`mixture_log_prob`
    """
    row = np.asarray(row, dtype=np.float64)
    if row.shape != (n_experts,):
        raise ValueError(f"A row of mixture weights has one entry per expert, ({n_experts},), got {row.shape}.")
    if not np.isfinite(row).all() or (row < 0.0).any() or abs(row.sum() - 1.0) > 1e-3:
        raise ValueError(f"Mixture weights must be >= 0 and sum to one, got {row}.")
    if usable is not None:
        row = np.where(usable, row, 0.0)
    active = np.flatnonzero(row >= max(min_weight, np.finfo(np.float64).tiny))
    if len(active) == 0:
        raise ValueError(f"No mixture weight reaches min_weight={min_weight} (largest: {row.max():.3g}); lower it.")
    return active, row[active] / row[active].sum()
