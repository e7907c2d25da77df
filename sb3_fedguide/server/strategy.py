"""The server's side of a federated method, free of any engine: arrays in, arrays out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import numpy as np

#: What crosses between a client and the server in one direction: named arrays, float32 but for counts.
Payload = dict[str, np.ndarray]

#: Key of an upload's number of samples, the weight of its client in averages.
N_SAMPLES = "n_samples"


class Strategy(ABC):
    """Aggregates one round's uploads into a broadcast for each client.

    It runs in process or behind a network, and knows neither torch nor environments.
    """

    def __init__(self) -> None:
        #: figures of the last :meth:`aggregate`, logged under ``federated/``
        self.metrics: dict[str, float] = {}

    @property
    def needs_setup(self) -> bool:
        """Whether another exchange is needed before the first round."""
        return False

    @abstractmethod
    def aggregate(self, round: int, uploads: Mapping[int, Payload]) -> dict[int, Payload]:
        """Combine the uploads of the clients that are present.

        :param round: 0 before the first round, h after the h-th
        :param uploads: payload by client id
        :return: broadcast by client id, one for every client in ``uploads``
        """

    def latest(self, client: int) -> Payload:
        """What a client that missed exchanges receives before it trains again."""
        return {}


class Composite(Strategy):
    """Several strategies side by side; each sees all uploads, and a client receives all their broadcasts."""

    def __init__(self, strategies: Sequence[Strategy]) -> None:
        super().__init__()
        self.strategies = list(strategies)

    @property
    def needs_setup(self) -> bool:
        return any(strategy.needs_setup for strategy in self.strategies)

    def aggregate(self, round: int, uploads: Mapping[int, Payload]) -> dict[int, Payload]:
        merged: dict[int, Payload] = {client: {} for client in uploads}
        self.metrics = {}
        for strategy in self.strategies:
            for client, payload in strategy.aggregate(round, uploads).items():
                merged[client].update(payload)
            self.metrics.update(strategy.metrics)
        return merged

    def latest(self, client: int) -> Payload:
        return {name: array for strategy in self.strategies for name, array in strategy.latest(client).items()}
