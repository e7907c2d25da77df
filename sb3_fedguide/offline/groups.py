"""Clients in groups that train at the same time, one on each core.

A client's result does not depend on the other clients, and so not on the groups.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from itertools import pairwise
from typing import TypeVar

import torch as th

from sb3_fedguide.offline.progress import StepProgress

__all__ = ["client_groups", "train_together"]

MIN_CLIENTS = 4
"""Of one group: below that, threads wait for each other's Python more than they save."""

Result = TypeVar("Result")


def client_groups(n_clients: int, n_cores: int | None = None) -> list[range]:
    """Neighbouring clients, in as many groups as there are cores that PyTorch's own threads leave free, at least one.

    :param n_cores: cores to use; default those that this process may use
    """
    if n_cores is None:
        n_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    n_groups = max(1, min(n_cores // th.get_num_threads(), n_clients // MIN_CLIENTS))
    bounds = [n_clients * group // n_groups for group in range(n_groups + 1)]
    return [range(start, stop) for start, stop in pairwise(bounds)]


def train_together(
    jobs: Sequence[Callable[[StepProgress | None], Result]], progress: StepProgress | None = None
) -> list[Result]:
    """Run the groups' jobs at the same time, each in a thread; PyTorch and NumPy hold no lock while they compute.

    :param jobs: each gets a function to which it reports its progress; all report the same totals
    :param progress: called with the progress of the slowest job
    :return: the results, in the order of the jobs
    :raises BaseException: a job's exception, or an interrupt of the caller; the other jobs then end at their next report
    """
    if len(jobs) == 1:
        return [jobs[0](progress)]
    reports = _Reports(len(jobs), progress)
    with ThreadPoolExecutor(len(jobs), thread_name_prefix="offline") as pool:
        futures = [pool.submit(job, reports.of(number)) for number, job in enumerate(jobs)]
        try:
            for future in wait(futures, return_when=FIRST_EXCEPTION).done:
                future.result()
        finally:
            reports.stopped = True
    return [future.result() for future in futures]


class _Reports:
    """Progress of several threads as one: that of the slowest."""

    def __init__(self, n_jobs: int, progress: StepProgress | None) -> None:
        self.done, self.progress = [0] * n_jobs, progress
        self.stopped = False
        self._lock = threading.Lock()

    def of(self, number: int) -> StepProgress:
        def report(done: int, total: int) -> None:
            if self.stopped:
                raise InterruptedError("another group's training has ended early")
            with self._lock:
                before, self.done[number] = min(self.done), done
                if self.progress is not None and min(self.done) > before:
                    self.progress(min(self.done), total)

        return report
