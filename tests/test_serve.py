"""The server of a real federation, with clients of a few lines: who takes part, who is left out, and what is kept."""

from __future__ import annotations

import logging
import re
from typing import Any

import numpy as np
import pytest

import sb3_fedguide
from sb3_fedguide.deployment.serve import Server, TooFewClients
from sb3_fedguide.deployment.transport import Failure, Message
from sb3_fedguide.server.averaging import combine
from sb3_fedguide.server.methods import complete_settings
from sb3_fedguide.server.metrics import ClientEvaluation, count_tests
from sb3_fedguide.state.checkpoint_files import checkpoints
from tests.loop_transport import CONFIG, NAME, STATED, Client, LoopTransport, replaced, run, timeout, upload


def expected(n_rounds: int = 5, clients: tuple[int, ...] = (0, 1, 2, 3)) -> np.ndarray:
    """Where everybody is after the rounds, if nobody was absent."""
    theta = np.zeros(3, dtype=np.float32)
    for round in range(1, n_rounds + 1):
        moved = [theta + np.random.default_rng([client, round]).normal(size=3) for client in clients]
        uploads = {k: {**upload(0), NAME: own.astype(np.float32)} for k, own in enumerate(moved)}
        theta = combine(uploads, [NAME], "mean", 0.0)[NAME]
    return theta


def test_a_run_with_its_log_and_its_table(tmp_path):
    transport, server, rows = run(folder=tmp_path)
    for client in range(4):
        np.testing.assert_array_equal(transport.site(client).theta, expected())
    assert server.round == 5 and server.finished and [row["round"] for row in rows] == [1, 2, 3, 4, 5]
    last = rows[-1]
    assert last["train/loss"] == 1.5 and last["client_2/std"] == 1.0 and "client_99/std" not in last
    assert last["federated/participants"] == 4 and last["time/total_timesteps"] == 5 * 4 * 8
    assert last["federated/bytes_total"] == 5 * 4 * (16 + 12) == server.coordinator.bytes_up + server.coordinator.bytes_down
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
    assert sorted(server.clients.joined) == [0, 1, 2] and server.coordinator.outdated == set()
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
    assert server.coordinator.strategy is None and rows[-1]["train/loss"] == 1.5 and "federated/bytes_up" not in rows[-1]
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
    assert server.coordinator.bytes_up == 5 * 4 * 16 and server.coordinator.bytes_down == 5 * 4 * 12
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
    assert sorted(server.dismissed) == [0, 1, 2, 3] and server.outbox == {}
    np.testing.assert_array_equal(transport.site(2).theta, expected())
    assert [row["round"] for row in rows] == [1, 2, 3, 4, 5, 5]  # of those who come late there is no average
    assert len((tmp_path / "waits" / "evaluations.csv").read_text().splitlines()) == 1 + 5 * 4 + 4


def test_a_finished_server_that_is_started_again_tells_who_was_away(tmp_path, caplog):
    transport = LoopTransport(evaluates, [0, 1, 2, 3])
    transport.undelivered = {(2, "finish", 5)}
    with caplog.at_level(logging.WARNING):
        _, server, _ = run(transport=transport, folder=tmp_path)
    assert server.finished and server.dismissed == [0, 1, 3] and list(server.outbox) == [2]
    assert "clients [2] do not know that the run is over" in caplog.text
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


def test_numbers_of_steps_that_are_none_are_not_counted():
    counted = {1: 10}
    said = [{"test_steps": 5}, {"test_steps": 12}, {"test_steps": -3}, {"test_steps": True}, {"test_steps": 2**60}, {}]
    assert count_tests(dict(enumerate(said)), counted) == 5 + 2
    assert counted == {0: 5, 1: 12}
    assert count_tests({0: {"test_steps": 4}, 1: {"test_steps": "20"}, 2: {"test_steps": 3}}, counted) == 3
