"""Checks, once per round, of the environments' outputs and of the trained policies."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
import torch as th
from torch import nn

from fed_envs.faults import ClientError


@contextmanager
def in_round(round: int) -> Iterator[None]:
    """Add the round to errors of clients."""
    try:
        yield
    except ClientError as error:
        raise error.in_round(round) from error.__cause__


def warn_of_new_episodes(client_ids: Sequence[int]) -> None:
    """Warn, once for the same clients, that their episodes began anew because their environments give no state."""
    if client_ids:
        warnings.warn(
            f"the environments of client{'s' if len(client_ids) > 1 else ''} {', '.join(map(str, client_ids))} give no state, "
            "so their episodes began anew; for an exact resume, give the environments save_state() and load_state(state)",
            stacklevel=2,
        )


def check_experience(client_ids: Sequence[int], experience: Mapping[str, np.ndarray]) -> None:
    """:param experience: name to ``(n_steps, n_clients, ...)``, in the order of a round's steps
    :raises ClientError: for the client whose environment was the first to return a non-finite value
    """
    first: tuple[int, int, str] | None = None
    for name, array in experience.items():
        if not np.isfinite(array).all():
            wrong = ~np.isfinite(array).all(axis=tuple(range(2, array.ndim)))
            step, client = np.argwhere(wrong)[0].tolist()
            if first is None or step < first[0]:
                first = step, client, name
    if first is not None:
        step, client, name = first
        raise ClientError(
            [client_ids[client]], f"its environment returned {name} that is not finite, in step {step} of the round"
        )


def check_policies(client_ids: Sequence[int], policy: nn.Module) -> None:
    """:param policy: its parameters are ``(n_clients, ...)``
    :raises ClientError: for all clients whose parameters are not finite
    """
    finite, names = np.ones(len(client_ids), dtype=bool), []
    for name, parameter in policy.named_parameters():
        if not th.isfinite(parameter).all():
            finite &= th.isfinite(parameter.detach()).flatten(1).all(dim=1).cpu().numpy()
            names.append(name)
    if names:
        broken = [client for client, whole in zip(client_ids, finite, strict=True) if not whole]
        raise ClientError(
            broken,
            f"the policy has diverged: {names[0]} is no longer finite; try a smaller learning_rate, "
            "normalize=True, or a smaller scale of rewards",
        )
