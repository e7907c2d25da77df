"""The interface between the server and its clients over any network: messages, failures, and which clients are present."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, get_args

from sb3_fedguide.server.payload import Payload

#: Kinds of requests, in the order of a run:
#:
#: * ``join``: which settings a client has;
#: * ``moments``: moments of its offline observations, once, where a trunk is trained;
#: * ``trunk``: some updates from the last average of the trunk, once for each average;
#: * ``setup``: 0, to prepare (the local part of the offline stage); from 1 on, the exchanges before the first round;
#: * ``round``: take the broadcast, train, upload;
#: * ``finish``: take the last broadcast.
Kind = Literal["join", "moments", "trunk", "setup", "round", "finish"]
KINDS: tuple[Kind, ...] = get_args(Kind)

#: In the facts of every request: its run.
RUN = "run"
#: In the facts of a reply: this client has not completed the offline stage, so it cannot execute the request.
UNPREPARED = "unprepared"


@dataclass(frozen=True)
class Message:
    """A request of the server, or a client's reply to it, which has the same kind and round.

    Kind and round together identify a request: a repeated request gets the same reply.

    :param kind: of the request
    :param round: the communication round, counted from 1; for other kinds, the number of the request of that kind
    :param payload: named arrays
    :param facts: JSON data
    :raises ValueError: for an unknown kind
    """

    kind: Kind
    round: int
    payload: Payload = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"a message of the kind {self.kind!r}; this version knows {', '.join(KINDS)}")


@dataclass(frozen=True)
class Failure:
    """A request that was not answered: ``"timeout"``, ``"gone"``, or ``"error: <type>"``.

    Of a client's exception only the name of its type is sent: its text may quote the client's data.
    """

    reason: str

    @classmethod
    def of(cls, error: BaseException) -> Failure:
        """The failure that a client sends for an exception."""
        return cls(f"error: {type(error).__name__}")


class Transport(Protocol):
    """Carries requests to clients and returns their replies. Clients are identified by their ids in the federation."""

    def clients(self) -> list[int]:
        """Ids of the clients that are present now."""
        ...

    def send_and_receive(self, requests: Mapping[int, Message], timeout: float | None) -> dict[int, Message | Failure]:
        """Send each client its request, and wait until all are answered or have failed.

        :param requests: by client id
        :param timeout: seconds; a client without an answer by then counts as ``Failure("timeout")``; ``None`` for no limit
        :return: one entry for every request
        """
        ...
