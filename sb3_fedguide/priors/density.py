"""The variance-preserving diffusion, and log-densities and samples by its probability-flow ODE.

``x_t = alpha(t) x_0 + sigma(t) eps`` with ``d log alpha = -b(t) / 2 dt`` and ``b(t) = 0.1 + 19.9 t``: the limit of DDPM's
K = 1000 steps with beta from 1e-4 to 2e-2, step ``k`` (from 0) at ``t = (k + 1) / K``.

Since ``alpha^2 + sigma^2 = 1``, noise levels are angles, ``alpha = cos(theta)`` and ``sigma = sin(theta)``, and the
probability flow takes its plainest form (Salimans and Ho 2022, appendix D): ``dx/dtheta = v`` with the velocity
``v = (eps - sigma x) / alpha``. Here a model is a function that returns ``v``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import torch as th

K = 1000
BETA_0 = 0.1
BETA_1 = 20.0


def noise_angle(t: np.ndarray | float) -> np.ndarray:
    """``theta(t)``, for times in (0, 1], float64."""
    t = np.asarray(t, dtype=np.float64)
    # sigma^2 / alpha^2 = expm1(int b dt)
    return np.arctan(np.sqrt(np.expm1(BETA_0 * t + 0.5 * (BETA_1 - BETA_0) * t**2)))


THETA_MIN = float(noise_angle(1.0 / K))
THETA_MAX = float(noise_angle(1.0))


def training_angle(quantile: np.ndarray | float) -> np.ndarray:
    """Quantiles (of values in [0, 1]) of the angles that priors are trained on: uniform in ``sqrt(theta)``."""
    low, high = math.sqrt(THETA_MIN), math.sqrt(THETA_MAX)
    return (low + (high - low) * np.asarray(quantile, dtype=np.float64)) ** 2


def uniform_step_angle(quantile: np.ndarray | float) -> np.ndarray:
    """Quantiles (of values in [0, 1]) of the angle of a uniformly drawn step ``k``."""
    return noise_angle((1.0 + (K - 1.0) * np.asarray(quantile, dtype=np.float64)) / K)


def ode_log_density(
    velocity: Callable[[th.Tensor, float], tuple[th.Tensor, th.Tensor]],
    x: th.Tensor,
    n_steps: int,
    log_terminal: Callable[[th.Tensor], th.Tensor] | None = None,
) -> th.Tensor:
    """Log-density of ``x`` under the probability flow, by RK4: ``log p(x) = log p_1(x_1) + int tr(dv/dx) dtheta``.

    (Song et al. 2021, eq. 39.) The steps are equal in ``u = sqrt(theta)``, which grows like the fourth root of ``t`` at first:
    the velocity of sharp data varies fastest at small noise. On Gaussians and mixtures with deviations of 0.03 to 0.3 the
    error is a half to a quarter of that of equal steps in ``sqrt(t)``.

    :param velocity: ``(x, theta) -> (v, trace of dv/dx)``, of shapes ``(..., d)`` and ``(...)``
    :param x: ``(..., d)``
    :param n_steps: RK4 steps, four evaluations each
    :param log_terminal: log-density at ``t = 1``; default the standard normal
    :return: ``(...)``
    """
    if n_steps < 1:
        raise ValueError(f"The density needs at least one integration step, got n_steps={n_steps}.")
    start = math.sqrt(THETA_MIN)
    step = (math.sqrt(THETA_MAX) - start) / n_steps

    def rates(u: float, state: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        v, trace = velocity(state, u * u)
        return 2.0 * u * v, 2.0 * u * trace  # dtheta = 2 u du

    integral = x.new_zeros(x.shape[:-1])
    for j in range(n_steps):
        u = start + j * step
        k1, d1 = rates(u, x)
        k2, d2 = rates(u + 0.5 * step, x + 0.5 * step * k1)
        k3, d3 = rates(u + 0.5 * step, x + 0.5 * step * k2)
        k4, d4 = rates(u + step, x + step * k3)
        x = x + step / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
        integral = integral + step / 6.0 * (d1 + 2.0 * (d2 + d3) + d4)
    if log_terminal is None:
        return integral - 0.5 * x.square().sum(dim=-1) - 0.5 * x.shape[-1] * math.log(2.0 * math.pi)
    return integral + log_terminal(x)


def sample_angles(n_steps: int) -> np.ndarray:
    """The noise angles of the ``n_steps`` evaluations of :func:`ddim_sample`, falling from ``t = 1``."""
    return np.linspace(math.sqrt(THETA_MAX), math.sqrt(THETA_MIN), n_steps + 1)[:-1] ** 2


def ddim_sample(velocity: Callable[[th.Tensor, float], th.Tensor], noise: th.Tensor, n_steps: int) -> th.Tensor:
    """Deterministic DDIM (Song et al. 2021, eta = 0) from standard normal ``noise`` at ``t = 1``.

    A DDIM step holds the predicted clean action and noise fixed, which turns ``(x, v)`` by the angle of the step:
    ``x' = cos(delta) x - sin(delta) v``. The last step goes to angle 0, the clean action that the model predicts.

    :param velocity: ``(x, theta) -> v``
    :param noise: ``(..., d)``
    :return: ``(..., d)``
    """
    if n_steps < 1:
        raise ValueError(f"Sampling needs at least one denoising step, got n_steps={n_steps}.")
    angles = np.append(sample_angles(n_steps), 0.0)
    x = noise
    for theta, following in itertools.pairwise(angles):
        delta = float(theta - following)
        x = math.cos(delta) * x - math.sin(delta) * velocity(x, float(theta))
    return x
