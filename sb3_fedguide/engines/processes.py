"""Worker processes on this machine."""

from __future__ import annotations

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
        # One thread each: what several libraries start by themselves gets into the other workers' way.
        before = os.environ.get("OMP_NUM_THREADS")
        os.environ["OMP_NUM_THREADS"] = "1"
        try:
            for blob in blobs:
                here, there = context.Pipe()
                process = context.Process(target=_work, args=(there, blob), daemon=True)
                process.start()
                there.close()
                self._pipes.append(here)
                self._processes.append(process)
        finally:
            if before is None:
                del os.environ["OMP_NUM_THREADS"]
            else:
                os.environ["OMP_NUM_THREADS"] = before
        for pipe in self._pipes:
            problem = _received(pipe, "while it started")
            if problem is not None:
                self._end()
                raise ValueError(f"this federation cannot be made in another process: {problem}")

    def _train(self, rounds: dict[int, Round]) -> dict[int, Trained | ClientError]:
        for k, round in rounds.items():
            try:
                self._pipes[k].send(round)
            except OSError as error:
                raise EngineError(f"a worker process is gone: {error}") from error
        return {k: _received(self._pipes[k], "in the round") for k in rounds}

    def _end(self) -> None:
        for pipe in self._pipes:
            pipe.close()  # the process sees the end of the pipe
        for process in self._processes:
            process.join(timeout=5)
            if process.is_alive():
                process.kill()
        self._pipes, self._processes = [], []


def _received(pipe: Connection, when: str) -> Any:
    try:
        reply = pipe.recv()
    except (EOFError, OSError) as error:
        raise EngineError(f"a worker process ended {when}; go on from the last checkpoint") from error
    if isinstance(reply, Exception) and not isinstance(reply, ClientError):
        raise reply
    return reply


def _work(pipe: Connection, blob: bytes) -> None:
    """A worker process: a round for every message, until the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is the main process's, which closes the pipe
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
