"""A federation over Flower with real processes, TLS and registered keys, beside the same federation in process."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest

import fed_envs
from sb3_fedguide.settings.config import resolve
from tests.flower_deployment import Deployment

pytestmark = pytest.mark.flower


def in_process(deployment: Deployment) -> dict[str, np.ndarray]:
    """What the same clients learn in one process."""
    common, family = deployment.common, fed_envs.load_family(deployment.metadata)
    config = resolve(common["algo"], family, "tuned", None, {**common["params"], "n_rounds": common["n_rounds"]})
    model = config.make(family, seed=0, verbose=0)
    model.learn(config.n_rounds * model.rollout_size * model.n_clients)
    path = deployment.folder / "in_process.npz"
    model.export_parameters(path)
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def assert_same(deployment: Deployment) -> None:
    """Every client has learned what it learns in process; it does the same sums in the same order."""
    expected = in_process(deployment)
    for client in range(deployment.n_clients):
        learned = deployment.parameters(client)
        assert learned.keys() == expected.keys()
        for name in learned.keys() - {"header", "__sha256__"}:
            alone, together = learned[name], expected[name]
            if together.shape != alone.shape:  # stacked along the clients
                together = together[client : client + 1]
            difference = np.abs(alone.astype(np.float64) - together).max(initial=0.0)
            assert difference <= 1e-5, f"{name} of client {client} differs by {difference}"


def test_same_as_in_process_though_a_supernode_is_killed(tmp_path: Path) -> None:
    """FedGuide on three clients. In round 2 a SuperNode is killed when its client has trained and before it has saved."""
    with Deployment(tmp_path, "fedguide", n_rounds=3, min_clients=3, timeout=300) as deployment:
        deployment.faults(1, round_2=["stall"])
        deployment.start_all()
        deployment.wait_for_file(tmp_path / "client_1.stalled")
        deployment.faults(1)
        (supernode,) = deployment.children("client_1", "flower_supernode")
        os.kill(supernode, signal.SIGKILL)
        assert deployment.exit_codes() == [0, 0, 0, 0]
        assert "round 2: client 1 is left out (gone)" in deployment.log("server")
        assert deployment.log("client_1").count("the SuperNode has stopped") >= 1
        assert_same(deployment)
