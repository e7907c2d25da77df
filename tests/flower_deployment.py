"""A whole deployment on the loopback device, with its processes, for the tests of faults."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import fed_envs
from sb3_fedguide.settings.config import resolve

TESTS = Path(__file__).parent
#: Settings small enough for a test, the same for the server and its clients.
SMALL: dict[str, Any] = {
    "rollout_size": 64, "n_envs_per_client": 4, "batch_size": 32, "n_epochs": 2,
    "pretraining": {"dataset_size": 100, "bc_updates": 5, "dice_updates": 5},
}  # fmt: skip


class Deployment:
    """Server and clients in a folder, as ``docs/deployment.md`` lays them out; a context manager that leaves no process.

    :param algo: command-line name
    :param params: hyperparameters
    :param env: family, of which there are the first ``n_clients`` clients
    :param family: its metadata instead of those that ship with the package
    :param host: by which clients know the server
    :param variables: of every process's environment
    :param server: further lines of the server's configuration
    """

    def __init__(
        self, folder: Path, algo: str, n_rounds: int, params: Mapping[str, Any] = SMALL, env: str = "Bandit2D",
        n_clients: int = 3, host: str = "localhost", variables: Mapping[str, str] | None = None,
        family: Mapping[str, Any] | None = None, **server: Any,
    ) -> None:  # fmt: skip
        self.folder, self.n_clients, self._variables = folder, n_clients, dict(variables or {})
        self.common = {"algo": algo, "seed": 0, "n_rounds": n_rounds, "params": dict(params)}
        self.metadata = folder / f"{env}.json"
        family = json.loads(fed_envs.FAMILIES[env].read_text()) if family is None else family
        self.metadata.write_text(json.dumps({**family, "clients": family["clients"][:n_clients]}))
        self._mark = uuid.uuid4().hex
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.run("certificates", "certificates", "--host", host)
        for client in range(n_clients):
            self.run("key", "keys", f"client_{client}")
            self._write(
                f"client_{client}", client=client, metadata=self.metadata.name, server=f"{host}:{self.port}",
                ca="certificates/ca.crt", key=f"keys/client_{client}", folder=f"client_{client}",
                cache_dir=f"cache_{client}", eval_freq=0, packages=["flower_faults"],
            )  # fmt: skip
        keys = {client: f"keys/client_{client}.pub" for client in range(n_clients)}
        self._write(
            "server", env=env, clients=keys, listen=f"127.0.0.1:{self.port}", certificates="certificates", folder="server",
            **server,
        )  # fmt: skip

    def _write(self, name: str, **lines: Any) -> None:
        (self.folder / f"{name}.yml").write_text(yaml.safe_dump({**self.common, **lines}))

    def _environment(self, name: str) -> dict[str, str]:
        own = {"FEDGUIDE_FAULTS": str(self.folder / f"{name}.faults"), "FEDGUIDE_MARK": self._mark, "OMP_NUM_THREADS": "1"}
        return {**os.environ, **self._variables, **own, "PYTHONPATH": str(TESTS)}

    def run(self, *command: str) -> None:
        """``fedguide deploy`` to its end."""
        subprocess.run([sys.executable, "-m", "sb3_fedguide", "deploy", *command], cwd=self.folder, check=True,
                       capture_output=True, env=self._environment(""))  # fmt: skip

    def faults(self, client: int, **by_message: Any) -> None:
        """What :mod:`tests.flower_faults` is to do, by message with an underscore for the space."""
        found = {message.replace("_", " "): fault for message, fault in by_message.items()}
        (self.folder / f"client_{client}.faults").write_text(json.dumps(found))

    def start(self, *names: str, program: Sequence[str] = (sys.executable, "-m", "sb3_fedguide")) -> None:
        """Start ``server`` or ``client_<k>``.

        :param program: instead of ``fedguide``
        """
        for name in names:
            kind = name.split("_")[0]
            with (self.folder / f"{name}.log").open("a") as log:
                command = [*program, "deploy", kind, f"{name}.yml"]
                self._processes[name] = subprocess.Popen(
                    command, cwd=self.folder, stdout=log, stderr=log, stdin=subprocess.DEVNULL, env=self._environment(name),
                    start_new_session=True,
                )  # fmt: skip

    def go(self, client: int) -> None:
        """Let a client go on that waits."""
        (self.folder / f"client_{client}.go").touch()

    def start_all(self) -> None:
        self.start("server", *(f"client_{client}" for client in range(self.n_clients)))

    def log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    def wait_for(self, name: str, pattern: str, seconds: float = 300.0) -> re.Match[str]:
        """Wait until a log has this regular expression in it."""
        until = time.monotonic() + seconds
        while (found := re.search(pattern, self.log(name))) is None:
            code = self._processes[name].poll()
            assert code is None or re.search(pattern, self.log(name)), f"{name} ended with {code}: {self.log(name)}"
            assert time.monotonic() < until, f"{name} does not say {pattern!r} after {seconds} s: {self.log(name)}"
            time.sleep(0.2)
        return found

    def wait_for_file(self, path: Path, seconds: float = 300.0) -> None:
        until = time.monotonic() + seconds
        while not path.exists():
            assert time.monotonic() < until, f"{path} is not there after {seconds} s: {self.log('server')}"
            time.sleep(0.2)

    def exit_code(self, name: str, seconds: float = 600.0) -> int:
        """Wait for the end of a process."""
        return self._processes[name].wait(seconds)

    def exit_codes(self) -> list[int]:
        """Wait for the end of all, the server first."""
        return [self.exit_code(name) for name in ("server", *(f"client_{client}" for client in range(self.n_clients)))]

    def wait_for_end(self, pids: Iterable[int], seconds: float = 30.0) -> None:
        until = time.monotonic() + seconds
        while left := [pid for pid in pids if _read(pid, "cmdline")]:
            assert time.monotonic() < until, f"still there after {seconds} s: {[_read(pid, 'cmdline') for pid in left]}"
            time.sleep(0.2)

    def kill(self, name: str) -> None:
        """SIGKILL for ``fedguide deploy`` itself; what it started has to end by itself."""
        self._processes[name].kill()
        self._processes[name].wait()

    def children(self, name: str, word: str) -> list[int]:
        """Processes that ``name`` started and whose command line has ``word`` in it."""
        parent = self._processes[name].pid
        return [pid for pid in _processes() if _parent(pid) == parent and word in _read(pid, "cmdline")]

    def parameters(self, client: int) -> dict[str, np.ndarray]:
        """What a client has learned."""
        with np.load(self.folder / f"client_{client}" / "site" / "parameters.npz", allow_pickle=False) as file:
            return {name: file[name] for name in file.files}

    def __enter__(self) -> Deployment:
        return self

    def __exit__(self, *exception: object) -> None:
        for process in self._processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        for process in self._processes.values():
            try:
                process.wait(60)
            except subprocess.TimeoutExpired:
                process.kill()
        until = time.monotonic() + 15
        while (left := [pid for pid in _processes() if f"FEDGUIDE_MARK={self._mark}" in _read(pid, "environ")]) and (
            time.monotonic() < until
        ):
            time.sleep(0.2)
        commands = [_read(pid, "cmdline") for pid in left]
        for pid in left:
            os.kill(pid, signal.SIGKILL)
        assert not commands, f"processes that stayed: {commands}"


def _processes() -> list[int]:
    return [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]


def _read(pid: int, name: str) -> str:
    try:
        return Path(f"/proc/{pid}/{name}").read_text(errors="replace")
    except OSError:  # it has ended, or is somebody else's
        return ""


def _parent(pid: int) -> int:
    stat = _read(pid, "stat")
    return int(stat.rpartition(")")[2].split()[1]) if stat else 0


CLIENT = {
    "algo": "fedguide", "env": "Bandit2D", "seed": 0, "client": 0, "server": "localhost:9443", "ca": "certificates/ca.crt",
    "key": "a", "folder": "out",
}  # fmt: skip


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
