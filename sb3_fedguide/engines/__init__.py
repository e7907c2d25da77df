"""Engines: where a federation's clients train when one process is not enough."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sb3_fedguide.engines.engine import Engine

__all__ = ["ENGINES", "make_engine"]

#: Names on the command line; ``lockstep`` is no engine: all clients train in the process itself.
ENGINES = ("lockstep", "processes", "ray")


def make_engine(name: str, num_actors: int, address: str | None = None) -> Engine | None:
    """The engine ``name``; ``None`` for ``lockstep``.

    :param num_actors: groups of clients that train at the same time
    :param address: of a Ray cluster; a local one is started if ``None``
    :raises ValueError: for an unknown name, a number below one, or if Ray is not installed
    """
    if name not in ENGINES:
        raise ValueError(f"engine={name!r} must be one of {', '.join(ENGINES)}")
    if num_actors < 1:
        raise ValueError(f"num_actors={num_actors} must be at least 1: it is the number of groups that train at the same time")
    if name == "processes":
        from sb3_fedguide.engines.processes import Processes

        return Processes(num_actors)
    if name == "ray":
        from sb3_fedguide.engines.ray_actors import RayActors

        return RayActors(num_actors, address)
    return None
