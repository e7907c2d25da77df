"""Callbacks of a run on the command line: its costs, and its evaluations over rounds."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from sb3_fedguide.cli.signals import StopSignals
from sb3_fedguide.common.callbacks import ExchangeCallback, RoundCallback
from sb3_fedguide.common.checkpoint import CheckpointCallback
from sb3_fedguide.common.evaluation import Evaluation, FederatedEvalCallback

TIMES = ("rollout", "train", "exchange")


class CostCallback(RoundCallback):
    """Adds up seconds by part of a round, and the bytes of the exchange."""

    state_attributes = ("seconds", "round_seconds", "pretraining_seconds", "total_seconds", "rejected")

    def __init__(self) -> None:
        super().__init__()
        self.seconds = dict.fromkeys(TIMES, 0.0)
        self.round_seconds: list[float] = []
        #: rounds in which the server rejected a client's upload, by client
        self.rejected: dict[int, int] = {}
        #: of the offline stage, which the caller measures
        self.pretraining_seconds = 0.0
        self._earlier_seconds, self._began = 0.0, time.perf_counter()
        self._exchange: ExchangeCallback | None = None

    @property
    def total_seconds(self) -> float:
        """Seconds since the callback was made, and in earlier parts of a resumed run."""
        return self._earlier_seconds + time.perf_counter() - self._began

    @total_seconds.setter
    def total_seconds(self, earlier: float) -> None:
        self._earlier_seconds, self._began = earlier, time.perf_counter()

    @property
    def n_bytes(self) -> dict[str, int]:
        """Bytes that all clients together sent and received, and the part of them before the first round."""
        names = ("bytes_up", "bytes_down", "offline_bytes_up", "offline_bytes_down")
        return {name: 0 if self._exchange is None else getattr(self._exchange.server, name) for name in names}

    def _on_training_start(self) -> None:
        self._exchange = next((hook for hook in self.locals["rounds"] if isinstance(hook, ExchangeCallback)), None)
        self._started = time.perf_counter()

    def _on_round_end(self) -> None:
        for name in TIMES:
            self.seconds[name] += float(self.logger.name_to_value.get(f"time/{name}", 0.0))
        for client in self.model.client_ids:
            if f"client_{client}/rejected" in self.logger.name_to_value:
                self.rejected[client] = self.rejected.get(client, 0) + 1
        now = time.perf_counter()
        self.round_seconds.append(now - self._started)
        self._started = now


class DeployedCallback(RoundCallback):
    """Remembers the policies after local training: the exchange may replace them before the model is saved."""

    state_attributes = ("_state",)

    def __init__(self) -> None:
        super().__init__()
        self._state: dict[str, np.ndarray] = {}

    def _on_local_training_end(self) -> None:
        self._state = self.model.acting_arrays()

    def replaced(self) -> dict[str, np.ndarray]:
        """The deployed policies' parameters if they differ from the model's own, else nothing."""
        now = self.model.acting_arrays()
        same = all(np.array_equal(array, now[name]) for name, array in self._state.items())
        return {} if same else self._state


class StopCallback(RoundCallback):
    """Ends the training after the round in which a signal came, with a checkpoint if checkpoints are on."""

    def __init__(self, signals: StopSignals, checkpoint: CheckpointCallback | None) -> None:
        super().__init__()
        self._signals, self._checkpoint = signals, checkpoint

    def _on_training_start(self) -> None:
        self._signals.can_wait = True

    def _on_round_logged(self) -> bool:
        if self._signals.received is None:
            return True
        if self._checkpoint is not None:
            self._checkpoint.save()
        return False

    def _on_training_end(self) -> None:
        self._signals.can_wait = False


class RunEvalCallback(FederatedEvalCallback):
    """Keeps the average return of every evaluation, and the seconds of all evaluations."""

    state_attributes = ("seconds", "curves", "client_curves")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.seconds = 0.0
        #: policy to ``[round, client-average return]`` of each evaluation
        self.curves: dict[str, list[tuple[int, float]]] = {}
        #: policy to ``[round, environment steps of all clients, each client's return]`` of each evaluation
        self.client_curves: dict[str, list[tuple[int, int, list[float]]]] = {}

    def _evaluate(self, policy: str, round: int) -> Evaluation:
        started = time.perf_counter()
        evaluation = super()._evaluate(policy, round)
        self.seconds += time.perf_counter() - started
        self.curves.setdefault(policy, []).append((round, evaluation.average))
        returns = [float(f"{value:.6g}") for value in evaluation.client_returns]
        self.client_curves.setdefault(policy, []).append((round, self.model.environment_steps, returns))
        return evaluation
