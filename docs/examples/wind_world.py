"""A world of one's own in one module, with its clients in ``Wind.json`` beside it: hover over the origin in the wind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from gymnasium import spaces

from fed_envs import Client, register_family, register_world
from fed_envs.world import Batch, ClientEnv, run_here


class WindClient(Client):
    wind: tuple[float, float]  # metres per step


class WindBatch(Batch):
    """Steps several environments; a single one is a batch of one."""

    def step(self, actions, rows, run=run_here):
        for row in rows:
            env = self.envs[row]
            env.position += 0.1 * np.clip(actions[row], -1, 1) + env.client.wind
            self.observations[row] = env.position
            self.rewards[row] = -np.linalg.norm(env.position)
            self.terminated[row] = self.rewards[row] < -5

    def info(self, row):
        return {}


class WindEnv(ClientEnv[WindClient]):
    world, batch_class = "wind", WindBatch

    def __init__(self, client=0, family=None, metadata=None, render_mode=None, **parameters):
        super().__init__(client, family, metadata, render_mode, **parameters)
        self.observation_space = spaces.Box(-10, 10, (2,), np.float32)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.position = np.zeros(2)
        self._start()

    def _reset(self):
        self.position = self.np_random.uniform(-1, 1, 2)
        return self.position.astype(np.float32), {}

    @classmethod
    def scripted_policy(cls, family, client):
        """Policy that collects the offline data: it flies back, with some noise."""
        return lambda obs, rng: np.tanh(-3 * obs + 0.3 * rng.standard_normal(obs.shape)).astype(np.float32)


register_world("wind", f"{__name__}:WindEnv", WindClient, backbones=("Wind",))
register_family(Path(__file__).with_name("Wind.json"))
