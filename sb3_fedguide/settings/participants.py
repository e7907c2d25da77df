"""The number of clients that take part in a round."""

from __future__ import annotations


def n_participants(client_fraction: float, n_clients: int) -> int:
    """Clients in each round: the rounded fraction of all, at least one."""
    return max(1, round(client_fraction * n_clients))
