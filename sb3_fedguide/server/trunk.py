"""The server's side of the trunk's federated pretraining: merged moments once, then averages. Needs nothing but NumPy."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fed_envs.faults import ClientError
from fed_envs.plain_data import State, freeze, thaw
from sb3_fedguide.server.averaging import weighted_average
from sb3_fedguide.server.moments import Moments, merge
from sb3_fedguide.server.payload import N_SAMPLES, Payload
from sb3_fedguide.server.validation import check_uploads

logger = logging.getLogger(__name__)

#: Prefixes of the server's payloads: merged observation moments, and the trunk's parameters.
MOMENTS, TRUNK = "moments.", "trunk."

#: Larger moments cannot come from observations: the merged mean would be that of one client, or overflow.
_LARGEST, _MOST_SAMPLES = 1e12, 2**40
#: The longest training of the trunk that one client may request, in medians of the clients' requests.
_MOST_UPDATES = 100


def merge_moments(uploads: Sequence[Mapping[str, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the union of the clients' data, see :func:`~sb3_fedguide.server.moments.merge`."""
    parts = [Moments(float(upload[N_SAMPLES]), upload["mean"], upload["var"]) for upload in uploads]
    merged = merge(parts)
    return merged.mean, np.sqrt(merged.var)


def moments_fault(moments: Payload, shape: Sequence[int]) -> str | None:
    """What is wrong with a client's moments of observations of ``shape``, if anything."""
    arrays = [moments.get(name) for name in (N_SAMPLES, "mean", "var")]
    if len(moments) != 3 or not all(isinstance(array, np.ndarray | np.generic) for array in arrays):
        return "they are not n_samples, mean and var"
    count, mean, var = map(np.asarray, arrays)
    if any(array.dtype != np.float64 for array in (count, mean, var)) or not all(
        np.isfinite(array).all() for array in (count, mean, var)
    ):
        return "they are not finite numbers of float64"
    if count.ndim != 0 or count < 1 or count != np.floor(count) or not mean.shape == var.shape == tuple(shape):
        return f"they are no positive number, mean and variance of {tuple(shape)}: {count.shape}, {mean.shape}, {var.shape}"
    if count > _MOST_SAMPLES or (np.abs(mean) > _LARGEST).any() or (var > _LARGEST).any():
        return f"there are more than 2**40 samples, or their mean or variance is above {_LARGEST:g}"
    return "a variance is negative" if (var < 0).any() else None


def excessive_updates(n_updates: Mapping[int, int]) -> dict[int, str]:
    """Clients that ask for a far longer training than most others, with the reason."""
    usual = float(np.median(list(n_updates.values())))
    return {
        client: f"it wants {n} updates, {n / usual:.3g} times the clients' median"
        for client, n in n_updates.items()
        if n > _MOST_UPDATES * usual
    }


class TrunkAverages:
    """The progress of the trunk's pretraining.

    :param moments: of each client that takes part
    :param n_updates: updates of each client
    :param average_every: updates between two averages
    :param upload_bound: as in :func:`~sb3_fedguide.server.validation.check_uploads`; ``None`` for no checks
    """

    def __init__(self, moments: Mapping[int, Payload], n_updates: int, average_every: int, upload_bound: float | None) -> None:
        self.clients = sorted(moments)
        self.n_samples = {client: int(moments[client][N_SAMPLES]) for client in self.clients}
        self.mean, self.std = merge_moments([moments[client] for client in self.clients])
        self.n_updates, self.average_every, self.upload_bound = n_updates, average_every, upload_bound
        self.n_averages = 0
        self.trunk: Payload = {}

    @property
    def n_done(self) -> int:
        """Updates that are averaged already."""
        return min(self.n_averages * self.average_every, self.n_updates)

    @property
    def finished(self) -> bool:
        return self.n_done == self.n_updates

    def payload(self) -> Payload:
        """The parameters from which a client continues, or, at the end, those of the finished trunk."""
        moments = {f"{MOMENTS}mean": self.mean, f"{MOMENTS}std": self.std}
        return moments | {TRUNK + name: array for name, array in self.trunk.items()}

    def facts(self) -> dict[str, Any]:
        """The update that the clients' schedules must have reached."""
        return {"n_updates": self.n_updates, "n_done": self.n_done, "average_every": self.average_every}

    def average(self, uploads: Mapping[int, Payload]) -> dict[int, str]:
        """Average the uploads that pass the checks.

        :return: the reason by client for every upload that was rejected
        :raises ClientError: if none passes
        """
        rejected: dict[int, str] = {}
        if self.upload_bound is not None:
            sent = {client: self.trunk for client in uploads}
            rejected = check_uploads(uploads, sent, bound=self.upload_bound)
        accepted = [client for client in sorted(uploads) if client not in rejected]
        if not accepted:  # a client that is asked again answers the same
            reasons = "; ".join(f"client {client}, {reason}" for client, reason in rejected.items())
            raise ClientError(
                sorted(uploads), f"the server cannot average the trunk, because it rejects every upload: {reasons}"
            )
        parts, counts = [uploads[client] for client in accepted], [self.n_samples[client] for client in accepted]
        self.trunk = weighted_average(parts, counts, parts[0])
        self.n_averages += 1
        return rejected

    def save_state(self) -> State:
        return freeze(vars(self))

    @classmethod
    def from_state(cls, state: State) -> TrunkAverages:
        """What :meth:`save_state` was called on."""
        averages = cls.__new__(cls)
        vars(averages).update(thaw(state))
        return averages
