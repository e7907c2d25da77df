"""Federated averaging of parameters (McMahan et al. 2017)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sb3_fedguide.server.strategy import N_SAMPLES, Payload, Strategy


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


class Averaging(Strategy):
    """Averages every uploaded array whose name begins with one of ``prefixes`` and sends the average to all.

    Between the rounds in which it averages it sends nothing, and clients go on with their own parameters.

    :param prefixes: what to average; everything by default
    :param average_every: after rounds ``average_every``, ``2 * average_every``, ...
    :param average_until: not after later rounds than this; ``None`` for no end
    """

    def __init__(self, prefixes: tuple[str, ...] = ("",), average_every: int = 1, average_until: int | None = None) -> None:
        super().__init__()
        self.prefixes = prefixes
        self.average_every = average_every
        self.average_until = average_until
        self._latest: Payload = {}

    def is_due(self, round: int) -> bool:
        """Whether the parameters are averaged after round ``round``."""
        return round > 0 and round % self.average_every == 0 and (self.average_until is None or round <= self.average_until)

    def aggregate(self, round: int, uploads: Mapping[int, Payload]) -> dict[int, Payload]:
        self.metrics = {}
        first = next(iter(uploads.values()))
        names = [name for name in first if name != N_SAMPLES and name.startswith(self.prefixes)]
        if not self.is_due(round) or not names:
            return {client: {} for client in uploads}
        average = weighted_average(uploads, names)
        drifts = [
            np.sqrt(sum(float(np.sum((payload[name] - average[name]) ** 2, dtype=np.float64)) for name in names))
            for payload in uploads.values()
        ]
        self.metrics = {"drift": float(np.mean(drifts))}
        self._latest = average
        return {client: {name: array.copy() for name, array in average.items()} for client in uploads}

    def latest(self, client: int) -> Payload:
        return {name: array.copy() for name, array in self._latest.items()}
