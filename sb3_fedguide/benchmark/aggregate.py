"""Methods over several families: normalised scores, their interquartile mean and its bootstrap interval.

Reference: R. Agarwal et al., Deep reinforcement learning at the edge of the statistical precipice, NeurIPS 2021.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces

from fed_envs import Family, FederatedVecEnv
from sb3_fedguide.benchmark.bootstrap import RESAMPLES, percentile_interval, resample
from sb3_fedguide.common.evaluation import Evaluation, evaluate_federation
from sb3_fedguide.seeding import EVALUATION_SEED, Role


@dataclass(frozen=True)
class Aggregate:
    """One method over all families.

    :param iqm: interquartile mean of the normalised scores
    :param interval: 95 % bootstrap interval; ``None`` if no family has two runs, so that nothing can be resampled
    :param scores: normalised mean score of each family
    """

    method: str
    n_runs: int
    iqm: float
    interval: tuple[float, float] | None
    scores: Mapping[str, float]


def aggregate(method: str, finals: Mapping[str, Sequence[float]], levels: Mapping[str, tuple[float, float]]) -> Aggregate:
    """One method's aggregate.

    :param finals: family to F of each run
    :param levels: family to the returns that score 0 and 1
    :raises ValueError: if the second of a family's levels is not above the first
    """
    groups = [normalise(np.asarray(values, dtype=float), *levels[family]) for family, values in finals.items()]
    resampled = any(len(group) > 1 for group in groups)
    return Aggregate(
        method=method,
        n_runs=sum(map(len, groups)),
        iqm=float(interquartile_mean(groups)),
        interval=bootstrap_interval(groups) if resampled else None,
        scores={family: float(group.mean()) for family, group in zip(finals, groups, strict=True)},
    )


def normalise(returns: np.ndarray, low: float, high: float) -> np.ndarray:
    """Scores: 0 at ``low``, 1 at ``high``, linear, not clipped.

    :raises ValueError: unless ``low < high``
    """
    if not low < high:
        raise ValueError(f"the level that scores 1, {high:.4g}, is not above the one that scores 0, {low:.4g}")
    return (returns - low) / (high - low)


def interquartile_mean(groups: Sequence[np.ndarray]) -> np.ndarray:
    """Mean of the pooled scores' quantile function between 1/4 and 3/4, every family weighing the same.

    With as many runs in each family and a number of runs that four divides, it is the mean of the middle half, as with
    ``scipy.stats.trim_mean(scores, 0.25)``; otherwise runs at the quartiles count in part instead of wholly.

    :param groups: one array ``(..., n_runs)`` per family
    :return: ``(...)``
    """
    scores = np.concatenate(groups, axis=-1)
    weights = np.concatenate([np.full(group.shape[-1], 1 / (len(groups) * group.shape[-1])) for group in groups])
    order = np.argsort(scores, axis=-1)
    upper = np.cumsum(weights[order], axis=-1)
    inside = np.clip(np.minimum(upper, 0.75) - np.maximum(upper - weights[order], 0.25), 0, None)
    return (inside * np.take_along_axis(scores, order, axis=-1)).sum(axis=-1) / inside.sum(axis=-1)


def bootstrap_interval(
    groups: Sequence[np.ndarray], n_resamples: int = RESAMPLES, confidence: float = 0.95, seed: int = 0
) -> tuple[float, float]:
    """Percentile interval of the interquartile mean; runs are resampled within their family (stratified).

    :param groups: one array ``(n_runs,)`` per family
    """
    low, high = percentile_interval(interquartile_mean(resample(groups, n_resamples, seed)), confidence)
    return float(low), float(high)


def random_actions(family: Family, n_episodes: int = 10) -> Evaluation:
    """What actions drawn uniformly from the action space return: the level that scores 0."""
    env = FederatedVecEnv(family, n_episodes, role=Role.EVAL_ENV)
    rng = np.random.default_rng(EVALUATION_SEED)
    space = env.action_space
    space.seed(EVALUATION_SEED)

    def draw(obs: np.ndarray) -> np.ndarray:
        if isinstance(space, spaces.Box):
            return rng.uniform(space.low, space.high, (len(obs), *space.shape)).astype(np.float32)
        return np.array([space.sample() for _ in obs])

    try:
        return evaluate_federation(draw, env)
    finally:
        env.close()
