"""``--track``: what is handed to the tracking libraries, and that their own files hold it."""

from __future__ import annotations

import importlib.util
import sqlite3
import sys
import types
from pathlib import Path
from typing import Any

import pytest

from sb3_fedguide.cli.train import main

CONFIG = {"algo": "local", "learning_rate": 3e-4}
NUMBERS: dict[str, Any] = {"eval/mean_reward": 1.5, "train/hidden": 3.0, "time/text": "no"}
EXCLUDED: dict[str, Any] = {"eval/mean_reward": None, "train/hidden": ("tensorboard",), "time/text": None}
SUMMARY = {"timesteps": 200, "seed": 3, "deployed": {"average": 7.5, "client_returns": [1.0]}}


class FakeTracker(types.ModuleType):
    """Has trackio's functions and remembers the calls."""

    def __init__(self) -> None:
        super().__init__("trackio")
        self.__spec__ = importlib.util.spec_from_loader("trackio", loader=None)
        self.runs: list[dict[str, Any]] = []
        self.logged: list[tuple[int, dict[str, float]]] = []
        self.n_finished = 0

    def init(self, **arguments: Any) -> FakeTracker:
        self.runs.append(arguments)
        return self

    def log(self, numbers: dict[str, float], step: int) -> None:
        self.logged.append((step, numbers))

    def finish(self) -> None:
        self.n_finished += 1


def test_a_run_and_its_continuation_are_one_tracked_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeTracker()
    monkeypatch.setitem(sys.modules, "trackio", fake)
    quick = ["--verbose", "0", "--picture-freq", "0", "--track", "trackio"]
    flags = ["--algo", "local", "--env", "Bandit2D", "--rounds", "1", "--eval-episodes", "2", "-f", str(tmp_path)]
    assert main([*flags, *quick, "--track-project", "mine", "-params", "bc_weight:0", "n_epochs:1"]) == 0
    assert main(["--resume", str(tmp_path / "local/Bandit2D_1"), "--rounds", "2", *quick]) == 0
    first, second = fake.runs
    assert (first["project"], first["resume"], second["resume"]) == ("mine", "never", "allow")
    assert first["name"] == second["name"] and first["project"] == second["project"]
    assert (first["config"]["algo"], first["config"]["n_epochs"]) == ("local", 1)
    scalars = [(step, numbers) for step, numbers in fake.logged if "eval/mean_reward" in numbers]
    assert [step for step, _ in scalars] == [scalars[0][0], 2 * scalars[0][0]] and scalars[0][0] >= 200
    assert all("time/total_timesteps" not in numbers for _, numbers in scalars)  # TensorBoard has it as its x axis
    step, summary = fake.logged[-1]
    assert step == scalars[1][0] and summary["summary/deployed/average"] == pytest.approx(scalars[1][1]["eval/mean_reward"])
    assert fake.n_finished == 2


def test_trackio_holds_what_was_logged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    pytest.importorskip("trackio")
    from sb3_fedguide.cli.tracking import TrackerOutputFormat

    tracker = TrackerOutputFormat("trackio", "project", tmp_path / "local" / "Bandit2D_1", CONFIG, resumed=False)
    tracker.write(NUMBERS, EXCLUDED, 100)
    tracker.finish(SUMMARY)
    [path] = tmp_path.rglob("project.db")
    rows = sqlite3.connect(path).execute("select step, metrics from metrics order by id").fetchall()
    assert [step for step, _ in rows] == [100, 200]
    assert b'"eval/mean_reward":1.5' in rows[0][1] and b"hidden" not in rows[0][1]
    assert b'"summary/deployed/average":7.5' in rows[1][1] and b"seed" not in rows[1][1]


def test_wandb_writes_an_offline_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    from sb3_fedguide.cli.tracking import TrackerOutputFormat

    folder = tmp_path / "local" / "Bandit2D_1"
    folder.mkdir(parents=True)
    tracker = TrackerOutputFormat("wandb", "project", folder, CONFIG, resumed=False)
    tracker.write(NUMBERS, EXCLUDED, 100)
    tracker.finish(SUMMARY)
    [path] = folder.rglob("*.wandb")
    content = path.read_bytes()
    assert b"eval/mean_reward" in content and b"summary/deployed/average" in content and b"train/hidden" not in content


@pytest.mark.parametrize("name", ["trackio", "wandb"])
def test_without_the_package_one_line_says_what_to_install(name, tmp_path, capfd, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda module: None if module == name else find(module))
    assert main(["--env", "Bandit2D", "--track", name, "-f", str(tmp_path / "logs")]) == 2
    expected = f"train.py: error: --track {name} needs the package {name}: pip install 'sb3-fedguide[{name}]'\n"
    assert capfd.readouterr().err == expected and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("flags", "reason"),
    {
        "--track mlflow": "invalid choice",
        "--track-project x": "is for --track trackio",
        "--track wandb --track-project a/b": "is not a name",
    }.items(),
)
def test_what_is_wrong_is_one_line(flags, reason, tmp_path, capfd):
    with pytest.raises(SystemExit) as stop:
        main(["--env", "Bandit2D", "-f", str(tmp_path / "logs"), *flags.split()])
    error = capfd.readouterr().err
    assert stop.value.code == 2 and reason in error and error.count("\n") == 1 and not list(tmp_path.iterdir())
