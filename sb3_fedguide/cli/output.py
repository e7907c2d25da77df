"""A reader of the output that goes away, as in ``fedguide evaluate RUN | head``."""

from __future__ import annotations

import functools
import os
import signal
import sys
from collections.abc import Callable
from typing import ParamSpec

P = ParamSpec("P")


def pipe_may_close(command: Callable[P, int]) -> Callable[P, int]:
    """Let a command end without a word when nobody reads its output any more; its exit code is then 141, as of ``yes``."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> int:
        try:
            code = command(*args, **kwargs)
            sys.stdout.flush()  # what waits in the buffer finds out here, and not while the interpreter ends
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
