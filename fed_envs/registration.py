"""Which families ship with the package, and their Gymnasium ids."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium

METADATA_FOLDER = Path(__file__).parent / "metadata"

#: The environment class of each kind of world, as strings: specs pickle, and the simulator loads with the first environment.
ENTRY_POINTS = {
    "bandit2d": "fed_envs.bandit2d:Bandit2DEnv",
    "reacher": "fed_envs.reacher:ReacherEnv",
    "locomotion": "fed_envs.locomotion:LocomotionEnv",
    "metaworld": "fed_envs.metaworld10:MetaWorldEnv",
    "point_maze": "fed_envs.point_maze:PointMazeEnv",
}

#: Names of the families that ship with the package, one metadata file each.
FAMILIES: tuple[str, ...] = tuple(sorted(path.stem for path in METADATA_FOLDER.glob("*.json")))


def environment_id(family: str) -> str:
    """The Gymnasium id of a family's environments."""
    return f"fed_envs/{family}-v0"


def environment_class(world: str) -> Any:
    """The environment class of a kind of world."""
    module, name = ENTRY_POINTS[world].split(":")
    return getattr(import_module(module), name)


def register_families() -> None:
    """Register every shipped family with Gymnasium; the second call does nothing."""
    for family in FAMILIES:
        if environment_id(family) in gymnasium.registry:
            continue
        content = json.loads((METADATA_FOLDER / f"{family}.json").read_text(encoding="utf-8"))
        gymnasium.register(
            id=environment_id(family),
            entry_point=ENTRY_POINTS[content["world"]],
            max_episode_steps=content["max_episode_steps"],
            kwargs={"family": family},
        )
