"""Who the clients of a family are: the schema of the metadata files, their validation, and loading.

A metadata file is JSON::

    {"schema_version": 1, "family": "HopperHard", "world": "locomotion", "backbone": "Hopper-v5",
     "max_episode_steps": 1000, "description": "...", "clients": [{"client": 0, "mass_scale": 0.9158037, ...}, ...]}

What a client has to say depends on the world: :class:`LocomotionClient`, :class:`ReacherClient`, :class:`Bandit2DClient`,
:class:`MetaWorldClient`, :class:`PointMazeClient`.
Anything unknown, missing, non-finite or out of range is refused with a message that names the file, the client and the field.
On the command line: ``python -m fed_envs.metadata {generate,show,validate}``.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import math
import os
import tempfile
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium
from gymnasium.envs.registration import EnvSpec
from pydantic import BaseModel, ConfigDict, Field, SerializeAsAny, ValidationError, field_validator, model_validator

from fed_envs.mazes import check_cells, free_cells, maze_rows
from fed_envs.registration import ENTRY_POINTS, FAMILIES, METADATA_FOLDER, environment_id

SCHEMA_VERSION: Literal[1] = 1

#: Goals further than this from the shoulder are redrawn (metres): just outside the arm's reach of 0.21 plus the goal's radius.
REACHER_GOAL_LIMIT = 0.25

#: The backbones each world can be built on (Gymnasium ids; Bandit2D is our own one-step world).
BACKBONES: dict[str, tuple[str, ...]] = {
    "bandit2d": ("Bandit2D",),
    "reacher": ("Reacher-v5",),
    "locomotion": ("Hopper-v5", "Walker2d-v5", "HalfCheetah-v5"),
    "metaworld": ("MetaWorld-v3",),
    "point_maze": ("PointMaze-v3",),
}

_Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_Scale = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=100)]
_Factor = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=100)]
_Weight = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1000, le=1000)]
_Cost = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=1000)]
_Unit = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1, le=1)]
_Cell = tuple[Annotated[int, Field(strict=True, ge=0)], Annotated[int, Field(strict=True, ge=0)]]
_Reach = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-REACHER_GOAL_LIMIT, le=REACHER_GOAL_LIMIT)]


class Client(BaseModel):
    """What every client has: an id, counted from 0 in the order of the file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    client: Annotated[int, Field(strict=True, ge=0)]

    def parameters(self) -> dict[str, Any]:
        """Every field but the id, defaults included."""
        return self.model_dump(exclude={"client"})


class LocomotionClient(Client):
    """A client of the Hopper, Walker2D and HalfCheetah families; scales multiply the backbone's own values."""

    dynamics: str = ""  # the preset's name, for people
    preference: str = ""  # likewise
    mass_scale: _Scale
    damping_scale: _Factor
    friction_scale: _Factor
    action_gain: _Scale
    forward_reward_weight: _Weight
    ctrl_cost_weight: _Cost
    instability_cost_weight: _Cost
    reset_noise_scale: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=1)]
    floor_priority: Annotated[bool, Field(strict=True)] = (
        False  # the floor's friction decides alone (see docs/environments.md)
    )


class ReacherClient(Client):
    """A client of the Reacher families: goal box in metres, angles of the start in radians."""

    goal_angle_deg: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, lt=360)]  # the sector's middle, for people
    goal_x: tuple[_Reach, _Reach]
    goal_y: tuple[_Reach, _Reach]
    action_offset: tuple[_Unit, _Unit]
    reward_scale: _Scale
    angle_offset: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-math.pi, le=math.pi)]
    preference: Literal["default", "speed", "stability", "efficiency"] = "default"
    mass_scale: _Scale = 1.0
    damping_scale: _Factor = 1.0
    gear_scale: _Scale = 1.0

    @model_validator(mode="after")
    def _goals_exist(self) -> ReacherClient:
        for name, (low, high) in (("goal_x", self.goal_x), ("goal_y", self.goal_y)):
            if low > high:
                raise ValueError(f"{name}: the lower bound {low} lies above the upper bound {high}")
        middle = math.hypot(sum(self.goal_x) / 2, sum(self.goal_y) / 2)
        if middle >= REACHER_GOAL_LIMIT:  # goals out of reach are redrawn, so most of the box has to be within it
            raise ValueError(
                f"goal_x, goal_y: the middle of the goal box is {middle:.3f} m from the shoulder, but goals at "
                f"{REACHER_GOAL_LIMIT} m and beyond are redrawn; move the box inwards"
            )
        return self


class PointMazeClient(Client):
    """A client of the PointMaze families; cells are (row, column), see :mod:`fed_envs.mazes`."""

    maze: str | tuple[str, ...]  # a name in fed_envs.mazes.MAZES, or rows of "#" and "."
    goal_cells: Annotated[tuple[_Cell, ...], Field(min_length=1)]
    start_cells: tuple[_Cell, ...] = ()  # none: every free cell but the goals
    gear_scale: _Scale = 1.0
    damping_scale: _Factor = 1.0
    reward_scale: _Scale = 1.0

    @field_validator("maze", mode="before")
    @classmethod
    def _closed_maze(cls, maze: Any) -> str | tuple[str, ...]:
        rows = maze_rows(maze)
        return maze if isinstance(maze, str) else rows

    @model_validator(mode="after")
    def _cells_are_free_and_connected(self) -> PointMazeClient:
        check_cells(maze_rows(self.maze), self.goal_cells, self.start_cells, self.starts())
        return self

    def starts(self) -> tuple[tuple[int, int], ...]:
        """The cells in which episodes start."""
        return self.start_cells or tuple(cell for cell in free_cells(maze_rows(self.maze)) if cell not in self.goal_cells)


class Bandit2DClient(Client):
    """A client of Bandit2D: which of the four peaks is its own, and how high the other three are."""

    peak: tuple[_Number, _Number]
    off_peak_weight: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=1)] = 1.0

    @field_validator("peak")
    @classmethod
    def _known_peak(cls, peak: tuple[float, float]) -> tuple[float, float]:
        if peak not in BANDIT2D_PEAKS:
            raise ValueError(f"must be one of {', '.join(map(str, BANDIT2D_PEAKS))}")
        return peak


#: Centres of Bandit2D's four reward modes.
BANDIT2D_PEAKS: tuple[tuple[float, float], ...] = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))

#: The tasks of MetaWorld10.
METAWORLD_TASKS: tuple[str, ...] = (
    "reach-v3", "push-v3", "pick-place-v3", "door-open-v3", "drawer-close-v3", "button-press-topdown-v3",
    "peg-insert-side-v3", "window-open-v3", "sweep-v3", "basketball-v3",
)  # fmt: skip


class MetaWorldClient(Client):
    """A client of MetaWorld10: its task, and whether object and goal start in the same place in every episode."""

    task: str
    fixed_goal: Annotated[bool, Field(strict=True)] = False

    @field_validator("task")
    @classmethod
    def _known_task(cls, task: str) -> str:
        if task not in METAWORLD_TASKS:
            raise ValueError(f"must be one of {', '.join(METAWORLD_TASKS)}, not {task!r}")
        return task


CLIENT_MODELS: dict[str, type[Client]] = {
    "bandit2d": Bandit2DClient,
    "reacher": ReacherClient,
    "locomotion": LocomotionClient,
    "metaworld": MetaWorldClient,
    "point_maze": PointMazeClient,
}


class Family(BaseModel):
    """A family of client environments that share their observation and action spaces (the content of one metadata file)."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    schema_version: Literal[1] = SCHEMA_VERSION
    name: Annotated[str, Field(alias="family", pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
    world: Literal["bandit2d", "reacher", "locomotion", "metaworld", "point_maze"]
    backbone: str
    max_episode_steps: Annotated[int, Field(strict=True, ge=1)]
    description: str = ""
    clients: tuple[SerializeAsAny[Client], ...]

    @field_validator("clients", mode="before")
    @classmethod
    def _clients_of_the_world(cls, value: Any, info: Any) -> tuple[Client, ...]:
        if "world" not in info.data:
            raise ValueError("clients: not checked, since the world is not known")
        if not isinstance(value, (list, tuple)) or not value:
            raise ValueError("clients: must be a list of at least one client")
        model = CLIENT_MODELS[info.data["world"]]
        clients: list[Client] = []
        problems: list[str] = []
        for position, entry in enumerate(value):
            content = entry.model_dump() if isinstance(entry, Client) else entry
            named = content.get("client", "?") if isinstance(content, dict) else "?"
            try:
                clients.append(model.model_validate(content))
            except ValidationError as error:
                problems += [f"client {named} (entry {position}): {line}" for line in describe(error)]
        ids = [client.client for client in clients]
        if not problems and ids != list(range(len(ids))):
            problems.append(f"client ids must be 0, 1, ..., {len(ids) - 1} in this order, each once; they are {ids}")
        if problems:
            raise ValueError("\n".join(problems))
        return tuple(clients)

    @model_validator(mode="after")
    def _backbone_of_the_world(self) -> Family:
        if self.backbone not in BACKBONES[self.world]:
            raise ValueError(
                f"backbone: a {self.world} world is built on {' or '.join(BACKBONES[self.world])}, not {self.backbone!r}"
            )
        if self.world == "bandit2d" and self.max_episode_steps != 1:
            raise ValueError("max_episode_steps: Bandit2D has one-step episodes, so this must be 1")
        return self

    @property
    def n_clients(self) -> int:
        return len(self.clients)

    def to_dict(self) -> dict[str, Any]:
        """The JSON-able content; optional client fields at their defaults are left out, so that new ones change no hash."""
        content = self.model_dump(mode="json", by_alias=True, exclude={"clients"})
        content["clients"] = [client.model_dump(mode="json", exclude_defaults=True) for client in self.clients]
        return content

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 of everything that defines the environments (all but the description), as hexadecimal digits."""
        content = {key: value for key, value in self.to_dict().items() if key != "description"}
        canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(canonical.encode("utf-8")).hexdigest()

    def client(self, client: int) -> Client:
        """Client ``client``'s parameters.

        :raises ValueError: if the family has no such client
        """
        if isinstance(client, bool) or not 0 <= int(client) < self.n_clients or int(client) != client:
            raise ValueError(f"{self.name} has clients 0 to {self.n_clients - 1}, not {client!r}")
        return self.clients[int(client)]

    def with_parameters(self, **parameters: Any) -> Family:
        """The same family with some client fields set to one value for all clients, e.g. ``off_peak_weight=0.1``.

        :raises ValueError: if a field does not exist or a value is out of range
        """
        if not parameters:
            return self
        content = self.to_dict()
        content["clients"] = [{**client, **parameters} for client in content["clients"]]
        return parse_family(content, f"{self.name} with {parameters}")

    def spec(self, client: int = 0, **kwargs: Any) -> EnvSpec:
        """The Gymnasium spec of one client's environment: it pickles, serialises to JSON, and needs no file beside it."""
        self.client(client)
        shipped = self.name in FAMILIES and load_family(self.name).content_hash == self.content_hash
        identity = {"family": self.name} if shipped else {"metadata": self.to_dict()}
        return EnvSpec(
            id=environment_id(self.name),
            entry_point=ENTRY_POINTS[self.world],
            max_episode_steps=self.max_episode_steps,
            kwargs={**identity, "client": int(client), **kwargs},
        )

    def make(self, client: int = 0, **kwargs: Any) -> gymnasium.Env:
        """One client's environment, wrapped as ``gymnasium.make`` does (time limit included).

        :param client: the client's id
        :param kwargs: passed to ``gymnasium.make``, e.g. ``render_mode="rgb_array"``
        """
        return gymnasium.make(self.spec(client), **kwargs)

    def dump(self, path: str | os.PathLike[str]) -> None:
        """Write the metadata file; it appears complete or not at all."""
        target = Path(path)
        descriptor, temporary = tempfile.mkstemp(dir=target.parent, prefix=target.name, suffix=".part")
        try:
            with os.fdopen(descriptor, "w", encoding="utf-8") as file:
                file.write(json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")
            umask = os.umask(0)
            os.umask(umask)
            os.chmod(temporary, 0o666 & ~umask)  # mkstemp makes files private
            os.replace(temporary, target)
        except BaseException:
            os.unlink(temporary)
            raise


def describe(error: ValidationError) -> list[str]:
    """One readable line per problem: ``field: what is wrong (got value)``."""
    lines = []
    for problem in error.errors(include_url=False):
        field = ".".join(str(part) for part in problem["loc"])
        message = problem["msg"].removeprefix("Value error, ")
        if problem["type"] == "missing":
            message = "is missing"
        elif problem["type"] == "extra_forbidden":
            message = "is not a known field"
        elif problem["type"] != "value_error":
            message += f" (got {problem['input']!r})"
        lines += [f"{field}: {line}" if field and field != "clients" else line for line in message.splitlines()]
    return lines


def parse_family(content: Any, source: str) -> Family:
    """Validate the content of a metadata file.

    :param content: the decoded JSON
    :param source: what to call it in error messages, usually the file's path
    :raises ValueError: with one line per problem, naming the source, the client and the field
    """
    if not isinstance(content, dict):
        raise ValueError(f"{source}: a metadata file is a JSON object, this is a {type(content).__name__}")
    if content.get("schema_version") != SCHEMA_VERSION:
        raise ValueError(
            f"{source}: schema_version: this version of fed_envs reads {SCHEMA_VERSION}, "
            f"the file has {content.get('schema_version', 'none')}"
        )
    try:
        return Family.model_validate(content)
    except ValidationError as error:
        raise ValueError("\n".join(f"{source}: {line}" for line in describe(error))) from None


def _refuse_duplicate_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    for key in keys:
        if keys.count(key) > 1:
            raise ValueError(f"the key {key!r} stands twice in one object")
    return dict(pairs)


def read_family(path: str | os.PathLike[str]) -> Family:
    """Load and validate a metadata file.

    :raises ValueError: if the file cannot be read, is not JSON, or does not follow the schema
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot read the metadata file {path}: {getattr(error, 'strerror', None) or error}") from None
    try:
        content = json.loads(text, object_pairs_hook=_refuse_duplicate_keys)
    except ValueError as error:
        raise ValueError(f"{path} is not valid JSON: {error}") from None
    return parse_family(content, str(path))


def load_family(family: str | os.PathLike[str] | Family, **parameters: Any) -> Family:
    """A family by name, by path of a metadata file, or as it is.

    :param family: a name in :data:`fed_envs.FAMILIES`, a path, or a :class:`Family`
    :param parameters: client fields to set for all clients, see :meth:`Family.with_parameters`
    :raises ValueError: for an unknown name (with the nearest one), or a file that does not follow the schema
    """
    if isinstance(family, Family):
        return family.with_parameters(**parameters)
    name = os.fspath(family)
    if name in FAMILIES:
        return _shipped_family(name).with_parameters(**parameters)
    if name.endswith(".json") or os.sep in name or Path(name).is_file():
        return read_family(name).with_parameters(**parameters)
    near = difflib.get_close_matches(name.lower(), {known.lower(): known for known in FAMILIES}, n=1)
    hint = f"did you mean {next(known for known in FAMILIES if known.lower() == near[0])!r}? " if near else ""
    raise ValueError(f"unknown family {name!r}: {hint}known are {', '.join(FAMILIES)}, or the path of a metadata .json file")


_SHIPPED: dict[str, Family] = {}


def _shipped_family(name: str) -> Family:
    if name not in _SHIPPED:
        _SHIPPED[name] = read_family(METADATA_FOLDER / f"{name}.json")
    return _SHIPPED[name]


if __name__ == "__main__":
    from fed_envs.metadata_command import main

    raise SystemExit(main())
