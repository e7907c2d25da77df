"""Federations whose clients take simulated time, and the command line's ``--delays``."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from sb3_fedguide import FedAvg, FedGuide, FedGuideA, FedRL, Local
from sb3_fedguide.cli.train import main
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.checkpoint import CheckpointCallback
from sb3_fedguide.common.participation import ParticipationAdam, simulate_delays
from sb3_fedguide.server.averaging import Averaging
from sb3_fedguide.server.delays import Delays, DelaySettings, parse_delays
from sb3_fedguide.server.rounds import Coordinator
from sb3_fedguide.server.strategy import Composite
from tests.conftest import others_slow
from tests.loop_engine import Here
from tests.scripted_delays import NEVER, Scripted

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


KINDS = (Local, FedAvg, FedGuide, FedRL)
PATIENT = ("sync:spread=0,jitter=0", "sync:spread=2", "deadline:deadline=inf,spread=1")


@pytest.mark.parametrize(
    ("kind", "settings"),
    others_slow(itertools.product(KINDS, PATIENT), lambda kind, settings: kind is FedAvg or settings == PATIENT[1]),
)
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
    rounds = Coordinator(Composite([Averaging(("a",)), Averaging(("b",), average_every=2)]))

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
    with pytest.raises(ValueError, match="before training"):
        simulate_delays(model, parse_delays("sync"))
    model.learn(64)  # a new training begins at second 0
    assert model.delays.rounds == 1


def test_workers_elsewhere_train_only_those_who_are_not_busy():
    here, _ = trained(FedAvg, "async:tick=30,spread=1,dropout=0.2", 5)
    apart = FedAvg("MlpPolicy", "Bandit2D", **SMALL)
    simulate_delays(apart, parse_delays("async:tick=30,spread=1,dropout=0.2"))
    engine = Here(4)
    engine.attach(apart)
    apart.learn(5 * 64)
    assert any(len(asked) < 4 for asked in engine.asked)
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
