"""Ray actors, on this machine or over the nodes of a cluster."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Sequence
from typing import Any

from fed_envs.faults import ClientError
from sb3_fedguide.engines.engine import Engine, EngineError
from sb3_fedguide.engines.worker import Round, Trained, Worker

_CONNECT_SECONDS = 10.0
#: How long Ray may take to restart an actor, on another node if its own is gone (17 s were measured).
RESTART_SECONDS = 120.0


class RayActors(Engine):
    """One Ray actor per group of clients, spread over the nodes.

    An actor keeps nothing. So if a round is lost with its actor, or with its whole node, the actor that Ray starts in its
    place trains it again, with the same result.

    :param num_actors: actors; no more than there are clients. Each takes one CPU.
    :param address: of a running cluster, such as ``"auto"`` or ``"10.0.0.1:6379"``; a cluster on this machine is started if
        ``None``
    :raises ValueError: if Ray is not installed; from :meth:`attach`, if the cluster has fewer CPUs
    """

    def __init__(self, num_actors: int, address: str | None = None) -> None:
        super().__init__(num_actors)
        self.address = address
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            import ray
        except ImportError:
            raise ValueError("the engine 'ray' needs Ray: pip install 'sb3-fedguide[ray]'") from None
        self._ray = ray
        self._started_ray = False
        self._actors: list[Any] = []

    def _start(self, blobs: Sequence[bytes]) -> None:
        ray = self._ray
        if not ray.is_initialized():
            _check_address(self.address)
            resources = {"num_cpus": max(self.num_actors, os.cpu_count() or 1)} if self.address is None else {}
            ray.init(
                self.address or "local", include_dashboard=False, log_to_driver=False, logging_level="warning", **resources
            )
            self._started_ray = True
        n_cpus = int(ray.cluster_resources().get("CPU", 0))
        if n_cpus < len(blobs):
            self._end()
            raise ValueError(f"the Ray cluster has {n_cpus} CPUs and each of {len(blobs)} actors takes one; use fewer actors")
        environment = {"env_vars": {"OMP_NUM_THREADS": "1"}}
        actor = ray.remote(Worker).options(
            num_cpus=1, max_restarts=-1, max_task_retries=0, scheduling_strategy="SPREAD", runtime_env=environment
        )
        self._actors = [actor.remote(blob) for blob in blobs]
        try:
            ray.get([actor.ready.remote() for actor in self._actors])
        except ray.exceptions.ActorDiedError as error:
            self._end()
            raise ValueError(f"this federation cannot be made in a Ray actor: {error}") from error

    def _train(self, rounds: dict[int, Round]) -> dict[int, Trained | ClientError]:
        waiting = {k: self._actors[k].train.remote(round) for k, round in rounds.items()}
        return {k: self._trained(k, rounds[k], reply) for k, reply in waiting.items()}

    def _trained(self, k: int, round: Round, reply: Any) -> Any:
        """Wait for a group's reply; if Ray has restarted the actor, the round is sent again."""
        ray = self._ray
        lost_since: float | None = None
        while True:
            try:
                return ray.get(reply)
            except ray.exceptions.RayTaskError as error:
                raise error.as_instanceof_cause() from None
            except (
                ray.exceptions.ActorUnavailableError,
                ray.exceptions.ActorDiedError,
                ray.exceptions.ObjectLostError,  # its reply went with its node
            ) as error:
                now = time.monotonic()
                lost_since = now if lost_since is None else lost_since
                if now - lost_since > RESTART_SECONDS:
                    raise EngineError(f"a Ray actor is lost: {error}; go on from the last checkpoint") from error
                time.sleep(1.0)
                reply = self._actors[k].train.remote(round)

    def _end(self) -> None:
        for actor in self._actors:
            self._ray.kill(actor)
        self._actors = []
        if self._started_ray:
            self._ray.shutdown()
            self._started_ray = False


def _check_address(address: str | None) -> None:
    """Check the address first: Ray itself tries for minutes to reach a missing cluster.

    :raises ValueError: if no process listens at ``host:port``
    """
    host, _, port = (address or "").rpartition(":")
    if not host or "/" in host or not port.isdecimal():
        return  # none, "auto", or one of Ray's other forms
    try:
        socket.create_connection((host, int(port)), _CONNECT_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise ValueError(f"there is no Ray cluster at {address}: {error}") from None
