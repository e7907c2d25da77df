"""A federation over Flower with real processes, TLS and registered keys, beside the same federation in process."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from tests.flower_deployment import Deployment, assert_same

pytestmark = pytest.mark.flower


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
