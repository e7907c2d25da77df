"""Simulated time: who is heard when, by hand, and that a federation without delays is what it was."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from sb3_fedguide import FedAvg, FedGuide, FedGuideA, FedRL, Local
from sb3_fedguide.cli.train import main
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.checkpoint import CheckpointCallback
from sb3_fedguide.common.participation import ParticipationAdam, simulate_delays
from sb3_fedguide.engines.processes import Processes
from sb3_fedguide.server.averaging import Averaging
from sb3_fedguide.server.delays import Delays, DelaySettings, delay_settings, parse_delays
from sb3_fedguide.server.rounds import Rounds
from sb3_fedguide.server.strategy import Composite

NEVER = math.inf


class Scripted(Delays):
    """Clients whose rounds take as long as a list says; an infinite one is a lost upload."""

    def __init__(self, settings: DelaySettings, seconds: list[list[float]]) -> None:
        super().__init__(settings, 0, range(len(seconds)))
        self.script = seconds

    def draw(self, index: int) -> tuple[float, bool]:
        seconds = self.script[index][self.begun[index]]
        return seconds, seconds == NEVER


def play(delays: Delays, rounds: int, client_fraction: float = 1.0) -> list[tuple[list[int], list[int], float]]:
    """Who begins, who is heard, and the second at which each round ends."""
    found = []
    for round in range(rounds):
        present, arrived = delays.begin(round, client_fraction), delays.end()
        found.append((np.flatnonzero(present).tolist(), np.flatnonzero(arrived).tolist(), delays.seconds))
    return found


# --- the three policies, by hand ------------------------------------------------------------------------------------------


def test_sync_waits_for_the_slowest_and_for_the_timeout_of_who_drops_out():
    delays = Scripted(DelaySettings("sync", timeout=50), [[10, 10, 10], [40, 20, 90], [5, NEVER, NEVER]])
    assert play(delays, 3) == [([0, 1, 2], [0, 1, 2], 40), ([0, 1, 2], [0, 1], 90), ([0, 1, 2], [0, 1], 180)]
    assert not delays.keep_busy and not delays.training.any()


def test_a_deadline_ends_the_round_and_the_late_are_busy_until_they_have_finished():
    delays = Scripted(DelaySettings("deadline", deadline=30, timeout=20), [[10, 10, 10], [40, 5, 5], [5, NEVER, 30]])
    assert play(delays, 3) == [
        ([0, 1, 2], [0, 2], 30),  # client 1 needs until 40
        ([0, 2], [0], 50),  # everybody else has come or is known not to: no need to wait until 60
        ([0, 1, 2], [0, 1, 2], 80),  # just in time
    ]


def test_after_a_deadline_that_nobody_meets_the_next_round_waits_for_the_first():
    delays = Scripted(DelaySettings("deadline", deadline=30), [[50, 10], [45, 10]])
    assert play(delays, 2) == [([0, 1], [], 45), ([1], [1], 55)]
    assert delays.finished.tolist() == [True, True]  # client 0 as well, in second 50


def test_async_aggregates_in_every_tick_what_has_come():
    delays = Scripted(DelaySettings("async", tick=10), [[5, 12, 5, 5], [25, 8, 8, 8], [10, 30, 9, 9]])
    assert play(delays, 4) == [
        ([0, 1, 2], [0, 2], 10),
        ([0, 2], [0, 1], 30),  # nobody was idle at 20
        ([0, 1], [0, 1, 2], 40),
        ([0, 1, 2], [0, 1, 2], 50),
    ]


def test_staleness_counts_the_rounds_since_a_client_began():
    delays = Scripted(DelaySettings("async", tick=10), [[5, 5, 5, 5], [25, 8], [10, NEVER, 9]])
    staleness = []
    for round in range(3):
        delays.begin(round)
        delays.end()
        staleness.append(delays.figures["federated/staleness"])
    # Client 1 began in round 0 and is heard in round 2, with client 0 who began in it.
    assert staleness == [0, 0, 1.0] and delays.figures == {
        "federated/simulated_seconds": 30, "federated/arrived": 2, "federated/staleness": 1.0
    }  # fmt: skip


def test_ticks_in_which_nobody_is_idle_are_no_rounds():
    delays = Scripted(DelaySettings("async", tick=7, median=7), [[100, 20, 1], [NEVER, 30, 30]])
    delays.idle_at[1], delays.training[1] = 1000.0, False
    assert play(delays, 2) == [([0], [0], 105), ([0], [0], 126)]


def test_who_dropped_out_begins_again_after_the_timeout():
    delays = Scripted(DelaySettings("async", tick=10, timeout=15), [[5, 5, 5, 5], [NEVER, 4, 4, 4]])
    assert play(delays, 4) == [([0, 1], [0], 10), ([0], [0], 20), ([0, 1], [0, 1], 30), ([0, 1], [0, 1], 40)]


# --- identities -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dropout", [0.0, 0.3])
def test_an_infinite_deadline_is_sync(dropout):
    histories = [
        play(Delays(DelaySettings(policy, spread=0.8, dropout=dropout, **more), 5, range(6)), 12, 0.5)
        for policy, more in [("sync", {}), ("deadline", {"deadline": math.inf})]
    ]
    assert histories[0] == histories[1] and (any(begun != heard for begun, heard, _ in histories[0]) == (dropout > 0))


@pytest.mark.parametrize("settings", ["sync:dropout=0.2", "deadline:deadline=50,dropout=0.2", "async:tick=20,dropout=0.2"])
def test_same_seed_same_history_and_no_other(settings):
    histories = [play(Delays(parse_delays(settings), seed, range(8)), 20) for seed in (1, 1, 2)]
    assert histories[0] == histories[1] != histories[2]


def test_a_clients_rounds_take_the_same_time_under_every_policy_and_in_any_company():
    def draws(delays: Delays, index: int) -> list[tuple[float, bool]]:
        found = []
        for k in range(5):
            delays.begun[index] = k
            found.append(delays.draw(index))
        return found

    alone, together = Delays(DelaySettings("sync"), 3, [7]), Delays(DelaySettings("async"), 3, [2, 7, 9])
    assert draws(alone, 0) == draws(together, 1) != draws(together, 0)


def test_the_distribution_is_the_documented_one():
    settings = DelaySettings("sync", median=100, spread=0.6, jitter=0.3, dropout=0.2)
    delays = Delays(settings, 0, range(600))
    logs, dropped = np.zeros((600, 4)), np.zeros((600, 4))
    for index in range(600):
        for k in range(4):
            delays.begun[index] = k
            seconds, dropped[index, k] = delays.draw(index)
            logs[index, k] = math.log(seconds / 100)
    assert abs(logs.mean()) < 0.08 and abs(logs.mean(axis=1).std() - math.hypot(0.6, 0.15)) < 0.05
    assert abs(np.sqrt(logs.var(axis=1, ddof=1).mean()) - 0.3) < 0.02 and abs(dropped.mean() - 0.2) < 0.03


@pytest.mark.parametrize("settings", ["deadline:deadline=40,dropout=0.2", "async:tick=15,dropout=0.2"])
def test_the_clock_goes_on_from_its_state(settings):
    whole, lost = (Delays(parse_delays(settings), 4, range(6)) for _ in range(2))
    expected = play(whole, 9)
    play(lost, 5)
    resumed = Delays(parse_delays(settings), 99, range(6))  # the seed is part of the state
    resumed.load_state(lost.save_state())
    assert [resumed.training.any(), resumed.seconds] == [True, expected[4][2]]
    resumed_history = []
    for round in range(5, 9):
        present, arrived = resumed.begin(round), resumed.end()
        resumed_history.append((np.flatnonzero(present).tolist(), np.flatnonzero(arrived).tolist(), resumed.seconds))
    assert resumed_history == expected[5:]
    with pytest.raises(ValueError, match="the run has the delays"):
        Delays(parse_delays("sync"), 4, range(6)).load_state(lost.save_state())


def test_somebody_can_always_begin():
    for settings in ("deadline:deadline=1,spread=2", "async:tick=1,spread=2,dropout=0.9,median=60", "sync:dropout=0.99"):
        delays = Delays(parse_delays(settings), 0, range(4))
        before = 0.0
        for begun, _, seconds in play(delays, 60, 0.25):
            assert begun and seconds > before
            before = seconds


# --- settings -------------------------------------------------------------------------------------------------------------


def test_settings_come_back_from_their_text():
    for settings in (
        DelaySettings("sync"),
        DelaySettings("deadline", deadline=math.inf, dropout=0.25),
        DelaySettings("async", median=1 / 3, spread=0.8, tick=0.1, timeout=5),
    ):
        assert parse_delays(str(settings)) == settings
    assert parse_delays("async:median=10") == DelaySettings("async", median=10, tick=10, timeout=20)
    assert delay_settings({"policy": "deadline", "median": 10}) == DelaySettings("deadline", median=10, deadline=20)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "sync or deadline or async, not ''"),
        ("fast", "not 'fast'"),
        ("sync:media=3", "delays have no 'media'"),
        ("sync:median", "'median' is not NAME=NUMBER"),
        ("sync:median=", "median='' is not a number"),
        ("sync:median=nan", "median=nan is not a number"),
        ("sync:median=inf", "must lie in"),
        ("sync:median=3,median=4", "median stands twice"),
        ("sync:policy=3", "policy stands twice"),
        ("sync:spread=-1", "spread=-1.0 must lie in"),
        ("sync:dropout=1", "dropout=1.0 must lie in"),
        ("sync:timeout=inf", "must be positive and finite"),
        ("sync:tick=3", "tick belongs to async"),
        ("async:deadline=3", "deadline belongs to deadline"),
        ("deadline:deadline=0", "deadline=0.0 must be positive"),
        ("async:tick=0.001", "at least a thousandth of the median"),
        ("async:,", "'' is not NAME=NUMBER"),
    ],
)
def test_wrong_settings_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        parse_delays(text)


@pytest.mark.parametrize(
    "values",
    [{"median": 3}, {"policy": ["sync"]}, {"policy": "sync", "median": "3"}, {"policy": "sync", "median": True}],
)
def test_wrong_mappings_are_refused(values):
    with pytest.raises(ValueError):
        delay_settings(values)


# --- federations ----------------------------------------------------------------------------------------------------------

SMALL = {"rollout_size": 16, "batch_size": 16, "n_epochs": 1, "seed": 3, "policy_kwargs": {"net_arch": [8]}}
OFFLINE = {"dataset_size": 50, "bc_updates": 2, "dice_updates": 2, "dice_width": 8, "dice_batch_size": 16, "prior_updates": 2}
GUIDED = {**SMALL, "pretraining": OFFLINE, "bc_weight": 0.3}
OFF_POLICY = {"rollout_size": 16, "learning_starts": 8, "batch_size": 8, "seed": 3, "policy_kwargs": {"net_arch": [8]}}


class Watch(RoundCallback):
    """Every client's parameters as the round begins, after its training and after the exchange; log and masks."""

    def __init__(self) -> None:
        super().__init__()
        self.before, self.trained, self.after = [], [], []
        self.present, self.outdated, self.logs = [], [], []

    def _vectors(self) -> np.ndarray:
        arrays = [parameter.detach().numpy() for parameter in self.model.policy.parameters()]
        return np.concatenate([array.reshape(len(array), -1) for array in arrays], axis=1).copy()

    def _on_round_start(self) -> None:
        self.before.append(self._vectors())
        self.present.append(self.model.present.tolist())

    def _on_local_training_end(self) -> None:
        self.trained.append(self._vectors())

    def _on_round_end(self) -> None:
        self.after.append(self._vectors())
        self.outdated.append(self.model.outdated.tolist())
        values = self.logger.name_to_value.items()
        self.logs.append({name: value for name, value in values if not name.startswith("time/")})


@pytest.fixture(autouse=True, scope="module")
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FEDGUIDE_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def trained(kind, settings: str | Delays | None, rounds: int = 4, more: list | None = None, **arguments) -> tuple:
    """A federation on Bandit2D after some rounds, and what was seen."""
    defaults = OFF_POLICY if kind is FedRL else GUIDED if issubclass(kind, FedGuide) else SMALL
    model, watch = kind("MlpPolicy", "Bandit2D", **{**defaults, **arguments}), Watch()
    if settings is not None:
        simulate_delays(model, settings.settings if isinstance(settings, Delays) else parse_delays(settings))
    if isinstance(settings, Delays):
        model.delays = settings
    model.learn(rounds * model.rollout_size * model.n_participants, [watch, *(more or [])])
    assert model.round == rounds
    return model, watch


@pytest.mark.parametrize("kind", [Local, FedAvg, FedGuide, FedRL])
@pytest.mark.parametrize("settings", ["sync:spread=0,jitter=0", "sync:spread=2", "deadline:deadline=inf,spread=1"])
def test_who_waits_for_everybody_gets_the_plain_federation(kind, settings):
    plain, delayed = trained(kind, None, 3), trained(kind, settings, 3)
    np.testing.assert_array_equal(plain[1].after, delayed[1].after)
    for bare, log in zip(plain[1].logs, delayed[1].logs, strict=True):
        assert repr({name: log[name] for name in bare}) == repr(bare)
        assert log.keys() - bare.keys() == {"federated/simulated_seconds", "federated/arrived", "federated/staleness"}
        assert log["federated/arrived"] == 4 and log["federated/staleness"] == 0


@pytest.mark.parametrize("kind", [FedAvg, FedGuide])
def test_ticks_longer_than_every_round_give_the_plain_federation(kind):
    """Bit for bit, beside the same optimiser; torch's Adam differs from it in the last digits."""
    own, watch = trained(kind, "async:tick=1e6")
    assert isinstance(own.policy.optimizer, ParticipationAdam)
    half, same = trained(kind, None, policy_kwargs={**SMALL["policy_kwargs"], "optimizer_class": ParticipationAdam,
                                                    "optimizer_kwargs": {"eps": 1e-5}})  # fmt: skip
    assert type(half.policy.optimizer) is type(own.policy.optimizer)
    np.testing.assert_array_equal(watch.after, same.after)
    np.testing.assert_allclose(watch.after, trained(kind, None)[1].after, atol=1e-5)


def test_a_lost_upload_moves_nothing_and_its_client_catches_up():
    delays = Scripted(DelaySettings("sync"), [[10] * 4, [NEVER, 10, 10, 10], [10] * 4, [10] * 4])
    _, watch = trained(FedAvg, delays)
    np.testing.assert_allclose(watch.after[0][0], watch.trained[0][[0, 2, 3]].mean(axis=0), atol=1e-6)
    np.testing.assert_array_equal(watch.after[0][1], watch.trained[0][1])  # it trained on, and received nothing
    assert watch.outdated[0] == [False, True, False, False] and not any(watch.outdated[1])
    np.testing.assert_array_equal(watch.before[1][1], watch.after[0][0])
    np.testing.assert_allclose(watch.after[1][1], watch.trained[1].mean(axis=0), atol=1e-6)


def test_nothing_is_exchanged_where_every_upload_is_lost():
    delays = Scripted(DelaySettings("sync"), [[NEVER, 10, NEVER]] * 4)
    model, watch = trained(FedAvg, delays, 3)
    np.testing.assert_array_equal(watch.after[0], watch.trained[0])
    assert not any(watch.outdated[0]) and "federated/bytes_up" not in watch.logs[0] and watch.logs[0]["federated/arrived"] == 0
    assert len(np.unique(watch.after[1], axis=0)) == 1 and len(model.strategy.sent) == 4
    np.testing.assert_array_equal(watch.after[2], watch.trained[2])


def test_the_late_keep_all_of_their_state_and_catch_up():
    delays = Scripted(DelaySettings("deadline", deadline=30), [[10] * 4, [45, 10], [10] * 4, [10] * 4])
    _, watch = trained(FedAvg, delays)
    assert [present[1] for present in watch.present] == [True, False, False, True]
    np.testing.assert_array_equal(watch.trained[0][1], watch.after[0][1])
    for round in (1, 2):
        np.testing.assert_array_equal(watch.before[round][1], watch.after[round][1])
    np.testing.assert_allclose(watch.after[2][0], watch.trained[2][[0, 2, 3]].mean(axis=0), atol=1e-6)
    np.testing.assert_array_equal(watch.before[3], np.broadcast_to(watch.after[2][0], watch.before[3].shape))


def test_a_stale_upload_is_averaged_in_the_tick_in_which_it_comes():
    delays = Scripted(DelaySettings("async", tick=10), [[5] * 4, [25, 5, 5], [5] * 4, [5] * 4])
    _, watch = trained(FedAvg, delays)
    assert [present[1] for present in watch.present] == [True, False, False, True]
    np.testing.assert_allclose(watch.after[0][0], watch.trained[0][[0, 2, 3]].mean(axis=0), atol=1e-6)
    np.testing.assert_array_equal(watch.trained[2][1], watch.trained[0][1])  # what it will upload
    np.testing.assert_array_equal(watch.after[1][1], watch.trained[0][1])
    expected = np.stack([watch.trained[2][0], watch.trained[0][1], watch.trained[2][2], watch.trained[2][3]]).mean(axis=0)
    np.testing.assert_allclose(watch.after[2], np.broadcast_to(expected, watch.after[2].shape), atol=1e-6)
    assert [log["federated/staleness"] for log in watch.logs] == [0, 0, 0.5, 0] and not any(watch.outdated[2])
    np.testing.assert_array_equal(watch.before[3], watch.after[2])  # nothing to catch up with: it had the last broadcast


def test_who_was_busy_while_the_others_were_sent_more_than_it_gets_now_catches_up():
    rounds = Rounds(Composite([Averaging(("a",)), Averaging(("b",), average_every=2)]))

    def upload(value: float) -> dict[str, np.ndarray]:
        return {name: np.full(2, value, dtype=np.float32) for name in "ab"} | {"n_samples": np.array(8, dtype=np.float32)}

    rounds.exchange(2, {0: upload(1), 1: upload(3)}, absent=[2])
    assert rounds.outdated == {2}
    assert rounds.exchange(3, {0: upload(1), 2: upload(3)}, absent=[1])[2].keys() == {"a"}
    assert rounds.outdated == {1, 2}  # client 2 has missed b
    assert rounds.exchange(4, {0: upload(1), 2: upload(3)}, absent=[1])[2].keys() == {"a", "b"}
    assert rounds.outdated == {1}


def test_every_method_goes_on_with_part_of_its_clients():
    for kind, arguments in [(FedGuide, {}), (FedGuideA, {"average_every": 2}), (FedRL, {}), (Local, {})]:
        model, watch = trained(kind, "async:tick=30,spread=1,dropout=0.2", 6, **arguments)
        assert np.isfinite(watch.after).all() and any(not all(present) for present in watch.present)
        for round in range(1, 6):
            away = ~np.array(watch.present[round])
            np.testing.assert_array_equal(watch.before[round][away], watch.trained[round][away])
        assert model.num_timesteps == 6 * 4 * 16


@pytest.mark.parametrize("settings", ["async:tick=30,spread=1,dropout=0.2", "deadline:deadline=25,spread=1,dropout=0.2"])
@pytest.mark.parametrize("kind", [FedAvg, FedGuide])
def test_a_run_goes_on_with_uploads_on_their_way(kind, settings, tmp_path):
    whole, expected = trained(kind, settings, 7)
    lost, _ = trained(kind, settings, 4, [CheckpointCallback(tmp_path, 3)])
    assert lost.delays.seconds != whole.delays.seconds
    defaults = GUIDED if kind is FedGuide else SMALL
    resumed, watch = kind("MlpPolicy", "Bandit2D", **{**defaults, "seed": 8}), Watch()
    simulate_delays(resumed, parse_delays(settings))
    resumed.resume(tmp_path)
    busy = np.array(expected.present[3])
    resumed.learn(4 * 64, watch, reset_num_timesteps=False)
    assert not busy.all()  # somebody was busy at the checkpoint
    assert resumed.round == 7 and resumed.delays.seconds == whole.delays.seconds
    assert watch.present == expected.present[3:] and repr(watch.logs) == repr(expected.logs[3:])
    np.testing.assert_array_equal(watch.after, expected.after[3:])


def test_a_run_with_delays_does_not_go_on_without_them(tmp_path):
    trained(FedAvg, "async", 2, [CheckpointCallback(tmp_path / "with", 2)])
    trained(FedAvg, None, 2, [CheckpointCallback(tmp_path / "without", 2)])
    plain = FedAvg("MlpPolicy", "Bandit2D", policy_kwargs={"net_arch": [8], "optimizer_class": ParticipationAdam},
                   **{name: value for name, value in SMALL.items() if name != "policy_kwargs"})  # fmt: skip
    with pytest.raises(ValueError, match="with simulated delays and cannot go on without"):
        plain.resume(tmp_path / "with").learn(64, reset_num_timesteps=False)
    other = FedAvg("MlpPolicy", "Bandit2D", **SMALL)
    simulate_delays(other, parse_delays("sync"))
    with pytest.raises(ValueError, match="without simulated delays and cannot go on with"):
        other.resume(tmp_path / "without").learn(64, reset_num_timesteps=False)


def test_a_saved_model_goes_on_with_its_clock(tmp_path):
    model, _ = trained(FedAvg, "async:tick=30,spread=1", 3)
    model.save(tmp_path / "model")
    loaded = FedAvg.load(tmp_path / "model", env=model.get_env())
    assert loaded.delays.seconds == model.delays.seconds > 0
    loaded.learn(64, reset_num_timesteps=False)
    assert loaded.round == 4 and loaded.delays.seconds > model.delays.seconds
    with pytest.raises(ValueError, match="from the beginning"):
        simulate_delays(model, parse_delays("sync"))
    model.learn(64)  # a new training begins at second 0
    assert model.delays.rounds == 1


def test_worker_processes_train_only_those_who_are_not_busy():
    here, _ = trained(FedAvg, "async:tick=30,spread=1,dropout=0.2", 5)
    apart = FedAvg("MlpPolicy", "Bandit2D", **SMALL)
    simulate_delays(apart, parse_delays("async:tick=30,spread=1,dropout=0.2"))
    with Processes(2) as engine:
        engine.attach(apart)
        apart.learn(5 * 64)
    assert apart.round == 5 and apart.num_timesteps == here.num_timesteps and apart.delays.seconds == here.delays.seconds
    for own, other in zip(here.policy.parameters(), apart.policy.parameters(), strict=True):
        np.testing.assert_array_equal(own.detach(), other.detach())


# --- the command line -----------------------------------------------------------------------------------------------------

COMMAND = [
    "--algo", "fedavg", "--env", "Bandit2D", "--no-eval", "--verbose", "0", "--rounds", "3", "--save-freq", "2",
    "--picture-freq", "0",
    "-params", "rollout_size:16", "n_envs_per_client:2", "batch_size:8", "bc_weight:0", "policy_kwargs.net_arch:[8]",
]  # fmt: skip


@pytest.mark.parametrize(
    ("spec", "message"), [("sync:median=0", "median=0.0 must lie in"), ("no.yml", "cannot read"), ("sunc", "not 'sunc'")]
)
def test_wrong_delays_are_one_message_and_exit_code_2(spec, message, tmp_path, capsys):
    assert main([*COMMAND, "-f", str(tmp_path / "logs"), "--delays", spec]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"train.py: error: --delays {spec}: ") and message in error and error.count("\n") == 1
    assert not (tmp_path / "logs").exists()


def test_a_run_keeps_its_delays_and_resumes_with_them(tmp_path, capsys):
    (tmp_path / "delays.yml").write_text("policy: async\nmedian: 60\ntick: 30\ndropout: 0.1\n")
    whole = [*COMMAND, "-f", str(tmp_path / "whole"), "--delays", "async:median=60,tick=30,dropout=0.1"]
    file = [*COMMAND, "-f", str(tmp_path / "file"), "--delays", str(tmp_path / "delays.yml")]
    assert main(whole) == main(file) == 0
    (tmp_path / "delays.yml").unlink()
    run = tmp_path / "file" / "fedavg" / "Bandit2D_1"
    (run / "summary.json").unlink()
    assert main(["--resume", str(run), "--delays", "async:dropout=0.1,tick=30"]) == 0
    with np.load(run / "parameters.npz") as found, np.load(tmp_path / "whole/fedavg/Bandit2D_1/parameters.npz") as expected:
        for name in expected.files:
            np.testing.assert_array_equal(found[name], expected[name])
    seconds = [json.loads((Path(folder) / "summary.json").read_text())["simulated_seconds"]
               for folder in (run, tmp_path / "whole/fedavg/Bandit2D_1")]  # fmt: skip
    assert seconds[0] == seconds[1] > 0
    (run / "summary.json").unlink()
    assert main(["--resume", str(run), "--delays", "sync"]) == 2
    assert "contradicts the run" in capsys.readouterr().err
