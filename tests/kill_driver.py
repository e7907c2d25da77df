"""Runs ``train.py`` in children that get a signal, SIGKILL by default, at a certain call of a function or after some seconds.

Reads jobs as JSON lines: ``argv``, ``log`` for the child's output, and ``at``: ``null``, ``["seconds", s]``, ``[place, n]``
with a name of ``PLACES``, perhaps with "after " before it, or ``["checkpoint", k, place, n]``, counted from the beginning of
the k-th checkpoint's write; and ``signals``, one for each call from the n-th on. Answers each with the child's exit code,
negative for a signal. A child is a fork of this process, which has imported everything, so that the tests do not wait for
imports.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

import sb3_fedguide.cli.recorder
import sb3_fedguide.monitoring.callbacks
import sb3_fedguide.offline.pretraining  # noqa: F401
from fed_envs import FederatedVecEnv
from sb3_fedguide.cli.train import main
from sb3_fedguide.common import checkpoint
from sb3_fedguide.registry import ALGORITHMS, algorithm

PLACES: dict[str, tuple[Any, str]] = {
    "step": (FederatedVecEnv, "step_wait"),
    "array": (np.lib.format, "write_array"),  # inside an npz file that is being written
    "fsync": (os, "fsync"),
    "replace": (os, "replace"),
    "unlink": (Path, "unlink"),
    "truncate": (os, "truncate"),
}


def _signalling(function: Callable[..., Any], first: int, signals: list[int], after: bool) -> Callable[..., Any]:
    calls = 0

    def counted(*arguments: Any, **keywords: Any) -> Any:
        nonlocal calls
        calls += 1
        due = signals[calls - first] if 0 <= calls - first < len(signals) else None
        if due is not None and not after:
            os.kill(os.getpid(), due)
        result = function(*arguments, **keywords)
        if due is not None and after:
            os.kill(os.getpid(), due)
        return result

    return counted


def _arm(place: str, first: int, *inside: Any, signals: list[int]) -> None:
    if place != "checkpoint":
        owner, name = PLACES[place.removeprefix("after ")]
        setattr(owner, name, _signalling(getattr(owner, name), first, signals, place.startswith("after ")))
        return
    write, calls = checkpoint.write_checkpoint, 0

    def counted(*arguments: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == first:
            _arm(*inside, signals=signals)
        return write(*arguments)

    checkpoint.write_checkpoint = counted


def _child(job: dict[str, Any]) -> None:
    code = 70
    try:
        log = os.open(job["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 1)
        os.dup2(log, 2)
        if job["at"] is not None and job["at"][0] != "seconds":
            _arm(*job["at"], signals=job.get("signals", [signal.SIGKILL]))
        code = main(job["argv"], prog="train.py")
    except SystemExit as exit:
        code = exit.code if isinstance(exit.code, int) else 71
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def run(job: dict[str, Any]) -> int:
    """Exit code of one child."""
    child = os.fork()
    if child == 0:
        _child(job)
    timer = None
    if job["at"] is not None and job["at"][0] == "seconds":
        timer = threading.Timer(job["at"][1], os.kill, (child, signal.SIGKILL))
        timer.start()
    # The child stays a zombie until it is waited for, so the timer cannot hit another process.
    os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
    if timer is not None:
        timer.cancel()
        timer.join()
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job of a shell ignores it
    th.set_num_threads(1)
    for known in ALGORITHMS:
        algorithm(known)
    for line in sys.stdin:
        print(run(json.loads(line)), flush=True)
