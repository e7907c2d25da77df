"""The server's transport plan, round by round: a table that a run writes, and what it says about who listens to whom."""

from __future__ import annotations

import csv
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fed_envs.files import GrowingTable
from fed_envs.state import State
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.monitoring.charts import flat
from sb3_fedguide.server.ot_moe import OTMoE, given_heads

_METRIC = "federated/effective_experts"  # logged in the rounds in which there was a plan


class PlanCallback(RoundCallback):
    """Writes the plan of every round to a CSV: a row per client that it routes, with the client's weight of each expert.

    Round 0 is the plan with which the first round begins. It does nothing for a method without a transport plan.

    :param path: file to write
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__()
        self.table = GrowingTable(path)

    def save_state(self) -> State:
        return {} if self.table.size is None else {"csv_size": self.table.size}

    def load_state(self, state: State) -> None:
        """:raises ValueError: where rows are missing that the state counts on"""
        self.table.cut(state["csv_size"])

    def _on_training_start(self) -> None:
        self._server = next((server for server in flat(self.model.strategy) if isinstance(server, OTMoE)), None)
        if self._server is not None:
            self.table.begin(("round", "client", *(f"expert_{m}" for m in range(self._server.n_experts))))

    def _on_round_start(self) -> None:
        if self.model.round == 0:
            self._write()

    def _on_round_end(self) -> None:
        if _METRIC in self.logger.name_to_value:
            self._write()

    def _write(self) -> None:
        if self._server is None or self._server.plan is None:
            return
        rows = self._server.plan / self._server.plan.sum(axis=1, keepdims=True)
        self.table.add(
            [
                [self.model.round, client, *(f"{weight:.4g}" for weight in row)]
                for client, row in zip(self._server.routed, rows, strict=True)
            ]
        )


@dataclass(frozen=True)
class Plans:
    """A run's plans.

    :param rounds: that have one, ``(n_rounds,)``; 0 is the one before the first round
    :param clients: numbers of all that were ever routed, ``n_clients``
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

        NaN where j was absent, and in round 0: its experts are heads as they are, not averages.
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
    """What a :class:`PlanCallback` wrote. Where a round is there twice, what came later counts.

    :raises ValueError: where there is no plan, or the file is damaged
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
