"""A transport without a network: sites in this process, or anything else that handles messages, with faults on demand."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import sb3_fedguide
from sb3_fedguide.deployment.serve import ServerConfig, serve
from sb3_fedguide.deployment.transport import Failure, Message
from sb3_fedguide.server.methods import complete_settings
from sb3_fedguide.server.metrics import ClientEvaluation

NAME = "action_net.weight"

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

    def send_and_receive(self, requests: Mapping[int, Message], timeout: float | None) -> dict[int, Message | Failure]:
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


class Client:
    """Walks at random from wherever the server puts it; a message that comes twice is answered once."""

    def __init__(self, client: int, /, **facts: Any) -> None:
        self.client, self.theta, self.n_received, self.reply = client, np.zeros(3, dtype=np.float32), 0, Message("join", -1)
        self.facts = {**STATED, "client": client, **facts}
        self.trained: list[int] = []

    def handle(self, message: Message) -> Message:
        if message.kind == "join":
            return Message("join", message.round, facts=self.facts)
        if (message.kind, message.round) != (self.reply.kind, self.reply.round):
            payload, facts = self.answer(message)
            self.reply = Message(message.kind, message.round, payload, facts)
        return self.reply

    def answer(self, message: Message) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        if message.kind == "setup":
            return {}, {}
        if message.payload and message.facts["broadcast"] > self.n_received:
            self.theta, self.n_received = message.payload[NAME], message.facts["broadcast"]
        if message.kind == "round":
            self.trained.append(message.round)
            step = np.random.default_rng([self.client, message.round]).normal(size=3)
            self.theta = (self.theta + step).astype(np.float32)
            figures = {"train/loss": float(self.client), f"client_{self.client}/std": 1.0, "client_99/std": 5.0}
            episode = ClientEvaluation(self.client, message.round, "deployed", [float(self.client)], [7])
            facts = {"figures": figures, "evaluations": [episode.facts()]}
            return {NAME: self.theta, "n_samples": np.array(8, dtype=np.float32)}, facts
        return {}, {}


CONFIG = ServerConfig("fedavg", 4, 5, 8, 1, wait=0.0, poll=0.0)
STATED = {
    "algorithm": "fedavg", "version": sb3_fedguide.__version__, "seed": 1, "n_rounds": 5, "rollout_size": 8,
    "settings": complete_settings("fedavg", {}), "shapes": {NAME: [3]}, "trunk": None,
}  # fmt: skip


def run(config: ServerConfig = CONFIG, transport: LoopTransport | None = None, folder: Path | None = None):
    """The transport, the server, and the log of every round."""
    transport = transport or LoopTransport(Client, [0, 1, 2, 3])
    rows: list[dict[str, float]] = []
    server = serve(config, transport, folder, lambda round, figures: rows.append({"round": round, **figures}))
    return transport, server, rows


def replaced(config: ServerConfig, **changes: Any) -> ServerConfig:
    return ServerConfig(**{**vars(config), **changes})


def upload(value: float) -> dict[str, np.ndarray]:
    return {NAME: np.full(3, value, dtype=np.float32), "n_samples": np.array(8, dtype=np.float32)}
