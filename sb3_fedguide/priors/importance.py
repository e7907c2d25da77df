"""Self-normalised importance weights from the policy that acted to the prior."""

from __future__ import annotations

import numpy as np

#: Log-densities further below their mean than this are floored: a model's tail is no evidence.
FLOOR_NATS = 20.0


def importance_weights(log_ratio: np.ndarray, supported: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Truncated, self-normalised weights ``w_t = pibar(a_t|s_t) / pi_old(a_t|s_t)`` over a whole sample (paper, below Eq. 11).

    ``E[w | s] = 1`` in every state, so one normaliser serves all states. Weights above ``sqrt(n)`` times their mean are
    truncated there (Ionides 2008).

    :param log_ratio: ``(n,)``
    :param supported: ``(n,)`` bool; rows that get no weight at all are ``False``
    :return: weights with mean one (all zero where nothing is supported), and their effective sample size in [0, n]
    """
    log_ratio = np.asarray(log_ratio, dtype=np.float64)
    supported = np.isfinite(log_ratio) if supported is None else supported & np.isfinite(log_ratio)
    if not supported.any():
        return np.zeros_like(log_ratio), 0.0
    log_ratio = np.maximum(log_ratio, log_ratio[supported].mean() - FLOOR_NATS)
    weights = np.where(supported, np.exp(log_ratio - log_ratio[supported].max()), 0.0)
    weights = np.minimum(weights, np.sqrt(len(weights)) * weights.mean())
    weights /= weights.mean()
    return weights, float(weights.sum() ** 2 / np.square(weights).sum())
