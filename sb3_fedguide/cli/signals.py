"""A run's reaction to signals that stop it."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import suppress
from types import FrameType, TracebackType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopSignals:
    """Inside its ``with`` block, SIGINT, SIGTERM and SIGHUP end the training after the current round; a second one at once.

    At once means ``KeyboardInterrupt``. The first signal raises it too while :attr:`can_wait` is false: before the first round
    there is nothing to wait for. A signal that the process ignores stays ignored. SIGHUP means that the terminal is gone. It
    may come from the shell and from the kernel, so a second SIGHUP counts as the same; terminal output is then dropped.
    """

    def __init__(self) -> None:
        #: the first received signal
        self.received: int | None = None
        #: whether rounds are running that check :attr:`received` at their end
        self.can_wait = False
        self._earlier: dict[int, Any] = {}
        self._terminals: list[int] = []

    @property
    def exit_code(self) -> int:
        """The exit code as in shells: 130 for SIGINT, 143 for SIGTERM, 129 for SIGHUP."""
        return 128 + (self.received or signal.SIGINT)

    def __enter__(self) -> StopSignals:
        self._terminals = [descriptor for descriptor in (1, 2) if _is_terminal(descriptor)]
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                if signal.getsignal(number) is not signal.SIG_IGN:
                    self._earlier[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for number, handler in self._earlier.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        again = self.received is not None and number != signal.SIGHUP
        if number == signal.SIGHUP:
            _drop_output(self._terminals)
        self.received = self.received or number
        if again or not self.can_wait:
            raise KeyboardInterrupt
        with suppress(OSError):
            # A handler may interrupt a print, so it does not print itself.
            os.write(2, b"\nstopping after this round; a second signal stops at once\n")


def _is_terminal(descriptor: int) -> bool:
    try:
        return os.isatty(descriptor)
    except OSError:
        return False


def _drop_output(descriptors: list[int]) -> None:
    """Redirect them to the null device: writing to a closed terminal raises an error in any print."""
    null = os.open(os.devnull, os.O_WRONLY)
    for descriptor in descriptors:
        os.dup2(null, descriptor)
    os.close(null)
