"""Split a federation's state by clients, and join such parts to one state.

All entries of :meth:`Federation.save_state` have a client axis: the first of arrays and lists. A client with several
environments may have as many neighbouring entries. The algorithm declares an entry that belongs to no client as shared.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any

import numpy as np

from fed_envs.plain_data import TAG, State

__all__ = ["join_clients", "take_clients"]


def take_clients(state: State, positions: Sequence[int], n_clients: int, shared: Collection[str]) -> State:
    """The part of the clients at ``positions``.

    :param state: of ``n_clients`` clients
    :param shared: entries that belong to no client, such as ``"random"``
    :raises ValueError: for an entry without a client axis that is not declared as shared
    """

    def take(values: Sequence[Any], path: str) -> Any:
        (value,) = values
        rows = _rows(value, path, n_clients, positions)
        return value[rows] if isinstance(value, np.ndarray) else [value[row] for row in rows]

    return _walk([state], "", set(shared), take)


def join_clients(parts: Sequence[State], shared: Collection[str]) -> State:
    """The inverse of :func:`take_clients`: one state of all clients, in the order of the parts.

    :param shared: as for :func:`take_clients`; these entries are taken from the first part
    """

    def join(values: Sequence[Any], path: str) -> Any:
        if isinstance(values[0], np.ndarray):
            return np.concatenate(values)
        return [item for value in values for item in value]

    return _walk(parts, "", set(shared), join)


def _walk(values: Sequence[Any], path: str, shared: set[str], combine: Callable[[Sequence[Any], str], Any]) -> Any:
    """Apply ``combine`` to the entries with a client axis of states of one structure."""
    first = values[0]
    if path in shared or _is_scalar(first):
        return first
    if isinstance(first, np.ndarray):
        return combine(values, path)
    if isinstance(first, dict):
        if first.get(TAG) == "dict":
            pairs = [[key, _walk(items, f"{path}.{key}", shared, combine)] for key, items in _pairs(values)]
            return {TAG: "dict", "value": pairs}
        if TAG in first:
            return first
        return {key: _walk([value[key] for value in values], _join(path, key), shared, combine) for key in first}
    if path.startswith("optimizers"):  # a list of optimisers, and of parameters in each
        return [_walk(list(items), f"{path}.", shared, combine) for items in zip(*values, strict=True)]
    return combine(values, path)


def _is_scalar(value: Any) -> bool:
    return value is None or isinstance(value, (bool, int, float, str)) or (isinstance(value, np.ndarray) and value.ndim == 0)


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


def _pairs(values: Sequence[State]) -> Iterator[tuple[Any, list[Any]]]:
    for entries in zip(*[value["value"] for value in values], strict=True):
        yield entries[0][0], [item for _, item in entries]


def _rows(value: np.ndarray | list[Any], path: str, n_clients: int, positions: Sequence[int]) -> list[int]:
    """Indices of the entries of the clients at ``positions``."""
    each, rest = divmod(len(value), n_clients)
    if rest or not each:
        raise ValueError(
            f"{path} in the state has {len(value)} entries for {n_clients} clients: an algorithm's state has one entry per "
            "client, or is declared as Held(..., shared=True)"
        )
    return [position * each + copy for position in positions for copy in range(each)]
