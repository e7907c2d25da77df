"""The server's side of a federated method, free of any engine: arrays in, arrays out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from sb3_fedguide.server.payload import N_SAMPLES, Payload
from sb3_fedguide.server.validation import UPLOAD_BOUND, check_uploads

if TYPE_CHECKING:
    from fed_envs.plain_data import State

__all__ = ["N_SAMPLES", "Composite", "Payload", "Strategy"]


class Strategy(ABC):
    """Aggregates one round's uploads into a broadcast for each client.

    It runs in process or behind a network, and knows neither torch nor environments. Whatever carries payloads calls
    :meth:`exchange` and :meth:`catch_up`; a method defines :meth:`aggregate` and :meth:`latest`.
    """

    def __init__(self) -> None:
        #: figures of the last exchange, logged under ``federated/``
        self.metrics: dict[str, float] = {}
        #: the same of single clients, by name and client id, logged under ``client_<k>/``
        self.client_metrics: dict[str, dict[int, float]] = {}
        #: clients whose uploads the last exchange used although they look wrong, and why
        self.doubts: dict[int, str] = {}
        #: how far norms of uploads may exceed the median, see :func:`check_uploads`; ``None`` for no checks at all
        self.upload_bound: float | None = UPLOAD_BOUND
        #: clients whose uploads the last exchange rejected, and why
        self.rejected: dict[int, str] = {}
        #: the last broadcast to each client, of the parameters that it uploads; its next upload is compared with it
        self.sent: dict[int, Payload] = {}
        #: names of these parameters
        self.compared: list[str] = []

    @property
    def needs_setup(self) -> bool:
        """Whether another exchange is needed before the first round."""
        return False

    @property
    def norm_groups(self) -> tuple[str, ...]:
        """Prefixes of the names of arrays whose norms are checked apart from those of all other arrays."""
        return ()

    def exchange(self, round: int, uploads: Mapping[int, Payload]) -> dict[int, Payload]:
        """Check the uploads, and aggregate those that pass.

        A client whose upload is rejected is treated as if it were absent: it receives nothing now, and the payload of
        :meth:`catch_up` before it trains again. Only in the setup before the first round, when it has nothing yet, it
        receives that payload at once.

        :param round: 0 before the first round, h after the h-th
        :param uploads: payload by client id
        :return: broadcast by client id, for those that receive one
        :raises ClientError: if the setup finds no valid upload
        """
        self.rejected = {}
        if self.upload_bound is not None:
            self.rejected = check_uploads(uploads, self.sent, self.norm_groups, self.upload_bound)
        accepted = {client: payload for client, payload in uploads.items() if client not in self.rejected}
        in_setup, self.metrics, self.client_metrics, self.doubts = self.needs_setup, {}, {}, {}
        broadcasts = self.aggregate(round, accepted) if accepted else {}
        if in_setup:
            if not accepted:
                reasons = "; ".join(f"client {client}, {reason}" for client, reason in self.rejected.items())
                from fed_envs.faults import ClientError

                raise ClientError(list(uploads), f"the server cannot begin, because it rejects every upload: {reasons}")
            broadcasts.update({client: self.latest(client) for client in self.rejected})
        apart = (*self.norm_groups, N_SAMPLES)
        self.compared = sorted({name for payload in accepted.values() for name in payload if not name.startswith(apart)})
        self._remember(broadcasts)
        if self.upload_bound is not None:
            self.metrics["rejected"] = float(len(self.rejected))
        return broadcasts

    def catch_up(self, client: int) -> Payload:
        """The payload for a client that has missed exchanges, before it trains again."""
        payload = self.latest(client)
        self._remember({client: payload})
        return payload

    def _remember(self, broadcasts: Mapping[int, Payload]) -> None:
        for client, payload in broadcasts.items() if self.upload_bound is not None else ():
            kept = {name: payload[name].copy() for name in self.compared if name in payload}
            self.sent.setdefault(client, {}).update(kept)

    @abstractmethod
    def aggregate(self, round: int, uploads: Mapping[int, Payload]) -> dict[int, Payload]:
        """Combine the uploads of the clients that are present and have passed the checks.

        :param round: 0 before the first round, h after the h-th
        :param uploads: payload by client id
        :return: broadcast by client id, one for every client in ``uploads``
        """

    def latest(self, client: int) -> Payload:
        """The current broadcast for a client that received nothing in the last exchanges."""
        return {}

    def save_state(self) -> State:
        """Everything that the server remembers, as plain data for a checkpoint: all attributes.

        :raises ValueError: if an attribute is not plain data and has no ``save_state`` and ``load_state`` itself
        """
        return {name: _saved(value) for name, value in vars(self).items()}

    def load_state(self, state: State) -> None:
        """Restore what :meth:`save_state` returned, in a strategy with the same settings."""
        for name, saved in state.items():
            own: Any = getattr(self, name, None)
            if hasattr(own, "load_state"):
                own.load_state(saved)
            elif _have_state(own):
                for part, part_saved in zip(own, saved, strict=True):
                    part.load_state(part_saved)
            else:
                from fed_envs.plain_data import thaw  # the server needs no environments until it is checkpointed

                setattr(self, name, thaw(saved))


class Composite(Strategy):
    """Several strategies side by side; each sees all uploads, and a client receives all their broadcasts."""

    def __init__(self, strategies: Sequence[Strategy]) -> None:
        super().__init__()
        self.strategies = list(strategies)

    @property
    def needs_setup(self) -> bool:
        return any(strategy.needs_setup for strategy in self.strategies)

    @property
    def norm_groups(self) -> tuple[str, ...]:
        return tuple(prefix for strategy in self.strategies for prefix in strategy.norm_groups)

    def aggregate(self, round: int, uploads: Mapping[int, Payload]) -> dict[int, Payload]:
        merged: dict[int, Payload] = {client: {} for client in uploads}
        self.metrics, self.client_metrics, self.doubts = {}, {}, {}
        for strategy in self.strategies:
            for client, payload in strategy.aggregate(round, uploads).items():
                merged[client].update(payload)
            self.metrics.update(strategy.metrics)
            self.client_metrics.update(strategy.client_metrics)
            self.doubts.update(strategy.doubts)
        return merged

    def latest(self, client: int) -> Payload:
        return {name: array for strategy in self.strategies for name, array in strategy.latest(client).items()}


def _have_state(value: Any) -> bool:
    return isinstance(value, list) and len(value) > 0 and all(hasattr(part, "save_state") for part in value)


def _saved(value: Any) -> Any:
    if hasattr(value, "save_state"):
        return value.save_state()
    from fed_envs.plain_data import freeze

    return [part.save_state() for part in value] if _have_state(value) else freeze(value)
