"""A benchmark's runs as tasks of Ray, on the machines of a cluster."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from sb3_fedguide.cli.benchmark_runs import POLL, BenchmarkRun, Outcome, execute
from sb3_fedguide.cli.signals import StopSignals


def connect(address: str | None) -> None:
    """Join a cluster, or start one on this machine.

    :param address: of the cluster; by default ``$RAY_ADDRESS``, the cluster of this machine, or a new one
    :raises ValueError: if Ray is not installed, or the cluster cannot be joined
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise ValueError(f"--engine ray needs Ray ({error}); install it: pip install 'sb3-fedguide[ray]'") from None
    try:
        ray.init(address=address, include_dashboard=None if address else False, log_to_driver=False, logging_level="warning")
    except (ConnectionError, RuntimeError, ValueError) as error:
        where = f"the Ray cluster at {address}" if address else "Ray"
        raise ValueError(
            f"{where} cannot be joined: {error}\nif it has a token, set RAY_AUTH_MODE=token and RAY_AUTH_TOKEN_PATH"
        ) from None


def run_on_ray(
    runs: Sequence[BenchmarkRun], n_at_once: int | None, signals: StopSignals, done: Callable[[BenchmarkRun, Outcome], None]
) -> None:
    """Do the runs as tasks of the cluster that :func:`connect` has joined, one CPU each, spread over its machines.

    :param n_at_once: runs at a time; by default as many as the cluster has CPUs
    :param signals: after the first signal, no run begins and the others end after their round; at the second, all are killed
    :param done: called for each run that ends
    """
    import ray

    # Ray does not retry a task: a failed run is reported, and the user resumes it.
    task: Any = ray.remote(num_cpus=1, max_retries=0, scheduling_strategy="SPREAD")(execute)
    waiting, running, cancelled = deque(runs), dict[Any, BenchmarkRun](), False
    n_at_once = n_at_once or max(1, int(ray.cluster_resources().get("CPU", 1)))
    try:
        while running or (waiting and signals.received is None):
            if signals.received is not None and not cancelled:
                cancelled = True
                for reference in running:
                    ray.cancel(reference, force=False)  # raises KeyboardInterrupt in execute()
            while waiting and len(running) < n_at_once and signals.received is None:
                run = waiting.popleft()
                running[task.options(name=run.name).remote(run)] = run
            ready, _ = ray.wait(list(running), timeout=POLL)
            for reference in ready:
                run = running.pop(reference)
                try:
                    done(run, ray.get(reference))
                except ray.exceptions.TaskCancelledError:
                    done(run, Outcome(problem="interrupted", interrupted=True))
                except ray.exceptions.RayError as error:
                    done(run, Outcome(problem=f"Ray: {str(error).strip().splitlines()[-1]}"))
    finally:
        for reference in running:
            ray.cancel(reference, force=True)
        ray.shutdown()
