"""Flower's own processes: how they start, and how all of them end."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from types import TracebackType

from flwr.supercore.interceptors import RuntimeVersionHttpInterceptor

from sb3_fedguide.deployment.flower.certificates import LOOPBACK

#: The deployment uses private interfaces of Flower, and is tested only with these releases.
FLOWER = "1.41."
_GRACE_SECONDS = 10.0
#: Uvicorn, inside the SuperNode, says of itself what Flower's level keeps back.
_START = """
import os, sys
from uvicorn.config import LOGGING_CONFIG
from flwr.supercore.app_utils import start_parent_process_monitor
for logger in LOGGING_CONFIG["loggers"].values():
    logger["level"] = os.environ.get("FLWR_LOG_LEVEL", "WARNING").upper()
start_parent_process_monitor(int(sys.argv.pop(1)))
from {module} import {function}
sys.argv[0] = "{function}"
{function}()
"""


def check_flower_version() -> None:
    """:raises ValueError: for another version of Flower than those that this package is tested with"""
    found = version("flwr")
    if not found.startswith(FLOWER):
        raise ValueError(f"this package needs flwr {FLOWER}x, and flwr {found} is installed: pip install 'flwr~={FLOWER}0'")


def environment(home: Path) -> dict[str, str]:
    """Environment of a Flower process whose own files are in ``home``."""
    return {"OMP_NUM_THREADS": "1", **os.environ, **loopback_without_proxy(), "FLWR_HOME": str(home)}


def loopback_without_proxy() -> dict[str, str]:
    """The variables that exclude this machine's own addresses from a proxy.

    Flower's processes talk to each other over the loopback device, and follow ``http_proxy`` and ``https_proxy``.
    """
    given = os.environ.get("no_proxy") or os.environ.get("NO_PROXY") or ""  # as httpx and curl: the lower case first
    hosts = [host.strip() for host in given.split(",") if host.strip()]
    hosts += [host for host in (LOOPBACK, "localhost", "::1") if host not in hosts and "*" not in hosts]
    return dict.fromkeys(("no_proxy", "NO_PROXY"), ",".join(hosts))


def runtime_version(component: str) -> RuntimeVersionHttpInterceptor:
    """What a client of Flower's HTTP interfaces says about itself."""
    return RuntimeVersionHttpInterceptor(component_name=component)


def free_port() -> int:
    """A free port of the loopback device."""
    with socket.create_server((LOOPBACK, 0)) as server:
        return server.getsockname()[1]


class FlowerProcess:
    """A Flower command in its own process group, which ends with the context, and when this process ends for any reason.

    :param module: where the command's function is, such as ``flwr.superlink.cli``, and ``function``, its name
    :param arguments: of the command
    :param env: environment
    """

    def __init__(self, module: str, function: str, arguments: Sequence[str], env: dict[str, str]) -> None:
        start = _START.format(module=module, function=function)
        command = [sys.executable, "-c", start, str(os.getpid()), *arguments]
        self.process = subprocess.Popen(command, env=env, start_new_session=True, stdin=subprocess.DEVNULL)

    @property
    def exit_code(self) -> int | None:
        """``None`` while it runs."""
        return self.process.poll()

    def __enter__(self) -> FlowerProcess:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._signal(signal.SIGTERM)
        until = time.monotonic() + _GRACE_SECONDS
        while self.process.poll() is None and time.monotonic() < until:
            time.sleep(0.05)
        self._signal(signal.SIGKILL)
        self.process.wait()

    def _signal(self, number: int) -> None:
        try:
            os.killpg(self.process.pid, number)
        except ProcessLookupError:  # all of the group have ended
            pass
