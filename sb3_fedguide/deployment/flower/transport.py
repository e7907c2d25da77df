"""Flower's Grid as a transport."""

from __future__ import annotations

import time
from collections.abc import Mapping

from flwr.app import Message as FlowerMessage
from flwr.app import MessageType
from flwr.common.constant import ErrorCode
from flwr.serverapp import Grid

from sb3_fedguide.deployment.flower.records import from_records, to_records
from sb3_fedguide.deployment.transport import Failure, Message

_POLL_SECONDS = 0.2
#: Flower takes a message without a limit for one of twelve hours.
_NO_LIMIT = 10 * 365 * 86400.0
_REASONS = {
    ErrorCode.MESSAGE_UNAVAILABLE: "timeout",
    ErrorCode.REPLY_MESSAGE_UNAVAILABLE: "timeout",
    ErrorCode.NODE_UNAVAILABLE: "gone",
    ErrorCode.CLIENT_APP_CRASHED: "gone",
}


class FlowerTransport:
    """Asks clients by Flower's messages. A client is known by its registered key, whatever it says about itself.

    :param grid: of the running server app
    :param clients: id of the client by its public key
    """

    def __init__(self, grid: Grid, clients: Mapping[bytes, int]) -> None:
        self._grid = grid
        self._clients = dict(clients)

    def clients(self) -> list[int]:
        return sorted(self._nodes())

    def send_and_receive(self, requests: Mapping[int, Message], timeout: float | None) -> dict[int, Message | Failure]:
        limit = _NO_LIMIT if timeout is None else min(timeout, _NO_LIMIT)
        until = time.monotonic() + limit
        nodes = self._nodes()
        sent = {client: self._send(nodes[client], requests[client], limit) for client in requests if client in nodes}
        waiting = {message: client for client, message in sent.items() if message}
        replies: dict[int, Message | Failure] = {client: Failure("gone") for client in requests if not sent.get(client)}
        while waiting and time.monotonic() < until:
            for reply in self._grid.pull_messages(list(waiting)):
                # Error replies come from the SuperLink: only the id of the request identifies the client.
                if (client := waiting.pop(reply.metadata.reply_to_message_id, None)) is not None:
                    replies[client] = _content(reply)
            if waiting:
                time.sleep(_POLL_SECONDS)
        return {client: replies.get(client, Failure("timeout")) for client in requests}

    def _send(self, node: int, request: Message, timeout: float) -> str | None:
        """Hand a request to the SuperLink, which forgets it after the timeout; return its id, or nothing if it is refused."""
        message = FlowerMessage(
            to_records(request), node, MessageType.TRAIN, ttl=timeout, group_id=f"{request.kind} {request.round}"
        )
        return next(iter(self._grid.push_messages([message])), None)

    def _nodes(self) -> dict[int, int]:
        """Flower's number of each client that is online."""
        nodes = self._grid.get_nodes()
        return {self._clients[node.public_key]: node.node_id for node in nodes if node.public_key in self._clients}


def _content(reply: FlowerMessage) -> Message | Failure:
    if reply.has_error():
        return Failure(_REASONS.get(reply.error.code, "error: Flower"))
    try:
        return from_records(reply.content)
    except ValueError as error:
        return Failure.of(error)
