"""Clients from the command line: environments that are registered with Gymnasium."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fed_envs import Family


def is_registered(name: str) -> bool:
    """Whether Gymnasium knows an environment of this name."""
    import gymnasium

    return name in gymnasium.registry


def registered_family(ids: Sequence[str], client_kwargs: str | None, env_kwargs: Sequence[str]) -> Family:
    """The clients of ``--env``, ``--client-kwargs`` and ``--env-kwargs``.

    :param ids: one per client, or one for all
    :raises ValueError: for unknown ids, a wrong file, or numbers that do not fit
    """
    from fed_envs.gymnasium_world import gymnasium_family
    from sb3_fedguide.settings.config import parse_params

    common = parse_params(env_kwargs, "--env-kwargs")
    if client_kwargs is None and len(ids) == 1:
        raise ValueError(
            f"{ids[0]} is one environment, and a federation has several clients: give --client-kwargs FILE, a YAML list with "
            f"the keyword arguments of each client, or several ids, --env {ids[0]},{ids[0]}"
        )
    own: list[dict[str, Any]] = [{}] * len(ids) if client_kwargs is None else _read(Path(client_kwargs))
    if len(ids) == 1:
        ids = [*ids] * len(own)
    if len(ids) != len(own):
        raise ValueError(f"--env has {len(ids)} ids and {client_kwargs} has {len(own)} entries; give one of each per client")
    return gymnasium_family(ids, [{**common, **entry} for entry in own])


def _read(path: Path) -> list[dict[str, Any]]:
    from sb3_fedguide.settings.config import read_yaml

    content = read_yaml(path)
    entries = [{} if entry is None else entry for entry in content] if isinstance(content, list) else []
    if not entries or not all(isinstance(entry, dict) and all(isinstance(key, str) for key in entry) for entry in entries):
        raise ValueError(
            f"--client-kwargs {path}: it must be a YAML list of mappings, one per client, such as '- {{g: 9.81}}'"
        )
    return entries
