"""Federated averaging of parameters (McMahan et al. 2017), and the server's step towards the average."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from sb3_fedguide.server.strategy import N_SAMPLES, Payload, Strategy
from sb3_fedguide.settings.arguments import Aggregator, Average, AveragingArguments, ServerStep
from sb3_fedguide.settings.ranges import check_values
from sb3_fedguide.settings.signatures import types_of


def weighted_average(parts: Sequence[Mapping[str, np.ndarray]], counts: Sequence[float], names: Iterable[str]) -> Payload:
    """``sum_i n_i / n * theta_i`` for the arrays ``names``, accumulated in float64 in the order of ``parts``; float32.

    :param counts: n_i, the samples of each part
    """
    weights = np.asarray(counts, dtype=np.float64) / np.sum(counts, dtype=np.float64)
    average = {}
    for name in names:
        total = np.zeros(parts[0][name].shape)
        for part, weight in zip(parts, weights, strict=True):
            total += weight * part[name]
        average[name] = total.astype(np.float32)
    return average


def combine(
    uploads: Mapping[int, Payload],
    names: list[str],
    aggregator: Aggregator,
    trim_fraction: float,
) -> Payload:
    """Combine the arrays ``names`` of all clients: by :func:`weighted_average`, or coordinate by coordinate by median or by
    the mean without the ``floor(trim_fraction * n)`` lowest and as many highest values (Yin et al. 2018).

    Median and trimmed mean count every client once, whatever number of samples it claims.
    """
    if aggregator == "mean":
        parts = [uploads[client] for client in sorted(uploads)]
        return weighted_average(parts, [float(part[N_SAMPLES]) for part in parts], names)
    stacks = {name: np.stack([uploads[client][name] for client in sorted(uploads)]) for name in names}
    return {name: robust_mean(stack, aggregator, trim_fraction).astype(np.float32) for name, stack in stacks.items()}


def robust_mean(values: np.ndarray, aggregator: Aggregator, trim_fraction: float) -> np.ndarray:
    """Median or trimmed mean over the first axis, see :func:`combine`; float64."""
    ordered = np.sort(values.astype(np.float64), axis=0)
    n = len(ordered)
    cut = (n - 1) // 2 if aggregator == "median" else min(int(trim_fraction * n + 1e-9), (n - 1) // 2)
    return ordered[cut : n - cut].mean(axis=0)


def fedexp_step(latest: Payload, uploads: Mapping[int, Payload], change: Payload, epsilon: float = 1e-12) -> float:
    """FedExP's step: ``max(1, sum_i w_i |Delta_i|^2 / (2 (|Delta|^2 + epsilon)))`` (Jhunjhunwala et al. 2023).

    Clients whose updates are orthogonal get a long step, those that agree a step of one.

    :param latest: theta, from which ``Delta_i = theta_i - theta``
    :param uploads: theta_i by client, with the samples whose share is ``w_i`` (``1 / N`` in the paper)
    :param change: Delta, the average of the ``Delta_i``, or what ``aggregator`` takes instead
    """
    counts = {client: float(payload[N_SAMPLES]) for client, payload in uploads.items()}
    total = sum(counts.values())
    lengths = sum(
        counts[client]
        / total
        * _squared_norm({name: uploads[client][name] - latest[name].astype(np.float64) for name in change})
        for client in sorted(uploads)
    )
    return max(1.0, lengths / (2 * (_squared_norm(change) + epsilon)))


def _squared_norm(arrays: Payload) -> float:
    return float(sum(np.sum(np.square(array, dtype=np.float64)) for array in arrays.values()))


def averaging_is_due(round: int, every: int, until: int | None = None) -> bool:
    """Whether parameters are averaged after round ``round``: after ``every``, ``2 * every``, ..., and not after ``until``."""
    return round > 0 and round % every == 0 and (until is None or round <= until)


def policy_is_due(round: int, average: str, every: int, until: int | None = None) -> bool:
    """Whether policies, and not only critics, are averaged after round ``round``."""
    return average != "critic" and averaging_is_due(round, every, until)


def averaged_prefixes(average: Average, actor: tuple[str, ...], critic: tuple[str, ...]) -> tuple[str, ...]:
    """The prefixes of the names of the averaged parameters.

    :param average: which of them
    """
    return {"all": actor + critic, "actor": actor, "critic": critic}[average]


class Averaging(Strategy):
    """Averages every uploaded array whose name begins with one of ``prefixes`` and sends the average to all.

    It sends ``theta + server_step * v`` with ``v = server_momentum * v + (average - theta)``, where theta is its last
    broadcast (FedOpt's SGD, Reddi et al. 2021). A step of 1 without momentum is the average itself.

    In rounds without averaging it sends nothing, and clients continue with their own parameters. An upload with zero samples
    comes from a client that has left the average after a test: it has no weight.

    :param prefixes: what to average; everything by default
    :param average_every: after rounds ``average_every``, ``2 * average_every``, ...
    :param average_until: last round with averaging; ``None`` for no end
    :param aggregator: how uploads are combined, see :func:`combine`
    :param trim_fraction: share of the clients that ``"trimmed_mean"`` leaves out on either side
    :param server_step: step size along the mean update: a number, or ``"exp"`` for :func:`fedexp_step`
    :param server_momentum: share of the last update that is added to this one
    :raises ValueError: for values out of range
    """

    def __init__(
        self,
        prefixes: tuple[str, ...] = ("",),
        average_every: int = AveragingArguments.average_every,
        average_until: int | None = AveragingArguments.average_until,
        aggregator: Aggregator = AveragingArguments.aggregator,
        trim_fraction: float = AveragingArguments.trim_fraction,
        server_step: ServerStep = AveragingArguments.server_step,
        server_momentum: float = AveragingArguments.server_momentum,
    ) -> None:
        super().__init__()
        check_values(types_of(AveragingArguments), locals())
        self.prefixes = prefixes
        self.average_every = average_every
        self.average_until = average_until
        self.aggregator = aggregator
        self.trim_fraction = trim_fraction
        self.server_step = server_step
        self.server_momentum = server_momentum
        self._latest: Payload = {}
        self._velocity: Payload = {}

    def is_due(self, round: int) -> bool:
        """Whether the parameters are averaged after round ``round``."""
        return averaging_is_due(round, self.average_every, self.average_until)

    def _combine(self, uploads: Mapping[int, Payload], names: list[str]) -> Payload:
        return combine(uploads, names, self.aggregator, self.trim_fraction)

    def aggregate(self, round: int, uploads: Mapping[int, Payload]) -> dict[int, Payload]:
        self.metrics = {}
        taking_part = {client: payload for client, payload in uploads.items() if payload.get(N_SAMPLES, 1) > 0}
        names = [name for name in next(iter(taking_part.values()), {}) if name != N_SAMPLES and name.startswith(self.prefixes)]
        if not self.is_due(round) or not names:
            return {client: {} for client in uploads}
        average = self._combine(taking_part, names)
        drifts = [
            np.sqrt(sum(float(np.sum((payload[name] - average[name]) ** 2, dtype=np.float64)) for name in names))
            for payload in taking_part.values()
        ]
        self.metrics = {"drift": float(np.mean(drifts))}
        self._latest = self._step_towards(average, taking_part)
        return {client: self.latest(client) for client in uploads}

    def _step_towards(self, average: Payload, uploads: Mapping[int, Payload]) -> Payload:
        """theta + server_step * v; the average itself in the first round, where no theta is known."""
        if (self.server_step == 1 and self.server_momentum == 0) or not self._latest:
            return average
        change = {name: average[name].astype(np.float64) - self._latest[name] for name in average}
        step = fedexp_step(self._latest, uploads, change) if self.server_step == "exp" else self.server_step
        self._velocity = {name: self.server_momentum * self._velocity.get(name, 0.0) + change[name] for name in change}
        self.metrics["server_step"] = float(step)
        return {name: (self._latest[name] + step * self._velocity[name]).astype(np.float32) for name in change}

    def latest(self, client: int) -> Payload:
        return {name: array.copy() for name, array in self._latest.items()}
