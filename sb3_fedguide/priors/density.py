"""The variance-preserving diffusion, and log-densities and samples by its probability-flow ODE.

``x_t = alpha(t) x_0 + sigma(t) eps`` with ``d log alpha = -b(t) / 2 dt`` and ``b(t) = 0.1 + 19.9 t``: the limit of DDPM's
K = 1000 steps with beta from 1e-4 to 2e-2, step ``k`` (from 0) at ``t = (k + 1) / K``.

Since ``alpha^2 + sigma^2 = 1``, noise levels are angles, ``alpha = cos(theta)`` and ``sigma = sin(theta)``, and the
probability flow takes its plainest form (Salimans and Ho 2022, appendix D): ``dx/dtheta = v`` with the velocity
``v = (eps - sigma x) / alpha``. Here a model is a function that returns ``v``.
"""

from __future__ import annotations

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
    from_clean: bool = True,
) -> th.Tensor:
    """Log-density of ``x`` under the probability flow, by RK4: ``log p(x) = log p_1(x_1) + int tr(dv/dx) dtheta``.

    (Song et al. 2021, eq. 39.) The steps are equal in ``u = sqrt(theta)``, which grows like the fourth root of ``t`` at first:
    the velocity of sharp data varies fastest at small noise. On Gaussians and mixtures with deviations of 0.03 to 0.3 the
    error is a half to a quarter of that of equal steps in ``sqrt(t)``.

    :param velocity: ``(x, theta) -> (v, trace of dv/dx)``, of shapes ``(..., d)`` and ``(...)``
    :param x: ``(..., d)``
    :param n_steps: RK4 steps, four evaluations each
    :param log_terminal: log-density at ``t = 1``; default the standard normal
    :param from_clean: density at noise angle 0, else at the smallest trained one. Between them ``v`` grows linearly in
        ``theta``, so half a step with its value at the end crosses the gap; without it, the density at three deviations
        of 0.1 is 0.05 nats off.
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
    if from_clean:
        v, trace = velocity(x, THETA_MIN)
        x = x + 0.5 * THETA_MIN * v
        integral = integral + 0.5 * THETA_MIN * trace
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
    """Angles of the ``n_steps`` evaluations of :func:`flow_sample`, falling from ``t = 1`` in equal steps of the cube root."""
    return np.linspace(THETA_MAX ** (1 / 3), THETA_MIN ** (1 / 3), n_steps + 1)[:-1] ** 3


def flow_sample(
    velocity: Callable[[th.Tensor, float], th.Tensor], noise: th.Tensor, n_steps: int, second_order: bool = True
) -> th.Tensor:
    """Sample by the probability flow from standard normal ``noise`` at ``t = 1``; one evaluation per step.

    A DDIM step (Song et al. 2021, eta = 0) holds the predicted clean action ``x_0 = alpha x - sigma v`` fixed. With
    ``second_order`` it is extrapolated from the last two predictions (DPM-Solver++ 2M, Lu et al. 2022), at the same price:
    with ten steps the Kolmogorov-Smirnov distance to one-dimensional mixtures falls from 0.04 to 0.01. The first step and
    the last, to the clean action, are plain DDIM.

    :param velocity: ``(x, theta) -> v``
    :param noise: ``(..., d)``
    :return: ``(..., d)``
    """
    if n_steps < 1:
        raise ValueError(f"Sampling needs at least one denoising step, got n_steps={n_steps}.")
    angles = [float(angle) for angle in sample_angles(n_steps)]
    x, earlier = noise, None
    for j, theta in enumerate(angles):
        clean = math.cos(theta) * x - math.sin(theta) * velocity(x, theta)
        if j == n_steps - 1:
            return clean
        following = angles[j + 1]
        predicted = clean
        if second_order and earlier is not None:
            # Linear in the log signal-to-noise ratio, taken at the middle of the step.
            ratio = math.log(math.tan(theta) / math.tan(following)) / math.log(math.tan(angles[j - 1]) / math.tan(theta))
            predicted = clean + 0.5 * ratio * (clean - earlier)
        shrink = math.sin(following) / math.sin(theta)
        x = shrink * x + (math.cos(following) - shrink * math.cos(theta)) * predicted
        earlier = clean
    return x
