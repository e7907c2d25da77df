"""A transport without a network: sites in this process, or anything else that handles messages, with faults on demand."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Mapping
from typing import Any

from sb3_fedguide.server.transport import Failure, Message

#: What happens to a request: it is not delivered, its reply is lost, or the reply is changed.
Fault = Callable[[Message], Message | Failure]


def timeout(reply: Message) -> Failure:
    """The client did all, and the server did not hear of it."""
    return Failure("timeout")


class LoopTransport:
    """Carries messages to objects with ``handle``, one for each client.

    :param make: makes client k's
    :param clients: who is there
    :param fresh: make a new one for every message
    """

    def __init__(self, make: Callable[[int], Any], clients: list[int], fresh: bool = False) -> None:
        self.make, self.fresh = make, fresh
        self.present = list(clients)
        self.sites: dict[int, Any] = {}
        #: faults by client, kind and round
        self.faults: dict[tuple[int, str, int], Fault] = {}
        #: requests that never arrive
        self.undelivered: set[tuple[int, str, int]] = set()
        #: called with every request before it is delivered
        self.watch: Callable[[int, Message], None] = lambda client, message: None
        self.sent: list[tuple[int, str, int]] = []

    def clients(self) -> list[int]:
        return list(self.present)

    def site(self, client: int) -> Any:
        if client not in self.sites:
            self.sites[client] = self.make(client)
        return self.sites[client]

    def exchange(self, requests: Mapping[int, Message], timeout: float | None) -> dict[int, Message | Failure]:
        return {client: self._deliver(client, request) for client, request in requests.items()}

    def _deliver(self, client: int, request: Message) -> Message | Failure:
        key = (client, request.kind, request.round)
        self.watch(client, request)
        self.sent.append(key)
        if client not in self.present:
            return Failure("gone")
        if key in self.undelivered:
            self.undelivered.remove(key)
            return Failure("timeout")
        try:
            reply = self.site(client).handle(over_the_wire(request))
        except Exception as error:
            self.sites.pop(client, None)
            return Failure.of(error)
        if self.fresh:
            self.sites.pop(client)
        fault = self.faults.pop(key, None)
        return over_the_wire(reply) if fault is None else fault(reply)


def over_the_wire(message: Message) -> Message:
    """A copy that shares nothing: facts have to be JSON."""
    facts = json.loads(json.dumps(message.facts, allow_nan=False))
    return Message(message.kind, message.round, copy.deepcopy(message.payload), facts)
