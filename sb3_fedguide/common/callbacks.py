"""Callbacks with events for communication rounds."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EventCallback
from tqdm.auto import tqdm

from fed_envs.plain_data import State
from sb3_fedguide.common.digits import shown
from sb3_fedguide.server.rounds import Coordinator
from sb3_fedguide.state.held import load_held, save_held

if TYPE_CHECKING:
    from sb3_fedguide.common.federation import Federation


class RoundCallback(BaseCallback):
    """A callback with four more events: before a round, after local training, after the exchange, after the round's log.

    A method that shares its policy replaces the clients' own parameters in the exchange: :meth:`_on_local_training_end` sees
    the policies that the clients deploy, :meth:`_on_round_end` those that the server broadcast.
    """

    model: Federation  # type: ignore[assignment]
    #: attributes that a checkpoint holds; those of base classes are added
    state_attributes: ClassVar[tuple[str, ...]] = ()

    def save_state(self) -> State:
        """This callback's part of a checkpoint, as plain data."""
        return save_held(self)

    def load_state(self, state: State) -> None:
        """Restore the state from :meth:`save_state`, before the training starts."""
        load_held(self, state)

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
        """Before the rollout; the participants are known."""

    def _on_local_training_end(self) -> None:
        """After ``train()``, before the exchange."""

    def _on_round_end(self) -> None:
        """After the exchange, before the round's log is written."""

    def _on_round_logged(self) -> bool:
        """After the whole round; false ends the training."""
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
    """Plays the server in process: carries uploads to the model's ``strategy`` and broadcasts back.

    Over a network :func:`sb3_fedguide.deployment.serve.serve` takes its place; clients, strategy and :class:`Coordinator` are
    the same.
    """

    state_attributes = ("bytes_counted",)

    def __init__(self) -> None:
        super().__init__()
        self.server = Coordinator(None)

    @property
    def bytes_counted(self) -> list[int]:
        """See :attr:`Coordinator.bytes_counted`."""
        return self.server.bytes_counted

    @bytes_counted.setter
    def bytes_counted(self, saved: list[int]) -> None:
        self.server.bytes_counted = saved

    def save_state(self) -> State:
        delays = self.model.delays
        return {**super().save_state(), **({} if delays is None else {"delays": delays.save_state()})}

    def load_state(self, state: State) -> None:
        """:raises ValueError: for the state of a run with other delays"""
        if "bytes_up" in state:  # of an earlier version
            state = {**state, "bytes_counted": [state["bytes_up"], state["bytes_down"]]}
        super().load_state({name: state[name] for name in self.state_attributes})
        if (self.model.delays is None) != ("delays" not in state):
            ran, goes_on = ("with", "without") if self.model.delays is None else ("without", "with")
            raise ValueError(f"the run was {ran} simulated delays and cannot go on {goes_on} them; see simulate_delays()")
        if self.model.delays is not None:
            self.model.delays.load_state(state["delays"])

    def _on_training_start(self) -> None:
        model = self.model
        if model.round == 0:
            self.bytes_counted = [*model.pretraining_bytes] * 2
        self.server.strategy = model.strategy
        self.server.outdated = {client for client, outdated in zip(model.client_ids, model.outdated, strict=True) if outdated}
        if model.delays is not None and model.round == 0:
            model.delays.restart()
        while self.server.needs_setup:
            self._exchange(model.present)

    def _on_round_start(self) -> None:
        model = self.model
        if model.delays is not None:
            model.take_part(model.delays.begin(model.round, model.client_fraction, model.test_work()))
        missing = np.flatnonzero(model.present & model.outdated).tolist()
        model.take_broadcasts({index: self.server.catch_up(model.client_ids[index]) for index in missing})
        self._remember_outdated()

    def _on_round_end(self) -> None:
        delays, uploading = self.model.delays, self.model.present
        if delays is not None:
            uploading = delays.end()
            for key, value in delays.metrics.items():
                self.logger.record(key, value)
        if self.model.strategy is not None and uploading.any():
            self._exchange(uploading)

    def _exchange(self, uploading: np.ndarray) -> None:
        """Exchange payloads with the clients ``uploading``, ``(n_clients,)`` bool."""
        model = self.model
        started = time.perf_counter()
        present = {client: index for index, client in enumerate(model.client_ids) if uploading[index]}
        uploads = {client: model.outgoing(index) for client, index in present.items()}
        broadcasts = self.server.exchange(model.round, uploads, set(model.client_ids) - present.keys())
        model.take_broadcasts({present[client]: broadcast for client, broadcast in broadcasts.items()})
        for client in self.server.rejected:
            model.record_client(client, "rejected", 1.0)
        for complaint in self.server.complaints:
            warnings.warn(f"round {model.round}: {complaint}", stacklevel=1)
        self._remember_outdated()
        for key, value in {**self.server.metrics, **model.upload_metrics()}.items():
            self.logger.record(key, value)
        self.logger.record("time/exchange", time.perf_counter() - started)

    def _remember_outdated(self) -> None:
        """Store it in the model, so that checkpoints and archives hold it."""
        self.model.outdated[:] = [client in self.server.outdated for client in self.model.client_ids]


class RoundProgressCallback(RoundCallback):
    """A progress bar over all rounds of a run with the client-average return of finished training episodes.

    Their actions are sampled; evaluations are deterministic and have other returns.
    """

    def __init__(self) -> None:
        super().__init__()
        self.bar: Any = None

    def _on_training_start(self) -> None:
        per_round = self.model.rollout_size * self.model.n_participants
        done = self.model.round
        total = done - (self.model.num_timesteps - self.model._total_timesteps) // per_round
        self.bar = tqdm(total=total, initial=done, desc=type(self.model).__name__, unit="round", dynamic_ncols=True)

    def _on_round_end(self) -> None:
        mean_return = shown(self.model.mean_episode_return())
        self.bar.set_postfix_str(f"training return {mean_return}, sampled actions", refresh=False)
        self.bar.update()

    def _on_training_end(self) -> None:
        self.bar.close()
