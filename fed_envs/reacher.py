"""Reacher with each client's own goals, actuation and preferences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from fed_envs.clients import REACHER_GOAL_LIMIT, ReacherClient
from fed_envs.metadata import Family
from fed_envs.mujoco_world import MujocoBatch, MujocoClientEnv


class Preference(NamedTuple):
    """Weights of the reward's terms, see :class:`ReacherEnv`."""

    distance: float
    control: float
    closing_speed: float
    joint_speed: float


#: Ours: the paper names the four preferences without formulas, so returns are not comparable with its figures.
PREFERENCES = {
    "default": Preference(distance=1.0, control=1.0, closing_speed=0.0, joint_speed=0.0),
    "speed": Preference(distance=1.0, control=1.0, closing_speed=0.1, joint_speed=0.0),
    "stability": Preference(distance=1.0, control=1.0, closing_speed=0.0, joint_speed=0.01),
    "efficiency": Preference(distance=1.0, control=3.0, closing_speed=0.0, joint_speed=0.0),
}


class ReacherBatch(MujocoBatch["ReacherEnv"]):
    """The one definition of a Reacher step, over ``(n, ...)`` arrays; formulas in :class:`ReacherEnv`."""

    def __init__(self, envs: Sequence[ReacherEnv]) -> None:
        super().__init__(envs)
        n, clients = len(envs), [env.client for env in envs]
        preferences = [PREFERENCES[client.preference] for client in clients]
        self.offset = np.array([client.action_offset for client in clients], dtype=np.float32)
        self.scale = np.array([client.reward_scale for client in clients])
        self.distance_weight = np.array([preference.distance for preference in preferences])
        self.control_weight = np.array([preference.control for preference in preferences], dtype=np.float32)
        self.closing_weight = np.array([preference.closing_speed for preference in preferences])
        self.joint_weight = np.array([preference.joint_speed for preference in preferences])
        self.before = np.zeros((n, 3))
        self.after = np.zeros((n, 3))
        self.angles = np.zeros((n, 2))
        self.terms = np.zeros((4, n))  # distance, control, closing speed, joint speed
        self._bodies = [(env.data.body("fingertip").xpos, env.data.body("target").xpos) for env in envs]

    def _apply(self, actions: np.ndarray) -> None:
        applied = self.applied
        np.add(actions, self.offset, out=applied)
        np.maximum(applied, np.float32(-1.0), out=applied)
        np.minimum(applied, np.float32(1.0), out=applied)

    def _before(self, row: int) -> None:
        fingertip, target = self._bodies[row]
        np.subtract(fingertip, target, out=self.before[row])

    def _after(self, row: int) -> None:
        fingertip, target = self._bodies[row]
        np.subtract(fingertip, target, out=self.after[row])

    def _observe(self) -> None:
        observations, angles = self.observations, self.angles
        angles[:] = self.state[:, :2]  # contiguous: vectorised cosines depend on it in the last bit
        observations[:, 0:2] = np.cos(angles)
        observations[:, 2:4] = np.sin(angles)
        observations[:, 4:6] = self.state[:, 2:4]
        observations[:, 6:8] = self.state[:, 4:6]
        observations[:, 8:10] = self.after[:, :2]

    def _evaluate(self) -> None:
        self._observe()
        distance, control, closing, joints = self.terms
        # vecdot and not a sum: it is what numpy.linalg.norm does for one vector, to the last bit
        np.sqrt(np.vecdot(self.after, self.after), out=distance)
        np.subtract(np.sqrt(np.vecdot(self.before, self.before)), distance, out=closing)
        closing /= self.dt
        closing *= self.closing_weight
        distance *= -self.distance_weight
        np.multiply(-np.add.reduce(np.square(self.applied), axis=1), self.control_weight, out=control)
        np.add.reduce(np.square(self.state[:, 4:6]), axis=1, out=joints)
        joints *= -self.joint_weight
        np.add(distance, control, out=self.rewards)
        self.rewards += closing
        self.rewards += joints
        self.rewards *= self.scale

    def info(self, row: int) -> dict[str, Any]:
        distance, control, closing, joints = (float(term) for term in self.terms[:, row] * self.scale[row])
        return {"reward_dist": distance, "reward_ctrl": control, "reward_speed": closing, "reward_stability": joints}


class ReacherEnv(MujocoClientEnv[ReacherClient]):
    r"""One client of a Reacher family.

    ## Description
    Gymnasium's ``Reacher-v5`` with the client's goals, a constant offset on its actions, a reward scale, and an offset on both
    joints' start angles; ReacherHard adds mass, damping and gear scales and a preference.

    ## Action Space
    ``Box(-1, 1, (2,), float32)``. The actuators get ``clip(action + action_offset, -1, 1)``, the applied action.

    ## Observation Space
    ``Box(-inf, inf, (10,), float64)``: cosines and sines of the two angles, the goal, the two angular velocities, fingertip
    minus goal.

    ## Rewards
    ``reward_scale * (-w_d * d - w_c * |applied action|^2 + w_s * (d_before - d) / dt - w_j * |angular velocity|^2)`` with the
    distance ``d`` from fingertip to goal, ``dt`` = 0.02 s, and weights by preference (ours, :data:`PREFERENCES`):

    | preference | w_d | w_c | w_s | w_j |
    |---|---|---|---|---|
    | default | 1 | 1 | 0 | 0 |
    | speed | 1 | 1 | 0.1 | 0 |
    | stability | 1 | 1 | 0 | 0.01 |
    | efficiency | 1 | 3 | 0 | 0 |

    The closing speeds of an episode add up to the distance gained, so that shaking to and fro earns nothing.

    ## Starting State
    Angles uniform within 0.1 rad of ``angle_offset`` on both joints, angular velocities within 0.005; the goal uniform in
    the box ``goal_x`` x ``goal_y``, redrawn while it lies 0.25 m or more from the shoulder.

    ## Episode End
    Never terminates; 50 steps.

    ## Version History
    * v0: Initial version
    """

    world = "reacher"
    batch_class = ReacherBatch

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
        self._build("reacher.xml", frame_skip=2, observation_dim=10)

    def _apply_parameters(self) -> None:
        self._scale_mass_and_damping(self.client.mass_scale, self.client.damping_scale)
        self.model.actuator_gear[:] *= self.client.gear_scale

    def _reset(self) -> tuple[np.ndarray, dict[str, Any]]:
        client, random = self.client, self.np_random
        mujoco.mj_resetData(self.model, self.data)
        qpos = random.uniform(low=-0.1, high=0.1, size=self.model.nq) + self.init_qpos
        qpos[:2] += client.angle_offset
        low, high = np.array([client.goal_x, client.goal_y]).T
        while True:
            goal = random.uniform(low=low, high=high)
            if np.linalg.norm(goal) < REACHER_GOAL_LIMIT:
                break
        qpos[-2:] = goal
        qvel = self.init_qvel + random.uniform(low=-0.005, high=0.005, size=self.model.nv)
        qvel[-2:] = 0.0
        self.set_state(qpos, qvel)
        return self._batch.observe(0), {}

    def _camera(self) -> dict[str, Any]:
        from gymnasium.envs.mujoco.reacher_v5 import DEFAULT_CAMERA_CONFIG

        return dict(DEFAULT_CAMERA_CONFIG)
