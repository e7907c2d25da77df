"""The server's part of a round, whatever carries the payloads: in process, worker processes or a network."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from sb3_fedguide.server.participants import draw_participants
from sb3_fedguide.server.payload import Payload
from sb3_fedguide.server.strategy import Strategy
from sb3_fedguide.settings.participants import n_participants


class Coordinator:
    """Knows which clients have missed an exchange, counts bytes, and calls the strategy.

    :param strategy: the method's; ``None`` for a method without exchange
    """

    def __init__(self, strategy: Strategy | None) -> None:
        self.strategy = strategy
        #: clients that have missed a broadcast, and have to catch up before they train again
        self.outdated: set[int] = set()
        #: bytes that all clients together have sent and received, and the part of them before the first round
        self.bytes_up = self.bytes_down = 0
        self.offline_bytes_up = self.offline_bytes_down = 0
        #: warnings of the last exchange: rejected uploads, and, once for each client, uploads that were used although they
        #: look wrong
        self.complaints: list[str] = []
        self._doubted: set[int] = set()
        #: figures of the last exchange, by log key
        self.metrics: dict[str, float] = {}

    @property
    def needs_setup(self) -> bool:
        """Whether another exchange is needed before the first round."""
        return self.strategy is not None and self.strategy.needs_setup

    @property
    def rejected(self) -> dict[int, str]:
        """Clients whose uploads the last exchange rejected, and why."""
        return {} if self.strategy is None else self.strategy.rejected

    def catch_up(self, client: int) -> Payload:
        """The payload that an :attr:`outdated` client receives before it trains again; it is then up to date."""
        self.outdated.discard(client)
        payload = {} if self.strategy is None else self.strategy.catch_up(client)
        self.bytes_down += payload_bytes({client: payload})
        return payload

    def exchange(self, round: int, uploads: Mapping[int, Payload], absent: Iterable[int] = ()) -> dict[int, Payload]:
        """Hand the uploads to the strategy, and count.

        :param round: 0 before the first round, h after the h-th
        :param uploads: payload by client id
        :param absent: all other clients of the federation
        :return: broadcast by client id, for those that receive one
        """
        assert self.strategy is not None
        missed = self.outdated & uploads.keys()  # they were busy while others received a broadcast
        broadcasts = self.strategy.exchange(round, uploads)
        self.outdated -= {k for k in missed if k in broadcasts and broadcasts[k].keys() >= self.strategy.latest(k).keys()}
        if any(broadcasts.values()):  # the absent and the rejected have missed this broadcast
            self.outdated |= {*absent, *self.strategy.rejected}
        doubts = {client: why for client, why in self.strategy.doubts.items() if client not in self._doubted}
        self._doubted |= doubts.keys()
        self.complaints = rejections("upload", self.strategy.rejected)
        self.complaints += [f"the upload of client {k} is used, but looks wrong: {why}" for k, why in doubts.items()]
        up, down = payload_bytes(uploads), payload_bytes(broadcasts)
        self.count(up, down, offline=round == 0)
        self.metrics = {f"federated/{key}": value for key, value in self.strategy.metrics.items()}
        for name, values in self.strategy.client_metrics.items():
            self.metrics |= {f"client_{client}/{name}": value for client, value in values.items()}
        self.metrics["federated/bytes_up"] = up
        self.metrics["federated/bytes_down"] = down
        self.metrics["federated/bytes_total"] = self.bytes_up + self.bytes_down
        self.metrics["federated/bytes_offline"] = self.offline_bytes_up + self.offline_bytes_down
        return broadcasts

    def count(self, up: int, down: int, offline: bool) -> None:
        """Add to the bytes; ``offline`` for those that are sent once, before the first round."""
        self.bytes_up += up
        self.bytes_down += down
        if offline:
            self.offline_bytes_up += up
            self.offline_bytes_down += down

    @property
    def bytes_counted(self) -> list[int]:
        """All counts, for a checkpoint; checkpoints of earlier versions have no offline bytes."""
        return [self.bytes_up, self.bytes_down, self.offline_bytes_up, self.offline_bytes_down]

    @bytes_counted.setter
    def bytes_counted(self, saved: Sequence[int]) -> None:
        self.bytes_up, self.bytes_down, self.offline_bytes_up, self.offline_bytes_down = [*saved, 0, 0][:4]


def rejections(what: str, reasons: Mapping[int, str]) -> list[str]:
    """A sentence for each client whose ``what`` the server does not use."""
    return [f"the server rejects the {what} of client {client}: {reason}" for client, reason in reasons.items()]


def participants(clients: Sequence[int], seed: int, round: int, client_fraction: float) -> list[int]:
    """The participants of a round among the clients that are present.

    :param clients: ids in ascending order
    :param round: counted from 0
    """
    n_present = n_participants(client_fraction, len(clients))
    if n_present == len(clients):
        return list(clients)
    present = draw_participants(seed, round, len(clients), n_present)
    return [clients[position] for position in np.flatnonzero(present).tolist()]


def payload_bytes(payloads: Mapping[int, Payload]) -> int:
    """Size of all arrays of all clients' payloads, in bytes; values that are no arrays, as in a wrong upload, count 0."""
    arrays = [array for payload in payloads.values() if isinstance(payload, Mapping) for array in payload.values()]
    return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray | np.generic))
