"""What goes wrong in a real federation, and what must not, with real processes; each test takes minutes."""

from __future__ import annotations

import os
import socket
import socketserver
import ssl
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.flower_deployment import SMALL, Deployment, assert_same

pytestmark = pytest.mark.flower_slow

SECRET = "what-must-not-leave-4711"
PRIOR: dict[str, Any] = {
    **SMALL, "prior_states": 16, "policy_kwargs": {"net_arch": [16]},
    "pretraining": {"dataset_size": 150, "bc_updates": 4, "dice_updates": 4, "dice_width": 8, "prior_updates": 6,
                    "prior_average_every": 3, "prior_width": 8},
}  # fmt: skip
DDPG: dict[str, Any] = {
    "rollout_size": 64, "n_envs_per_client": 4, "batch_size": 16, "learning_starts": 8, "buffer_size": 200, "train_freq": 4,
    "policy_kwargs": {"net_arch": [16]}, "pretraining": {"dataset_size": 100, "bc_updates": 5},
}  # fmt: skip


@pytest.mark.parametrize(("algo", "env", "params"), [("fedguide", "Reacher", PRIOR), ("fedrl", "Reacher", DDPG)])
def test_same_as_in_process(tmp_path: Path, algo: str, env: str, params: dict) -> None:
    """With a trunk that is trained over the network; and off-policy."""
    with Deployment(tmp_path, algo, 2, params, env, min_clients=3, timeout=300) as deployment:
        deployment.start_all()
        assert deployment.exit_codes() == [0, 0, 0, 0]
        assert_same(deployment)


def test_registered_environments_of_ones_own_are_deployed(tmp_path: Path) -> None:
    """Pendulums of the Gymnasium package give no state, so that their episodes begin anew with every round, and it is said."""
    clients = [{"client": k, "id": "Pendulum-v1", "kwargs": {"g": 9.0 + k}} for k in range(2)]
    family = {"schema_version": 1, "family": "Pendulums", "world": "gymnasium", "backbone": "Gymnasium",
              "max_episode_steps": 16, "description": "", "clients": clients}  # fmt: skip
    params = {**SMALL, "bc_weight": 0.0, "pretraining": {}, "mix": 1.0}
    with Deployment(tmp_path, "fedavg", 2, params, "Gymnasium", 2, family=family, min_clients=2, timeout=300) as deployment:
        deployment.start_all()
        assert deployment.exit_codes() == [0, 0, 0]
        assert "their episodes began anew" in deployment.log("client_0")
        first, second = ({name: array for name, array in deployment.parameters(k).items() if name.startswith("policy")}
                         for k in range(2))  # fmt: skip
        assert first.keys() == second.keys() and len(first) > 5
        for name, array in first.items():  # after the last average they have the same policy
            assert np.isfinite(array).all() and np.array_equal(array, second[name]), name


def test_slow_raising_and_lying_clients(tmp_path: Path) -> None:
    """The others go on, who was left out returns, and the server learns nothing that it should not."""
    with Deployment(tmp_path, "fedavg", 100, min_clients=1, timeout=60) as deployment:
        deployment.faults(1, round_2=["wait"])
        deployment.faults(2, round_1=["raise", SECRET])
        deployment.start_all()
        deployment.wait_for("server", r"round 1: client 2 is left out \(error: ValueError\)")
        deployment.wait_for("server", r"round 1: clients 2, failed 1, rejected 0")
        deployment.wait_for("server", r"round 2: client 1 is left out \(timeout\)")
        deployment.wait_for("server", r"round 2: clients 2, failed 1, rejected 0")
        deployment.go(1)
        back = int(deployment.wait_for("server", r"round (\d+): clients 3, failed 0, rejected 0")[1])
        assert back > 2
        nan, shape = back + 2, back + 4
        deployment.faults(2, **{f"round_{nan}": ["nan"], f"round_{shape}": ["shape"]})
        deployment.wait_for("server", rf"round {nan}: the server rejects the upload of client 2: .* not finite")
        deployment.wait_for("server", rf"round {nan}: clients 3, failed 0, rejected 1")
        deployment.wait_for("server", rf"round {shape}: the server rejects the upload of client 2: .* has the shape \(2, 3\)")
        deployment.wait_for("server", rf"round {shape}: clients 3, failed 0, rejected 1")
        deployment.wait_for("server", rf"round {shape + 1}: clients 3, failed 0, rejected 0")
        assert "client 0 is left out" not in deployment.log("server")
        assert SECRET in deployment.log("client_2")
        for path in [tmp_path / "server.log", *(tmp_path / "server").rglob("*")]:
            assert not path.is_file() or SECRET.encode() not in path.read_bytes(), path


def test_killed_server_and_killed_client_go_on(tmp_path: Path) -> None:
    """``fedguide deploy`` itself is killed on both sides. What it started ends by itself, and the result is the same."""
    with Deployment(tmp_path, "fedguide", 3, min_clients=3, timeout=300) as deployment:
        deployment.start_all()
        deployment.wait_for("server", "round 1: clients 3")
        children = deployment.children("server", "flower_superlink") + deployment.children("client_2", "flower_supernode")
        deployment.kill("server")
        deployment.kill("client_2")
        deployment.wait_for_end(children)
        deployment.start("server", "client_2")
        assert deployment.exit_codes() == [0, 0, 0, 0]
        assert "going on after round " in deployment.log("server")
        assert deployment.log("server").count("round 1: clients") == 1
        assert_same(deployment)


#: ``fedguide`` whose server hands out an app that writes a file where it is imported.
EVIL = """
import sys
from flwr.cli.build import build_fab_from_files
from flwr.supercore.fab import Fab
import hashlib
from sb3_fedguide.deployment.flower import server_node
def app_bundle():
    toml = server_node._APP.replace("sb3_fedguide.deployment.flower.client_app:app", "evil:app")
    assert "evil:app" in toml
    files = {"pyproject.toml": toml.encode(), "evil.py": b"open('EXECUTED', 'w')"}
    content = build_fab_from_files(files)[0]
    assert b"evil.py" in content
    return Fab(hashlib.sha256(content).hexdigest(), content, {})
server_node.app_bundle = app_bundle
from sb3_fedguide.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


def test_what_is_closed(tmp_path: Path) -> None:
    """Code that the server pushes does not run, control and runtime are closed from outside, and a strange key is refused."""
    from flwr.supercore.protobuf.constants import PROTOBUF_MEDIA_TYPE

    with Deployment(tmp_path, "fedavg", 2, n_clients=1) as deployment:
        (tmp_path / "evil.py").write_text(EVIL)
        deployment.faults(0, round_2=["wait"])
        deployment.start("server", program=[sys.executable, "evil.py"])
        deployment.start("client_0")
        deployment.wait_for("server", "round 1: clients 1")
        context = ssl.create_default_context(cafile=tmp_path / "certificates" / "ca.crt")
        answers = {}
        for path in (
            "control/list-nodes",
            "control/register-node",
            "control/start-run",
            "runtime/acquire-task",
            "fleet/get-run",
        ):
            request = urllib.request.Request(f"https://localhost:{deployment.port}/v1/{path}", b"", method="POST")
            request.add_header("content-type", PROTOBUF_MEDIA_TYPE)
            with pytest.raises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(request, context=context, timeout=20)
            answers[path] = refused.value.code
        assert answers.pop("fleet/get-run") == 401  # a path that is open asks for the signature of a registered key
        assert set(answers.values()) == {403}
        deployment.run("key", "keys", "stranger")
        strange = ["flower-supernode", "--superlink", f"localhost:{deployment.port}", "--root-certificates",
                   "certificates/ca.crt", "--auth-supernode-private-key", "keys/stranger", "--port", str(deployment.port + 1),
                   "--isolation", "process"]  # fmt: skip
        command = [str(Path(sys.executable).parent / strange[0]), *strange[1:]]
        result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120,
                                env={**os.environ, "FLWR_TELEMETRY_ENABLED": "0"})  # fmt: skip
        assert result.returncode == 1 and "2004" in result.stdout + result.stderr
        deployment.go(0)
        assert deployment.exit_codes() == [0, 0]
        assert not list(tmp_path.rglob("EXECUTED")) and not list((tmp_path / "client_0").rglob("evil*"))
        assert list((tmp_path / "server").rglob("evil.py"))  # it was there to be fetched


class CompanyProxy(socketserver.ThreadingTCPServer):
    """A proxy as companies have them: it knows where ``fed.example.org`` is, and lets ``CONNECT`` through to it alone."""

    daemon_threads = allow_reuse_address = True

    class Tunnel(socketserver.StreamRequestHandler):
        server: CompanyProxy

        def handle(self) -> None:
            method, target, _ = self.rfile.readline().decode().split()
            while self.rfile.readline().strip():
                pass
            self.server.asked.append(f"{method} {target}")
            host, _, port = target.rpartition(":")
            if method != "CONNECT" or host != "fed.example.org":
                self.wfile.write(b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\n\r\n")
                return
            try:
                upstream = socket.create_connection(("127.0.0.1", int(port)))
            except OSError:
                self.wfile.write(b"HTTP/1.1 502 Bad Gateway\r\nContent-Length: 0\r\n\r\n")
                return
            self.wfile.write(b"HTTP/1.1 200 Connection established\r\n\r\n")
            with upstream:
                back = threading.Thread(target=self._pass, args=(upstream, self.connection), daemon=True)
                back.start()
                self._pass(self.connection, upstream)
                back.join()

        @staticmethod
        def _pass(source: socket.socket, target: socket.socket) -> None:
            try:
                while data := source.recv(65536):
                    target.sendall(data)
                target.shutdown(socket.SHUT_WR)
            except OSError:  # one side has gone
                pass

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), self.Tunnel)
        self.asked: list[str] = []

    def __enter__(self) -> CompanyProxy:
        threading.Thread(target=self.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.shutdown()
        self.server_close()


def test_a_deployment_goes_through_a_companys_proxy_and_its_own_processes_do_not(tmp_path: Path) -> None:
    """Only the proxy knows the server's name, and it forbids everything else, the loopback device included."""
    with CompanyProxy() as proxy:
        address = f"http://127.0.0.1:{proxy.server_address[1]}"
        variables = {name: address for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY")}
        variables |= dict.fromkeys(("no_proxy", "NO_PROXY"), "")
        with Deployment(
            tmp_path,
            "fedavg",
            n_rounds=2,
            n_clients=2,
            host="fed.example.org",
            variables=variables,
            min_clients=2,
            timeout=300,
        ) as deployment:
            deployment.start_all()
            assert deployment.exit_codes() == [0, 0, 0]
            assert set(proxy.asked) == {f"CONNECT fed.example.org:{deployment.port}"}
            assert_same(deployment)
