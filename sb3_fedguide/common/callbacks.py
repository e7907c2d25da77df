"""Callbacks that know of communication rounds."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EventCallback
from tqdm import tqdm

from fed_envs.state import State, declared_state, load_declared

if TYPE_CHECKING:
    from sb3_fedguide.common.federation import Federation


class RoundCallback(BaseCallback):
    """A callback with four more events: before a round, after local training, after the exchange, after the round's log.

    Between the two, a method that shares its policy replaces the clients' own parameters: what a client would deploy is
    seen in :meth:`_on_local_training_end`, what the server broadcast in :meth:`_on_round_end`.
    """

    model: Federation  # type: ignore[assignment]
    #: attributes that a checkpoint holds; those of base classes are added
    state_attributes: ClassVar[tuple[str, ...]] = ()

    def save_state(self) -> State:
        """What a checkpoint has to know of this callback, as plain data."""
        return declared_state(self)

    def load_state(self, state: State) -> None:
        """Go on from what :meth:`save_state` returned, before the training starts."""
        load_declared(self, state)

    def _on_step(self) -> bool:
        return True

    def on_round_start(self) -> None:
        self._on_round_start()

    def on_local_training_end(self) -> None:
        self._on_local_training_end()

    def on_round_end(self) -> None:
        self._on_round_end()

    def on_round_logged(self) -> bool:
        return self._on_round_logged()

    def _on_round_start(self) -> None:
        """Before the rollout; who takes part is known."""

    def _on_local_training_end(self) -> None:
        """After ``train()``, before the exchange."""

    def _on_round_end(self) -> None:
        """After the exchange, before the round's log is written."""

    def _on_round_logged(self) -> bool:
        """After everything that belongs to the round; false ends the training."""
        return True


def round_callbacks(callback: BaseCallback | None) -> Iterator[RoundCallback]:
    """The round callbacks in a tree of SB3 callbacks, in order."""
    if isinstance(callback, RoundCallback):
        yield callback
    elif isinstance(callback, CallbackList):
        for child in callback.callbacks:
            yield from round_callbacks(child)
    elif isinstance(callback, EventCallback):
        yield from round_callbacks(callback.callback)


class ExchangeCallback(RoundCallback):
    """Plays the server in process: carries uploads to the model's ``strategy`` and broadcasts back, and counts bytes.

    A deployment over a network replaces this callback by its transport; clients and strategy stay the same.
    """

    state_attributes = ("bytes_up", "bytes_down")

    def __init__(self) -> None:
        super().__init__()
        self.bytes_up = 0
        self.bytes_down = 0

    def _on_training_start(self) -> None:
        if self.model.round == 0:
            self.bytes_up, self.bytes_down = self.model.pretraining_bytes
        strategy = self.model.strategy
        while strategy is not None and strategy.needs_setup:
            self._exchange()

    def _on_round_start(self) -> None:
        model = self.model
        for index in np.flatnonzero(model.present & model.outdated).tolist():
            broadcast = model.strategy.catch_up(model.client_ids[index]) if model.strategy is not None else {}
            model.receive(index, broadcast)
            model.outdated[index] = False
            self.bytes_down += payload_bytes({index: broadcast})

    def _on_round_end(self) -> None:
        if self.model.strategy is not None:
            self._exchange()

    def _exchange(self) -> None:
        model, strategy = self.model, self.model.strategy
        assert strategy is not None
        started = time.perf_counter()
        present = {client: index for index, client in enumerate(model.client_ids) if model.present[index]}
        uploads = {client: model.upload(index) for client, index in present.items()}
        broadcasts = strategy.exchange(model.round, uploads)
        for client, broadcast in broadcasts.items():
            model.receive(present[client], broadcast)
        for client, reason in strategy.rejected.items():
            warnings.warn(f"round {model.round}: the server rejects the upload of client {client}: {reason}", stacklevel=1)
            model.record_client(client, "rejected", 1.0)
        if any(broadcasts.values()):  # what the others received is what the absent and the rejected have missed
            model.outdated |= ~model.present
            model.outdated[[present[client] for client in strategy.rejected]] = True
        up, down = payload_bytes(uploads), payload_bytes(broadcasts)
        self.bytes_up += up
        self.bytes_down += down
        for key, value in strategy.metrics.items():
            self.logger.record(f"federated/{key}", value)
        self.logger.record("federated/bytes_up", up)
        self.logger.record("federated/bytes_down", down)
        self.logger.record("federated/bytes_total", self.bytes_up + self.bytes_down)
        self.logger.record("time/exchange", time.perf_counter() - started)


def payload_bytes(payloads: dict[int, dict[str, np.ndarray]]) -> int:
    """Size of all arrays of all clients' payloads, in bytes."""
    return sum(array.nbytes for payload in payloads.values() for array in payload.values())


class RoundProgressCallback(RoundCallback):
    """A progress bar over rounds with the current client-average return of finished training episodes."""

    def __init__(self, total_timesteps: int) -> None:
        super().__init__()
        self.total_timesteps = total_timesteps
        self.bar: Any = None

    def _on_training_start(self) -> None:
        per_round = self.model.rollout_size * self.model.n_participants
        remaining = max(0, self.total_timesteps - self.model.num_timesteps)
        self.bar = tqdm(total=-(-remaining // per_round), desc=type(self.model).__name__, unit="round", dynamic_ncols=True)

    def _on_round_end(self) -> None:
        self.bar.set_postfix({"return": f"{self.model.mean_episode_return():.1f}"}, refresh=False)
        self.bar.update()

    def _on_training_end(self) -> None:
        self.bar.close()
