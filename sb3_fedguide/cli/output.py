"""Handle a closed output pipe, as in ``fedguide evaluate RUN | head``."""

from __future__ import annotations

import functools
import os
import signal
import sys
from collections.abc import Callable
from typing import ParamSpec

P = ParamSpec("P")


def pipe_may_close(command: Callable[P, int]) -> Callable[P, int]:
    """Let a command end silently if its output pipe is closed; its exit code is then 141, as that of ``yes``."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> int:
        try:
            code = command(*args, **kwargs)
            sys.stdout.flush()  # buffered output raises its error here, not at the interpreter's exit
            return code
        except BrokenPipeError:
            null = os.open(os.devnull, os.O_WRONLY)
            for stream in (sys.stdout, sys.stderr):
                try:
                    stream.flush()
                except BrokenPipeError:
                    os.dup2(null, stream.fileno())
            os.close(null)
            return 128 + signal.SIGPIPE

    return run
