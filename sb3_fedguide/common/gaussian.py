"""Diagonal Gaussians with a leading client dimension: the few closed forms that the losses need."""

from __future__ import annotations

import math

import torch as th

LOG_2PI = math.log(2 * math.pi)


def log_prob(mean: th.Tensor, log_std: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Log-density of raw (unclipped) actions.

    :param mean: ``(n_clients, batch, action_dim)``
    :param log_std: ``(n_clients, action_dim)``, independent of the state
    :param actions: ``(n_clients, batch, action_dim)``
    :return: ``(n_clients, batch)``
    """
    log_std = log_std.unsqueeze(1)
    return -0.5 * (((actions - mean) * th.exp(-log_std)) ** 2 + 2 * log_std + LOG_2PI).sum(dim=-1)


def entropy(log_std: th.Tensor) -> th.Tensor:
    """Differential entropy in nats, ``(n_clients,)``; ``log_std`` as in :func:`log_prob`."""
    return (log_std + 0.5 * (1 + LOG_2PI)).sum(dim=-1)


def kl_divergence(mean_p: th.Tensor, log_std_p: th.Tensor, mean_q: th.Tensor, log_std_q: th.Tensor) -> th.Tensor:
    """Exact ``KL(p || q)`` per state, ``(n_clients, batch)``; arguments as in :func:`log_prob`."""
    log_std_p, log_std_q = log_std_p.unsqueeze(1), log_std_q.unsqueeze(1)
    variance_ratio = th.exp(2 * (log_std_p - log_std_q))
    distance = ((mean_p - mean_q) * th.exp(-log_std_q)) ** 2
    return 0.5 * (variance_ratio + distance - 1 - 2 * (log_std_p - log_std_q)).sum(dim=-1)
