"""``fedguide benchmark --engine ray`` on two Ray nodes on this machine, with a token; needs Ray (``make test-ray``)."""

from __future__ import annotations

import json
import os
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from sb3_fedguide.cli.train import main as train

pytestmark = pytest.mark.ray

#: Imported by every run (``--gym-packages``). Its wait ends only if two runs are going on at once: on two nodes of one CPU.
GATE = """
import os, signal, sys, time
from pathlib import Path
here = Path(__file__).parent
if "train" in sys.argv and "--resume" not in sys.argv:
    seed = int(sys.argv[sys.argv.index("--seed") + 1])
    if seed == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    (here / f"started-{seed}").touch()
    other = {0: "started-1", 1: "started-0"}.get(seed, "go")
    deadline = time.monotonic() + 120
    while not (here / other).exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    if not (here / other).exists():
        sys.exit("nobody else came")
"""
SETTINGS = ["--rounds", "2", "--eval-episodes", "2", "-params", "bc_weight:0", "n_epochs:1", "policy_kwargs.net_arch:[8]"]


def free_port() -> int:
    with socket.socket() as connection:
        connection.bind(("127.0.0.1", 0))
        return connection.getsockname()[1]


class Cluster:
    """A head and one more node with one CPU each, both started as a user starts them."""

    def __init__(self, folder: Path) -> None:
        token = folder / "token"
        token.write_text(secrets.token_hex(32))
        token.chmod(0o600)
        self.environment = {
            **os.environ, "OMP_NUM_THREADS": "1", "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(token),
            "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]),
        }  # fmt: skip
        self.folder, self.address = folder, f"127.0.0.1:{free_port()}"
        port = self.address.rpartition(":")[2]
        head = ["--head", "--port", port, "--include-dashboard=false", "--temp-dir", str(folder / "ray")]
        self.head = self._start("head", [*head, "--ray-client-server-port", str(free_port())])
        self.node = self._start("node", ["--address", self.address])

    def _start(self, name: str, flags: Sequence[str]) -> subprocess.Popen[bytes]:
        log = self.folder / f"{name}.txt"
        command = [sys.executable, "-m", "ray.scripts.scripts", "start", "--num-cpus", "1", "--node-ip-address", "127.0.0.1"]
        command += ["--disable-usage-stats", "--object-store-memory", "80000000", "--block", *flags]
        with log.open("wb") as file:
            process = subprocess.Popen(
                command, stdout=file, stderr=subprocess.STDOUT, env=self.environment, start_new_session=True
            )
        deadline = time.monotonic() + 120
        while "Ray runtime started" not in log.read_text():
            assert process.poll() is None and time.monotonic() < deadline, log.read_text()
            time.sleep(0.1)
        return process

    def close(self) -> None:
        for process in (self.node, self.head):
            if process.poll() is None:
                process.terminate()  # with --block it ends what it has started
                process.wait(60)

    def benchmark(self, *flags: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "sb3_fedguide", "benchmark", "--algos", "local", "--envs", "Bandit2D", *SETTINGS]
        command += ["-f", "results", "--gym-packages", "gate", "--engine", "ray", "--address", self.address, *flags]
        return subprocess.Popen(
            command, cwd=self.folder, env=self.environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )


@pytest.fixture
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    pytest.importorskip("ray")
    folder = tmp_path_factory.mktemp("r")
    (folder / "gate.py").write_text(GATE)
    cluster = Cluster(folder)
    yield cluster
    cluster.close()


def finished(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, errors = process.communicate(timeout=300)
    return process.returncode, out, errors


def test_runs_spread_over_nodes_and_survive_what_dies(cluster, tmp_path):
    code, out, errors = finished(cluster.benchmark("--seeds", "0", "1", "2"))
    results = cluster.folder / "results" / "Bandit2D-tuned"
    assert code == 1 and "local on Bandit2D, seed 2 failed: its process was killed (SIGKILL)" in errors, errors
    assert sorted(path.name for path in results.glob("*.json")) == ["local-seed0.json", "local-seed1.json"], errors
    assert "nobody else came" not in errors and "local" in out

    flags = ["--algo", "local", "--env", "Bandit2D", "--seed", "0", *SETTINGS, "--verbose", "0", "-f", str(tmp_path)]
    assert train(flags) == 0
    here = json.loads((tmp_path / "local/Bandit2D_1/summary.json").read_text())
    assert json.loads((results / "local-seed0.json").read_text())["deployed"] == here["deployed"]

    process = cluster.benchmark("--seeds", "0", "1", "3", "4")
    deadline = time.monotonic() + 120
    while not all((cluster.folder / f"started-{seed}").exists() for seed in (3, 4)):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    raylets = subprocess.run(["ps", "-g", str(cluster.node.pid), "-o", "pid="], capture_output=True, text=True, check=True)
    for pid in map(int, raylets.stdout.split()):
        os.kill(pid, signal.SIGKILL)
    (cluster.folder / "go").touch()
    code, out, errors = finished(process)
    assert code == 1 and "1 of 2 runs failed" in errors and "failed: Ray: " in errors, errors
    assert len(list(results.glob("*.json"))) == 3
    assert cluster.benchmark("--seeds", "0", "1", "3", "4").wait(300) == 0
    assert len(list(results.glob("*.json"))) == 4


def test_interrupts_end_runs_with_a_checkpoint(cluster):
    (cluster.folder / "go").touch()
    process = cluster.benchmark("--seeds", "3", "--rounds", "3000", "--label", "long", "--save-freq", "1")
    runs = cluster.folder / "results/Bandit2D-long/runs/local-seed3"
    deadline = time.monotonic() + 120
    while not list(runs.glob("local/Bandit2D_1/checkpoints/round_*.npz")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGTERM)
    code, _, errors = finished(process)
    assert code == 143 and "1 runs are not finished; the same command resumes them" in errors, errors
    assert "which is complete" in (runs / "output.txt").read_text()
