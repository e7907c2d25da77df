"""A run's table of transport plans: the share of every client's head in every other client's prior."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sb3_fedguide.server.ot_moe import given_heads


@dataclass(frozen=True)
class Plans:
    """A run's plans.

    :param rounds: with a plan, ``(n_rounds,)``; 0 is the plan before the first round
    :param clients: numbers of all clients in any plan, ``n_clients``
    :param weights: of the experts in each client's mixture, ``(n_rounds, n_clients, n_experts)``; NaN where a client
        was absent
    """

    rounds: np.ndarray
    clients: list[int]
    weights: np.ndarray

    @property
    def loads(self) -> np.ndarray:
        """Share of the plan that each expert carries, ``(n_rounds, n_experts)``; even where it is ``1 / n_experts``."""
        return np.nanmean(self.weights, axis=1)

    @property
    def effective_experts(self) -> np.ndarray:
        """Exponential of the entropy of each client's weights, ``(n_rounds, n_clients)``; 1 is a single expert."""
        return np.exp(_entropy(self.weights, axis=2))

    @property
    def effective_clients(self) -> np.ndarray:
        """Exponential of the entropy of what each expert is routed, ``(n_rounds, n_experts)``; 1 is a single client."""
        there = np.nan_to_num(self.weights)
        return np.exp(_entropy(there / np.maximum(there.sum(axis=1, keepdims=True), np.finfo(float).tiny), axis=1))

    @property
    def listening(self) -> np.ndarray:
        """Share of client i's head in client j's prior at [round, j, i], ``(n_rounds, n_clients, n_clients)``.

        NaN where j was absent, and in round 0, whose experts are single heads, not averages.
        """
        n = len(self.clients)
        given = np.full((len(self.rounds), n, n), np.nan)
        for index, plan in enumerate(self.weights):
            if self.rounds[index] > 0:
                there = np.flatnonzero(~np.isnan(plan[:, 0]))
                given[index, there] = 0.0
                given[index][np.ix_(there, there)] = given_heads(plan[there])
        return given


def _entropy(shares: np.ndarray, axis: int) -> np.ndarray:
    return -(shares * np.log(np.maximum(shares, np.finfo(float).tiny))).sum(axis=axis)


def read_plans(path: Path) -> Plans:
    """The table that a :class:`PlanCallback` wrote. If a round is in it twice, the later rows count.

    :raises ValueError: if there is no plan, or the file is damaged
    """
    found: dict[tuple[int, int], list[float]] = {}
    lengths = set()
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.reader(file)
            header = next(reader, [])
            for row in reader:
                found[int(row[0]), int(row[1])] = [float(weight) for weight in row[2:]]
                lengths.add(len(row))
    except (OSError, ValueError, IndexError, csv.Error) as error:
        raise ValueError(f"{path} is not a run's table of transport plans ({error})") from None
    if header[:2] != ["round", "client"] or not lengths <= {len(header)} or len(header) < 3:
        raise ValueError(f"{path} is not a run's table of transport plans: its rows and its header do not fit")
    if not found:
        raise ValueError(f"{path} has no transport plan yet")
    rounds, clients = sorted({round for round, _ in found}), sorted({client for _, client in found})
    weights = np.full((len(rounds), len(clients), len(header) - 2), np.nan)
    for (round, client), shares in found.items():
        weights[rounds.index(round), clients.index(client)] = shares
    return Plans(np.array(rounds), clients, weights)
