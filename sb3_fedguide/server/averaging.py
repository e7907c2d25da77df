"""Federated averaging of parameters (McMahan et al. 2017)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np

from sb3_fedguide.server.strategy import N_SAMPLES, Payload, Strategy

#: What can take the place of the average, see :func:`combine`.
Aggregator = Literal["mean", "median", "trimmed_mean"]
AGGREGATORS: tuple[Aggregator, ...] = get_args(Aggregator)


def weighted_average(uploads: Mapping[int, Payload], names: list[str]) -> Payload:
    """``sum_i n_i / n * theta_i`` for the arrays ``names``, accumulated in float64 in the order of client ids."""
    clients = sorted(uploads)
    counts = np.array([float(uploads[client][N_SAMPLES]) for client in clients])
    weights = counts / counts.sum()
    average = {}
    for name in names:
        total = np.zeros(uploads[clients[0]][name].shape)
        for client, weight in zip(clients, weights, strict=True):
            total += weight * uploads[client][name]
        average[name] = total.astype(np.float32)
    return average


def combine(
    uploads: Mapping[int, Payload],
    names: list[str],
    aggregator: Aggregator,
    trim_fraction: float,
) -> Payload:
    """The arrays ``names`` of all clients in one: their :func:`weighted_average`, or coordinate by coordinate their median or
    the mean of what is left without the ``floor(trim_fraction * n)`` lowest and as many of the highest (Yin et al. 2018).

    Median and trimmed mean count every client once, whatever number of samples it claims.
    """
    if aggregator == "mean":
        return weighted_average(uploads, names)
    combined = {}
    for name in names:
        ordered = np.sort(np.stack([uploads[client][name] for client in sorted(uploads)]).astype(np.float64), axis=0)
        n = len(ordered)
        cut = (n - 1) // 2 if aggregator == "median" else min(int(trim_fraction * n + 1e-9), (n - 1) // 2)
        combined[name] = ordered[cut : n - cut].mean(axis=0).astype(np.float32)
    return combined


def averaging_is_due(round: int, every: int, until: int | None = None) -> bool:
    """Whether parameters are averaged after round ``round``: after ``every``, ``2 * every``, ..., and not after ``until``."""
    return round > 0 and round % every == 0 and (until is None or round <= until)


AVERAGE_CHOICES = ("all", "actor", "critic")


def averaged_prefixes(average: str, actor: tuple[str, ...], critic: tuple[str, ...]) -> tuple[str, ...]:
    """How the names of the parameters begin that are averaged.

    :param average: one of :data:`AVERAGE_CHOICES`
    """
    return {"all": actor + critic, "actor": actor, "critic": critic}[average]


def check_averaging(average: str, average_every: int) -> None:
    """:raises ValueError: for an unknown choice, or a number of rounds below one"""
    if average not in AVERAGE_CHOICES:
        raise ValueError(f"average={average!r} must be one of {', '.join(AVERAGE_CHOICES)}")
    if average_every < 1:
        raise ValueError(f"average_every={average_every} must be at least 1 round")


def check_aggregator(aggregator: str, trim_fraction: float) -> None:
    """:raises ValueError: for an unknown aggregator, or a fraction that leaves nothing"""
    if aggregator not in AGGREGATORS:
        raise ValueError(f"aggregator={aggregator!r} must be one of {', '.join(AGGREGATORS)}")
    if not 0 <= trim_fraction < 0.5:
        raise ValueError(f"trim_fraction={trim_fraction} must lie in [0, 0.5): so much is left out on either side")


class Averaging(Strategy):
    """Averages every uploaded array whose name begins with one of ``prefixes`` and sends the average to all.

    Between the rounds in which it averages it sends nothing, and clients go on with their own parameters.

    :param prefixes: what to average; everything by default
    :param average_every: after rounds ``average_every``, ``2 * average_every``, ...
    :param average_until: not after later rounds than this; ``None`` for no end
    :param aggregator: what takes the place of the average, see :func:`combine`
    :param trim_fraction: what ``"trimmed_mean"`` leaves out on either side
    :raises ValueError: for an unknown aggregator, or a fraction that leaves nothing
    """

    def __init__(
        self,
        prefixes: tuple[str, ...] = ("",),
        average_every: int = 1,
        average_until: int | None = None,
        aggregator: Aggregator = "mean",
        trim_fraction: float = 0.25,
    ) -> None:
        super().__init__()
        check_aggregator(aggregator, trim_fraction)
        self.prefixes = prefixes
        self.average_every = average_every
        self.average_until = average_until
        self.aggregator = aggregator
        self.trim_fraction = trim_fraction
        self._latest: Payload = {}

    def is_due(self, round: int) -> bool:
        """Whether the parameters are averaged after round ``round``."""
        return averaging_is_due(round, self.average_every, self.average_until)

    def _combine(self, uploads: Mapping[int, Payload], names: list[str]) -> Payload:
        return combine(uploads, names, self.aggregator, self.trim_fraction)

    def aggregate(self, round: int, uploads: Mapping[int, Payload]) -> dict[int, Payload]:
        self.metrics = {}
        first = next(iter(uploads.values()))
        names = [name for name in first if name != N_SAMPLES and name.startswith(self.prefixes)]
        if not self.is_due(round) or not names:
            return {client: {} for client in uploads}
        average = self._combine(uploads, names)
        drifts = [
            np.sqrt(sum(float(np.sum((payload[name] - average[name]) ** 2, dtype=np.float64)) for name in names))
            for payload in uploads.values()
        ]
        self.metrics = {"drift": float(np.mean(drifts))}
        self._latest = average
        return {client: {name: array.copy() for name, array in average.items()} for client in uploads}

    def latest(self, client: int) -> Payload:
        return {name: array.copy() for name, array in self._latest.items()}
