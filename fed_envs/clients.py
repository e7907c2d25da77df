"""The fields of a client's entry in a metadata file, for each kind of world."""

from __future__ import annotations

import difflib
import json
import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from fed_envs.mazes import check_cells, free_cells, maze_rows

#: Goals further than this from the shoulder are redrawn (metres): just outside the arm's reach of 0.21 plus the goal's radius.
REACHER_GOAL_LIMIT = 0.25

#: The backbones each world can be built on (Gymnasium ids; Bandit2D is our own one-step world).
BACKBONES: dict[str, tuple[str, ...]] = {
    "bandit2d": ("Bandit2D",),
    "reacher": ("Reacher-v5",),
    "locomotion": ("Hopper-v5", "Walker2d-v5", "HalfCheetah-v5"),
    "metaworld": ("MetaWorld-v3",),
    "point_maze": ("PointMaze-v3",),
    "gymnasium": ("Gymnasium",),
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
    """The field of every client: an id, counted from 0 in the order of the file."""

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


class GymnasiumClient(Client):
    """A client of a registered environment: its id, and the keyword arguments that it is made with."""

    id: str
    kwargs: dict[str, Any] = {}

    @field_validator("id")
    @classmethod
    def _registered(cls, id: str) -> str:
        import gymnasium

        if id in gymnasium.registry:  # never "module:id": reading a file imports nothing
            return id
        near = difflib.get_close_matches(id, gymnasium.registry, n=1)
        hint = f"; did you mean {near[0]!r}" if near else ""
        raise ValueError(
            f"no environment {id!r} is registered with Gymnasium{hint}; one of your own has to be registered by a module that "
            "is imported first (--gym-packages)"
        )

    @field_validator("kwargs")
    @classmethod
    def _plain(cls, kwargs: dict[str, Any]) -> dict[str, Any]:
        try:
            if json.loads(json.dumps(kwargs, allow_nan=False)) == kwargs:
                return kwargs
        except (TypeError, ValueError):
            pass
        raise ValueError(f"must be numbers, texts, lists and mappings, as in JSON (got {kwargs!r})")


CLIENT_MODELS: dict[str, type[Client]] = {
    "bandit2d": Bandit2DClient,
    "reacher": ReacherClient,
    "locomotion": LocomotionClient,
    "metaworld": MetaWorldClient,
    "point_maze": PointMazeClient,
    "gymnasium": GymnasiumClient,
}
