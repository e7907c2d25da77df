"""The server of a real federation, with clients of a few lines: who takes part, who is left out, and what is kept."""

from __future__ import annotations

import json
import logging
import re
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sb3_fedguide
from fed_envs.faults import ClientError
from sb3_fedguide import FedAvg, FedGuideA
from sb3_fedguide.algorithms import ALGORITHMS, algorithm
from sb3_fedguide.cli.schema import hyperparameters
from sb3_fedguide.common.checkpoint_files import checkpoints
from sb3_fedguide.server import build
from sb3_fedguide.server.averaging import Averaging, weighted_average
from sb3_fedguide.server.build import METHODS, Method, complete_settings, make_strategy, register_method
from sb3_fedguide.server.figures import ClientEvaluation, evaluation_figures, merge_figures, read_evaluations
from sb3_fedguide.server.ot_moe import OTMoE
from sb3_fedguide.server.participants import draw_participants
from sb3_fedguide.server.rounds import Rounds, participants
from sb3_fedguide.server.serve import Server, ServerConfig, TooFewClients, serve
from sb3_fedguide.server.svrpg import SVRPG
from sb3_fedguide.server.transport import Failure, Message
from sb3_fedguide.server.trunk import TrunkAverages, excessive_updates, moments_fault
from tests.loop_transport import LoopTransport, timeout

ROOT = Path(__file__).resolve().parent.parent
NAME = "action_net.weight"


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


# --- rounds ---------------------------------------------------------------------------------------------------------------


def upload(value: float) -> dict[str, np.ndarray]:
    return {NAME: np.full(3, value, dtype=np.float32), "n_samples": np.array(8, dtype=np.float32)}


def test_who_misses_what_others_receive_catches_up_once():
    rounds = Rounds(Averaging(average_every=2))
    assert rounds.exchange(1, {0: upload(1), 1: upload(3)}, absent=[2]) == {0: {}, 1: {}} and rounds.outdated == set()
    broadcasts = rounds.exchange(2, {0: upload(1), 1: upload(3)}, absent=[2])
    np.testing.assert_array_equal(broadcasts[0][NAME], [2, 2, 2])
    assert rounds.outdated == {2} and (rounds.bytes_up, rounds.bytes_down) == (4 * 16, 2 * 12)
    np.testing.assert_array_equal(rounds.catch_up(2)[NAME], [2, 2, 2])
    assert rounds.outdated == set() and rounds.bytes_down == 3 * 12
    assert rounds.figures["federated/bytes_total"] == 4 * 16 + 2 * 12 and rounds.figures["federated/bytes_down"] == 24


def test_who_is_rejected_is_outdated():
    rounds = Rounds(Averaging())
    assert sorted(rounds.exchange(1, {0: upload(1), 1: upload(np.nan), 2: "nothing"})) == [0]
    assert rounds.outdated == {1, 2} == rounds.rejected.keys() and rounds.figures["federated/rejected"] == 2


def test_participants_are_those_of_a_federation_in_process():
    drawn = [participants([0, 1, 2, 3], 7, round, 0.5) for round in range(20)]
    assert drawn == [np.flatnonzero(draw_participants(7, round, 4, 2)).tolist() for round in range(20)]
    assert participants([2, 5, 9], 7, 0, 1.0) == [2, 5, 9] and set(participants([2, 5, 9], 7, 0, 0.4)) <= {2, 5, 9}


# --- strategies without models --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALGORITHMS)
def test_defaults_on_the_server_are_those_of_the_constructors(name):
    parameters = hyperparameters(algorithm(name))
    settings = complete_settings(name, {})
    assert settings == {key: parameters[key][1] for key in settings}
    assert algorithm(name).server_method in METHODS


def test_one_definition_for_models_and_servers():
    model = FedGuideA("MlpPolicy", "Bandit2D", seed=4, eta=0.2, average_every=3, upload_bound=None, rollout_size=64)
    own, served = model.strategy, make_strategy("fedguide-a", model.server_settings(), 4, 4)
    assert json.dumps(model.server_settings()) and served.upload_bound is None
    for one, other in zip(own.strategies, served.strategies, strict=True):
        assert type(one) is type(other)
        assert {**vars(one), "rng": 0} == {**vars(other), "rng": 0}
    assert own.strategies[0].rng.random() == served.strategies[0].rng.random() and served.strategies[0].n_experts == 4
    fedavg = FedAvg("MlpPolicy", "Bandit2D", average="critic", average_until=7, seed=0, rollout_size=64)
    assert vars(make_strategy("fedavg", fedavg.server_settings(), 4, 0)) == vars(fedavg.strategy)
    kinds = {name: make_strategy(name, {}, 3, 0) for name in ALGORITHMS}
    assert kinds["local"] is None and isinstance(kinds["fedsvrpgm"], SVRPG) and isinstance(kinds["fedguide-p"], OTMoE)
    assert kinds["fedrl"].prefixes == ("actor.", "critic.") and kinds["fedguide"].n_experts == 3


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("fedavg", {"averge": "all"}, "no setting 'averge'"),
        ("fedavg", {"average": "everything"}, "average='everything' must be one of"),
        ("fedrl", {"average_every": 0}, "average_every=0"),
        ("fedguide-a", {"average_every": 0}, "average_every=0"),
        ("fedguide", {"eta": -1.0}, "eta=-1.0"),
        ("fedavg", {"client_fraction": 0.0}, "client_fraction=0.0"),
        ("fedavg", {"upload_bound": -1.0}, "upload_bound=-1.0"),
        ("fedbest", {}, "unknown algorithm 'fedbest'"),
    ],
)
def test_wrong_settings_are_refused(name, settings, message):
    with pytest.raises(ValueError, match=message):
        make_strategy(name, settings, 3, 0)


class Half(FedAvg):
    def receive(self, index, broadcast):
        pass


class Own(FedAvg):
    def _make_strategy(self):
        return Averaging(self.averaged_prefixes)


def test_algorithms_of_ones_own(monkeypatch):
    monkeypatch.setitem(ALGORITHMS, "half", (__name__, "Half"))
    monkeypatch.setitem(ALGORITHMS, "own", (__name__, "Own"))
    assert make_strategy("half", {"average_every": 3}, 3, 0).average_every == 3  # its class's own server
    with pytest.raises(ValueError, match="register_method"):
        make_strategy("own", {}, 3, 0)
    monkeypatch.setattr(build, "METHODS", dict(METHODS))
    register_method("own", Method(lambda settings, n_clients, seed: Averaging(("x",) * n_clients), {"k": 1}))
    assert make_strategy("own", {"k": 2}, 3, 0).prefixes == ("x",) * 3
    with pytest.raises(ValueError, match="has a server's side already"):
        register_method("own", METHODS["fedavg"])


# --- serving --------------------------------------------------------------------------------------------------------------


def expected(n_rounds: int = 5, clients: tuple[int, ...] = (0, 1, 2, 3)) -> np.ndarray:
    """Where everybody is after the rounds, if nobody was absent."""
    theta = np.zeros(3, dtype=np.float32)
    for round in range(1, n_rounds + 1):
        moved = [theta + np.random.default_rng([client, round]).normal(size=3) for client in clients]
        uploads = {k: {**upload(0), NAME: own.astype(np.float32)} for k, own in enumerate(moved)}
        theta = weighted_average(uploads, [NAME])[NAME]
    return theta


def test_a_run_with_its_log_and_its_table(tmp_path):
    transport, server, rows = run(folder=tmp_path)
    for client in range(4):
        np.testing.assert_array_equal(transport.site(client).theta, expected())
    assert server.round == 5 and server.finished and [row["round"] for row in rows] == [1, 2, 3, 4, 5]
    last = rows[-1]
    assert last["train/loss"] == 1.5 and last["client_2/std"] == 1.0 and "client_99/std" not in last
    assert last["federated/participants"] == 4 and last["time/total_timesteps"] == 5 * 4 * 8
    assert last["federated/bytes_total"] == 5 * 4 * (16 + 12) == server.rounds.bytes_up + server.rounds.bytes_down
    assert last["eval/mean_reward"] == 1.5 and last["eval/worst_client"] == 0 and last["eval/mean_ep_length"] == 7
    table = (tmp_path / "evaluations.csv").read_text().splitlines()
    assert table[0] == "round,timesteps,policy,client,mean_return,std_return,mean_length,success_rate"
    assert table[1] == "1,32,deployed,0,0,0,7," and table[-1] == "5,160,deployed,3,3,0,7," and len(table) == 21


def test_a_lost_reply_is_asked_for_again_where_all_are_needed():
    transport = LoopTransport(Client, [0, 1, 2, 3])
    transport.faults = {(1, "round", 2): timeout, (3, "setup", 0): timeout}
    transport.undelivered = {(2, "round", 4)}
    _, _, rows = run(replaced(CONFIG, min_clients=4, wait=None), transport)
    np.testing.assert_array_equal(transport.site(1).theta, expected())
    assert all(transport.site(client).trained == [1, 2, 3, 4, 5] for client in range(4))
    assert transport.sent.count((1, "round", 2)) == 2 and [row["federated/failed"] for row in rows] == [1, 1, 0, 1, 0]


def test_who_is_too_slow_is_absent_for_the_round_and_catches_up(caplog):
    transport = LoopTransport(Client, [0, 1, 2, 3])
    transport.faults = {(1, "round", 2): timeout}
    received = {}

    def watch(client: int, message: Message) -> None:
        if message.kind == "round":
            received[client, message.round] = message.payload.get(NAME), message.facts["broadcast"]

    transport.watch = watch
    with caplog.at_level(logging.WARNING):
        _, server, rows = run(transport=transport)
    assert "client 1 is left out (timeout)" in caplog.text
    assert [row["federated/participants"] for row in rows] == [4, 3, 4, 4, 4] and transport.site(1).trained == [1, 2, 3, 4, 5]
    np.testing.assert_array_equal(received[1, 3][0], received[0, 3][0])  # what the others received after round 2
    assert received[1, 3][1] == 2
    thetas = [transport.site(client).theta for client in range(4)]
    assert all(np.array_equal(theta, thetas[0]) for theta in thetas) and server.timesteps == [32, 56, 88, 120, 152]


def test_a_client_that_is_away_for_a_while_and_one_that_comes_late_are_welcome():
    transport = LoopTransport(Client, [0, 1])
    received = {}

    def watch(client: int, message: Message) -> None:
        coming = {1: [0, 1], 2: [0, 1, 2], 3: [0, 2], 4: [0, 1, 2]}
        if message.kind == "round" and client == 0:
            transport.present = coming.get(message.round, transport.present)
        if message.kind == "round":
            received[client, message.round] = message.payload.get(NAME)

    transport.watch = watch
    _, server, rows = run(replaced(CONFIG, start_clients=2), transport)
    assert transport.site(2).trained == [4, 5] and transport.site(1).trained == [1, 2, 5]
    assert [row["federated/participants"] for row in rows] == [2, 2, 1, 2, 3]
    assert sorted(server.clients.joined) == [0, 1, 2] and server.rounds.outdated == set()
    for client, round in ((2, 4), (1, 5)):  # both begin with what the others have
        np.testing.assert_array_equal(received[client, round], received[0, round])
    thetas = [transport.site(client).theta for client in range(3)]
    assert all(np.array_equal(theta, thetas[0]) for theta in thetas)


def test_who_comes_between_two_averages_begins_with_the_last():
    settings = {"average_every": 2}
    own = {"settings": complete_settings("fedavg", settings)}
    transport, received = LoopTransport(lambda client: Client(client, **own), [0, 1]), {}

    def watch(client: int, message: Message) -> None:
        if message.kind == "round":
            received[client, message.round] = message.payload.get(NAME)
            transport.present = [0, 1, 2] if message.round >= 2 else [0, 1]

    transport.watch = watch
    run(replaced(CONFIG, start_clients=2, settings=settings), transport)
    assert transport.site(2).trained == [4, 5] and received[0, 4] is None
    np.testing.assert_array_equal(received[2, 4], received[0, 3])


def test_below_the_fewest_clients_it_waits_or_stops_and_goes_on_later(tmp_path):
    transport = LoopTransport(Client, [0, 1, 2, 3])

    def leave(client: int, message: Message) -> None:
        if (message.kind, message.round) == ("round", 3):
            transport.present = [0]

    transport.watch = leave
    few = replaced(CONFIG, min_clients=3)
    with pytest.raises(TooFewClients, match=r"1 of the 3 clients that are needed after round 2, after 0 s"):
        run(few, transport, tmp_path)
    assert transport.site(0).trained == [1, 2, 3] and transport.site(1).trained == [1, 2]
    transport.present, transport.watch = [0, 1, 2, 3], lambda client, message: None
    _, _, rows = run(few, transport, tmp_path)
    assert [row["round"] for row in rows] == [3, 4, 5] and transport.site(0).trained == [1, 2, 3, 4, 5]
    np.testing.assert_array_equal(transport.site(2).theta, expected())

    looks = []
    transport = LoopTransport(Client, [0])
    transport.clients = lambda: looks.append(0) or ([0, 1, 2, 3] if len(looks) > 5 else [0])  # type: ignore[method-assign]
    transport.present = [0, 1, 2, 3]
    run(replaced(CONFIG, wait=None), transport)
    np.testing.assert_array_equal(transport.site(3).theta, expected())


@pytest.mark.parametrize(
    ("facts", "reason"),
    [
        ({"seed": 2}, "its seed is 2, the server's 1"),
        ({"algorithm": "fedprox"}, "its algorithm is 'fedprox', the server's 'fedavg'"),
        ({"n_rounds": 6}, "its n_rounds is 6"),
        ({"rollout_size": 9}, "its rollout_size is 9"),
        ({"version": "0.0"}, "its version is '0.0'"),
        ({"settings": {**STATED["settings"], "average_every": 2}}, "settings: its average_every is 2, the server's 1"),
        ({"settings": None}, "its settings is None"),
        ({"shapes": {NAME: [4]}}, r"shapes: its action_net.weight is \[4\], most others' \[3\]"),
        ({"trunk": {"prior_width": 4}}, "its trunk is {'prior_width': 4}, most others' None"),
        ({"client": 3}, "it says that it is client 3"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_a_client_with_other_settings_is_refused(facts, reason, caplog):
    def make(client: int) -> Client:
        return Client(client, **(facts if client == 0 else {}))

    with caplog.at_level(logging.WARNING):
        transport, server, _ = run(replaced(CONFIG, start_clients=3), LoopTransport(make, [0, 1, 2, 3]))
    assert list(server.clients.refused) == [0]
    assert re.search(f"client 0 is refused: {reason}", caplog.text)
    assert transport.site(0).trained == [] and transport.site(1).trained == [1, 2, 3, 4, 5]
    np.testing.assert_array_equal(transport.site(1).theta, expected(clients=(1, 2, 3)))


def test_a_refused_client_is_asked_again_when_it_has_been_away():
    transport = LoopTransport(lambda client: Client(client, seed=2), [0, 1, 2, 3])
    for client in (0, 1, 2):
        transport.sites[client] = Client(client)

    def watch(client: int, message: Message) -> None:
        if message.kind == "round" and client == 0:
            transport.present = [0, 1, 2] if message.round == 2 else [0, 1, 2, 3]
            if message.round == 2:
                transport.sites[3] = Client(3)

    transport.watch = watch
    _, server, _ = run(replaced(CONFIG, start_clients=3), transport)
    assert transport.sent.count((3, "join", 0)) == 2 and transport.site(3).trained == [5] and server.clients.refused == {}


def broken(value: Any) -> Any:
    def fault(reply: Message) -> Message:
        return Message(reply.kind, reply.round, {**reply.payload, NAME: value}, reply.facts)

    return fault


@pytest.mark.parametrize(
    "value", [np.full(3, np.nan, np.float32), np.zeros(4, np.float32), np.zeros(3), "text", None], ids=repr
)
def test_a_broken_upload_is_rejected_and_counted_and_moves_nobody(value, caplog):
    transport = LoopTransport(Client, [0, 1, 2, 3])
    transport.faults = {(2, "round", 3): broken(value)}
    with caplog.at_level(logging.WARNING):
        _, _, rows = run(transport=transport)
    assert [row["federated/rejected"] for row in rows] == [0, 0, 1, 0, 0] and rows[2]["client_2/rejected"] == 1
    assert "round 3: the server rejects the upload of client 2" in caplog.text
    thetas = [transport.site(client).theta for client in range(4)]
    assert all(np.array_equal(theta, thetas[0]) and np.isfinite(theta).all() for theta in thetas)


def test_answers_to_other_requests_and_clients_that_raise_are_left_out(caplog):
    class Raising(Client):
        def answer(self, message: Message):
            if (message.kind, message.round) == ("round", 2):
                raise ValueError("the goal of the patient is at 0.1234")
            return super().answer(message)

    transport = LoopTransport(lambda client: Raising(client) if client == 1 else Client(client), [0, 1, 2, 3])
    transport.faults = {
        (0, "round", 1): lambda reply: Message("round", 7, reply.payload, reply.facts),
        (2, "round", 3): lambda reply: Message("setup", 3, reply.payload, reply.facts),
        (3, "round", 4): lambda reply: Message("round", 4, {}, {"unprepared": True}),
        (0, "round", 5): lambda reply: Message("round", 5, reply.payload, ["figures"]),  # type: ignore[arg-type]
    }
    with caplog.at_level(logging.WARNING):
        _, _, rows = run(transport=transport)
    assert [row["federated/participants"] for row in rows] == [3, 3, 3, 3, 2]
    assert "client 1 is left out (error: ValueError)" in caplog.text and "patient" not in caplog.text
    assert transport.sent.count((3, "setup", 0)) == 2  # prepared again, while the others trained


def test_without_exchange_there_are_logs_and_nothing_else(tmp_path):
    config = replaced(CONFIG, algorithm="local")
    own = {"algorithm": "local", "settings": complete_settings("local", {})}
    transport, server, rows = run(config, LoopTransport(lambda client: Client(client, **own), [0, 1, 2, 3]), tmp_path)
    assert server.rounds.strategy is None and rows[-1]["train/loss"] == 1.5 and "federated/bytes_up" not in rows[-1]
    assert not np.array_equal(transport.site(0).theta, transport.site(1).theta)


class Killed(BaseException):
    """As if the server's process had ended."""


@pytest.mark.parametrize(("kind", "round"), [("join", 0), ("setup", 0), ("round", 1), ("round", 3), ("finish", 5)])
@pytest.mark.parametrize("before", [True, False], ids=["before", "between two clients"])
def test_a_server_that_is_killed_goes_on_to_the_same_end(kind, round, before, tmp_path):
    transport = LoopTransport(Client, [0, 1, 2, 3])

    def kill(client: int, message: Message) -> None:
        if (client, message.kind, message.round) == (0 if before else 2, kind, round):
            transport.watch = lambda client, message: None
            raise Killed

    transport.watch = kill
    with pytest.raises(Killed):
        run(transport=transport, folder=tmp_path)
    (tmp_path / "evaluations.csv").open("a").write("9,9,deployed,0,0,0,0,\n" if kind == "round" and round > 1 else "")
    _, server, rows = run(transport=transport, folder=tmp_path)
    for client in range(4):
        np.testing.assert_array_equal(transport.site(client).theta, expected())
        assert transport.site(client).trained == [1, 2, 3, 4, 5]
    assert server.rounds.bytes_up == 5 * 4 * 16 and server.rounds.bytes_down == 5 * 4 * 12
    assert len((tmp_path / "evaluations.csv").read_text().splitlines()) == 21
    assert [row["round"] for row in rows] == [*range(round if kind == "round" else 1, 6)] or kind == "finish"
    assert len(checkpoints(tmp_path / "checkpoints")) == 2
    _, _, rows = run(transport=transport, folder=tmp_path)  # a finished run is finished
    assert rows == [] and transport.site(0).trained == [1, 2, 3, 4, 5]


def evaluates(client: int) -> Client:
    """Measures what was sent last."""

    class Evaluating(Client):
        def answer(self, message: Message):
            payload, facts = super().answer(message)
            if message.kind == "finish":
                facts = {"evaluations": [ClientEvaluation(client, 5, "broadcast", [float(client)], [7]).facts()]}
            return payload, facts

    return Evaluating(client)


def test_what_is_measured_at_the_end_has_the_steps_of_the_last_round():
    _, _, rows = run(transport=LoopTransport(evaluates, [0, 1, 2, 3]))
    assert rows[-1] == {"round": 5, "eval/broadcast_mean_reward": 1.5, "time/total_timesteps": 160} and len(rows) == 6


def test_who_is_away_at_the_end_hears_of_it_when_it_comes_back(tmp_path):
    transport = LoopTransport(evaluates, [0, 1, 2, 3])
    transport.undelivered = {(2, "finish", 5)}
    patient = replaced(CONFIG, wait=None, timeout=30.0)
    _, server, rows = run(patient, transport, tmp_path / "waits")
    assert [key for key in transport.sent if key[1] == "finish"] == [
        *((client, "finish", 5) for client in range(4)),
        (2, "finish", 5),
    ]
    assert sorted(server.told) == [0, 1, 2, 3] and server.outbox == {}
    np.testing.assert_array_equal(transport.site(2).theta, expected())
    assert [row["round"] for row in rows] == [1, 2, 3, 4, 5, 5]  # of those who come late there is no average
    assert len((tmp_path / "waits" / "evaluations.csv").read_text().splitlines()) == 1 + 5 * 4 + 4


def test_a_finished_server_that_is_started_again_tells_who_was_away(tmp_path, caplog):
    transport = LoopTransport(evaluates, [0, 1, 2, 3])
    transport.undelivered = {(2, "finish", 5)}
    with caplog.at_level(logging.WARNING):
        _, server, _ = run(transport=transport, folder=tmp_path)
    assert server.finished and server.told == [0, 1, 3] and list(server.outbox) == [2]
    assert "clients [2] have not heard that the run is over" in caplog.text
    nobody = LoopTransport(Client, [])
    run(transport=nobody, folder=tmp_path)
    assert nobody.sent == []
    transport.sent.clear()
    _, server, rows = run(transport=transport, folder=tmp_path)
    assert [key for key in transport.sent if key[1] != "join"] == [(2, "finish", 5)] and rows == []
    np.testing.assert_array_equal(transport.site(2).theta, expected())
    transport.sent.clear()
    run(replaced(CONFIG, wait=None), transport, tmp_path)
    assert transport.sent == []


def test_another_version_goes_on_with_a_run_if_all_have_it(tmp_path, monkeypatch, caplog):
    transport = LoopTransport(Client, [0, 1, 2, 3])

    def kill(client: int, message: Message) -> None:
        if (client, message.kind, message.round) == (0, "round", 3):
            raise Killed

    transport.watch = kill
    with pytest.raises(Killed):
        run(transport=transport, folder=tmp_path)
    transport.watch = lambda client, message: None
    monkeypatch.setattr(sb3_fedguide, "__version__", "99.0")
    for client in (0, 1, 2):
        transport.site(client).facts["version"] = "99.0"
    with caplog.at_level(logging.WARNING):
        _, server, _ = run(transport=transport, folder=tmp_path)
    assert transport.site(0).trained == [1, 2, 3, 4, 5] and transport.site(3).trained == [1, 2]
    assert server.round == 5 and list(server.clients.refused) == [3]
    assert f"client 3 is refused: its version is '{STATED['version']}', the server's '99.0'" in caplog.text


def test_the_checkpoint_of_another_federation_is_refused(tmp_path):
    run(folder=tmp_path)
    with pytest.raises(ValueError, match=r"another federation: its seed is 1, this server's 2; give this one a folder"):
        Server(replaced(CONFIG, seed=2), LoopTransport(Client, []), tmp_path).run()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_rounds": 0}, "n_rounds=0"),
        ({"start_clients": 5}, "start_clients=5"),
        ({"min_clients": 5}, "min_clients=5, but only 4"),
        ({"min_clients": 3, "settings": {"client_fraction": 0.5}}, "min_clients=3, but only 2"),
        ({"settings": {"lambda_prior": 1.0}}, "no setting 'lambda_prior'"),
        ({"seed": -1}, "seed=-1 must be an integer"),
        ({"seed": 1.0}, r"seed=1\.0 must be an integer"),
        ({"timeout": 0.0}, r"timeout=0\.0 must be a number of seconds above 0, or None"),
        ({"setup_timeout": float("inf")}, "setup_timeout=inf must be .* or None"),
        ({"wait": float("nan")}, "wait=nan must be .* or None"),
        ({"poll": -1.0}, r"poll=-1\.0 must be"),
    ],
)
def test_a_configuration_that_cannot_be_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        replaced(CONFIG, **changes)


def test_an_unknown_kind_of_message_is_refused():
    with pytest.raises(ValueError, match="kind 'shell'"):
        Message("shell", 1)
    assert Failure.of(KeyError("secret")).reason == "error: KeyError"


# --- what clients report --------------------------------------------------------------------------------------------------


def test_reports_are_data_of_strangers():
    assert merge_figures(
        {0: {"figures": "none"}, 1: {}, 2: {"figures": {1: 2, "a": "b", "c": True, "d": 3, "eval/x": 1}}}
    ) == {"d": 3}
    hostile = {"a": 10**400, "b": float("nan"), "c": float("-inf"), "client_1/d": 10**400, "client_1/e": float("nan"), "f": 2}
    assert merge_figures({0: {"figures": {"a": 1, "b": 2.0}}, 1: {"figures": hostile}}) == {"a": 1.0, "b": 2.0, "f": 2.0}
    good = ClientEvaluation(4, 2, "broadcast", [1.0, 2.0], [3, 4], [True, False])
    assert read_evaluations(4, {"evaluations": [good.facts()]}) == [good]
    for change in (
        {"returns": [float("nan"), 1.0]}, {"returns": []}, {"lengths": [1]}, {"policy": "../x"}, {"round": "x"},
        {"successes": [True]}, {"returns": None}, {"returns": [10**400, 1.0]}, {"lengths": [10**400, 1]},
        {"lengths": [2**53, 1]}, {"lengths": [-1, 1]},
    ):  # fmt: skip
        assert read_evaluations(4, {"evaluations": [{**good.facts(), **change}]}) == []
    assert read_evaluations(4, {"evaluations": "x"}) == read_evaluations(4, {"evaluations": [3, None]}) == []
    figures = evaluation_figures([good, ClientEvaluation(1, 2, "deployed", [4.0], [2], [True])])
    assert figures["eval/broadcast_mean_reward"] == 1.5 and figures["eval/success_rate"] == 1.0


# --- the trunk ------------------------------------------------------------------------------------------------------------


def moments(**changes: Any) -> dict[str, Any]:
    return {"n_samples": np.array(5.0), "mean": np.zeros(2), "var": np.ones(2), **changes}


@pytest.mark.parametrize(
    "changes",
    [
        {"n_samples": np.array(0.0)}, {"n_samples": np.array(1.5)}, {"n_samples": np.array(np.inf)}, {"n_samples": 5.0},
        {"mean": np.zeros(2, np.float32)}, {"mean": np.array([np.nan, 0])}, {"var": -np.ones(2)}, {"var": np.ones(3)},
        {"mean": np.zeros((2, 1)), "var": np.ones((2, 1))}, {"more": np.zeros(1)}, {"mean": "x"},
        {"mean": np.array([0, -2e12])}, {"var": np.array([2e12, 0])}, {"n_samples": np.array(2.0**41)},
    ],
)  # fmt: skip
def test_moments_that_cannot_be_are_found(changes):
    assert moments_fault(moments()) is None
    assert moments_fault(moments(**changes)) is not None


@pytest.mark.parametrize("n_updates", [701, 10**9, 10**400, True, "7"])
def test_one_client_does_not_have_all_train_for_ever(n_updates, caplog):
    common = {"shapes": {NAME: [3], "observations": [2]}, "trunk": {"prior_average_every": 4}}

    class Trunk(Client):
        def answer(self, message: Message):
            if message.kind == "moments":
                return moments(), {"n_updates": n_updates if self.client == 0 else 7}
            if message.kind == "trunk":
                return {"w": np.ones(2, np.float32)}, {}
            return super().answer(message)

    with caplog.at_level(logging.WARNING):
        _, server, _ = run(transport=LoopTransport(lambda client: Trunk(client, **common), [0, 1, 2, 3]))
    assert server.trunk.clients == [1, 2, 3] and server.trunk.n_updates == 7 and server.round == 5
    assert re.search(r"moments of client 0: it wants \d+ updates|client 0 is left out \(its answer is of no use", caplog.text)
    assert excessive_updates({0: 700, 1: 7, 2: 7}) == {} and list(excessive_updates({0: 701, 1: 7, 2: 7})) == [0]


def test_trunks_are_averaged_by_samples_and_broken_ones_are_left_out():
    own = {0: moments(), 1: moments(n_samples=np.array(15.0)), 2: moments()}
    trunk = TrunkAverages(own, n_updates=5, average_every=2, upload_bound=30.0)
    assert trunk.facts() == {"n_updates": 5, "n_done": 0, "average_every": 2}
    assert sorted(trunk.payload()) == [
        "moments.mean",
        "moments.std",
    ]
    values = {client: {"w": np.full(2, float(client), np.float32)} for client in own}
    assert trunk.average({0: values[0], 1: values[1]}) == {}
    np.testing.assert_allclose(trunk.trunk["w"], [0.75, 0.75])
    rejected = trunk.average({**values, 2: {"w": np.full(2, np.nan, np.float32)}})
    assert list(rejected) == [2] and trunk.n_done == 4 and not trunk.finished
    again = TrunkAverages.from_state(trunk.save_state())
    assert again.facts() == trunk.facts()
    with pytest.raises(ClientError, match="rejects every upload: client 2"):
        again.average({2: {"w": np.full(2, np.nan, np.float32)}})
    assert again.n_done == 4
    again.average({0: values[0]})
    assert again.n_done == 5 and again.finished and not trunk.finished


# --- without PyTorch ------------------------------------------------------------------------------------------------------

ALONE = """
import importlib.machinery
import sys

blocked = ["torch", "gymnasium", "mujoco", "metaworld", "stable_baselines3", "gymnasium_robotics", "minari", "pydantic"]

class Finder(importlib.machinery.PathFinder):  # as if they were not installed
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in blocked else super().find_spec(name, path, target)

sys.meta_path[:] = [Finder if finder is importlib.machinery.PathFinder else finder for finder in sys.meta_path]
from sb3_fedguide.server.build import METHODS, complete_settings, make_strategy
for name in METHODS:
    make_strategy(name, {}, 3, 0)
import numpy as np
import sb3_fedguide
from sb3_fedguide.server.serve import ServerConfig, serve
from sb3_fedguide.server.transport import Message

class Transport:
    def clients(self):
        return [0, 1, 2]

    def exchange(self, requests, timeout):
        return {client: self.reply(client, request) for client, request in requests.items()}

    def reply(self, client, request):
        facts, payload = {}, {}
        if request.kind == "join":
            facts = {
                "algorithm": "fedguide-a", "version": sb3_fedguide.__version__, "seed": 0, "n_rounds": 4, "rollout_size": 8,
                "settings": complete_settings("fedguide-a", {"average_every": 2}), "client": client,
                "shapes": {"observations": [2]}, "trunk": {"prior_average_every": 3},
            }
        rng = np.random.default_rng(client)
        if request.kind == "moments":
            payload, facts = {"n_samples": np.array(9.0), "mean": rng.normal(size=2), "var": np.ones(2)}, {"n_updates": 7}
        if request.kind == "trunk":
            payload = {"w": rng.normal(size=(2, 2)).astype(np.float32)}
        if request.kind == "round" or (request.kind == "setup" and request.round > 0):
            payload["prior.head"] = rng.normal(size=(2, 3)).astype(np.float32)
            if "prior.experts" in request.payload or request.kind == "round":
                payload["prior.cost_row"] = rng.random(3).astype(np.float32)
        if request.kind == "round" and request.round % 2 == 0:
            payload.update(log_std=np.zeros(2, np.float32), n_samples=np.array(8, np.float32))
        return Message(request.kind, request.round, payload, facts)

config = ServerConfig("fedguide-a", 3, 4, 8, 0, {"average_every": 2}, wait=0.0, poll=0.0)
for n in (1, 2):
    server = serve(config, Transport(), sys.argv[1])
print(server.round, server.trunk.n_done, sorted(sys.modules.keys() & set(blocked)))
"""


def test_the_server_needs_neither_pytorch_nor_environments(tmp_path):
    command = [sys.executable, "-c", textwrap.dedent(ALONE), str(tmp_path)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert result.stdout == "4 7 []\n", result.stderr
