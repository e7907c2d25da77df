"""The documented example of an algorithm of one's own works as the page says."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_fedguide.algorithms import ALGORITHMS, register_algorithm
from sb3_fedguide.cli.train import main

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "docs" / "examples"
SMALL = ["--rounds", "2", "-params", "rollout_size:60", "batch_size:20", "n_envs_per_client:2", "bc_weight:0"]


def test_the_page_shows_the_file():
    code = (EXAMPLES / "half_averaging.py").read_text().split("\n\n", 2)[2]
    assert code.strip() in (ROOT / "docs" / "extending.md").read_text()


def test_the_example_trains_from_the_command_line(tmp_path):
    command = [sys.executable, str(ROOT / "train.py"), "--gym-packages", "half_averaging", "--algo", "half-averaging"]
    command += ["--env", "Bandit2D", "-f", str(tmp_path), *SMALL]
    result = subprocess.run(command, cwd=EXAMPLES, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    summary = json.loads((tmp_path / "half-averaging" / "Bandit2D_1" / "summary.json").read_text())
    assert summary["rounds_done"] == 2 and summary["bytes_up"] > 0


def test_the_example_does_what_it_says(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    from half_averaging import HalfAveraging

    model = HalfAveraging("MlpPolicy", "Bandit2D", rollout_size=20, batch_size=10, seed=0)
    before = model.policy.client_state_dict(1)
    average = {name: np.full_like(tensor.numpy(), 2.0) for name, tensor in before.items()}
    model.receive(1, average)
    for name, tensor in model.policy.client_state_dict(1).items():
        np.testing.assert_allclose(tensor.numpy(), 0.5 * before[name].numpy() + 1.0, rtol=1e-6)
    monkeypatch.delitem(ALGORITHMS, "half-averaging")


def test_a_taken_name_is_refused():
    with pytest.raises(ValueError, match="taken"):
        register_algorithm("fedavg", "somewhere:Else")
    with pytest.raises(ValueError, match="module:Class"):
        register_algorithm("mine", "somewhere")
    register_algorithm("fedavg", "sb3_fedguide.algorithms.fedavg:FedAvg")  # the same again is no mistake


def test_a_missing_module_is_one_message(capsys, tmp_path):
    assert main(["--gym-packages", "no_such_module", "--env", "Bandit2D", "-f", str(tmp_path / "logs")]) == 2
    assert "--gym-packages no_such_module" in capsys.readouterr().err
    assert not (tmp_path / "logs").exists()
