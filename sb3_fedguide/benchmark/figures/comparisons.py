"""Comparisons of methods over several families.

Reference: R. Agarwal et al., Deep reinforcement learning at the edge of the statistical precipice, NeurIPS 2021. M families
are its tasks, and N seeds its runs. Intervals are of 95 %, by bootstrap samples of the runs within their family (stratified).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_fedguide.benchmark.bootstrap import RESAMPLES, percentile_interval, resample

Interval = tuple[np.ndarray, np.ndarray]
#: A profile's band is taken over fewer samples: it has a value at each of its levels.
PROFILE_RESAMPLES = 2_000


def performance_profile(groups: Sequence[np.ndarray], levels: np.ndarray) -> np.ndarray:
    """Share of runs with a score above each level, its run-score distribution: ``1/M sum_m 1/N sum_n 1[x_mn > tau]``.

    :param groups: scores, one array ``(..., n_runs)`` per family; families weigh the same
    :param levels: ``tau``, ``(n_levels,)``
    :return: ``(..., n_levels)``
    """
    return np.mean([(group[..., None, :] > levels[:, None]).mean(axis=-1) for group in groups], axis=0)


def profile_band(groups: Sequence[np.ndarray], levels: np.ndarray, seed: int = 0) -> Interval:
    """Pointwise interval of :func:`performance_profile`, two arrays ``(n_levels,)``."""
    samples = resample(groups, PROFILE_RESAMPLES, seed)
    profiles = np.stack([performance_profile(samples, levels[k : k + 1])[:, 0] for k in range(len(levels))], axis=-1)
    return percentile_interval(profiles)


def probability_of_improvement(ours: Sequence[np.ndarray], theirs: Sequence[np.ndarray]) -> np.ndarray:
    """``P(X > Y)``, the mean over families of ``1/(N K) sum_i sum_j S(x_i, y_j)``.

    ``S`` is 1 where ``x > y``, 1/2 where they are equal, and otherwise 0: the Mann-Whitney statistic.

    :param ours: scores or returns, one array ``(..., n_runs)`` per family; both have the same families
    """
    each = []
    for x, y in zip(ours, theirs, strict=True):
        pairs = x[..., :, None], y[..., None, :]
        each.append(((pairs[0] > pairs[1]) + 0.5 * (pairs[0] == pairs[1])).mean(axis=(-2, -1)))
    return np.mean(each, axis=0)


def improvement_interval(
    ours: Sequence[np.ndarray], theirs: Sequence[np.ndarray], n_resamples: int = RESAMPLES, seed: int = 0
) -> tuple[float, float]:
    """Interval of :func:`probability_of_improvement`; the runs of both are resampled."""
    samples = resample([*ours, *theirs], n_resamples, seed)
    values = probability_of_improvement(samples[: len(ours)], samples[len(ours) :])
    low, high = percentile_interval(values)
    return float(low), float(high)
