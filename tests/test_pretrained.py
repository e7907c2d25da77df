"""The runs that come with the package: their returns come out again, and are far better than those of random actions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fed_envs import load_family
from sb3_fedguide.benchmark.aggregate import random_actions
from sb3_fedguide.cli.main import main
from sb3_fedguide.cli.pretrained import PRETRAINED, find_run, shipped_runs

#: Bytes of all of them together.
MOST = 350_000


@pytest.mark.parametrize("name", shipped_runs())
def test_the_shipped_returns_come_out_again_and_beat_random_actions(name, tmp_path):
    assert main(["evaluate", name.lower(), "--policy", "deployed", "-o", str(tmp_path / "result.json")]) == 0
    values = json.loads((tmp_path / "result.json").read_text())["policies"]["deployed"]
    said = json.loads((PRETRAINED / name / "provenance.json").read_text())
    shipped, random = (np.array(said["returns"][which]["clients"]) for which in ("deployed", "random actions"))
    np.testing.assert_allclose(values["client_returns"], shipped, rtol=0.02)  # to the digit on the same machine and versions
    assert (shipped > random + 0.4 * np.abs(random)).all()
    if name == "Bandit2D":  # the others' take a moment
        np.testing.assert_allclose(random_actions(load_family(name)).client_returns, random, atol=1e-3)


def test_where_they_come_from_is_said_and_they_are_small():
    assert set(shipped_runs()) == {"Bandit2D", "ReacherHard"}
    for name, folder in shipped_runs().items():
        said = json.loads((folder / "provenance.json").read_text())
        assert f"--env {name} --seed {said['seed']}" in said["commands"][0] and len(said["commit"]) >= 7
        summary = json.loads((folder / "summary.json").read_text())
        assert summary["finished"] and summary["rounds_done"] == said["rounds"]
        assert summary["metadata_hash"] == load_family(name).content_hash  # of this version's family
        assert not {path.suffix for path in folder.iterdir()} - {".npz", ".yml", ".json"}
    assert sum(path.stat().st_size for path in PRETRAINED.rglob("*")) < MOST


def test_a_folder_comes_before_a_name_and_a_wrong_name_lists_them(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert find_run("bandit2d") == find_run("Bandit2D") == PRETRAINED / "Bandit2D"
    (tmp_path / "bandit2d").mkdir()
    assert find_run("bandit2d") == Path("bandit2d")
    for argv in (["evaluate", "Bandit2"], ["train", "--env", "Bandit2D", "-i", "Bandit2"]):
        try:
            code = main(argv)
        except SystemExit as stop:
            code = stop.code
        error = capsys.readouterr().err
        assert code == 2 and error.count("\n") == 1
        assert "there is no such folder. Did you mean 'Bandit2D'? Shipped with this package: Bandit2D, ReacherHard" in error


def test_their_policies_are_exported_into_the_current_folder_and_trained_on(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["export", "bandit2d", "--clients", "1"]) == 0
    assert [path.name for path in (tmp_path / "policies").iterdir()] == ["client_1.zip"]
    assert not (PRETRAINED / "Bandit2D" / "policies").exists()
    train = [
        "train",
        "--env",
        "Bandit2D",
        "-i",
        "Bandit2D",
        "--rounds",
        "1",
        "--no-eval",
        "--verbose",
        "0",
        "--picture-freq",
        "0",
    ]
    assert main([*train, "-params", "policy_kwargs.net_arch:[32,32]", "pretraining.dice_width:32"]) == 0
