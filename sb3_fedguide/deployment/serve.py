"""The server of a real federation: its rounds over any :class:`~sb3_fedguide.deployment.transport.Transport`.

It needs only the strategy, NumPy, and a folder for its checkpoints: no PyTorch, environments or clients' metadata.
"""

from __future__ import annotations

import logging
import time
import uuid
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from fed_envs.files import GrowingTable
from fed_envs.plain_data import State, freeze, thaw
from sb3_fedguide.deployment.clients import RUN_FACTS, Clients, difference, server_facts
from sb3_fedguide.deployment.config import ServerConfig, TooFewClients
from sb3_fedguide.deployment.transport import RUN, UNPREPARED, Failure, Kind, Message, Transport
from sb3_fedguide.server.methods import make_strategy
from sb3_fedguide.server.metrics import EVALUATION_COLUMNS, count_tests, evaluation_metrics, merge_metrics, read_evaluations
from sb3_fedguide.server.payload import Payload
from sb3_fedguide.server.rounds import Coordinator, participants, payload_bytes, rejections
from sb3_fedguide.server.trunk import TrunkAverages, excessive_updates, moments_fault
from sb3_fedguide.state.checkpoint_files import newest_checkpoint, remove_leftovers, write_checkpoint

logger = logging.getLogger(__name__)

#: Attributes of the server that a checkpoint stores unchanged.
_ATTRIBUTES = ("run_id", "round", "timesteps", "test_steps", "n_broadcasts", "n_setups", "outbox", "finished", "dismissed")
__all__ = ["Server", "ServerConfig", "TooFewClients", "serve"]

CHECKPOINTS = "checkpoints"
EVALUATIONS = "evaluations.csv"

#: Called after every round with its number and its log.
RoundHook = Callable[[int, Mapping[str, float]], None]


def serve(
    config: ServerConfig, transport: Transport, folder: str | Path | None = None, on_round: RoundHook | None = None
) -> Server:
    """Run a federation to its end, from its checkpoint if there is one.

    :param folder: where checkpoints and the table of evaluations are kept; ``None`` for neither
    :param on_round: called after every round with the log of that round: the clients' reports under ``client_<k>/``, their
        averages, and the server's own figures under ``federated/``; once more after the last round if clients evaluated
        the last broadcast
    :return: the server at the end
    :raises TooFewClients: see :class:`ServerConfig`
    :raises ClientError: if no payload of the clients before the first round is valid
    :raises ValueError: for the checkpoint of another federation
    """
    server = Server(config, transport, folder, on_round)
    server.run()
    return server


class Server:
    """A federation's server; :func:`serve` makes and runs one."""

    def __init__(
        self,
        config: ServerConfig,
        transport: Transport,
        folder: str | Path | None = None,
        on_round: RoundHook | None = None,
    ) -> None:
        self.config, self.transport, self.on_round = config, transport, on_round
        self.folder = None if folder is None else Path(folder)
        strategy = make_strategy(config.algorithm, config.settings, config.n_clients, config.seed)
        #: the strategy, outdated clients, and bytes
        self.coordinator = Coordinator(strategy)
        #: clients that have joined, were refused, or are ready to train
        self.clients = Clients(server_facts(config))
        #: clients that were present at the last check
        self.present: set[int] = set()
        self.trunk: TrunkAverages | None = None
        #: complete rounds
        self.round = 0
        #: environment steps of all clients together, tests included, after each round; and those of tests by client
        self.timesteps: list[int] = []
        self.test_steps: dict[int, int] = {}
        #: number of exchanges with a broadcast
        self.n_broadcasts = 0
        #: distinguishes this run from others with the same settings
        self.run_id = uuid.uuid4().hex
        #: broadcasts that clients have not yet confirmed: number, the round before it (0 for none), arrays
        self.outbox: dict[int, tuple[int, int, Payload]] = {}
        #: requests that failed since the last round, by client
        self.failures: dict[int, str] = {}
        self.n_setups = 0
        self.finished = False
        #: clients that know of the run's end
        self.dismissed: list[int] = []
        self._table = None if self.folder is None else GrowingTable(self.folder / EVALUATIONS)

    def run(self) -> None:
        """See :func:`serve`."""
        self._resume()
        if not self.finished:
            self._await_clients()
            self._pretrain_trunk()
            self._prepare()
            while self.coordinator.needs_setup:
                self._set_up()
            while self.round < self.config.n_rounds:
                self._play_round()
        self._finish()

    def _await_clients(self) -> None:
        """Wait until enough clients with the same settings are present."""
        started = time.monotonic()
        while self.clients.common is None:
            self._welcome()
            self._refuse(self.clients.agree(self.config.n_start))
            if self.clients.common is None:
                self._pause(started, len(self.clients.joined), self.config.n_start)

    def _welcome(self) -> None:
        """Check which clients are present, and ask new ones for their settings."""
        self.present = set(self.transport.clients())
        newcomers = self.clients.newcomers(self.present)
        requests = {client: Message("join", 0, facts=self.clients.facts) for client in newcomers}
        refused = {}
        for client, reply in self._ask(requests, self.config.timeout).items():
            reason = self.clients.join(client, reply.facts)
            if reason is not None:
                refused[client] = reason
            else:
                logger.info("client %d has joined", client)
        self._refuse(refused)

    def _refuse(self, reasons: Mapping[int, str]) -> None:
        for client, reason in reasons.items():
            logger.warning("client %d is refused: %s; correct its configuration and restart it", client, reason)

    def _pretrain_trunk(self) -> None:
        settings = self.clients.common["trunk"] if self.clients.common is not None else None
        if settings is None:
            return
        bound, timeout = self.config.all_settings["upload_bound"], self.config.setup_timeout
        if self.trunk is None:
            replies = self._collect(lambda: self._to_joined(Message("moments", 0)), timeout, self._fault_of_moments)
            self._count_trunk(replies, {})
            n_updates = {client: int(reply.facts["n_updates"]) for client, reply in replies.items()}
            self._warn(rejections("moments", excessive := excessive_updates(n_updates)))
            moments = {client: reply.payload for client, reply in replies.items() if client not in excessive}
            longest = max(n_updates[client] for client in moments)
            self.trunk = TrunkAverages(moments, longest, int(settings["prior_average_every"]), bound)
            self._save()
        while not self.trunk.finished:
            request = Message("trunk", self.trunk.n_averages + 1, self.trunk.payload(), self.trunk.facts())
            members = self.trunk.clients
            replies = self._collect(lambda: self._to_joined(request, members), timeout)  # noqa: B023 (called at once)
            self._count_trunk(replies, request.payload)
            rejected = self.trunk.average({client: reply.payload for client, reply in replies.items()})
            self._warn(rejections("part of the trunk", rejected))
            self._save()

    def _fault_of_moments(self, reply: Message) -> str | None:
        assert self.clients.common is not None
        n_updates, shape = reply.facts.get("n_updates"), self.clients.common["shapes"]["observations"]
        if type(n_updates) is not int or not 1 <= n_updates < 2**53:
            return "it does not say how long its data are to be trained on"
        return moments_fault(reply.payload, shape)

    def _to_joined(self, request: Message, members: Iterable[int] | None = None) -> dict[int, Message]:
        self._welcome()
        there = self.present & self.clients.joined.keys()
        return {client: request for client in sorted(there if members is None else there & set(members))}

    def _count_trunk(self, replies: Mapping[int, Message], sent: Payload) -> None:
        uploads = {client: reply.payload for client, reply in replies.items()}
        self.coordinator.count(payload_bytes(uploads), payload_bytes(dict.fromkeys(replies, sent)), offline=True)

    def _preparations(self) -> dict[int, Message]:
        """Requests to clients that have not completed the offline stage."""
        request = Message("setup", 0, {} if self.trunk is None else self.trunk.payload())
        return {client: message for client, message in self._to_joined(request).items() if client not in self.clients.prepared}

    def _prepare(self) -> None:
        """The local part of the offline stage."""
        started = time.monotonic()
        while True:
            for client in self._ask(self._preparations(), self.config.setup_timeout):
                self._note_prepared(client)
            if len(self._there()) >= self.config.min_clients:
                return self._save()
            self._pause(started, len(self._there()), self.config.min_clients)

    def _set_up(self) -> None:
        """One of the exchanges before the first round."""
        self.n_setups += 1

        def requests() -> dict[int, Message]:
            self._welcome()
            return self._to_prepared("setup", self.n_setups, self._there())

        replies = self._collect(requests, self.config.setup_timeout)
        self._aggregate(0, replies)
        self._save()

    def _play_round(self) -> None:
        round, config = self.round + 1, self.config
        started = time.perf_counter()

        def requests() -> dict[int, Message]:
            waiting = self._preparations()
            there = self._there()
            fraction = config.all_settings["client_fraction"]
            chosen = participants(there, config.seed, round - 1, fraction) if there else []
            return self._to_prepared("round", round, chosen) | waiting

        replies = self._collect(requests, config.timeout)
        facts = {client: reply.facts for client, reply in replies.items()}
        figures, earlier = merge_metrics(facts), self.timesteps[-1] if self.timesteps else 0
        self.timesteps.append(earlier + config.rollout_size * len(replies) + count_tests(facts, self.test_steps))
        exchanged = time.perf_counter()
        self._aggregate(round, replies)
        self.round = round
        figures |= self.coordinator.metrics
        figures |= {f"client_{client}/rejected": 1.0 for client in self.coordinator.rejected}
        figures["federated/participants"], figures["federated/failed"] = len(replies), len(self.failures)
        figures["time/exchange"] = time.perf_counter() - exchanged
        figures["time/round"], figures["time/server_round"] = round, time.perf_counter() - started
        self._report(round, replies, figures)
        self.failures = {}

    def _finish(self) -> None:
        """Deliver the last broadcast, and wait for absent clients for a while; after a restart, only for the missing ones."""
        started = time.monotonic()
        while away := self.clients.prepared.difference(self.dismissed):
            self._welcome()
            requests = self._to_prepared("finish", self.config.n_rounds, sorted(away.intersection(self._there())))
            replies = self._ask(requests, self.config.timeout)
            for client in replies:
                self.outbox.pop(client, None)
            self.dismissed += replies
            is_late, self.finished = self.finished, True
            if replies or not is_late:
                self._report(self.config.n_rounds, replies, None if is_late else {})  # an average is not of the late alone
            if time.monotonic() - started >= self.config.finish_timeout:
                break
            time.sleep(self.config.poll if away.difference(self.dismissed) else 0.0)
        if away := self.clients.prepared.difference(self.dismissed):
            logger.warning("clients %s do not know that the run is over; start the server again for them", sorted(away))

    def _report(self, round: int, replies: Mapping[int, Message], figures: dict[str, float] | None) -> None:
        """Store the clients' evaluations, call the hook unless ``figures`` is ``None``, and write the checkpoint."""
        evaluations = [
            evaluation
            for client, reply in sorted(replies.items())
            for evaluation in read_evaluations(client, reply.facts)
            if 0 < evaluation.round <= round
        ]
        if self._table is not None and evaluations:
            self._table.begin(EVALUATION_COLUMNS)
            self._table.add([evaluation.row(self.timesteps[evaluation.round - 1]) for evaluation in evaluations])
        if self.on_round is not None and figures is not None and (figures := figures | evaluation_metrics(evaluations)):
            self.on_round(round, {**figures, "time/total_timesteps": self.timesteps[-1]})
        self._save()

    def _aggregate(self, round: int, replies: Mapping[int, Message]) -> None:
        if self.coordinator.strategy is None:
            return
        uploads = {client: reply.payload for client, reply in replies.items()}
        broadcasts = self.coordinator.exchange(round, uploads, self.clients.prepared - uploads.keys())
        self.n_broadcasts += any(broadcasts.values())
        for client, broadcast in broadcasts.items():
            if broadcast:
                self.outbox[client] = (self.n_broadcasts, round, broadcast)
        self._warn(self.coordinator.complaints)

    def _warn(self, complaints: Iterable[str]) -> None:
        for complaint in complaints:
            logger.warning("round %d: %s", self.round + 1, complaint)

    def _there(self) -> list[int]:
        """The clients that were present at the last check and are ready to train."""
        return sorted(self.present & self.clients.prepared & self.clients.joined.keys())

    def _to_prepared(self, kind: Kind, round: int, clients: Iterable[int]) -> dict[int, Message]:
        """Requests with the payload that each client has missed."""
        requests = {}
        for client in clients:
            if client in self.coordinator.outdated:
                self.outbox[client] = (self.n_broadcasts, 0, self.coordinator.catch_up(client))
            number, after, payload = self.outbox.get(client, (0, 0, {}))
            requests[client] = Message(kind, round, payload, {"broadcast": number, "after": after})
        return requests

    def _collect(
        self,
        requests: Callable[[], dict[int, Message]],
        timeout: float | None,
        fault: Callable[[Message], str | None] | None = None,
    ) -> dict[int, Message]:
        """Replies of at least :attr:`ServerConfig.min_clients` clients; missing clients are asked again.

        :param requests: makes the requests to the clients that are present now
        :param fault: the reason why a reply does not count, if any
        """
        started, replies = time.monotonic(), {}
        while True:
            asked = {client: request for client, request in requests().items() if client not in replies}
            for client, reply in self._ask(asked, timeout, fault).items():
                if asked[client].kind == "setup" and asked[client].round == 0:
                    self._note_prepared(client)
                else:
                    replies[client] = reply
                    self.outbox.pop(client, None)
            if len(replies) >= self.config.min_clients:
                return replies
            self._pause(started, len(replies), self.config.min_clients)

    def _ask(
        self, requests: Mapping[int, Message], timeout: float | None, fault: Callable[[Message], str | None] | None = None
    ) -> dict[int, Message]:
        """The replies that arrived; for the other clients it records the reason."""
        if not requests:
            return {}
        requests = {
            client: replace(request, facts={**request.facts, RUN: self.run_id}) for client, request in requests.items()
        }
        answers, replies = self.transport.send_and_receive(requests, timeout), {}
        for client, request in requests.items():
            answer = answers.get(client, Failure("gone"))
            if isinstance(answer, Message):
                if (answer.kind, answer.round) != (request.kind, request.round):
                    answer = Failure(f"answered the request {answer.kind} {answer.round}")
                elif not isinstance(answer.facts, dict):
                    answer = Failure("its facts are no mapping")
                elif answer.facts.get(UNPREPARED):
                    self.clients.prepared.discard(client)
                    answer = Failure("not prepared: its state is gone, or it is new")
                elif fault is not None and (reason := fault(answer)):
                    answer = Failure(f"its answer is of no use: {reason}")
            if isinstance(answer, Message):
                replies[client] = answer
                continue
            self.failures[client] = answer.reason
            logger.warning("%s %d: client %d is left out (%s)", request.kind, request.round, client, answer.reason)
        return replies

    def _note_prepared(self, client: int) -> None:
        self.clients.prepared.add(client)
        if self.n_broadcasts > 0:  # it has missed a broadcast
            self.coordinator.outdated.add(client)

    def _pause(self, started: float, have: int, need: int) -> None:
        """Wait before the next check of the present clients.

        :raises TooFewClients: after :attr:`ServerConfig.wait`
        """
        limit = self.config.wait
        if limit is not None and time.monotonic() - started >= limit:
            where = "before the first round" if self.round == 0 else f"after round {self.round}"
            raise TooFewClients(f"{have} of the {need} clients that are needed {where}, after {limit:g} s of waiting")
        time.sleep(self.config.poll)

    def _save(self) -> None:
        if self.folder is None or self._table is None:
            return
        state: State = {
            "server": self.clients.facts,
            "attributes": freeze({name: getattr(self, name) for name in _ATTRIBUTES}),
            "outdated": sorted(self.coordinator.outdated),
            "bytes": self.coordinator.bytes_counted,
            "clients": self.clients.save_state(),
            "strategy": None if self.coordinator.strategy is None else self.coordinator.strategy.save_state(),
            "trunk": None if self.trunk is None else self.trunk.save_state(),
            "table_size": self._table.size,
        }
        write_checkpoint(self.folder / CHECKPOINTS, self.round, state)

    def _resume(self) -> None:
        """Load the checkpoint, if there is one.

        :raises ValueError: for that of another federation
        """
        if self.folder is None or self._table is None:
            return
        remove_leftovers(self.folder / CHECKPOINTS)
        found = newest_checkpoint(self.folder / CHECKPOINTS)
        if found is None:
            return
        path, state = found
        if other := difference(state["server"], self.clients.facts, RUN_FACTS, "this server's"):
            raise ValueError(f"{path} is the checkpoint of another federation: {other}; give this one a folder of its own")
        for name, value in thaw(state["attributes"]).items():
            setattr(self, name, value)
        self.coordinator.outdated = set(state["outdated"])
        self.coordinator.bytes_counted = state["bytes"]
        self.clients.load_state(state["clients"])
        if self.coordinator.strategy is not None:
            self.coordinator.strategy.load_state(state["strategy"])
        self.trunk = None if state["trunk"] is None else TrunkAverages.from_state(state["trunk"])
        self._table.cut(state["table_size"])
        logger.info("going on after round %d", self.round)
