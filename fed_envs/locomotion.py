"""Hopper, Walker2D and HalfCheetah with each client's own dynamics and reward weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import mujoco
import numpy as np

from fed_envs.clients import LocomotionClient
from fed_envs.metadata import Family
from fed_envs.mujoco_world import MujocoBatch, MujocoClientEnv


@dataclass(frozen=True)
class Backbone:
    """What Gymnasium's v5 environment of that name does by default."""

    xml_file: str
    module: str  # where Gymnasium keeps its camera
    frame_skip: int
    observation_dim: int
    healthy_reward: float
    healthy_z: tuple[float, float] = (-np.inf, np.inf)
    healthy_angle: tuple[float, float] = (-np.inf, np.inf)
    healthy_state: float = np.inf  # every state after the first two is smaller in size than this
    velocity_clip: float = np.inf
    gaussian_start_velocity: bool = False
    n_unstable_velocities: int = 3  # the instability cost takes this many velocities, from the pitch's on


BACKBONES = {
    "Hopper-v5": Backbone("hopper.xml", "hopper_v5", 4, 11, 1.0, (0.7, np.inf), (-0.2, 0.2), 100.0, velocity_clip=10.0),
    "Walker2d-v5": Backbone("walker2d_v5.xml", "walker2d_v5", 4, 17, 1.0, (0.8, 2.0), (-1.0, 1.0), velocity_clip=10.0),
    "HalfCheetah-v5": Backbone(
        "half_cheetah.xml", "half_cheetah_v5", 5, 17, 0.0, gaussian_start_velocity=True, n_unstable_velocities=1
    ),
}


class LocomotionBatch(MujocoBatch["LocomotionEnv"]):
    """The one definition of a locomotion step, over ``(n, ...)`` arrays; formulas in :class:`LocomotionEnv`."""

    def __init__(self, envs: Sequence[LocomotionEnv]) -> None:
        super().__init__(envs)
        n, clients = len(envs), [env.client for env in envs]
        self.backbone = envs[0].backbone
        self.gain = np.array([[client.action_gain] for client in clients], dtype=np.float32)
        self.forward_weight = np.array([client.forward_reward_weight for client in clients])
        # Actions are float32, and so is their cost, as in Gymnasium.
        self.ctrl_weight = np.array([client.ctrl_cost_weight for client in clients], dtype=np.float32)
        self.instability_weight = np.array([client.instability_cost_weight for client in clients])
        self.x_before = np.zeros(n)
        self.x_velocity = np.zeros(n)
        self.forward_reward = np.zeros(n)
        self.healthy_reward = np.zeros(n)
        self.ctrl_cost = np.zeros(n, dtype=np.float32)
        self.instability_cost = np.zeros(n)
        nq = self.nq
        self._positions = [env.data.qpos for env in envs]
        # Views that every step uses, so that slicing costs nothing.
        self._x, self._z, self._pitch = self.state[:, 0], self.state[:, 1], self.state[:, 2]
        self._bounded = self.state[:, 2:]
        self._unstable = self.state[:, nq + 2 : nq + 2 + self.backbone.n_unstable_velocities]
        self._seen_positions, self._seen_velocities = self.state[:, 1:nq], self.state[:, nq:]
        self._observed_positions = self.observations[:, : nq - 1]
        self._observed_velocities = self.observations[:, nq - 1 :]

    def _apply(self, actions: np.ndarray) -> None:
        applied = self.applied
        np.multiply(actions, self.gain, out=applied)
        np.maximum(applied, np.float32(-1.0), out=applied)
        np.minimum(applied, np.float32(1.0), out=applied)

    def _before(self, row: int) -> None:
        self.x_before[row] = self._positions[row][0]

    def _observe(self) -> None:
        self._observed_positions[:] = self._seen_positions
        limit = self.backbone.velocity_clip
        if limit == np.inf:
            self._observed_velocities[:] = self._seen_velocities
        else:
            np.maximum(self._seen_velocities, -limit, out=self._observed_velocities)
            np.minimum(self._observed_velocities, limit, out=self._observed_velocities)

    def _evaluate(self) -> None:
        backbone = self.backbone
        self._observe()
        np.subtract(self._x, self.x_before, out=self.x_velocity)
        self.x_velocity /= self.dt
        np.multiply(self.forward_weight, self.x_velocity, out=self.forward_reward)
        np.multiply(self.ctrl_weight, np.add.reduce(np.square(self.applied), axis=1), out=self.ctrl_cost)
        unstable = np.add.reduce(np.square(self._unstable), axis=1)
        unstable *= 0.25
        unstable += np.square(self._pitch)
        np.multiply(self.instability_weight, unstable, out=self.instability_cost)
        rewards = self.rewards
        if backbone.healthy_reward:
            healthy = (self._z > backbone.healthy_z[0]) & (self._z < backbone.healthy_z[1])
            healthy &= (self._pitch > backbone.healthy_angle[0]) & (self._pitch < backbone.healthy_angle[1])
            if backbone.healthy_state != np.inf:
                healthy &= np.maximum.reduce(np.abs(self._bounded), axis=1) < backbone.healthy_state
            np.logical_not(healthy, out=self.terminated)
            np.multiply(healthy, backbone.healthy_reward, out=self.healthy_reward)
            np.add(self.forward_reward, self.healthy_reward, out=rewards)
            rewards -= self.ctrl_cost
        else:
            np.subtract(self.forward_reward, self.ctrl_cost, out=rewards)
        rewards -= self.instability_cost

    def info(self, row: int) -> dict[str, Any]:
        info = {
            "x_position": float(self._x[row]),
            "z_distance_from_origin": float(self._z[row] - self.envs[row].init_qpos[1]),
            "x_velocity": float(self.x_velocity[row]),
            "reward_forward": float(self.forward_reward[row]),
            "reward_ctrl": -float(self.ctrl_cost[row]),
            "reward_instability": -float(self.instability_cost[row]),
        }
        if self.backbone.healthy_reward:
            info["reward_survive"] = float(self.healthy_reward[row])
        return info


class LocomotionEnv(MujocoClientEnv[LocomotionClient]):
    r"""One client of a Hopper, Walker2D or HalfCheetah family.

    ## Description
    Gymnasium's ``Hopper-v5``, ``Walker2d-v5`` or ``HalfCheetah-v5`` (the family's backbone) with the client's dynamics: all
    body masses times ``mass_scale``, joint damping times ``damping_scale``, the floor's friction times ``friction_scale``.
    With every scale 1 and the backbone's weights it is that environment exactly.

    ## Action Space
    ``Box(-1, 1, (3 or 6,), float32)``. The actuators get ``clip(action_gain * action, -1, 1)``, the applied action.

    ## Observation Space
    The backbone's: positions without x, then velocities (clipped to 10 for Hopper and Walker2D).

    ## Rewards
    ``forward_reward_weight * dx/dt + healthy_reward - ctrl_cost_weight * |applied action|^2 - instability_cost_weight * u``
    with ``u = pitch^2 + |qvel[2:5]|^2 / 4`` for Hopper and Walker2D, ``u = pitch^2 + qvel[2]^2 / 4`` for HalfCheetah.

    ## Starting State
    The backbone's, with ``reset_noise_scale``.

    ## Episode End
    The backbone's: Hopper and Walker2D terminate when unhealthy, HalfCheetah never; 1000 steps.

    ## Arguments
    Those of :class:`fed_envs.world.ClientEnv` and ``width``, ``height``, ``camera``; any field of
    :class:`fed_envs.clients.LocomotionClient` as a keyword replaces the client's own, e.g. ``floor_priority=True``: MuJoCo
    takes the larger friction of two touching geoms, so that a slippery floor under a foot of friction 2.0 changes nothing
    unless the floor has priority.

    ## Version History
    * v0: Initial version
    """

    world = "locomotion"
    batch_class = LocomotionBatch
    camera_name = "track"  # it follows the body, which a free camera of Gymnasium 1.4 does not do

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
        self.backbone = BACKBONES[self.family.backbone]
        self._build(self.backbone.xml_file, self.backbone.frame_skip, self.backbone.observation_dim)

    def _apply_parameters(self) -> None:
        self._scale_mass_and_damping(self.client.mass_scale, self.client.damping_scale)
        floor = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_GEOM, "floor")
        self.model.geom_friction[floor] *= self.client.friction_scale
        if self.client.floor_priority:
            self.model.geom_priority[floor] = 1

    def _reset(self) -> tuple[np.ndarray, dict[str, Any]]:
        scale, random = self.client.reset_noise_scale, self.np_random
        mujoco.mj_resetData(self.model, self.data)
        qpos = self.init_qpos + random.uniform(low=-scale, high=scale, size=self.model.nq)
        if self.backbone.gaussian_start_velocity:
            qvel = self.init_qvel + scale * random.standard_normal(self.model.nv)
        else:
            qvel = self.init_qvel + random.uniform(low=-scale, high=scale, size=self.model.nv)
        self.set_state(qpos, qvel)
        info = {"x_position": float(qpos[0]), "z_distance_from_origin": float(qpos[1] - self.init_qpos[1])}
        return self._batch.observe(0), info

    def _camera(self) -> dict[str, Any]:
        camera = import_module(f"gymnasium.envs.mujoco.{self.backbone.module}").DEFAULT_CAMERA_CONFIG
        return dict(camera)
