"""Mean and variance of several clients' data together, from their moments alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sb3_fedguide.server.averaging import robust_mean
from sb3_fedguide.server.payload import OBSERVATION_COUNT, OBSERVATION_MEAN, OBSERVATION_VAR, Payload
from sb3_fedguide.server.strategy import Strategy
from sb3_fedguide.settings.arguments import Aggregator, AveragingArguments
from sb3_fedguide.settings.ranges import check_values
from sb3_fedguide.settings.signatures import types_of

#: Weight of mean 0 and variance 1 before anything is known, as in SB3's ``RunningMeanStd``.
START_COUNT = 1e-4


@dataclass(frozen=True)
class Moments:
    """Of ``count`` samples; mean and (population) variance by coordinate, float64."""

    count: float
    mean: np.ndarray
    var: np.ndarray


def merge(parts: Sequence[Moments]) -> Moments:
    """The moments of the union of the data, exact (Chan et al. 1979).

    :raises ValueError: for no parts
    """
    if not parts:
        raise ValueError("there are no moments to merge: at least one client has to give its own")
    count, mean, squares = parts[0].count, parts[0].mean, parts[0].var * parts[0].count
    for part in parts[1:]:
        total = count + part.count
        delta = part.mean - mean
        squares = squares + part.var * part.count + delta**2 * (count * part.count / total)
        mean = mean + delta * (part.count / total)
        count = total
    return Moments(count, mean, squares / count)


class ObservationMoments(Strategy):
    """Pools the clients' observation statistics: ``normalize="shared"``.

    A client uploads count, mean and variance of its last round's raw observations, and receives those of all observations
    that all clients have uploaded since the beginning. With the mean as aggregator they are exact, except for
    :data:`START_COUNT`, and do not depend on the order of the uploads. Before the first round one exchange pools the
    statistics of the clients' offline data.

    :param aggregator: how the mean and variance of a round are pooled: ``"mean"``, or coordinate by coordinate the median or
        trimmed mean of the clients' means, and of their mean squared distances from it
    :param trim_fraction: see :func:`~sb3_fedguide.server.averaging.combine`
    """

    def __init__(
        self, aggregator: Aggregator = AveragingArguments.aggregator, trim_fraction: float = AveragingArguments.trim_fraction
    ) -> None:
        super().__init__()
        check_values(types_of(AveragingArguments), locals())
        self.aggregator = aggregator
        self.trim_fraction = trim_fraction
        self.count = 0.0
        self.mean: np.ndarray | None = None
        self.var: np.ndarray | None = None

    @property
    def needs_setup(self) -> bool:
        return self.mean is None

    @property
    def norm_groups(self) -> tuple[str, ...]:
        return (OBSERVATION_COUNT, OBSERVATION_MEAN, OBSERVATION_VAR)

    def aggregate(self, round: int, uploads: Mapping[int, Payload]) -> dict[int, Payload]:
        self.metrics = {}
        if round > 0 or self.needs_setup:  # a method may need further exchanges before the first round
            self._pool([_moments(uploads[client]) for client in sorted(uploads)])
        return {client: self.latest(client) for client in uploads}

    def _pool(self, parts: list[Moments]) -> None:
        parts = [part for part in parts if part.count > 0]
        if not parts:
            return
        if self.aggregator == "mean":
            pooled = parts
        else:
            means, variances = np.stack([part.mean for part in parts]), np.stack([part.var for part in parts])
            mean = robust_mean(means, self.aggregator, self.trim_fraction)
            var = robust_mean(variances + (means - mean) ** 2, self.aggregator, self.trim_fraction)
            pooled = [Moments(sum(part.count for part in parts), mean, var)]
        if self.mean is None or self.var is None:
            start = Moments(START_COUNT, np.zeros_like(parts[0].mean), np.ones_like(parts[0].var))
        else:
            start = Moments(self.count, self.mean, self.var)
        pooled = [start, *pooled]
        merged = merge(pooled)
        self.count, self.mean, self.var = merged.count, merged.mean, merged.var

    def latest(self, client: int) -> Payload:
        if self.mean is None or self.var is None:
            return {}
        return {
            OBSERVATION_COUNT: np.array(self.count),
            OBSERVATION_MEAN: self.mean.copy(),
            OBSERVATION_VAR: self.var.copy(),
        }


def _moments(upload: Payload) -> Moments:
    return Moments(float(upload[OBSERVATION_COUNT]), upload[OBSERVATION_MEAN], upload[OBSERVATION_VAR])
