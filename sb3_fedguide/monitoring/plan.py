"""The server's transport plan, round by round, as a table that a run writes; :mod:`sb3_fedguide.benchmark.plans` reads it."""

from __future__ import annotations

import os

from fed_envs.files import GrowingTable
from fed_envs.plain_data import State
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.monitoring.charts import flat
from sb3_fedguide.server.ot_moe import OTMoE

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
        """:raises ValueError: if rows are missing that the state counts on"""
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
