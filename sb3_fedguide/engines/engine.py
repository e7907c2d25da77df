"""Training of groups of clients outside this process, one round at a time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EventCallback

from fed_envs.faults import ClientError
from fed_envs.plain_data import State
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.faults import warn_of_new_episodes
from sb3_fedguide.common.federation import Federation
from sb3_fedguide.common.resumable import SHARED_ENTRIES
from sb3_fedguide.engines.worker import Round, Trained, describe
from sb3_fedguide.seeding import Role
from sb3_fedguide.state.client_axis import join_clients, take_clients


class EngineError(RuntimeError):
    """A worker is lost, and the round cannot be completed."""


class Engine(ABC):
    """Divides the clients into groups that train at the same time; server, evaluation and log stay in the main process.

    Workers keep nothing between rounds, except environments that give no state: in each round, a group's state goes to its
    worker and comes back trained. A run has equal results, checkpoints and files with every engine and any number of workers.

        with Processes(2) as engine:
            engine.attach(model)
            model.learn(total_timesteps)

    :param num_actors: groups of clients; no more than there are clients
    """

    def __init__(self, num_actors: int) -> None:
        self.num_actors = num_actors
        self.groups: list[list[int]] = []
        self._model: Federation | None = None

    def attach(self, model: Federation) -> None:
        """Let the workers train ``model``'s clients from its next round on.

        :raises ValueError: if the model or its environments cannot be sent to other processes
        """
        if model.device.type != "cpu":
            raise ValueError(f"engines train on CPUs, and the device is {model.device}; use device='cpu', or no engine")
        if not model.is_federated:
            raise ValueError(f"{type(model).__name__} needs all clients in one process; leave the engine out")
        for engine in {self, model.engine or self}:
            engine.close()
        n_groups = min(self.num_actors, model.n_clients)
        # Neighbours often need similar time, so groups of every n-th client take equally long.
        self.groups = [list(range(first, model.n_clients, n_groups)) for first in range(n_groups)]
        self._start([describe(model, group) for group in self.groups])
        model.engine, self._model = self, model

    @abstractmethod
    def _start(self, blobs: Sequence[bytes]) -> None:
        """Start one worker per group."""

    @abstractmethod
    def _train(self, rounds: dict[int, Round]) -> dict[int, Trained | ClientError]:
        """Train the groups ``rounds.keys()`` at the same time.

        :raises EngineError: for a worker that is lost
        """

    @abstractmethod
    def _end(self) -> None:
        """End all workers."""

    def close(self) -> None:
        """End all workers; the model's clients then train in this process again."""
        if self._model is not None and self._model.engine is self:
            self._model.engine = None
        self._model = None
        self._end()

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def train_round(self, model: Federation, callbacks: BaseCallback) -> bool:
        """One round of ``model``'s participants; afterwards the model is the same as if they had trained here.

        :raises ClientError: if a client's environment or policy failed
        :raises EngineError: for a worker that is lost
        :raises ValueError: for callbacks that count environment steps
        """
        _check_callbacks(callbacks)
        callbacks.on_rollout_start()
        for role in Role:
            model.streams(role)  # those that a client has not drawn from yet are joined with those of the others
        state = model.save_state()
        steps_at_once = model._active_steps(model._federated_env())
        parts = {k: _part(model, state, group) for k, group in enumerate(self.groups)}
        active = [k for k, group in enumerate(self.groups) if model.present[group].any()]
        try:
            trained = self._train({k: Round(parts[k], model._total_timesteps, steps_at_once) for k in active})
        except BaseException:
            self.close()  # a worker with an unread reply would answer the next round with this round's result
            raise
        for reply in trained.values():
            if isinstance(reply, ClientError):
                raise reply
        replies = {k: reply for k, reply in trained.items() if isinstance(reply, Trained)}
        parts.update({k: reply.state for k, reply in replies.items()})
        self._take(model, state, [parts[k] for k in range(len(self.groups))])
        for k, reply in replies.items():
            if reply.observations is not None:
                model.rollout_buffer.observations[:, self.groups[k]] = reply.observations  # type: ignore[attr-defined]
        model.gather_episodes()
        self._record(model, replies)
        warn_of_new_episodes(sorted(client for reply in replies.values() for client in reply.restarted))
        callbacks.on_rollout_end()
        return True

    def _take(self, model: Federation, state: State, parts: Sequence[State]) -> None:
        """Put the groups' states together in the model's order, and load them."""
        trained = next(k for k, group in enumerate(self.groups) if model.present[group].any())
        parts = [parts[trained], *parts[:trained], *parts[trained + 1 :]]  # shared entries are the first part's
        groups = [self.groups[trained], *self.groups[:trained], *self.groups[trained + 1 :]]
        order = [position for group in groups for position in group]
        joined = join_clients(parts, SHARED_ENTRIES)
        # Gradient steps in which any client took part: in each round, a client that begins later takes part until the end.
        joined["attributes"]["_n_updates"] = max(part["attributes"]["_n_updates"] for part in parts)
        joined = take_clients(joined, np.argsort(order).tolist(), model.n_clients, SHARED_ENTRIES)
        # What belongs to the process and the server has not changed.
        model.load_state({**joined, **{name: state[name] for name in ("identity", "strategy", "random")}})

    def _record(self, model: Federation, replies: dict[int, Trained]) -> None:
        """Log the workers' values: those of single clients unchanged, others averaged over the participants."""
        values: dict[str, list[tuple[float, int]]] = {}
        excluded: dict[str, Any] = {}
        for k, reply in replies.items():
            n_present = int(model.present[self.groups[k]].sum())
            for key, (value, outputs) in reply.metrics.items():
                values.setdefault(key, []).append((value, n_present))
                excluded[key] = outputs
        for key, entries in values.items():
            model.logger.record(key, _combined(key, entries), exclude=excluded[key])


def _part(model: Federation, state: State, group: Sequence[int]) -> State:
    part = take_clients(state, group, model.n_clients, SHARED_ENTRIES)
    clients = [model.client_ids[position] for position in group]
    return {**part, "identity": {**state["identity"], "clients": clients}, "strategy": None}


def _combined(key: str, entries: Sequence[tuple[float, int]]) -> float:
    values = [value for value, _ in entries]
    if key.startswith("time/") or key.endswith(("_max", "/n_updates")):
        return max(values)
    if key.endswith("_min"):
        return min(values)
    if len(set(values)) == 1:
        return values[0]
    return sum(value * weight for value, weight in entries) / sum(weight for _, weight in entries)


def _check_callbacks(callback: BaseCallback) -> None:
    if isinstance(callback, CallbackList):
        for child in callback.callbacks:
            _check_callbacks(child)
    elif isinstance(callback, EventCallback) or not isinstance(callback, RoundCallback):
        raise ValueError(
            f"{type(callback).__name__} counts environment steps, and with an engine these happen in other processes: use a "
            "RoundCallback, or train without an engine"
        )
