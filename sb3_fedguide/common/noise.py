"""Temporally correlated exploration noise of all clients."""

from __future__ import annotations

import numpy as np


class OrnsteinUhlenbeckNoise:
    """One Ornstein-Uhlenbeck process around zero per client, environment and action dimension.

    ``x <- x - theta x dt + sigma sqrt(dt) n`` with ``n`` standard normal, as SB3's ``OrnsteinUhlenbeckActionNoise``. The
    caller draws ``n``, so that each client has its own stream.

    :param shape: ``(n_clients, n_envs_per_client, action_dim)``
    :param theta: rate of mean reversion
    :param sigma: scale
    :param dt: time step; the DDPG paper's process has 1, SB3's default is 0.01
    """

    def __init__(self, shape: tuple[int, int, int], theta: float, sigma: float, dt: float) -> None:
        self.theta, self.sigma, self.dt = theta, sigma, dt
        self.state = np.zeros(shape)

    def __call__(self, normal: np.ndarray, present: np.ndarray | None = None) -> np.ndarray:
        """The next values, ``shape``, from standard normal draws of the same shape.

        :param present: ``(n_clients,)`` bool, clients whose processes go on; all if ``None``
        """
        state = self.state - self.theta * self.dt * self.state + self.sigma * np.sqrt(self.dt) * normal
        self.state = state if present is None else np.where(present[:, None, None], state, self.state)
        return self.state

    def reset(self, ended: np.ndarray | None = None) -> None:
        """Set the processes of ``ended`` episodes, ``(n_clients, n_envs_per_client)`` bool, to zero; all by default."""
        self.state[... if ended is None else ended] = 0.0
