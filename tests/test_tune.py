"""``fedguide tune``: what it refuses, which trials it does, and that an interrupted study goes on."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

import fed_envs
from sb3_fedguide.cli import benchmark_runs, tune
from sb3_fedguide.cli.tune_arguments import parse_tune
from sb3_fedguide.registry import ALGORITHMS

optuna = pytest.importorskip("optuna")

N_CLIENTS = fed_envs.load_family("Bandit2D").n_clients
#: Stands for the training command. Its return in round r is 100 * mu + seed + r.
TRAINING = """
import json, os, signal, sys, time
from pathlib import Path
flags = sys.argv[1:]
value = lambda flag: flags[flags.index(flag) + 1]
resumed = "--resume" in flags
folder = Path(value("--resume")) if resumed else Path(value("-f")) / value("--algo") / "Bandit2D_1"
seed = int(folder.parents[1].name.removeprefix("seed"))
if not resumed:
    folder.mkdir(parents=True)
    (folder / "config.yml").write_text(json.dumps(dict(pair.split(":") for pair in flags if ":" in pair)))
    for name, text in {"versions.json": "{}", "metadata.json": "{}"}.items():
        (folder / name).write_text(text)
settings = json.loads((folder / "config.yml").read_text())
with open("starts.txt", "a") as file:
    print(folder.parents[3].name, seed, settings["mu"], "resumed" if resumed else "new", file=file, flush=True)
if os.environ.get("BEHAVIOUR") == "fail":
    sys.exit("the disk of client 3 is on fire")
if os.environ.get("BEHAVIOUR") == "wait":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    (folder / "waiting").touch()
    time.sleep(60)
returns = {round: 100 * float(settings["mu"]) + seed + round for round in range(1, 7)}
with open(folder / "evaluations.csv", "w") as file:
    print("round,timesteps,policy,client,mean_return", file=file)
    for round, average in returns.items():
        for client in range(N):
            print(f"{round},{round * 100},deployed,{client},{average + (client - (N - 1) / 2)}", file=file)
deployed = {"average": returns[6], "worst_client": 0.5, "n_episodes": 3, "curve": list(map(list, returns.items()))}
summary = {
    "algo": "fedprox", "env": "Bandit2D", "conf_file": "tuned", "n_rounds": 6, "seed": seed, "rounds_done": 6,
    "finished": True, "metadata_hash": "", "bytes_up": 0, "bytes_down": 0, "seconds": {"median_round": 1.0, "total": 1.0},
    "deployed": deployed,
}
(folder / "summary.json").write_text(json.dumps(summary))
"""
FIXED = ["--algo", "fedprox", "--env", "Bandit2D", "--rounds", "6", "--eval-freq", "1", "-params", "bc_weight:0"]


@pytest.fixture(scope="module")
def empty_storage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A storage without studies: to make its tables takes longer than everything else in a test."""
    path = tmp_path_factory.mktemp("storage") / "empty.db"
    optuna.storages.RDBStorage(f"sqlite:///{path}")
    return path


@pytest.fixture
def quick(tmp_path: Path, empty_storage: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """The command with the training command replaced, in ``tmp_path``, on a space of four values of ``mu``."""
    script = tmp_path.parent / f"{tmp_path.name}-training.py"
    script.write_text(f"N = {N_CLIENTS}\n{TRAINING}")
    monkeypatch.setattr(benchmark_runs, "TRAIN", (sys.executable, str(script)))
    monkeypatch.setattr(tune, "POLL", 0.01)
    monkeypatch.chdir(tmp_path)

    class CopiedStorage(optuna.storages.RDBStorage):
        def __init__(self, url: str, **arguments: Any) -> None:
            if not (path := Path(url.removeprefix("sqlite:///"))).exists():
                shutil.copy(empty_storage, path)
            super().__init__(url, **arguments)

    monkeypatch.setattr(optuna.storages, "RDBStorage", CopiedStorage)
    Path("space.yml").write_text("mu: [0.1, 0.2, 0.3, 0.4]\n")

    def run(*flags: str, behaviour: str = "") -> int:
        monkeypatch.setenv("BEHAVIOUR", behaviour)
        return tune.main([*FIXED, "--search", "space.yml", "-f", "out", *flags])

    return run


def starts(folder: Path) -> list[str]:
    path = folder / "starts.txt"
    lines = path.read_text().splitlines() if path.exists() else []
    path.unlink(missing_ok=True)
    return lines


def study(name: str = "Bandit2D-fedprox", file: str = "out/Bandit2D-fedprox/study.db") -> optuna.Study:
    return optuna.load_study(study_name=name, storage=f"sqlite:///{file}")


def test_a_grid_tries_every_combination_once_and_goes_on(quick, tmp_path, capfd):
    grid = ("--sampler", "grid", "--pruner", "none", "--seeds", "1", "3")
    assert quick(*grid, "--n-trials", "3") == 0
    assert starts(tmp_path) == [f"trial-{k} {seed} {mu} new" for k, mu in enumerate((0.1, 0.2, 0.3)) for seed in (1, 3)]
    assert [trial.value for trial in study().trials] == pytest.approx([18, 28, 38])  # 100 mu + mean seed + six rounds
    assert quick(*grid, "--processes", "2") == 0
    assert starts(tmp_path) == [f"trial-3 {seed} 0.4 new" for seed in (1, 3)]
    assert quick(*grid) == 0 and starts(tmp_path) == []
    steps = study().trials[0].intermediate_values
    assert list(steps) == list(range(1, 13))
    assert (steps[6], steps[7]) == pytest.approx((10 + 1 + 6, 10 + 2 + 1))  # seed 1 alone, then the mean of both
    best = yaml.safe_load(Path("out/Bandit2D-fedprox/best.yml").read_text())["Bandit2D"]
    assert (best["mu"], best["bc_weight"], best["n_rounds"]) == (0.4, 0, 6)
    assert not list(tmp_path.glob("out/*/trial-*/runs/seed*"))
    assert "4 trials (4 complete)" in capfd.readouterr().out


def test_the_best_settings_are_a_configuration(quick, tmp_path):
    from sb3_fedguide.settings.config import resolve

    assert quick("--sampler", "grid", "--n-trials", "1") == 0
    config = resolve("fedprox", fed_envs.load_family("Bandit2D"), "out/Bandit2D-fedprox/best.yml")
    assert (config.entry, config.values["mu"], config.n_rounds) == ("Bandit2D", 0.1, 6)


def test_the_pruner_sees_every_evaluated_round(quick, tmp_path):
    Path("space.yml").write_text("mu: [0.9, 0.8, 0.7, 0.6, 0.5, 0.1]\n")
    assert quick("--sampler", "grid") == 0
    trials = study().trials
    assert [trial.state.name for trial in trials] == ["COMPLETE"] * 5 + ["PRUNED"]
    assert list(trials[-1].intermediate_values) == [1, 2]  # the median pruner's warm-up is a third of six rounds
    assert not (tmp_path / "out/Bandit2D-fedprox/trial-5/fedprox-seed0.json").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_an_interrupted_trial_goes_on_where_it_was(quick, tmp_path, capfd, request, number):
    earlier = signal.signal(number, signal.default_int_handler)  # a shell's background jobs ignore SIGINT
    request.addfinalizer(lambda: signal.signal(number, earlier))

    def interrupt() -> None:
        while not list(tmp_path.glob("out/*/trial-*/runs/*/fedprox/*/waiting")):
            time.sleep(0.01)
        os.kill(os.getpid(), number)

    threading.Thread(target=interrupt, daemon=True).start()
    assert quick("--sampler", "grid", "--n-trials", "2", behaviour="wait") == 128 + number
    assert starts(tmp_path) == ["trial-0 0 0.1 new"]
    assert "the same command resumes" in capfd.readouterr().err
    assert [trial.state.name for trial in study().trials] == ["RUNNING"]
    assert quick("--sampler", "grid", "--n-trials", "2") == 0
    assert starts(tmp_path) == ["trial-0 0 0.1 resumed", "trial-1 0 0.2 new"]
    assert [trial.value for trial in study().trials] == pytest.approx([16, 26])


def test_settings_that_come_again_are_not_run_again(quick, tmp_path):
    Path("space.yml").write_text("mu: [0.1, 0.2]\n")
    assert quick("--sampler", "random", "--pruner", "none", "--n-trials", "6") == 0
    assert len(starts(tmp_path)) == 2
    trials = study().trials
    assert len(trials) == 6 and all(trial.value == 6 + 100 * json.loads(trial.params["mu"]) for trial in trials)


def test_failures_are_reported_and_do_not_use_up_the_study(quick, tmp_path, capfd):
    assert quick("--n-trials", "9", "--storage", "mine.db", "--study-name", "s", behaviour="fail") == 1
    assert len(starts(tmp_path)) == 3 and "the disk of client 3 is on fire" in capfd.readouterr().err
    assert [trial.state.name for trial in study("s", "mine.db").trials] == ["FAIL"] * 3


WRONG = {
    "--algo fedpox": "Did you mean 'fedprox'",
    "--n-trials 0": "--n-trials must be at least 1",
    "--seeds 1 1": "--seeds names 1 twice",
    "--seeds -1": "--seeds must not be negative",
    "--processes 0": "--processes must be at least 1",
    "--study-name a/b": "also the name of a folder",
    "--search nowhere.yml": "there is no file nowhere.yml",
    "--sampler best": "invalid choice",
    "mu: [0.1, -1]": "mu=-1 must be at least 0",
    "mu: [0.1, much]": "mu must be a number",
    "mu: 0.1": "mu must be [values] or",
    "mu: [0.1, 0.1]": "mu lists a value twice",
    "mu: {low: 1, high: 0.5}": "low must be below high",
    "mu: {low: 0, high: 0.5, log: true}": "and positive",
    "mv: [0.1]": "unknown hyperparameter 'mv'",
    "rollout_size: [100, 200]": "the same rounds and environment steps",
    "bc_weight: [0.1]": "-params sets it; give one of them",
    "[0.1]": "a search space maps hyperparameters",
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_is_one_line_and_nothing_is_written(quick, tmp_path, capfd, wrong):
    flags = wrong.split() if wrong.startswith("--") else []
    if not flags:
        Path("space.yml").write_text(wrong)
    try:
        code = quick(*flags)
    except SystemExit as stop:
        code = stop.code
    error = capfd.readouterr().err
    assert code == 2 and WRONG[wrong] in error and error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["space.yml"]


def test_a_grid_needs_lists_and_other_settings_another_study(quick, tmp_path, capfd):
    assert quick("--sampler", "grid", "--n-trials", "1") == 0
    assert quick("--seeds", "5") == 2 and "--seeds [0], not [5]" in capfd.readouterr().err
    Path("space.yml").write_text("mu: {low: 0.1, high: 0.2}\n")
    assert quick("--sampler", "grid") == 2 and "mu is an interval" in capfd.readouterr().err
    (tmp_path / "no.db").write_text("this is no data base" * 100)
    assert quick("--storage", "no.db") == 2 and "cannot be used as a study's storage" in capfd.readouterr().err


def test_without_optuna_one_line_says_what_to_install(quick, capfd, monkeypatch):
    find = tune.importlib.util.find_spec
    monkeypatch.setattr(tune.importlib.util, "find_spec", lambda name: None if name == "optuna" else find(name))
    assert quick() == 2
    assert capfd.readouterr().err == "fedguide tune: error: tuning needs Optuna: pip install 'sb3-fedguide[tune]'\n"


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_default_space_holds_known_settings_in_range(algo):
    from sb3_fedguide.cli.tune_space import default_space
    from sb3_fedguide.settings.config import resolve

    space = default_space(algo, {})
    assert {"learning_rate"} <= space.entries.keys() and max(map(len, space.entries.values())) <= 3  # type: ignore[arg-type]
    for settings in space.probes():
        values = resolve(algo, fed_envs.load_family("Bandit2D"), overrides=settings).values
        assert {name: values[name] for name in settings} == settings


def test_the_interval_of_whole_numbers_gives_whole_numbers():
    from sb3_fedguide.cli.tune_space import Interval, Space

    space = Space({"n_epochs": Interval(2, 9), "learning_rate": Interval(1e-5, 1e-2, log=True)})
    asked = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=1)).ask()
    settings = space.suggest(asked)
    assert isinstance(settings["n_epochs"], int) and 2 <= settings["n_epochs"] <= 9
    assert isinstance(settings["learning_rate"], float) and asked.distributions["learning_rate"].log


def test_parsing_keeps_the_training_commands_defaults():
    arguments = parse_tune(["--algo", "local", "--env", "Bandit2D"], "fedguide tune")
    assert (arguments.conf_file, arguments.eval_freq, arguments.seeds) == ("tuned", 5, [0])
