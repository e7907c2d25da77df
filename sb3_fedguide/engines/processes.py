"""Worker processes on this machine."""

from __future__ import annotations

import atexit
import multiprocessing
import os
import signal
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

from fed_envs.faults import ClientError
from sb3_fedguide.engines.engine import Engine, EngineError
from sb3_fedguide.engines.worker import Round, Trained, Worker


class Processes(Engine):
    """One process per group of clients, for a machine with idle cores.

    :param num_actors: processes; no more than there are clients
    """

    def __init__(self, num_actors: int) -> None:
        super().__init__(num_actors)
        self._pipes: list[Connection] = []
        self._processes: list[Any] = []

    def _start(self, blobs: Sequence[bytes]) -> None:
        context = multiprocessing.get_context("spawn")
        atexit.register(self._end)  # before multiprocessing's own, which waits for workers after a SIGTERM
        # One thread each: the threads that libraries start by default slow the other workers down.
        before = os.environ.get("OMP_NUM_THREADS")
        os.environ["OMP_NUM_THREADS"] = "1"
        try:
            for blob in blobs:
                here, other = context.Pipe()
                process = context.Process(target=_work, args=(other, blob), daemon=True)
                process.start()
                other.close()
                self._pipes.append(here)
                self._processes.append(process)
        finally:
            if before is None:
                del os.environ["OMP_NUM_THREADS"]
            else:
                os.environ["OMP_NUM_THREADS"] = before
        for pipe in self._pipes:
            try:
                problem = _received(pipe)
            except EngineError:
                self._end()
                raise EngineError(
                    "a worker process ended while it started: it imports the script that made the engine, so that a script's "
                    'own work has to stand below `if __name__ == "__main__":`, and there has to be a file of it'
                ) from None
            if problem is not None:
                self._end()
                raise ValueError(f"this federation cannot be made in another process: {problem}")

    def _train(self, rounds: dict[int, Round]) -> dict[int, Trained | ClientError]:
        for k, round in rounds.items():
            try:
                self._pipes[k].send(round)
            except OSError as error:
                raise EngineError(f"a worker process is gone: {error}") from error
        return {k: _received(self._pipes[k]) for k in rounds}

    def _end(self) -> None:
        atexit.unregister(self._end)
        for pipe in self._pipes:
            pipe.close()  # the process sees the end of the pipe
        for process in self._processes:
            process.join(timeout=5)
            if process.is_alive():
                process.kill()
                process.join()
        self._pipes, self._processes = [], []


def _received(pipe: Connection) -> Any:
    try:
        reply = pipe.recv()
    except (EOFError, OSError) as error:
        raise EngineError("a worker process ended in the round; go on from the last checkpoint") from error
    if isinstance(reply, Exception) and not isinstance(reply, ClientError):
        raise reply
    return reply


def _work(pipe: Connection, blob: bytes) -> None:
    """A worker process: a round for every message, until the pipe is closed."""
    # A terminal and a service manager signal all processes; only the main process stops the worker, by closing the pipe.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    try:
        worker = Worker(blob)
    except Exception as error:
        pipe.send(f"{type(error).__name__}: {error}")
        return
    pipe.send(None)
    while True:
        try:
            round = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            reply: Any = worker.train(round)
        except Exception as error:
            reply = error
        pipe.send(reply)
