"""Quality of a baseline, and the best blend of two (paper, Lemma 2)."""

from __future__ import annotations

import numpy as np


def explained_variances(values: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """``1 - Var(returns - values) / Var(returns)`` per client.

    :param values: ``(n_clients, n_rows)``, like ``returns``
    :return: ``(n_clients,)``; NaN if returns do not vary
    """
    variance = returns.var(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(variance > 0, 1 - (returns - values).var(axis=1) / variance, np.nan)


def advantage_variances(returns: np.ndarray, baseline: np.ndarray) -> np.ndarray:
    """``Var(G - V)`` of each client: the variance of the advantage with baseline ``V`` (paper, Lemma 2).

    :param returns: Monte Carlo returns G, ``(n_clients, n_rows)``, like ``baseline``
    :return: ``(n_clients,)``
    """
    return (returns - baseline).var(axis=1, dtype=np.float64)


def residual_correlations(returns: np.ndarray, online: np.ndarray, dice: np.ndarray) -> np.ndarray:
    """``kappa_i = Corr(G - V_theta, V_phi - V_theta)`` (paper, Lemma 2).

    At beta* the advantage's variance is ``Var(G - V_theta) (1 - kappa_i^2)``: the largest reduction that V_phi allows.

    :param returns: Monte Carlo returns G, ``(n_clients, n_rows)``, like the values ``online`` and ``dice``
    :return: ``(n_clients,)``; 0 if one of the two does not vary
    """
    residual, correction = _centred_difference(returns, online), _centred_difference(dice, online)
    scale = np.sqrt((residual**2).mean(axis=1) * (correction**2).mean(axis=1))
    return np.divide((residual * correction).mean(axis=1), scale, out=np.zeros_like(scale), where=scale > 0)


def _centred_difference(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """``first - second`` minus its mean over rows; zero if it varies only by single precision's rounding."""
    difference = first.astype(np.float64) - second
    difference -= difference.mean(axis=1, keepdims=True)
    rounding = 1e-6 * np.maximum(np.abs(first).max(axis=1), np.abs(second).max(axis=1))
    return np.where((difference.std(axis=1) > rounding)[:, None], difference, 0.0)


def optimal_blend(returns: np.ndarray, online: np.ndarray, dice: np.ndarray) -> np.ndarray:
    """Weight beta of the online critic that minimises the variance of ``G - beta V_theta - (1 - beta) V_phi``.

    With ``d = V_phi - V_theta``: ``beta* = 1 - Cov(G - V_theta, d) / Var(d)``, clipped to [0, 1].

    :param returns: Monte Carlo returns G, ``(n_clients, n_rows)``, like the values ``online`` and ``dice``
    :return: ``(n_clients,)``; 1 if the two values differ by a constant
    """
    difference = (dice - online).astype(np.float64)
    difference -= difference.mean(axis=1, keepdims=True)
    residual = (returns - online).astype(np.float64)
    residual -= residual.mean(axis=1, keepdims=True)
    variance = (difference**2).mean(axis=1)
    covariance = (residual * difference).mean(axis=1)
    share = np.divide(covariance, variance, out=np.zeros_like(variance), where=variance > 1e-12)
    return 1 - np.clip(share, 0.0, 1.0)


def baseline_metrics(returns: np.ndarray, online: np.ndarray, dice: np.ndarray, blend: np.ndarray) -> dict[str, np.ndarray]:
    """Explained variance of each baseline, and the quantities of the paper's Lemma 2, ``(n_clients,)`` each.

    :param returns: Monte Carlo returns G, ``(n_clients, n_rows)``, like the three baselines
    """
    best = optimal_blend(returns, online, dice)
    return {
        "beta_optimal": best,
        "residual_correlation": residual_correlations(returns, online, dice),
        "advantage_variance_online": advantage_variances(returns, online),
        "advantage_variance_blend": advantage_variances(returns, blend),
        "advantage_variance_optimal": advantage_variances(returns, best[:, None] * online + (1 - best[:, None]) * dice),
        "explained_variance_online": explained_variances(online, returns),
        "explained_variance_dice": explained_variances(dice, returns),
        "explained_variance_blend": explained_variances(blend, returns),
    }
