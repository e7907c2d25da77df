"""What carries a round between the server and its clients, whatever the network: messages, failures, and who is there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, get_args

from sb3_fedguide.server.payload import Payload

#: What the server asks for, in the order of a run:
#:
#: * ``join``: which settings a client has;
#: * ``moments``: moments of its offline observations, once, where a trunk is trained;
#: * ``trunk``: some updates from the last average of the trunk, once for each average;
#: * ``setup``: 0, to prepare (the local part of the offline stage); from 1 on, the exchanges before the first round;
#: * ``round``: take what the server sent, train, upload;
#: * ``finish``: take what the server sent last.
Kind = Literal["join", "moments", "trunk", "setup", "round", "finish"]
KINDS: tuple[Kind, ...] = get_args(Kind)

#: In the facts of every request: which run it belongs to.
RUN = "run"
#: In the facts of a reply: this client has not been through the offline stage, so that it cannot do what was asked.
UNPREPARED = "unprepared"


@dataclass(frozen=True)
class Message:
    """A request of the server, or a client's reply to it, which has the same kind and round.

    Kind and round together name a request: one that is sent again is the same, and is answered by the same reply.

    :param kind: what it is about
    :param round: the communication round, counted from 1; of the other kinds, which of them it is
    :param payload: named arrays
    :param facts: plain data as JSON knows them
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

    Of a client's exception the name of its type crosses and nothing else: its text may quote the client's data.
    """

    reason: str

    @classmethod
    def of(cls, error: BaseException) -> Failure:
        """What a client's exception becomes before it leaves the client."""
        return cls(f"error: {type(error).__name__}")


class Transport(Protocol):
    """Carries requests to clients and brings what came back. Clients are known by their ids in the federation."""

    def clients(self) -> list[int]:
        """Ids of the clients that are there now."""
        ...

    def send_and_receive(self, requests: Mapping[int, Message], timeout: float | None) -> dict[int, Message | Failure]:
        """Send each client its request, and wait until all are answered or have failed.

        :param requests: by client id
        :param timeout: seconds, after which whoever has not answered counts as ``Failure("timeout")``; ``None`` for no limit
        :return: one entry for every request
        """
        ...
