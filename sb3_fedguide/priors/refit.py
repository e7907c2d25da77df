"""Refit of a client's prior head on its offline data and on what it has recently done well."""

from __future__ import annotations

import numpy as np

from sb3_fedguide.priors.base import HeadStatistics, Prior

#: Rows of a rollout that enter a refit, and noise draws of each: enough for a few hundred coefficients.
ROWS, DRAWS = 1024, 8
#: Bound on the weights exp(A / temperature), relative to their mean over the rollout.
MAX_WEIGHT = 20.0
#: How much of the earlier rollouts' statistics is kept from round to round.
MEMORY = 0.8


def refit_head(
    prior: Prior,
    offline: HeadStatistics,
    recent: HeadStatistics,
    weight: float,
    temperature: float,
    obs: np.ndarray,
    actions: np.ndarray,
    advantages: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, HeadStatistics]:
    """A client's new head in closed form, by weighted ridge regression, and the statistics of its recent rollouts.

    :param offline: statistics of its offline data, of weight one
    :param recent: of its earlier rollouts; zeros for none
    :param weight: share of the recent rollouts, in [0, 1]; 0 keeps the offline head
    :param temperature: of ``exp(A / temperature)``, in standard deviations of the advantage
    :param obs: the rollout's raw observations ``(n, obs_dim)``
    :param actions: executed actions ``(n, action_dim)``
    :param advantages: ``(n,)``, in any scale
    """
    weights = np.exp(np.clip((advantages - advantages.mean()) / (advantages.std() + 1e-8) / temperature, -20, 20))
    weights = np.minimum(weights / weights.mean(), MAX_WEIGHT)
    chosen = np.sort(rng.choice(len(obs), min(ROWS, len(obs)), replace=False))
    recent = recent * MEMORY + prior.head_statistics(obs[chosen], actions[chosen], rng, weights[chosen], n_draws=DRAWS)
    return prior.solve_head(offline * (1 - weight) + recent * (weight / recent.weight)), recent
