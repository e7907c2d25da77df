"""Behaviour cloning of every client's actor on its own data, all clients in lockstep."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence

import numpy as np
import torch as th
from torch import nn

from sb3_fedguide.offline.groups import client_groups, train_together
from sb3_fedguide.offline.progress import StepProgress
from sb3_fedguide.settings.pretraining import DEFAULTS

__all__ = ["clone"]

_BLOCK = 250  # updates whose minibatches are drawn at once, and between two reports of progress


def clone(
    actor: nn.Module,
    observations: Sequence[np.ndarray],
    actions: Sequence[np.ndarray],
    rngs: Sequence[np.random.Generator],
    n_updates: int = DEFAULTS.bc_updates,
    batch_size: int = DEFAULTS.bc_batch_size,
    learning_rate: float = DEFAULTS.bc_learning_rate,
    progress: StepProgress | None = None,
) -> np.ndarray:
    """Fit the mean actions to the data by least squares, in place; a client's result does not depend on the others.

    :param actor: maps observations ``(N, batch, obs_dim)`` to mean actions ``(N, batch, action_dim)``; every parameter
        has the client dimension first
    :param observations: one array ``(n_k, obs_dim)`` per client, normalised as the actor will see them
    :param actions: one array ``(n_k, action_dim)`` per client
    :param rngs: one per client: draws its minibatches
    :param batch_size: rows per client and update
    :return: each client's mean squared error over the last updates (up to 250), ``(N,)``
    :raises ValueError: if the lists do not have one fitting entry per client, or a setting is out of range
    """
    if not observations or not len(observations) == len(actions) == len(rngs):
        raise ValueError(
            "behaviour cloning needs observations, actions and a generator per client, "
            f"got {len(observations)}, {len(actions)} and {len(rngs)}"
        )
    if n_updates < 1 or batch_size < 1:
        raise ValueError(f"n_updates and batch_size must be at least 1, got {n_updates} and {batch_size}")
    sizes = [len(rows) for rows in observations]
    if sizes != [len(rows) for rows in actions] or min(sizes) == 0:
        raise ValueError(f"every client needs as many actions as observations, at least one; got {sizes} observations")

    def job(group: range) -> Callable[[StepProgress | None], np.ndarray]:
        part = _clients_view(actor, group)
        arrays = [observations[k] for k in group], [actions[k] for k in group], [rngs[k] for k in group]
        return lambda report: _clone_group(part, *arrays, n_updates, batch_size, learning_rate, report)

    return np.concatenate(train_together([job(group) for group in client_groups(len(sizes))], progress))


def _clients_view(actor: nn.Module, group: range) -> nn.Module:
    """The module of some neighbouring clients; its parameters are views of those of ``actor``."""
    part = copy.deepcopy(actor)
    for own, whole in zip(part.parameters(), actor.parameters(), strict=True):
        own.data = whole.data[group.start : group.stop]
    return part


def _clone_group(
    actor: nn.Module,
    observations: Sequence[np.ndarray],
    actions: Sequence[np.ndarray],
    rngs: Sequence[np.random.Generator],
    n_updates: int,
    batch_size: int,
    learning_rate: float,
    progress: StepProgress | None,
) -> np.ndarray:
    """As :func:`clone`, for clients that are updated in lockstep."""
    sizes = [len(rows) for rows in observations]
    starts = np.cumsum([0, *sizes[:-1]])
    obs_table = th.from_numpy(np.concatenate(observations).astype(np.float32))
    action_table = th.from_numpy(np.concatenate(actions).astype(np.float32))
    parameters = [parameter for parameter in actor.parameters() if parameter.requires_grad]
    # foreach, not fused: the fused kernel's rounding depends on a client's position in the stack.
    optimizer = th.optim.Adam(parameters, lr=learning_rate, foreach=True)
    n_clients = len(sizes)
    errors = th.zeros(n_clients)
    for start in range(0, n_updates, _BLOCK):
        block = min(_BLOCK, n_updates - start)
        drawn = [
            first + rng.integers(0, size, (block, batch_size)) for rng, size, first in zip(rngs, sizes, starts, strict=True)
        ]
        errors = th.zeros(n_clients)
        for index in th.from_numpy(np.stack(drawn, axis=1).reshape(block, -1)):
            batch_obs = obs_table.index_select(0, index).view(n_clients, batch_size, -1)
            batch_actions = action_table.index_select(0, index).view(n_clients, batch_size, -1)
            loss = (actor(batch_obs) - batch_actions).square().mean(dim=(1, 2))
            optimizer.zero_grad(set_to_none=True)
            loss.sum().backward()
            optimizer.step()
            errors += loss.detach()
        errors /= block
        if progress is not None:
            progress(start + block, n_updates)
    return errors.numpy()
