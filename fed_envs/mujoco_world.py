"""Base classes of the MuJoCo worlds: building a client's model, stepping the simulator, rendering."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any, ClassVar

import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco.mujoco_env import expand_model_path

from fed_envs.world import Batch, ClientEnv, ClientT, EnvT, Runner, run_here

#: The part of MuJoCo's data that determines the next steps.
STATE = mujoco.mjtState.mjSTATE_INTEGRATION
FRAMES = ("xpos", "xquat", "xmat", "xipos", "ximat", "geom_xpos", "geom_xmat", "site_xpos", "site_xmat")


@lru_cache(maxsize=8)
def _compiled(xml_file: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(expand_model_path(xml_file))


class MujocoClientEnv(ClientEnv[ClientT]):
    """A client environment on one of Gymnasium's MuJoCo models.

    :param width: width of rendered images in pixels
    :param height: height of rendered images in pixels
    :param camera: MuJoCo's settings of the camera that takes them, e.g. ``{"distance": 4.0, "azimuth": 90.0}``, instead of the
        world's own camera
    """

    #: a camera of the model that pictures are taken by, instead of one with the settings of :meth:`_camera`
    camera_name: ClassVar[str | None] = None
    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}  # noqa: RUF012
    _batch: MujocoBatch[Any]

    def __init__(
        self, *args: Any, width: int = 480, height: int = 480, camera: dict[str, Any] | None = None, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self.width, self.height, self.camera = width, height, camera
        self._renderer: Any = None

    def _build(self, model: str | mujoco.MjModel, frame_skip: int, observation_dim: int) -> None:
        """Make model and data with this client's parameters, and the spaces.

        :param model: the name of one of Gymnasium's files, or a compiled model
        """
        # a copy each: nobody's change reaches another client
        self.model = copy.deepcopy(_compiled(model) if isinstance(model, str) else model)
        self.frame_skip = frame_skip
        self.dt = self.model.opt.timestep * frame_skip
        self._apply_parameters()
        self.data = mujoco.MjData(self.model)
        self.init_qpos = self.data.qpos.copy()
        self.init_qvel = self.data.qvel.copy()
        self.observation_space = spaces.Box(-np.inf, np.inf, (observation_dim,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (self.model.nu,), np.float32)
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.dt)}
        self._start()

    def _apply_parameters(self) -> None:
        """Apply those of the client's parameters that concern the model."""

    def _scale_mass_and_damping(self, mass_scale: float, damping_scale: float) -> None:
        """Scale all bodies' masses but the world's, and all joints' damping; inertias stay as they are (as in the paper)."""
        self.model.dof_damping[:] *= damping_scale
        if mass_scale != 1.0:
            self.model.body_mass[1:] *= mass_scale
            # Subtree masses and the inverse weights that set contact softness follow from the masses.
            mujoco.mj_setConst(self.model, mujoco.MjData(self.model))

    def set_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Put the simulator into a state (generalised positions ``(nq,)`` and velocities ``(nv,)``)."""
        self.data.qpos[:] = qpos
        self.data.qvel[:] = qvel
        mujoco.mj_forward(self.model, self.data)

    def save_state(self) -> dict[str, Any]:
        state = np.zeros(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, self.data, state, STATE)
        # Frames lag behind the generalised positions by one simulation step, and rewards read them.
        return {"simulation": state, **{name: getattr(self.data, name).copy() for name in FRAMES}}

    def load_state(self, state: dict[str, Any]) -> None:
        size = mujoco.mj_stateSize(self.model, STATE)
        if state["simulation"].shape != (size,):
            raise ValueError(
                f"the state of {self.family.name}'s client {self.client.client} has {state['simulation'].size} numbers "
                f"instead of {size}: it is of another model or version of MuJoCo"
            )
        mujoco.mj_setState(self.model, self.data, state["simulation"], STATE)
        mujoco.mj_forward(self.model, self.data)  # fills what follows from the state, and changes where the solver starts
        mujoco.mj_setState(self.model, self.data, state["simulation"], STATE)
        for name in FRAMES:
            getattr(self.data, name)[:] = state[name]

    @abstractmethod
    def _camera(self) -> dict[str, Any]:
        """MuJoCo's camera settings for pictures."""

    def render(self) -> Any:
        if self._renderer is None:
            from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer  # needs OpenGL, so only when asked for

            screen = self.model.vis.global_
            screen.offwidth, screen.offheight = max(screen.offwidth, self.width), max(screen.offheight, self.height)
            free = self.camera is not None or self.camera_name is None
            self._renderer = MujocoRenderer(
                self.model,
                self.data,
                self._camera() if self.camera is None else self.camera,
                self.width,
                self.height,
                **({"camera_id": -1} if free else {"camera_name": self.camera_name}),
            )
        return self._renderer.render(self.render_mode)

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_renderer": None}


class MujocoBatch(Batch[EnvT]):
    """Steps each environment's own simulator; subclasses turn actions into controls and states into rewards."""

    def __init__(self, envs: Sequence[EnvT]) -> None:
        super().__init__(envs)
        n, model = len(envs), envs[0].model  # type: ignore[attr-defined]
        self.nq, self.nv = model.nq, model.nv
        self.state = np.zeros((n, self.nq + self.nv))
        self.applied = np.zeros((n, model.nu), dtype=np.float32)  # actions as the actuators get them
        self.frame_skip: int = envs[0].frame_skip  # type: ignore[attr-defined]
        self.dt: float = envs[0].dt  # type: ignore[attr-defined]
        # Attribute access on MjData builds a new array each time, so the views are made once.
        self._views = [
            (env.model, env.data, env.data.ctrl, env.data.qpos, env.data.qvel, row[: self.nq], row[self.nq :])  # type: ignore[attr-defined]
            for env, row in zip(envs, self.state, strict=True)
        ]

    def _before(self, row: int) -> None:
        """Read what the reward needs from before the step."""

    def _after(self, row: int) -> None:
        """Read what the reward needs after the step, besides positions and velocities."""

    def _simulate(self, rows: Iterator[int]) -> None:
        step, frame_skip, applied, views = mujoco.mj_step, self.frame_skip, self.applied, self._views
        before, after = self._before, self._after
        for row in rows:
            model, data, control, positions, velocities, positions_read, velocities_read = views[row]
            before(row)
            control[:] = applied[row]
            # Gymnasium also calls mj_rnePostConstraint, which only fills contact forces that no observation here contains.
            step(model, data, frame_skip)  # releases the interpreter lock
            positions_read[:] = positions
            velocities_read[:] = velocities
            after(row)

    def step(self, actions: np.ndarray, rows: Sequence[int], run: Runner = run_here) -> None:
        self._apply(actions)
        run(self._simulate, rows)
        self._evaluate()

    @abstractmethod
    def _apply(self, actions: np.ndarray) -> None:
        """Fill ``self.applied`` from the policy's actions ``(n, nu)``."""

    @abstractmethod
    def _evaluate(self) -> None:
        """Fill ``observations``, ``rewards`` and ``terminated`` from what was read."""

    def observe(self, row: int) -> np.ndarray:
        """The observation of one environment's present state, ``(observation_dim,)``."""
        _, _, _, positions, velocities, positions_read, velocities_read = self._views[row]
        positions_read[:] = positions
        velocities_read[:] = velocities
        self._after(row)
        self._observe()
        return self.observations[row].copy()

    @abstractmethod
    def _observe(self) -> None:
        """Fill ``observations`` from what was read."""
