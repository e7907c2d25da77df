"""MetaWorld10: one MetaWorld v3 manipulation task per client."""

from __future__ import annotations

import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.policies import ENV_POLICY_MAP

from fed_envs.clients import MetaWorldClient
from fed_envs.metadata import Family
from fed_envs.mujoco_world import MujocoClientEnv
from fed_envs.plain_data import freeze, thaw
from fed_envs.seeding import stream
from fed_envs.world import Batch, Runner, ScriptedPolicy, run_here

OBSERVATION_DIM = 39
FIXED_GOAL_SEED = 0
#: Bound on the actions of the data's scripted policies, and the standard deviation of their noise before the tanh.
SCRIPT_LIMIT, SCRIPT_NOISE = 0.9, 0.3
# Attributes of metaworld's environment that belong to one object, not to its state.
_OWN = ("model", "data", "mujoco_renderer", "_np_random")
_ABSENT = object()


class SharedModel:
    """A task's compiled model, 20 MB of mostly textures and meshes, which all environments of the task share.

    An episode moves some of the model's bodies and sites, so each environment puts its own positions in before it uses the
    model, and a lock keeps threads from doing so at the same time.
    """

    def __init__(self, path: str) -> None:
        self.model = mujoco.MjModel.from_xml_path(path)
        self.lock = threading.RLock()
        self.positions = self.read()

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        return self.model.body_pos.copy(), self.model.site_pos.copy()

    @contextmanager
    def at(self, positions: tuple[np.ndarray, np.ndarray]) -> Iterator[None]:
        """The model with bodies and sites at ``positions``, for this thread alone."""
        with self.lock:
            self.model.body_pos[:], self.model.site_pos[:] = positions
            yield


_MODELS: dict[str, SharedModel] = {}
_MODELS_LOCK = threading.Lock()


def _shared_model(path: str) -> SharedModel:
    with _MODELS_LOCK:
        if path not in _MODELS:
            _MODELS[path] = SharedModel(path)
        return _MODELS[path]


@cache
def _sawyer_class(task: str) -> Any:
    """metaworld's environment of a task, on the shared model and able to draw a goal without simulating anything."""

    class Sawyer(ALL_V3_ENVIRONMENTS[task]):  # type: ignore[misc, valid-type]
        max_path_length = sys.maxsize  # the time limit is applied outside
        only_draw = False

        def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
            model = _shared_model(self.fullpath).model
            return model, mujoco.MjData(model)

        def _reset_hand(self, steps: int = 50) -> None:
            if self.only_draw:
                self.init_tcp = self.tcp_center
            else:
                super()._reset_hand(steps)

    return Sawyer


class MetaWorldBatch(Batch["MetaWorldEnv"]):
    """Steps metaworld's environments one by one; they compute observation and reward themselves."""

    def __init__(self, envs: Sequence[MetaWorldEnv]) -> None:
        super().__init__(envs)
        self._clipped = np.zeros((len(envs), 4), dtype=np.float32)
        self._infos: list[dict[str, Any]] = [{} for _ in envs]

    def step(self, actions: np.ndarray, rows: Sequence[int], run: Runner = run_here) -> None:
        # metaworld clips the hand's motion but pays for the gripper's effort beyond its limit.
        np.clip(actions, -1.0, 1.0, out=self._clipped)
        run(self._simulate, rows)

    def _simulate(self, rows: Iterator[int]) -> None:
        for row in rows:
            self.observations[row], self.rewards[row], self._infos[row] = self.envs[row].advance(self._clipped[row])

    def info(self, row: int) -> dict[str, Any]:
        return dict(self._infos[row])

    def infos(self) -> list[dict[str, Any]]:
        return [{"success": env.success, "is_success": env.succeeded} for env in self.envs]


class MetaWorldEnv(MujocoClientEnv[MetaWorldClient]):
    """One client of MetaWorld10.

    ## Description
    A simulated Sawyer arm on one of MetaWorld's v3 tasks (``client.task``): metaworld's own environment, with the goal in
    the observation.

    ## Action Space
    ``Box(-1, 1, (4,), float32)``: motion of the hand along x, y, z (1 is a centimetre), effort of the gripper. Actions
    beyond the bounds are clipped.

    ## Observation Space
    ``Box(-inf, inf, (39,), float64)``: the hand's position, the gripper's opening, positions and quaternions of two objects
    (zeros where there is one), 18 numbers; the same of the step before; the goal's position. metaworld bounds them
    differently for each task; here all clients have one space.

    ## Rewards
    metaworld's shaped reward of the task (its second version), between 0 and 10. ``info`` has metaworld's entries;
    ``success`` says whether the task is solved in this state, ``is_success`` whether it was at any step of the episode.

    ## Starting State
    The arm's start is fixed. Positions of object and goal are drawn from the task's own region at every reset, from the
    environment's own generator, not from NumPy's global one as in metaworld. With ``fixed_goal`` they are the same in
    every episode.

    ## Episode End
    Never terminates; 500 steps.

    ## Arguments
    Those of :class:`fed_envs.world.ClientEnv` and ``width``, ``height``, ``camera``; any field of
    :class:`fed_envs.clients.MetaWorldClient` as a keyword replaces the client's own, e.g. ``fixed_goal=True``. ``model``
    is shared with other environments of the task: do not change it.

    ## Version History
    * v0: Initial version
    """

    world = "metaworld"
    batch_class = MetaWorldBatch

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
        self.observation_space = spaces.Box(-np.inf, np.inf, (OBSERVATION_DIM,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.success = self.succeeded = False
        self._make_sawyer()
        self.frame_skip = self.sawyer.frame_skip
        self.dt = self.model.opt.timestep * self.frame_skip
        self.metadata = {
            "render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"],
            "render_fps": round(1.0 / self.dt),
        }
        self._start()

    def _make_sawyer(self) -> None:
        make = _sawyer_class(self.client.task)
        self._shared = _shared_model(make.__new__(make).model_name)
        with self._shared.at(self._shared.positions):
            self.sawyer = make()
        self.sawyer._set_task_called = True
        self.sawyer._partially_observable = False
        del self.sawyer.sawyer_observation_space  # cached for a hidden goal
        self.model, self.data = self.sawyer.model, self.sawyer.data
        self._positions = self._shared.positions
        self._fresh = dict(self.sawyer.__dict__)

    def _reset(self) -> tuple[np.ndarray, dict[str, Any]]:
        sawyer = self.sawyer
        sawyer.__dict__.clear()  # nothing of earlier episodes
        sawyer.__dict__.update(self._fresh)
        sawyer._np_random = stream(FIXED_GOAL_SEED) if self.client.fixed_goal else self.np_random
        with self._shared.at(self._shared.positions):
            # metaworld resets the model, then the simulator, then the model again, which draws twice unless it is frozen;
            # of the first time only what it drew and where it put the bodies matters.
            mujoco.mj_resetData(self.model, self.data)
            mujoco.mj_forward(self.model, self.data)
            sawyer.seeded_rand_vec, sawyer._freeze_rand_vec, sawyer.only_draw = True, False, True
            sawyer.reset_model()
            sawyer._freeze_rand_vec, sawyer.only_draw = True, False
            mujoco.mj_resetData(self.model, self.data)
            observation = sawyer.reset_model()
            self._positions = self._shared.read()
        sawyer._prev_obs = observation[:18].copy()
        observation[18:36] = sawyer._prev_obs
        self.success = self.succeeded = False
        return observation, {}

    def advance(self, action: np.ndarray) -> tuple[np.ndarray, float, dict[str, Any]]:
        """One step of metaworld's environment: observation ``(39,)``, reward and info for an action ``(4,)`` within bounds."""
        with self._shared.at(self._positions):
            observation, reward, _, _, values = self.sawyer.step(action)
        self.success = bool(values["success"])
        self.succeeded |= self.success
        info = {name: float(value) for name, value in values.items()}
        return observation, float(reward), {**info, "success": self.success, "is_success": self.succeeded}

    @classmethod
    def scripted_policy(cls, family: Family, client: int) -> ScriptedPolicy:
        """metaworld's scripted policy of the client's task, with Gaussian noise of 0.3 before a tanh.

        The policies' actions are at the bounds most of the time. Clipped noise would put atoms there, which no density of the
        actions has. So their actions stay within 0.9, and the tanh squashes the noise.
        """
        own = family.client(client)
        assert isinstance(own, MetaWorldClient)
        policy = ENV_POLICY_MAP[own.task]()  # type: ignore[abstract]

        def act(observations: np.ndarray, rng: np.random.Generator) -> np.ndarray:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # it says that its actions will be clipped
                wanted = np.array([policy.get_action(observation) for observation in observations], dtype=np.float64)
            raw = np.arctanh(np.clip(wanted, -SCRIPT_LIMIT, SCRIPT_LIMIT)) + SCRIPT_NOISE * rng.standard_normal(wanted.shape)
            return np.tanh(raw).astype(np.float32)

        return act

    def set_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        with self._shared.at(self._positions):
            super().set_state(qpos, qvel)

    def _camera(self) -> dict[str, Any]:
        return {"lookat": np.array([0.0, 0.65, 0.15]), "distance": 1.5, "azimuth": 130.0, "elevation": -25.0}

    def render(self) -> Any:
        with self._shared.at(self._positions):
            mujoco.mj_kinematics(self.model, self.data)  # a reset moves bodies without placing them
            return super().render()

    def save_state(self) -> dict[str, Any]:
        """The simulator's state, the positions of the shared model's bodies, and metaworld's attributes.

        Some attributes are views into the simulator's memory, saved as the array's name and a row. Attributes that are not
        plain data are the same in every environment of the task.
        """
        attributes, views = {}, {}
        for name, value in self.sawyer.__dict__.items():
            source = self._viewed(value)
            if source is not None:
                views[name] = source
            elif name in _OWN or isinstance(value, spaces.Space):
                continue
            elif isinstance(value, np.ndarray) or value is not self._fresh.get(name, _ABSENT):
                attributes[name] = value
        return {
            **super().save_state(),
            "positions": self._positions,
            "success": self.success,
            "succeeded": self.succeeded,
            "attributes": attributes,
            "views": views,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        self._positions = state["positions"]
        self.success, self.succeeded = state["success"], state["succeeded"]
        sawyer = self.sawyer
        sawyer.__dict__.clear()
        sawyer.__dict__.update(self._fresh)
        sawyer.__dict__.update(state["attributes"])
        for name, (source, index) in state["views"].items():
            setattr(sawyer, name, getattr(self.data, source)[index])
        with self._shared.at(self._positions):
            super().load_state(state)

    def _viewed(self, value: Any) -> tuple[str, int] | None:
        if not isinstance(value, np.ndarray) or value.base is None:
            return None
        for name in ("xpos", "site_xpos", "geom_xpos"):
            positions = getattr(self.data, name)
            if np.may_share_memory(value, positions):
                offset = value.__array_interface__["data"][0] - positions.__array_interface__["data"][0]
                return name, offset // positions.strides[0]
        return None

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        for name in ("sawyer", "model", "data", "_shared", "_fresh"):
            del state[name]
        return {**state, "_saved": freeze(self.save_state())}

    def __setstate__(self, state: dict[str, Any]) -> None:
        saved = thaw(state.pop("_saved"))
        self.client = state["client"]
        self._make_sawyer()
        self.__dict__.update(state)
        self.load_state(saved)
        super().__setstate__({})
