"""Environments for the tests, and the log of one."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class PointEnv(gym.Env[np.ndarray, np.ndarray]):
    """A point that is paid for staying near its client's target; cheap and with both ways for an episode to end."""

    def __init__(self, target: float = 0.5, length: int = 20) -> None:
        self.observation_space = gym.spaces.Box(-10.0, 10.0, (3,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.target, self.length = target, length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position, self.steps = self.np_random.normal(size=2) * 0.5, 0
        return self._observation(), {}

    def step(self, action):
        self.position = self.position + 0.2 * np.clip(action, -1, 1) + 0.02 * self.np_random.normal(size=2)
        self.steps += 1
        reward = -float(np.square(self.position - self.target).sum())
        terminated = bool(np.abs(self.position).max() > 2.5)
        return self._observation(), reward, terminated, self.steps >= self.length and not terminated, {}

    def _observation(self) -> np.ndarray:
        return np.array([*self.position, self.steps / self.length], dtype=np.float32)


class CountingEnv(PointEnv):
    """A user's own environment that can be put back."""

    def save_state(self):
        return {"position": self.position, "steps": self.steps}

    def load_state(self, state):
        self.position, self.steps = state["position"], state["steps"]


SPACES = {
    "discrete": spaces.Discrete(4),
    "multidiscrete": spaces.MultiDiscrete([2, 3]),
    "multibinary": spaces.MultiBinary(3),
}


class ChoiceEnv(gym.Env):
    """Paid for every entry of the action that is what the observation's signs ask for."""

    def __init__(self, space: spaces.Space, shift: int = 0) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.action_space = space
        self.sizes = {spaces.Discrete: lambda: [space.n], spaces.MultiDiscrete: lambda: space.nvec}.get(
            type(space), lambda: [2] * 3
        )()
        self.shift, self.steps = shift, 0
        self.position = np.zeros(3, dtype=np.float32)

    def _draw(self):
        self.position = self.np_random.normal(size=3).astype(np.float32)
        return self.position.copy()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._draw(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        wanted = [(int(x > 0) + self.shift) % size for x, size in zip(self.position, self.sizes, strict=False)]
        reward = float(np.mean(np.reshape(action, -1) == wanted))
        self.steps += 1
        return self._draw(), reward, False, self.steps >= 8, {}

    def save_state(self):
        return {"position": self.position.copy(), "steps": self.steps}

    def load_state(self, state):
        self.position, self.steps = state["position"].copy(), state["steps"]


def choices(kind: str, n: int = 2):
    return [lambda k=k: ChoiceEnv(SPACES[kind], k) for k in range(n)]


ACTIONS = gym.spaces.Box(-2.0, 2.0, (1,))


def pendulum_log(seed: int, n: int = 90) -> dict[str, np.ndarray]:
    """Three episodes of a pendulum, the last two of which are cut off."""
    env, rng = gym.make("Pendulum-v1"), np.random.default_rng(seed)
    rows = {name: [] for name in ("observations", "actions", "rewards", "next_observations")}
    for episode in range(3):
        observation = env.reset(seed=seed + episode)[0]
        for _ in range(n // 3):
            action = rng.uniform(-2, 2, 1).astype(np.float32)
            following, reward, *_ = env.step(action)
            for name, value in zip(rows, (observation, action, reward, following), strict=True):
                rows[name].append(value)
            observation = following
    log = {name: np.asarray(values, dtype=np.float32) for name, values in rows.items()}
    return log | {"terminations": np.arange(n) == n // 3 - 1, "truncations": np.arange(n) % (n // 3) == n // 3 - 1}
