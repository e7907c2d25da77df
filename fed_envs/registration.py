"""Which families ship with the package, and their Gymnasium ids."""

from __future__ import annotations

import json
import os
import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fed_envs.clients import Client

METADATA_FOLDER = Path(__file__).parent / "metadata"

#: The environment class of each kind of world, as strings: specs pickle, and the simulator loads with the first environment.
ENTRY_POINTS = {
    "bandit2d": "fed_envs.bandit2d:Bandit2DEnv",
    "reacher": "fed_envs.reacher:ReacherEnv",
    "locomotion": "fed_envs.locomotion:LocomotionEnv",
    "metaworld": "fed_envs.metaworld10:MetaWorldEnv",
    "point_maze": "fed_envs.point_maze:PointMazeEnv",
    "gymnasium": "fed_envs.gymnasium_world:GymnasiumEnv",
}

#: Every family's metadata file by its name: those that ship with the package, and those that a user registers.
FAMILIES: dict[str, Path] = {path.stem: path for path in sorted(METADATA_FOLDER.glob("*.json"))}


def environment_id(family: str) -> str:
    """The Gymnasium id of a family's environments."""
    return f"fed_envs/{family}-v0"


def entry_point_of(world: str) -> str:
    """Gymnasium's entry point for a kind of world; if loading fails, :func:`environment_class` says what is missing."""
    return f"{__name__}:{world}"


def environment_class(world: str) -> Any:
    """The environment class of a kind of world.

    :raises ValueError: if the world needs the extra metaworld, which is not installed; or if MuJoCo cannot be loaded with the
        renderer in ``MUJOCO_GL``
    """
    module, name = ENTRY_POINTS[world].split(":")
    try:
        return getattr(import_module(module), name)
    except (ImportError, AttributeError) as error:
        if isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] == "metaworld":
            raise ValueError(
                "MetaWorld10 needs metaworld, which is not installed: pip install 'sb3-fedguide[metaworld]' (it brings MuJoCo "
                "3.3.0; every other family works without it)"
            ) from error
        asked = os.environ.get("MUJOCO_GL")
        if not asked or "mujoco" in sys.modules:
            raise
        raise ValueError(
            f"MuJoCo cannot be loaded with MUJOCO_GL={asked} ({type(error).__name__}: {error}): install what it needs (Debian "
            "and Ubuntu: libosmesa6 for osmesa, libegl1 for egl), or unset MUJOCO_GL, since training renders nothing"
        ) from error


def __getattr__(name: str) -> Any:
    """A world's environment class under the world's name, for Gymnasium's entry points.

    :raises ValueError: as in :func:`environment_class`
    """
    if name not in ENTRY_POINTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return environment_class(name)


def register_families() -> None:
    """Register every shipped family with Gymnasium; the second call does nothing."""
    import gymnasium

    for family, path in FAMILIES.items():
        if environment_id(family) not in gymnasium.registry:
            content = json.loads(path.read_text(encoding="utf-8"))
            _register(family, content["world"], content["max_episode_steps"])


def register_world(world: str, entry_point: str, client_model: type[Client], backbones: tuple[str, ...]) -> None:
    """Register the user's own kind of world, so that metadata files can name it.

    :param world: the metadata's ``world``
    :param entry_point: ``"module:Class"`` of a :class:`fed_envs.world.ClientEnv`
    :param client_model: the fields of a client's entry
    :param backbones: allowed values of the metadata's ``backbone``
    :raises ValueError: for a name that is already taken
    """
    from fed_envs.clients import BACKBONES, CLIENT_MODELS

    if ENTRY_POINTS.get(world, entry_point) != entry_point:
        raise ValueError(f"the world {world!r} is taken by {ENTRY_POINTS[world]}; choose another name")
    ENTRY_POINTS[world], CLIENT_MODELS[world], BACKBONES[world] = entry_point, client_model, backbones


def register_family(path: str | os.PathLike[str]) -> None:
    """Register the user's own family by its metadata file: by name everywhere, and as ``fed_envs/<Family>-v0`` in Gymnasium.

    :raises ValueError: for a file that does not follow the schema, or a name that is already taken
    """
    import gymnasium

    from fed_envs.metadata import read_family

    family, file = read_family(path), Path(path).absolute()
    if FAMILIES.get(family.name, file) != file:
        raise ValueError(f"the family {family.name} is registered already, from {FAMILIES[family.name]}; choose another name")
    FAMILIES[family.name] = file
    if environment_id(family.name) not in gymnasium.registry:
        _register(family.name, family.world, family.max_episode_steps)


def _register(family: str, world: str, max_episode_steps: int) -> None:
    import gymnasium

    gymnasium.register(
        id=environment_id(family),
        entry_point=entry_point_of(world),
        max_episode_steps=max_episode_steps,
        kwargs={"family": family},
    )
