"""Bandit2D: one step, two-dimensional actions, four reward modes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from fed_envs.clients import BANDIT2D_PEAKS, Bandit2DClient
from fed_envs.metadata import Family
from fed_envs.world import Batch, ClientEnv, Runner, ScriptedPolicy, run_here

PEAKS = np.array(BANDIT2D_PEAKS)  # (4, 2)
SIGMA = 0.2  # width of the reward modes
ACTION_LIMIT = 1.5
DATA_RADIUS = 0.3
IMAGE_SIZE = 240


def peak_weights(client: Bandit2DClient) -> np.ndarray:
    """The heights of the four peaks for a client, ``(4,)``: 1 for its own, ``off_peak_weight`` for the others."""
    own = (PEAKS == client.peak).all(axis=1)
    return np.where(own, 1.0, client.off_peak_weight)


def _reward(actions: np.ndarray, weights: np.ndarray) -> np.ndarray:
    offsets = actions[..., None, :] - PEAKS
    squares = offsets[..., 0] * offsets[..., 0] + offsets[..., 1] * offsets[..., 1]
    return np.maximum.reduce(weights * np.exp(squares * (-0.5 / SIGMA**2)), axis=-1)


def reward(actions: np.ndarray, client: Bandit2DClient | int = 0, off_peak_weight: float = 1.0) -> np.ndarray:
    """``max_m w_m exp(-|a - c_m|^2 / (2 * 0.2^2))`` for a client, for any number of actions.

    :param actions: ``(..., 2)``
    :param client: a client, or its number: client ``c`` owns peak ``c mod 4``
    :param off_peak_weight: height of the other peaks, if ``client`` is a number
    :return: ``(...)`` float64
    """
    if not isinstance(client, Bandit2DClient):
        peak = BANDIT2D_PEAKS[client % len(BANDIT2D_PEAKS)]
        client = Bandit2DClient(client=client, peak=peak, off_peak_weight=off_peak_weight)
    return _reward(np.asarray(actions, dtype=np.float64), peak_weights(client))


class Bandit2DBatch(Batch["Bandit2DEnv"]):
    """The one definition of a bandit step, over ``(n, 2)`` actions."""

    def __init__(self, envs: Sequence[Bandit2DEnv]) -> None:
        super().__init__(envs)
        self.weights = np.array([peak_weights(env.client) for env in envs])
        self.terminated[:] = True
        self.actions = np.zeros((len(envs), 2))

    def step(self, actions: np.ndarray, rows: Sequence[int], run: Runner = run_here) -> None:
        clipped = np.clip(actions, -ACTION_LIMIT, ACTION_LIMIT).astype(np.float64)
        self.actions = clipped
        self.rewards[:] = _reward(clipped, self.weights)

    def info(self, row: int) -> dict[str, Any]:
        return {}


class Bandit2DEnv(ClientEnv[Bandit2DClient]):
    """One client of Bandit2D.

    ## Description
    A continuous bandit: every episode is one step. Four Gaussian reward modes of width 0.2 sit at (1, 0), (0, 1), (-1, 0),
    (0, -1); client ``c`` owns peak ``c mod 4``.

    ## Action Space
    ``Box(-1.5, 1.5, (2,), float32)``

    ## Observation Space
    ``Box(-1.5, 1.5, (2,), float32)``, always zeros.

    ## Rewards
    ``max_m w_m exp(-|a - c_m|^2 / (2 * 0.2^2))`` with ``w`` = 1 for the client's own peak and ``off_peak_weight``
    (default 1, as in the paper) for the others.

    ## Episode End
    Terminates after one step.

    ## Version History
    * v0: Initial version
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012
    world = "bandit2d"
    batch_class = Bandit2DBatch

    def __init__(
        self,
        client: int = 0,
        family: str | None = None,
        metadata: str | dict[str, Any] | Family | None = None,
        render_mode: str | None = None,
        **parameters: Any,
    ) -> None:
        super().__init__(client, family, metadata, render_mode, **parameters)
        self.observation_space = spaces.Box(-ACTION_LIMIT, ACTION_LIMIT, (2,), np.float32)
        self.action_space = spaces.Box(-ACTION_LIMIT, ACTION_LIMIT, (2,), np.float32)
        self._start()

    @classmethod
    def scripted_policy(cls, family: Family, client: int) -> ScriptedPolicy:
        """Uniform within radius 0.3 of the client's own peak, as in the paper."""
        own = family.client(client)
        assert isinstance(own, Bandit2DClient)
        peak = np.asarray(own.peak)

        def around_peak(observations: np.ndarray, rng: np.random.Generator) -> np.ndarray:
            radius = DATA_RADIUS * np.sqrt(rng.random(len(observations)))
            angle = 2.0 * np.pi * rng.random(len(observations))
            return (peak + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])).astype(np.float32)

        return around_peak

    def _reset(self) -> tuple[np.ndarray, dict[str, Any]]:
        return np.zeros(2, dtype=np.float32), {}

    def render(self) -> np.ndarray:
        """The reward over all actions as shades of blue, and the last action as a red dot, ``(240, 240, 3)`` uint8."""
        axis = np.linspace(-ACTION_LIMIT, ACTION_LIMIT, IMAGE_SIZE)
        grid = np.stack(np.meshgrid(axis, -axis), axis=-1)  # the second action upwards
        heights = _reward(grid, peak_weights(self.client))
        image = np.stack([255 - 200 * heights, 255 - 120 * heights, np.full_like(heights, 255)], axis=-1).astype(np.uint8)
        image[np.square(grid - self._batch.actions[0]).sum(axis=-1) < 0.05**2] = (220, 30, 30)  # type: ignore[attr-defined]
        return image
