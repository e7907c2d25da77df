"""Bootstrap samples of runs, and percentile intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

#: Resamples of an interval.
RESAMPLES = 10_000


def resample(groups: Sequence[np.ndarray], n_resamples: int = RESAMPLES, seed: int = 0) -> list[np.ndarray]:
    """Bootstrap samples, stratified: each group's runs are drawn from its own.

    :param groups: one array ``(n_runs,)`` per group, such as a family
    :return: one array ``(n_resamples, n_runs)`` per group
    """
    rng = np.random.default_rng(seed)
    return [group[rng.integers(0, len(group), (n_resamples, len(group)))] for group in groups]


def percentile_interval(samples: np.ndarray, confidence: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """The middle ``confidence`` of ``samples``, ``(n_resamples, ...)``: lower and upper end, ``(...)`` each."""
    low, high = np.quantile(samples, [(1 - confidence) / 2, (1 + confidence) / 2], axis=0)
    return low, high


def mean_interval(values: np.ndarray, confidence: float = 0.95, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Percentile bootstrap interval of the mean over runs.

    :param values: ``(n_runs, ...)``
    :return: lower and upper end, ``(...)`` each
    """
    n_runs = len(values)
    (drawn,) = resample([np.arange(n_runs)], seed=seed)
    counts = np.stack([(drawn == run).sum(axis=1) for run in range(n_runs)], axis=1)
    return percentile_interval(np.tensordot(counts / n_runs, values, axes=1), confidence)
