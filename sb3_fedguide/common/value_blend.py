"""How good a baseline is, and the best blend of two (paper, Lemma 2)."""

from __future__ import annotations

import numpy as np


def explained_variances(values: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """``1 - Var(returns - values) / Var(returns)`` per client.

    :param values: ``(n_clients, n_rows)``, like ``returns``
    :return: ``(n_clients,)``; NaN where returns do not vary
    """
    variance = returns.var(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(variance > 0, 1 - (returns - values).var(axis=1) / variance, np.nan)


def optimal_blend(returns: np.ndarray, online: np.ndarray, dice: np.ndarray) -> np.ndarray:
    """Weight beta of the online critic that minimises the variance of ``G - beta V_theta - (1 - beta) V_phi``.

    With ``d = V_phi - V_theta``: ``beta* = 1 - Cov(G - V_theta, d) / Var(d)``, clipped to [0, 1].

    :param returns: Monte Carlo returns G, ``(n_clients, n_rows)``, like the values ``online`` and ``dice``
    :return: ``(n_clients,)``; 1 where the two values differ by a constant
    """
    difference = (dice - online).astype(np.float64)
    difference -= difference.mean(axis=1, keepdims=True)
    residual = (returns - online).astype(np.float64)
    residual -= residual.mean(axis=1, keepdims=True)
    variance = (difference**2).mean(axis=1)
    covariance = (residual * difference).mean(axis=1)
    share = np.divide(covariance, variance, out=np.zeros_like(variance), where=variance > 1e-12)
    return 1 - np.clip(share, 0.0, 1.0)
