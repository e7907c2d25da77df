"""``train.py --resume``: a run that is killed at any moment and goes on is the run that nobody killed, bit for bit."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from fed_envs.plain_data import freeze
from sb3_fedguide.cli.run_folder import exclusive
from sb3_fedguide.cli.train import main
from sb3_fedguide.common.checkpoint import checkpoints
from sb3_fedguide.registry import ALGORITHMS, algorithm
from sb3_fedguide.state.array_files import read_arrays
from tests.comparisons import same

ROOT = Path(__file__).parents[1]


class Driver:
    """A process that forks a child for each run, see ``kill_driver``."""

    def __init__(self, cache: Path) -> None:
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "FEDGUIDE_CACHE": str(cache)}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.kill_driver"], cwd=ROOT, env=environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip

    def __call__(self, argv: list[str], log: Path, at: list | None = None, **more) -> int:
        job = {"argv": argv, "log": str(log), "at": at, **more}
        self.process.stdin.write(json.dumps(job) + "\n")
        self.process.stdin.flush()
        return int(self.process.stdout.readline())


@pytest.fixture(scope="module")
def driver(tmp_path_factory):
    driver = Driver(tmp_path_factory.mktemp("cache"))
    yield driver
    driver.process.stdin.close()
    driver.process.wait()


SETTINGS = "n_envs_per_client:1 rollout_size:64 policy_kwargs.net_arch:[8] normalize:true"
PPO = "n_epochs:1 batch_size:32"
DDPG = "learning_starts:20 buffer_size:150 train_freq:16"
OFFLINE_STAGE = "bc_weight:0.3 pretraining.bc_updates:2 pretraining.dataset_size:100"
GUIDE = (
    "pretraining.dice_updates:2 pretraining.prior_updates:2 pretraining.prior_width:8 pretraining.dice_width:8 "
    "adapt:advantage prior_states:32"
)


def arguments(algo: str, env: str, folder: Path, rounds: int = 6) -> list[str]:
    guide = algorithm(algo).uses_prior
    offline = OFFLINE_STAGE + " " + GUIDE if guide else "bc_weight:0"
    params = f"{SETTINGS} {DDPG if algo == 'fedrl' else PPO} {offline}".split()
    return [
        "--algo", algo, "--env", env, "--rounds", str(rounds), "--eval-freq", "2", "--eval-episodes", "2", "--save-freq", "2",
        "--cache-dir", str(folder / "cache"), "-f", str(folder), "--verbose", "0",
        "--picture-freq", "0", "-params", *params,
    ]  # fmt: skip


def results(folder: Path) -> dict:
    """All that a run computes."""
    summary = json.loads((folder / "summary.json").read_text())
    del summary["seconds"]
    parameters = {name: read_arrays(folder / name) for name in ("parameters.npz", "deployed.npz") if (folder / name).exists()}
    return {"csv": (folder / "evaluations.csv").read_text(), "summary": summary, "parameters": parameters}


def scalars(folder: Path) -> dict[str, list[tuple[int, float]]]:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    return {
        tag: [(event.step, event.value) for event in events.Scalars(tag)]
        for tag in events.Tags()["scalars"]
        if not tag.startswith("time/")
    }


def survive(driver: Driver, algo: str, env: str, tmp_path: Path, kills: list[list], rounds: int = 6) -> int:
    """Kill a run at each of the moments and let it go on, until it is through; compare it with one that nobody killed.

    :return: how many of the kills hit it while it was running
    """
    whole, parts, log = tmp_path / "whole", tmp_path / "parts", tmp_path / "log.txt"
    tmp_path.mkdir(exist_ok=True)
    assert driver(arguments(algo, env, whole, rounds), log) == 0, log.read_text()
    folder = parts / algo / f"{env}_1"
    codes: list[int] = []
    for at in [*kills, None]:
        if not (folder / "metadata.json").exists():  # killed before its settings were written down: begin again
            argv = arguments(algo, env, parts, rounds)
            if folder.exists():
                assert driver(["--resume", str(folder)], log) == 2
                assert "is not the folder of a run to resume" in log.read_text()
                folder = folder.with_name(f"{env}_{int(folder.name.rsplit('_', 1)[1]) + 1}")
        else:
            argv = ["--resume", str(folder), "--verbose", "0"]
        codes.append(driver(argv, log, at))
        assert codes[-1] in (0, -signal.SIGKILL), log.read_text()
        if codes[-1] == 0:
            break
    assert codes[-1] == 0
    assert same(freeze(results(folder)), freeze(results(whole / algo / f"{env}_1"))), (algo, kills)
    expected, found = scalars(whole / algo / f"{env}_1"), scalars(folder)
    assert repr(found) == repr(expected), (algo, kills)  # no point twice, none lost
    assert len(checkpoints(folder / "checkpoints")) == min(2, rounds // 2)
    assert [path.name for path in (folder / "checkpoints").glob(".*")] == []
    return codes.count(-signal.SIGKILL)


def moments(seed: int, n: int) -> list[list]:
    """Random moments to kill a run at: in rollouts and evaluations, and in every part of writing a file."""
    rng = np.random.default_rng(seed)
    ends = {"step": 170, "array": 60, "fsync": 5, "replace": 5}  # most are reached in what is left of a run
    drawn = []
    for _ in range(n):
        place = str(rng.choice(list(ends)))
        drawn.append([("after " if rng.random() < 0.5 else "") + place, int(rng.integers(1, ends[place] + 1))])
    return drawn


@pytest.mark.slow
def test_a_run_survives_kills_at_random_moments(driver, tmp_path):
    assert survive(driver, "fedguide-a", "Bandit2D", tmp_path, moments(3, 3), rounds=4) >= 2


CHECKPOINT_KILLS = [
    ["checkpoint", 2, "array", 30],
    ["truncate", 1],
    ["checkpoint", 1, "replace", 1],
    ["checkpoint", 2, "unlink", 1],
]
MORE_CHECKPOINT_KILLS = [["checkpoint", 1, "array", 1], ["checkpoint", 1, "fsync", 1], ["checkpoint", 1, "after replace", 1]]


@pytest.mark.parametrize("kills", [CHECKPOINT_KILLS, pytest.param(MORE_CHECKPOINT_KILLS, marks=pytest.mark.slow)])
def test_a_run_survives_kills_inside_the_write_of_a_checkpoint(kills, driver, tmp_path):
    assert survive(driver, "local", "Bandit2D", tmp_path, kills, rounds=8) == len(kills)


@pytest.mark.slow
def test_a_run_survives_kills_inside_the_offline_stage(driver, tmp_path):
    kills = [["array", 3], ["replace", 9], ["array", 14]]
    assert survive(driver, "fedguide", "Bandit2D", tmp_path, kills, rounds=2) == len(kills)


@pytest.mark.slow
@pytest.mark.parametrize("algo", ALGORITHMS)
@pytest.mark.parametrize("env", ["Bandit2D", "Reacher"])
def test_every_algorithm_survives_kills_at_random_moments(algo, env, driver, tmp_path):
    hit = sum(survive(driver, algo, env, tmp_path / str(seed), moments(seed, 8)) for seed in range(3))
    assert hit >= 9


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["fedrl", "fedguide"])
def test_a_run_survives_kills_by_the_clock(algo, driver, tmp_path):
    rng = np.random.default_rng(7)
    assert survive(driver, algo, "Reacher", tmp_path, [["seconds", float(rng.uniform(0.2, 3))] for _ in range(8)], 10) >= 3


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_ends_the_run_after_the_round_with_a_checkpoint(driver, tmp_path, number, code):
    whole, log = tmp_path / "whole", tmp_path / "log.txt"
    assert driver(arguments("fedavg", "Bandit2D", whole), log) == 0
    # 64 steps a round and one an evaluation: in the middle of the third round
    assert driver(arguments("fedavg", "Bandit2D", tmp_path), log, ["step", 160], signals=[number]) == code
    folder = tmp_path / "fedavg" / "Bandit2D_1"
    summary = json.loads((folder / "summary.json").read_text())
    assert not summary["finished"] and summary["rounds_done"] == 3
    assert checkpoints(folder / "checkpoints")[-1].name == "round_000003.npz"  # two would have been the next in turn
    text = log.read_text()
    assert "stopping after this round" in text
    assert "interrupted in round 3, which is complete" in text and f"--resume {folder}" in text
    assert (folder / "model.zip").exists()
    assert driver(["--resume", str(folder)], log) == 0
    assert same(freeze(results(folder)), freeze(results(whole / "fedavg" / "Bandit2D_1")))


def test_a_second_signal_ends_the_run_at_once(driver, tmp_path):
    log = tmp_path / "log.txt"
    at = ["step", 160]
    assert driver(arguments("local", "Bandit2D", tmp_path), log, at, signals=[signal.SIGTERM, signal.SIGINT]) == 143
    folder = tmp_path / "local" / "Bandit2D_1"
    assert "interrupted in round 3;" in log.read_text()
    assert json.loads((folder / "summary.json").read_text())["rounds_done"] == 2
    assert [path.name for path in checkpoints(folder / "checkpoints")] == ["round_000002.npz"]


@pytest.fixture(scope="module")
def stopped(driver, tmp_path_factory):
    """A run that was killed in its fifth round."""
    folder = tmp_path_factory.mktemp("stopped")
    assert driver(arguments("local", "Bandit2D", folder), folder / "log.txt", ["step", 300]) == -signal.SIGKILL
    return folder / "local" / "Bandit2D_1"


def command(*argv: str) -> int:
    """Exit code of the command in this process."""
    try:
        return main(argv)
    except SystemExit as exit:  # argparse
        return exit.code


CONTRADICTIONS = {
    "--rounds 3": "the run in .* has done 4 rounds, so its length cannot be 3",
    "-i elsewhere": "-i elsewhere: there is no .*elsewhere; give the folder of a trained run, or its parameters.npz",
    "--seed 1": "--seed 1 contradicts the run in .*, whose own is 0",
    "--algo fedavg": "--algo fedavg contradicts the run in .*, whose own is local",
    "--env Reacher": "--env Reacher contradicts the run in .*, whose own is Bandit2D",
    "--no-eval": "--no-eval True contradicts",
    "-params n_epochs:2": "--hyperparams .* contradicts",
    "-f elsewhere": "--log-folder elsewhere contradicts",
    "--save-freq -1": "--save-freq must not be negative, not -1",
}


@pytest.mark.parametrize("flags", CONTRADICTIONS)
def test_flags_that_contradict_are_refused_and_nothing_is_changed(flags, stopped, capsys):
    before = {path: path.stat().st_mtime_ns for path in stopped.rglob("*")}
    assert command("--resume", str(stopped), *flags.split()) == 2
    error = capsys.readouterr().err
    assert re.search(CONTRADICTIONS[flags], error) and len(error.splitlines()) == 1
    assert {path: path.stat().st_mtime_ns for path in stopped.rglob("*")} == before


def test_flags_that_agree_or_are_free_are_taken(stopped, tmp_path, capsys, monkeypatch):
    folder = shutil.copytree(stopped, tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    flags = ["--algo", "local", "--rounds", "6", "--seed", "0", "--save-freq", "1", "--verbose", "1", "--cache-dir", "other"]
    assert command("--resume", "run", *flags) == 0
    captured = capsys.readouterr()
    assert "writing to run, resuming after round 4" in captured.out and captured.err == ""
    assert [path.name for path in checkpoints(folder / "checkpoints")] == ["round_000005.npz", "round_000006.npz"]
    lines = (folder / "command.txt").read_text().splitlines()
    assert len(lines) == 2 and "--resume run" in lines[1]
    assert json.loads((folder / "summary.json").read_text())["finished"]
    assert yaml.safe_load((folder / "args.yml").read_text())["save_freq"] == 2  # as the run was begun
    assert not (tmp_path / "other").exists()
    content = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert command("--resume", "run") == 0  # and once more
    assert "the run in run is finished: it has done its 6 rounds" in capsys.readouterr().out
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == content


def test_a_finished_run_goes_on_for_longer(driver, tmp_path, capsys):
    log = tmp_path / "log.txt"
    assert driver(arguments("fedavg", "Bandit2D", tmp_path / "whole", 7), log) == 0
    assert driver(arguments("fedavg", "Bandit2D", tmp_path, 3), log) == 0
    folder = tmp_path / "fedavg" / "Bandit2D_1"
    assert checkpoints(folder / "checkpoints")[-1].name == "round_000003.npz"  # though it is not the second's turn
    assert driver(["--resume", str(folder), "--rounds", "7", "--save-freq", "2"], log, ["step", 160]) == -signal.SIGKILL
    assert driver(["--resume", str(folder)], log) == 0  # it knows how long it is now
    whole, found = results(tmp_path / "whole" / "fedavg" / "Bandit2D_1"), results(folder)
    assert same(freeze(whole["parameters"]), freeze(found["parameters"]))
    assert whole["summary"]["deployed"] == found["summary"]["deployed"]
    rows = [row for row in found["csv"].splitlines() if not row.startswith("3,768,broadcast")]  # it was the last round
    assert rows == whole["csv"].splitlines() and len(found["csv"].splitlines()) == len(rows) + 4
    assert yaml.safe_load((folder / "args.yml").read_text())["rounds"] == 7
    capsys.readouterr()
    assert command("--resume", str(folder), "-n", str(7 * 4 * 64)) == 0
    assert "is finished: it has done its 7 rounds" in capsys.readouterr().out
    assert command("--resume", str(folder), "--rounds", "6") == 2
    assert "has done 7 rounds, so its length cannot be 6" in capsys.readouterr().err
    shutil.rmtree(folder / "checkpoints")
    assert command("--resume", str(folder), "--rounds", "8") == 2
    assert f"no checkpoint to resume from; start a new run from its parameters with -i {folder}" in capsys.readouterr().err


@pytest.mark.parametrize("algo", ["fedavg", pytest.param("fedguide", marks=pytest.mark.slow)])
def test_a_run_starts_from_what_another_has_learned(algo, driver, tmp_path, capsys):
    log = tmp_path / "log.txt"
    assert driver(arguments(algo, "Bandit2D", tmp_path, 2), log) == 0
    first, second = (tmp_path / algo / f"Bandit2D_{number}" for number in (1, 2))
    more = [*arguments(algo, "Bandit2D", tmp_path, 1), "learning_rate:1e-12", "-i"]
    assert driver([*more, str(first)], log) == 0, log.read_text()
    before, after = (read_arrays(folder / "parameters.npz") for folder in (first, second))
    kept = [name for name in before if name.startswith("policy/")]
    assert kept and all(np.allclose(before[name], after[name], atol=1e-6) for name in kept)
    assert yaml.safe_load((second / "args.yml").read_text())["trained_agent"] == str(first / "parameters.npz")
    if algo == "fedavg":
        assert command(*more, str(first / "model.zip")) == 2
        assert "would be unpickled" in capsys.readouterr().err
        assert command(*arguments("fedrl", "Bandit2D", tmp_path, 1), "-i", str(first)) == 2
        assert "does not fit this FedRL" in capsys.readouterr().err
        assert not (tmp_path / "fedrl").exists()


def test_a_damaged_newest_checkpoint_is_named_and_the_one_before_it_used(stopped, driver, tmp_path, capsys):
    assert driver(arguments("local", "Bandit2D", tmp_path), tmp_path / "log.txt") == 0
    folder = shutil.copytree(stopped, tmp_path / "run")
    second = checkpoints(folder / "checkpoints")[-1]
    content = second.read_bytes()
    second.write_bytes(content[: len(content) // 2])
    assert command("--resume", str(folder)) == 0
    error = capsys.readouterr().err
    assert re.fullmatch(r"train\.py: warning: .*round_000004\.npz is damaged.*resuming from .*round_000002\.npz\n", error), (
        error
    )
    assert same(freeze(results(folder)), freeze(results(tmp_path / "local" / "Bandit2D_1")))


def test_without_an_intact_checkpoint_the_run_does_not_go_on(stopped, tmp_path, capsys):
    folder = shutil.copytree(stopped, tmp_path / "run")
    for path in checkpoints(folder / "checkpoints"):
        path.write_bytes(b"")
    rows = (folder / "evaluations.csv").read_bytes()
    assert command("--resume", str(folder)) == 2
    error = capsys.readouterr().err
    assert error.startswith("train.py: error: no checkpoint can be read: ") and len(error.splitlines()) == 1
    assert (folder / "evaluations.csv").read_bytes() == rows
    shutil.rmtree(folder / "checkpoints")  # then it begins again
    assert command("--resume", str(folder)) == 0
    with (folder / "evaluations.csv").open() as file:
        assert [row["round"] for row in csv.DictReader(file)] == [str(round) for round in range(1, 7) for _ in range(4)]


def test_missing_evaluations_are_noticed(stopped, tmp_path, capsys):
    folder = shutil.copytree(stopped, tmp_path / "run")
    (folder / "evaluations.csv").unlink()
    assert command("--resume", str(folder)) == 2
    assert re.search(r"error: .*evaluations\.csv has 0 bytes .*rows are missing", capsys.readouterr().err)


DAMAGES = {
    "args.yml": ["- a list", "algo: [local]", "algo: locall", "seed: -1", "eval_freq: often", "hyperparams: 3", ": :", "\x00"],
    "config.yml": ["n_rounds: many", "unknown: 3", "3", "{}"],
    "metadata.json": ["{}", "nothing"],
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_run_folders_are_refused(name, stopped, tmp_path, capsys):
    folder = shutil.copytree(stopped, tmp_path / "run")
    original = (folder / name).read_text()
    for text in DAMAGES[name]:
        (folder / name).write_text(f"{original}\n{text}" if text.partition(":")[0] in original else text)
        assert command("--resume", str(folder)) == 2, text
        error = capsys.readouterr().err
        assert error.startswith("train.py: error: ") and "Traceback" not in error, error
    (folder / name).unlink()
    assert command("--resume", str(folder)) == 2
    assert f"has no {name}" in capsys.readouterr().err
    assert command("--resume", str(tmp_path / "nowhere")) == 2
    assert "is not the folder of a run to resume" in capsys.readouterr().err


def test_one_process_at_a_time(stopped, capsys):
    with exclusive(stopped):
        assert command("--resume", str(stopped)) == 2
    assert "is still going on in another process" in capsys.readouterr().err


def test_other_versions_are_named(stopped, tmp_path, capsys):
    folder = shutil.copytree(stopped, tmp_path / "run")
    versions = json.loads((folder / "versions.json").read_text())
    (folder / "versions.json").write_text(json.dumps({**versions, "torch": "1.0"}))
    assert command("--resume", str(folder)) == 0
    assert "warning: the run began with torch 1.0; its results may differ" in capsys.readouterr().err


def test_without_checkpoints_nothing_is_written_and_the_run_begins_again(driver, tmp_path):
    argv, log = [*arguments("local", "Bandit2D", tmp_path), "--save-freq", "0"], tmp_path / "log.txt"
    assert driver(argv, log, ["step", 300]) == -signal.SIGKILL
    folder = tmp_path / "local" / "Bandit2D_1"
    assert not (folder / "checkpoints").exists()
    assert driver(["--resume", str(folder)], log) == 0
    steps = [step for step, _ in scalars(folder)["rollout/ep_rew_mean"]]
    assert steps == [256 * round for round in range(1, 7)] and not (folder / "checkpoints").exists()


def test_a_world_that_cannot_be_saved_says_so_before_it_is_trained(tmp_path, monkeypatch, capsys):
    from fed_envs.bandit2d import Bandit2DEnv

    start = Bandit2DEnv._start
    monkeypatch.setattr(Bandit2DEnv, "_start", lambda env: (setattr(env, "engine", object()), start(env))[1])
    assert command(*arguments("local", "Bandit2D", tmp_path)) == 2
    assert re.search(r"error: client 0: .*: engine: a object is no plain data .*--save-freq 0", capsys.readouterr().err)
    assert command(*arguments("local", "Bandit2D", tmp_path, 1), "--save-freq", "0") == 0
