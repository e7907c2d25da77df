"""A client's machine: Flower's SuperNode, and the processes that answer its messages with the code installed here."""

from __future__ import annotations

import importlib
import multiprocessing.process
import os
import sys
import time
from pathlib import Path

import httpx
from flwr.proto.runtime_pb2 import AcquireTaskRequest
from flwr.supercore.constant import TaskType
from flwr.supercore.runtime import RuntimeHttpClient

from sb3_fedguide.deployment.flower.certificates import LOOPBACK
from sb3_fedguide.deployment.flower.client_app import FINISHED, app
from sb3_fedguide.deployment.flower.processes import (
    FlowerProcess,
    environment,
    free_port,
    loopback_without_proxy,
    runtime_version,
)
from sb3_fedguide.deployment.site import PARAMETERS, SITE

_POLL_SECONDS = 0.2
#: The SuperLink refuses a key for up to a minute after its SuperNode was killed.
_RESTART_SECONDS = 10.0
#: Seconds in which a process ends after its answer.
_EXIT_SECONDS = 5.0
#: Seconds in which the SuperNode delivers the last reply.
_LAST_SECONDS = 5.0


class ClientNode:
    """Keeps a SuperNode running, and answers its messages.

    In Flower the server sends the code that its clients run. Here it cannot: of Flower's kinds of tasks this takes
    only messages for a client, and answers them in a fork of this process with the installed
    :mod:`sb3_fedguide.deployment.flower.client_app`. What the server sent as an app is neither unpacked nor installed.

    :param server: ``host:port``
    :param ca: file of the authority that signed the server's certificate
    :param key: file of this client's private key
    :param config: JSON file that the app reads: ``site`` for :func:`~sb3_fedguide.deployment.site.make_site`, and ``folder``
    :param folder: that folder; Flower keeps its own files in it too
    """

    def __init__(self, server: str, ca: Path, key: Path, config: Path, folder: Path) -> None:
        self._folder = folder
        self._arguments = [
            "--superlink", server, "--root-certificates", str(ca), "--auth-supernode-private-key", str(key),
            "--node-config", f"config='{config}'", "--isolation", "process", "--host", LOOPBACK,
        ]  # fmt: skip
        self._env = environment(folder)
        os.environ.update(loopback_without_proxy())  # this process and its forks ask the SuperNode as well

    @property
    def finished(self) -> bool:
        """Whether the federation has ended."""
        return (self._folder / FINISHED).exists()

    def run(self) -> None:
        """Run until the federation ends; return at once if it has ended already."""
        if not (self._folder / SITE / PARAMETERS).exists():  # it was not prepared when the end came
            (self._folder / FINISHED).unlink(missing_ok=True)
        while not self.finished:
            port = free_port()
            arguments = [*self._arguments, "--port", str(port)]
            with FlowerProcess("flwr.supernode.cli", "flower_supernode", arguments, self._env) as node:
                self._answer(node, f"{LOOPBACK}:{port}")
                code = node.exit_code
            if not self.finished:
                print(f"the SuperNode has stopped ({code}); starting it again in {_RESTART_SECONDS:.0f} s", file=sys.stderr)
                time.sleep(_RESTART_SECONDS)

    def _answer(self, node: FlowerProcess, address: str) -> None:
        """Answer messages until the SuperNode ends, or the federation."""
        client = RuntimeHttpClient.from_server_address(address, True, None, [runtime_version("SuperExec")])
        worker: multiprocessing.process.BaseProcess | None = None
        try:
            while node.exit_code is None and not self.finished:
                if (token := _next_task(client)) is None:
                    time.sleep(_POLL_SECONDS)
                    continue
                # A SuperNode has one message at a time: a process that still works on the previous one waits for a reply that
                # will not come, as after a restart of the server.
                _end(worker, _EXIT_SECONDS)
                worker = multiprocessing.get_context("fork").Process(target=run_installed_app, args=(address, token))
                worker.start()
        finally:
            _end(worker, _EXIT_SECONDS if self.finished else 0.0)
        if self.finished:
            time.sleep(_LAST_SECONDS)


def _next_task(client: RuntimeHttpClient) -> str | None:
    """Token of a message that waits for its answer, if one does."""
    try:
        answer = client.AcquireTask(AcquireTaskRequest(supported_task_types=[TaskType.CLIENT_APP]))
    except httpx.HTTPError:  # the SuperNode is starting, or ending
        return None
    return answer.token or None


def _end(worker: multiprocessing.process.BaseProcess | None, seconds: float) -> None:
    if worker is not None:
        worker.join(seconds)
        worker.kill()
        worker.join()


def run_installed_app(address: str, token: str) -> None:
    """Flower's process for one message, with the installed app in the place of that which the server sent."""
    flower = importlib.import_module("flwr.supernode.runtime.run_clientapp")
    pinned = {"install_from_fab": lambda *_, **__: None, "get_load_client_app_fn": lambda *_, **__: lambda *_: app}
    for name, replacement in pinned.items():
        if not hasattr(flower, name):
            raise RuntimeError(f"flwr has no {name} any more: this package needs another version of it")
        setattr(flower, name, replacement)
    flower.run_clientapp(address, token, insecure=True, parent_pid=os.getppid())
