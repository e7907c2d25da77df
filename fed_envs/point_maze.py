"""PointMaze with each client's own goals, maze, actuation and reward scale."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from fed_envs.clients import PointMazeClient
from fed_envs.mazes import WALL, cell_center, distances, maze_rows
from fed_envs.metadata import Family
from fed_envs.mujoco_world import MujocoBatch, MujocoClientEnv
from fed_envs.world import Runner, ScriptedPolicy, run_here

WALL_HEIGHT = 0.4
NOISE = 0.25  # goals and starts are uniform within this distance of their cell's middle, in both coordinates
MAX_SPEED = 5.0  # velocities are clipped before every step
SUCCESS_DISTANCE = 0.45

SCRIPT_SPEED = 2.5  # metres per second between waypoints
SCRIPT_NOISE = 0.4  # standard deviation before squashing
_SLOWING = 4.0  # 1 / s: how fast it approaches its goal at the end
_TRACKING = 0.6  # s / m: force for a difference in velocity
_SATURATION = 2.0  # the largest force before noise and squashing: tanh(2) = 0.96


@lru_cache(maxsize=32)
def _compiled_maze(rows: tuple[str, ...]) -> mujoco.MjModel:
    """gymnasium-robotics' ball and walls. Its own builder leaves a temporary file behind, so the walls are placed here."""
    package = find_spec("gymnasium_robotics")  # the file's place only: importing it loads all of its environments
    if package is None or package.origin is None:
        raise ValueError("PointMaze needs gymnasium-robotics: pip install gymnasium-robotics")
    tree = ET.parse(Path(package.origin).parent / "envs" / "assets" / "point" / "point.xml")
    world = tree.find(".//worldbody")
    assert world is not None
    height = WALL_HEIGHT / 2
    for i, row in enumerate(rows):
        for j, cell in enumerate(row):
            if cell == WALL:
                x, y = cell_center(rows, (i, j))
                wall = {"name": f"block_{i}_{j}", "type": "box", "pos": f"{x} {y} {height}", "size": f"0.5 0.5 {height}"}
                ET.SubElement(world, "geom", {**wall, "contype": "1", "conaffinity": "1", "rgba": "0.7 0.5 0.3 1.0"})
    target = {"name": "target", "type": "sphere", "pos": f"0 0 {height}", "size": "0.2", "rgba": "1 0 0 0.7"}
    ET.SubElement(world, "site", target)
    for texture in tree.iterfind(".//texture[@type='skybox']"):  # 11 MB in every client's copy, for a gradient
        texture.set("width", "64")
        texture.set("height", "64")
    return mujoco.MjModel.from_xml_string(ET.tostring(tree.getroot(), encoding="unicode"))


class PointMazeBatch(MujocoBatch["PointMazeEnv"]):
    """The one definition of a PointMaze step, over ``(n, ...)`` arrays; formulas in :class:`PointMazeEnv`."""

    def __init__(self, envs: Sequence[PointMazeEnv]) -> None:
        super().__init__(envs)
        n = len(envs)
        self.scale = np.array([env.client.reward_scale for env in envs])
        self.goals = np.array([env.goal for env in envs])
        self.distance = np.zeros(n)
        self._goals = [env.goal for env in envs]
        self._offset = np.zeros((n, 2))

    def _apply(self, actions: np.ndarray) -> None:
        np.clip(actions, np.float32(-1.0), np.float32(1.0), out=self.applied)

    def _before(self, row: int) -> None:
        model, data, _, _, velocities, _, _ = self._views[row]
        np.clip(velocities, -MAX_SPEED, MAX_SPEED, out=velocities)
        mujoco.mj_forward(model, data)  # as gymnasium-robotics: contacts start their next solution from this one

    def _after(self, row: int) -> None:
        self.goals[row] = self._goals[row]

    def _observe(self) -> None:
        self.observations[:, :4] = self.state
        self.observations[:, 4:] = self.goals
        np.subtract(self.state[:, :2], self.goals, out=self._offset)
        np.sqrt(np.add.reduce(self._offset * self._offset, axis=1), out=self.distance)

    def _evaluate(self) -> None:
        self._observe()
        np.exp(-self.distance, out=self.rewards)
        self.rewards *= self.scale

    def step(self, actions: np.ndarray, rows: Sequence[int], run: Runner = run_here) -> None:
        super().step(actions, rows, run)
        near = (self.distance <= SUCCESS_DISTANCE).tolist()
        for row in rows:
            env = self.envs[row]
            env.success = near[row]
            env.succeeded |= near[row]

    def info(self, row: int) -> dict[str, Any]:
        env = self.envs[row]
        return {"success": env.success, "is_success": env.succeeded}

    def infos(self) -> list[dict[str, Any]]:
        return [{"success": env.success, "is_success": env.succeeded} for env in self.envs]


class PointMazeEnv(MujocoClientEnv[PointMazeClient]):
    """One client of a PointMaze family.

    ## Description
    gymnasium-robotics' ``PointMaze`` with dense reward and flat observations: a ball that is pushed in the plane has to get
    to its goal through a maze. The client has its own goal cells and may have its own maze, start cells, actuator gear,
    joint damping and reward scale. ``maze`` is ``Open``, ``UMaze``, ``Medium``, ``Large`` (gymnasium-robotics' maps), or a
    list of rows of ``#`` (wall) and ``.`` (free); cells are ``(row, column)`` from the top left corner, 1 m wide, and the
    middle of the map is the origin.

    ## Action Space
    ``Box(-1, 1, (2,), float32)``: the force in x and y, 100 N times ``gear_scale`` at 1. The ball weighs 4.2 kg; its velocity
    is clipped to 5 m/s in each coordinate. A step is 0.01 s.

    ## Observation Space
    ``Box(-inf, inf, (6,), float64)``: the ball's x, y, its velocities in x and y, the goal's x, y. gymnasium-robotics'
    ``achieved_goal`` repeats x, y and is left out.

    ## Rewards
    ``reward_scale * exp(-d)`` with the distance ``d`` from ball to goal after the step.

    ## Starting State
    The goal is uniform within 0.25 m (in x and in y) of the middle of one of ``goal_cells``, the ball likewise of
    ``start_cells`` (by default all free cells but the goals); starts whose cell's middle is within 0.5 m of the goal are
    redrawn. Velocities are zero. The goal stays for the episode.

    ## Episode End
    Never terminates, also not at the goal, where the reward goes on (``continuing_task=True``, ``reset_target=False`` of
    gymnasium-robotics, its defaults); 300 steps. ``info["success"]`` says whether the ball is within 0.45 m of the goal,
    ``info["is_success"]`` whether it was at any step of the episode.

    ## Version History
    * v0: Initial version
    """

    world = "point_maze"
    batch_class = PointMazeBatch
    _batch: PointMazeBatch

    def __init__(
        self,
        client: int = 0,
        family: str | None = None,
        metadata: str | dict[str, Any] | Family | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        **parameters: Any,
    ) -> None:
        super().__init__(client, family, metadata, render_mode, width=width, height=height, **parameters)
        self.rows = maze_rows(self.client.maze)
        self.success = self.succeeded = False  # at this step, at any step of the episode
        self.goal = np.zeros(2)  # of the present episode, written in place: batches read it
        self._goal_centers = np.array([cell_center(self.rows, cell) for cell in self.client.goal_cells])
        self._start_centers = np.array([cell_center(self.rows, cell) for cell in self.client.starts()])
        self._build(_compiled_maze(self.rows), frame_skip=1, observation_dim=6)

    def _apply_parameters(self) -> None:
        self.model.dof_damping[:] *= self.client.damping_scale
        self.model.actuator_gear[:] *= self.client.gear_scale

    def _reset(self) -> tuple[np.ndarray, dict[str, Any]]:
        random = self.np_random  # drawn from in gymnasium-robotics' order
        mujoco.mj_resetData(self.model, self.data)
        goal = self._goal_centers[random.integers(low=0, high=len(self._goal_centers))]
        self.goal[:] = goal + random.uniform(low=-NOISE, high=NOISE, size=2)
        while True:
            start = self._start_centers[random.integers(low=0, high=len(self._start_centers))]
            if np.linalg.norm(start - self.goal) > 0.5:
                break
        start = start + random.uniform(low=-NOISE, high=NOISE, size=2)
        self.model.site("target").pos[:2] = self.goal
        self.set_state(start, self.init_qvel)
        observation = self._batch.observe(0)
        self.success = bool(self._batch.distance[0] <= SUCCESS_DISTANCE)
        self.succeeded = False
        return observation, {"success": self.success, "is_success": False}

    def save_state(self) -> dict[str, Any]:
        return {**super().save_state(), "goal": self.goal, "success": self.success, "succeeded": self.succeeded}

    def load_state(self, state: dict[str, Any]) -> None:
        self.goal[:] = state["goal"]
        self.model.site("target").pos[:2] = self.goal
        self.success, self.succeeded = state["success"], state["succeeded"]
        super().load_state(state)

    def _camera(self) -> dict[str, Any]:
        return {"distance": 12.5 if len(self.rows) > 8 else 8.8}  # gymnasium-robotics'

    @classmethod
    def scripted_policy(cls, family: Family, client: int) -> ScriptedPolicy:
        """Moves from cell to cell along a shortest path and stays at the goal, with Gaussian noise, squashed by tanh.

        It tracks a velocity of 2.5 m/s towards the next cell's middle, or towards the goal in the goal's cell and slower near
        it; it knows the client's gear and damping.
        """
        own = family.client(client)
        assert isinstance(own, PointMazeClient)
        rows = maze_rows(own.maze)
        waypoints = {goal: _waypoints(rows, goal) for goal in own.goal_cells}
        gear = 100.0 * own.gear_scale

        def cells(points: np.ndarray) -> np.ndarray:
            columns, lines = points[:, 0] + len(rows[0]) / 2, len(rows) / 2 - points[:, 1]
            return np.floor(np.column_stack([lines, columns])).astype(np.int64)

        def towards_goal(observations: np.ndarray, rng: np.random.Generator) -> np.ndarray:
            positions, velocities, goals = observations[:, :2], observations[:, 2:4], observations[:, 4:]
            here, there = cells(positions), cells(goals)
            ways = [waypoints[i, j] for i, j in there.tolist()]
            targets = np.array([way[i, j] for way, (i, j) in zip(ways, here.tolist(), strict=True)])
            arriving = (here == there).all(axis=1)
            targets[arriving] = goals[arriving]
            offsets = targets - positions
            lengths = np.sqrt(np.add.reduce(offsets * offsets, axis=1))
            speeds = np.where(arriving, np.minimum(_SLOWING * lengths, SCRIPT_SPEED), SCRIPT_SPEED)
            wanted = offsets * (speeds / np.maximum(lengths, 1e-9))[:, None]
            force = _TRACKING / own.gear_scale * (wanted - velocities) + own.damping_scale / gear * wanted
            force = np.clip(force, -_SATURATION, _SATURATION) + SCRIPT_NOISE * rng.standard_normal(force.shape)
            return np.tanh(force).astype(np.float32)

        return towards_goal


def _waypoints(rows: tuple[str, ...], goal: tuple[int, int]) -> np.ndarray:
    """For each cell ``(i, j)`` the middle of the next one on a shortest path to the goal, ``(height, width, 2)``."""
    steps = distances(rows, goal)
    table = np.array([[cell_center(rows, (i, j)) for j in range(len(rows[0]))] for i in range(len(rows))])
    for (i, j), distance in steps.items():
        for neighbour in ((i - 1, j), (i, j + 1), (i + 1, j), (i, j - 1)):
            if steps.get(neighbour, distance) < distance:
                table[i, j] = cell_center(rows, neighbour)
                break
    return table
