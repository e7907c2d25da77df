"""The server's machine: Flower's SuperLink on the loopback device, the proxy before it, and the round loop."""

from __future__ import annotations

import hashlib
import os
import sys
import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

import httpx
from flwr.cli.build import build_fab_from_files
from flwr.common.serde import fab_to_proto
from flwr.proto.control_pb2 import ListNodesRequest, RegisterNodeRequest, StartRunRequest, UnregisterNodeRequest
from flwr.proto.runtime_pb2 import AcquireTaskRequest
from flwr.supercore.constant import TaskType
from flwr.supercore.control import ControlHttpClient
from flwr.supercore.fab import Fab
from flwr.supercore.runtime import RuntimeHttpClient

from sb3_fedguide import __version__
from sb3_fedguide.deployment.flower.certificates import CA, LOOPBACK, SERVER, SERVER_KEY
from sb3_fedguide.deployment.flower.processes import (
    FlowerProcess,
    environment,
    free_port,
    loopback_without_proxy,
    runtime_version,
)
from sb3_fedguide.deployment.flower.proxy import FleetProxy, ProxyServer
from sb3_fedguide.deployment.flower.server_app import CONFIG, FINISHED
from sb3_fedguide.exit_codes import EXIT_FAILED

_POLL_SECONDS = 0.2
_START_SECONDS = 120.0

#: The app that Flower hands to the clients: a name, a version and no code.
_APP = f"""
[project]
name = "fedguide"
version = "{__version__}"
description = "Runs what is installed"
license = "MIT"
[tool.flwr.app]
publisher = "fedguide"
[tool.flwr.app.components]
serverapp = "sb3_fedguide.deployment.flower.server_app:app"
clientapp = "sb3_fedguide.deployment.flower.client_app:app"
"""


class ServerNode:
    """Runs a federation's server; all its processes end with it.

    :param listen: host and port that clients connect to
    :param certificates: folder with the authority's and the server's certificate, and the server's key
    :param keys: id of each client by its public key; no other key is accepted
    :param config: file that the server app reads
    :param folder: for Flower's own files
    """

    def __init__(
        self, listen: tuple[str, int], certificates: Path, keys: Mapping[bytes, int], config: Path, folder: Path
    ) -> None:
        self._listen, self._certificates, self._keys, self._folder = listen, certificates, keys, folder
        self._ca = certificates / CA
        self._env = {**environment(folder), CONFIG: str(config)}
        os.environ.update(loopback_without_proxy())  # this process asks the SuperLink as well
        self._address = f"{LOOPBACK}:{free_port()}"

    def run(self) -> int:
        """Run the federation to its end.

        :return: exit code: 0, that of the round loop, or 1 where another part of it failed
        :raises OSError: if it could not be started
        """
        (self._folder / FINISHED).unlink(missing_ok=True)
        certificate, key = self._certificates / SERVER, self._certificates / SERVER_KEY
        host, port = self._address.split(":")
        arguments = [
            "--host", host, "--port", port, "--ssl-ca-certfile", str(self._ca), "--ssl-certfile", str(certificate),
            "--ssl-keyfile", str(key), "--enable-supernode-auth", "--isolation", "process",
            "--database", str(self._folder / "superlink.db"), "--disable-runtime-dependency-installation",
        ]  # fmt: skip
        with ExitStack() as stack:
            passing = FleetProxy(f"https://{self._address}", self._ca)
            proxy = ProxyServer(self._listen, passing, certificate, key, len(self._keys))
            link = stack.enter_context(FlowerProcess("flwr.superlink.cli", "flower_superlink", arguments, self._env))
            control = self._wait_for(link)
            self._register(control)
            stack.enter_context(proxy)
            run = control.StartRun(StartRunRequest(fab=fab_to_proto(app_bundle()))).run_id
            app = stack.enter_context(self._start_app(run, link))
            while app.exit_code is None and link.exit_code is None and proxy.alive:
                time.sleep(_POLL_SECONDS)
            return self._outcome(app.exit_code)

    def _outcome(self, code: int | None) -> int:
        """The exit code for that of the round loop's process, ``None`` if another process ended first."""
        if code == 0 and not (self._folder / FINISHED).is_file():
            print(
                "Flower ended the run before its first round or in the middle of it; start the server again", file=sys.stderr
            )
            return EXIT_FAILED
        return EXIT_FAILED if code is None else code

    def _wait_for(self, link: FlowerProcess) -> ControlHttpClient:
        """Wait until the SuperLink answers."""
        client = ControlHttpClient.from_server_address(
            self._address, False, self._ca.read_bytes(), [runtime_version("flwr CLI")]
        )
        until = time.monotonic() + _START_SECONDS
        while link.exit_code is None and time.monotonic() < until:
            try:
                client.ListNodes(ListNodesRequest())
                return client
            except httpx.TransportError:
                time.sleep(_POLL_SECONDS)
        raise OSError(f"Flower's SuperLink did not start on {self._address} (exit code {link.exit_code})")

    def _register(self, control: ControlHttpClient) -> None:
        """Register the keys of the configuration, and unregister all others."""
        registered = {node.public_key: node.node_id for node in control.ListNodes(ListNodesRequest()).nodes_info
                      if node.status != "unregistered"}  # fmt: skip
        for key in registered.keys() - self._keys.keys():
            control.UnregisterNode(UnregisterNodeRequest(node_id=registered[key]))
        for key in self._keys.keys() - registered.keys():
            control.RegisterNode(RegisterNodeRequest(public_key=key, name=f"client {self._keys[key]}"))

    def _start_app(self, run: int, link: FlowerProcess) -> FlowerProcess:
        """Start the process of the round loop, but no run that another user may have started."""
        client = RuntimeHttpClient.from_server_address(
            self._address, False, self._ca.read_bytes(), [runtime_version("SuperExec")]
        )
        until, token = time.monotonic() + _START_SECONDS, ""
        while not token:
            answer = client.AcquireTask(AcquireTaskRequest(supported_task_types=[TaskType.SERVER_APP]))
            token = answer.token if answer.task.run_id == run else ""
            if link.exit_code is not None or time.monotonic() > until:
                raise OSError(f"Flower's SuperLink on {self._address} did not start the run (exit code {link.exit_code})")
            time.sleep(_POLL_SECONDS)
        arguments = ["--runtime-api-address", self._address, "--root-certificates", str(self._ca), "--token", token]
        return FlowerProcess("flwr.superlink.cli", "flwr_serverapp", arguments, self._env)


def app_bundle() -> Fab:
    """Flower's bundle of the app, which clients fetch and do not run."""
    content = build_fab_from_files({"pyproject.toml": _APP.encode()})[0]
    return Fab(hashlib.sha256(content).hexdigest(), content, {})
