"""What a run says while it is under way."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sb3_fedguide.cli import benchmark_runs, status
from sb3_fedguide.cli.benchmark import main as benchmark
from sb3_fedguide.cli.status import Stage, Status, duration, read_status


def test_a_stage_is_timed_from_its_own_beginning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr(status.time, "monotonic", lambda: now[0])
    shown = []
    report = Status(tmp_path, 100, lambda *progress: shown.append(progress))
    report("prior", 0, 400)
    assert read_status(tmp_path) == Stage("prior", 0, 400, 0.0, None)
    now[0] += 0.5
    report("prior", 50, 400)
    assert read_status(tmp_path).done == 0  # not every half second
    now[0] += 9.5
    report("prior", 100, 400)
    assert read_status(tmp_path) == Stage("prior", 100, 400, 10.0, 30.0)
    assert shown == [("prior", 0, 400), ("prior", 50, 400), ("prior", 100, 400)]
    report._report("round", 60, 100)  # of a run that goes on
    now[0] += 20.0
    report._report("round", 70, 100)
    assert str(read_status(tmp_path)) == "round 70 of 100, 20 s, about 60 s left"
    report.remove()
    assert read_status(tmp_path) is None


@pytest.mark.parametrize("content", ["", "{", "[]", '{"name": "prior"}', '{"name": 1, "done": "x", "total": 1, "left": null}'])
def test_a_file_that_says_nothing_is_no_status(tmp_path: Path, content: str) -> None:
    (tmp_path / "status.json").write_text(content)
    assert read_status(tmp_path) is None


def test_durations() -> None:
    assert [duration(seconds) for seconds in (0.4, 89, 90, 3000, 5370, 11100)] == [
        "0 s", "89 s", "2 min", "50 min", "1 h 30 min", "3 h 05 min"
    ]  # fmt: skip


def test_a_benchmark_says_what_its_runs_are_doing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """A real run, looked at all the time; its folder has no status once it is finished."""
    monkeypatch.setattr(benchmark_runs, "REPORT", 0.0)
    flags = ["--envs", "Bandit2D", "--algos", "local", "--seeds", "0", "--rounds", "3", "-f", str(tmp_path), "--keep-runs"]
    assert benchmark([*flags, "-params", "pretraining.dataset_size:200", "pretraining.bc_updates:20"]) == 0
    said = {line.strip() for line in capsys.readouterr().err.splitlines() if line.startswith("  local on Bandit2D, seed 0: ")}
    assert "local on Bandit2D, seed 0: beginning" in said and any(" of 3, " in line or " of 20, " in line for line in said)
    (summary,) = tmp_path.rglob("summary.json")
    assert json.loads(summary.read_text())["finished"] and not (summary.parent / "status.json").exists()
