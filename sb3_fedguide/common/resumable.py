"""The whole state of a federation between two rounds, as plain data: the content of a checkpoint."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import recursive_getattr
from torch import nn

from fed_envs import FederatedVecEnv
from fed_envs.plain_data import State, freeze, thaw
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.checkpoint import CheckpointError, newest_checkpoint
from sb3_fedguide.common.normalization import FederatedNormalizer
from sb3_fedguide.server.delays import Delays
from sb3_fedguide.server.strategy import Strategy
from sb3_fedguide.state.array_files import array_mismatches
from sb3_fedguide.state.held import Held, load_held, save_held
from sb3_fedguide.state.optimizer_state import load_optimizer, optimizer_state
from sb3_fedguide.state.stacked import to_arrays, to_tensors

#: Entries of a federation's state that belong to no client.
SHARED_ENTRIES = frozenset({"identity", "shared", "strategy", "random"})

SelfResumable = TypeVar("SelfResumable", bound="Resumable")


class Resumable(BaseAlgorithm):
    """Mixin of a federation that saves and loads its state between two rounds.

    A new object with the same settings that loads the state goes on bit for bit like the object that saved it. An
    algorithm's additions to the state are named only in its own ``state_attributes``.
    """

    #: attributes that change during training, by name or as :class:`Held`; those of the base classes are added
    state_attributes: ClassVar[tuple[str | Held, ...]] = (
        "seed", "num_timesteps", "round", "_n_updates", "_episode_num", "_current_progress_remaining", "pretrained",
        "pretraining_bytes", "present", "outdated", "has_trained", "test_steps", "episode_infos", "_streams", "_last_obs",
        "_last_episode_starts",
    )  # fmt: skip
    #: simulated time, see :func:`sb3_fedguide.common.participation.simulate_delays`; none if ``None``
    delays: Delays | None = None
    normalizer: FederatedNormalizer
    strategy: Strategy | None
    client_ids: list[int]
    n_envs_per_client: int
    rollout_size: int
    family: Any
    #: of the resumed run, until its callbacks exist
    _callback_states: Sequence[State] = ()
    #: by attribute, the functions given to :meth:`hold`
    _makers: Mapping[str, Callable[[], Any] | None] = MappingProxyType({})

    @abstractmethod
    def _optimizers(self) -> list[th.optim.Optimizer]:
        """All optimisers."""

    def _identity(self) -> dict[str, Any]:
        """Settings that must be the same in the model that loads a state."""
        return {
            "algorithm": type(self).__name__,
            "family": None if self.family is None else self.family.content_hash,
            "clients": list(self.client_ids),
            "n_envs_per_client": self.n_envs_per_client,
            "rollout_size": self.rollout_size,
        }

    def _setup_state(self) -> None:
        """Declare the state of a model with these settings, by :meth:`hold`; the last step of ``_setup_model()``.

        It is called again when training begins and when a state is loaded, and does not change existing state."""

    def hold(self, **makers: Callable[[], Any] | None) -> None:
        """Declare attributes, for :meth:`_setup_state`. If a saved model does not have one, it is made when it is first read.

        :param makers: by attribute, a function that makes its initial value, in its final shapes; ``None`` if the model does
            not need it with its settings
        :raises TypeError: for a value instead of a function, and for an attribute with a value in the class
        """
        for name, make in makers.items():
            if make is not None and (not callable(make) or isinstance(make, nn.Module)):
                raise TypeError(
                    f"hold({name}=...) takes a function that makes it, 'lambda: ...', and not the {type(make).__name__}"
                )
            if hasattr(type(self), name):
                raise TypeError(
                    f"{type(self).__name__}.{name} hides what hold({name}=...) makes; only annotate it in the class"
                )
            if make is None:
                setattr(self, name, None)
            elif vars(self).get(name, make) is None:
                delattr(self, name)
        self._makers = {**self._makers, **makers}

    def holds(self, name: str) -> bool:
        """Whether an attribute has a value, or will have one when it is first read."""
        return self._makers.get(name) is not None or recursive_getattr(self, name, None) is not None

    def begin_anew(self, names: Iterable[str]) -> None:
        """Reset attributes to their initial values from :meth:`hold`.

        :raises ValueError: for attributes without an initial value; then none is reset
        """
        names = list(names)
        unknown = [name for name in names if self._makers.get(name) is None]
        if unknown:
            raise ValueError(
                f"{', '.join(unknown)} must be reset, but {type(self).__name__} has no initial value for it: give hold() a "
                "function that makes it, in _setup_state()"
            )
        for name in names:
            vars(self).pop(name, None)

    if not TYPE_CHECKING:  # a type checker would accept every attribute

        def __getattr__(self, name: str) -> Any:
            make = self._makers.get(name)
            if make is None:
                return object.__getattribute__(self, name)  # raises AttributeError
            value = make()
            setattr(self, name, value)
            return value

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_makers"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        if "policy" in state:  # saved after _setup_model()
            self._setup_state()

    def save_state(self) -> State:
        """Policies, optimisers, server, normalisation, random streams, environments and counters; only between two rounds.

        :raises ValueError: if something cannot be part of it, with the remedy
        """
        state: State = {
            "identity": self._identity(),
            "attributes": save_held(self),
            "shared": save_held(self, shared=True),
            "policy": to_arrays(self.policy.state_dict()),
            "optimizers": [optimizer_state(optimizer) for optimizer in self._optimizers()],
            "normalizer": to_arrays(self.normalizer.state_dict()),
            "strategy": None if self.strategy is None else self.strategy.save_state(),
            "env": self._federated_env().save_state(),
            # Nothing here draws from the processes' own generators; a user's environment or algorithm may.
            "random": {"torch": th.get_rng_state().numpy().copy(), "numpy": freeze(np.random.get_state())},
        }
        forgotten = self._forgotten(state["attributes"].keys() | state["shared"].keys())
        if forgotten:
            raise ValueError(
                f"{type(self).__name__} keeps arrays in {', '.join(forgotten)}, which no checkpoint would hold: name them in "
                "its state_attributes, or in _excluded_save_params() if every round makes them anew"
            )
        return state

    def load_state(self, state: State) -> None:
        """Load a state of :meth:`save_state`; ``learn(remaining_timesteps, reset_num_timesteps=False)`` then goes on.

        :raises ValueError: for the state of another algorithm, other clients or other sizes
        """
        for name, own in self._identity().items():
            if state["identity"].get(name) != own:
                raise ValueError(f"the state does not fit: its {name} is {state['identity'].get(name)!r}, here it is {own!r}")
        mismatches = array_mismatches(state["policy"], to_arrays(self.policy.state_dict()))
        if mismatches:
            raise ValueError(f"the state's policies do not fit: {mismatches[0]}")
        held = {**state["attributes"], **state["shared"]}
        for name, make in self._makers.items():
            if name in held and (make is None) != (held[name] is None):
                theirs, ours = ("holds", "none") if make is None else ("holds no", "one")
                raise ValueError(
                    f"the state does not fit: it {theirs} {name}, and a {type(self).__name__} with these settings has {ours}; "
                    "make the model with the settings of the one that gave the state"
                )
        load_held(self, held)
        self._setup_state()
        self.policy.load_state_dict(to_tensors(state["policy"]))
        for optimizer, saved in zip(self._optimizers(), state["optimizers"], strict=True):
            load_optimizer(optimizer, saved)
        self.normalizer.load_state_dict(to_tensors(state["normalizer"]))
        if self.strategy is not None:
            self.strategy.load_state(state["strategy"])
        self._federated_env().load_state(state["env"])
        th.set_rng_state(th.from_numpy(state["random"]["torch"].copy()))
        np.random.set_state(thaw(state["random"]["numpy"]))

    def begin_lost_episodes(self) -> list[int]:
        """Begin new episodes in environments whose state :meth:`load_state` could not restore.

        :return: the clients that lost an episode
        """
        rows, observations, clients = self._federated_env().begin_lost_episodes()
        if len(rows):
            assert isinstance(self._last_obs, np.ndarray) and self._last_episode_starts is not None
            self._last_obs[rows], self._last_episode_starts[rows] = observations, True
            self.normalizer.returns.reshape(-1)[rows] = 0.0
        return clients

    def resume(self: SelfResumable, folder: str | Path) -> SelfResumable:
        """Load the newest intact checkpoint of a :class:`CheckpointCallback` in ``folder``.

        The next ``learn(remaining_timesteps, callbacks, reset_num_timesteps=False)`` goes on from there, with callbacks of
        the same classes as in the run that wrote it.

        :raises ValueError: if there is none, none is intact, or it does not fit
        """
        found = newest_checkpoint(folder)
        if found is None:
            raise ValueError(f"there is no checkpoint in {folder}")
        path, state = found
        try:
            self.load_state(state["model"])
            self._callback_states = [*state["callbacks"]]
        except (KeyError, TypeError, IndexError, RuntimeError, AttributeError) as error:
            raise ValueError(f"{path} does not fit this version or algorithm: {error!r}") from error
        return self

    def _resume_callbacks(self, callbacks: Iterable[RoundCallback]) -> None:
        """Give the callbacks of a resumed run their part of the checkpoint, by class and order.

        :raises CheckpointError: if one is missing, or its part does not fit
        """
        waiting = list(self._callback_states)
        for callback in callbacks:
            match = next((saved for saved in waiting if saved["class"] == type(callback).__name__), None)
            if match is not None:
                waiting.remove(match)
                try:
                    callback.load_state(match["state"])
                except ValueError as error:
                    raise CheckpointError(str(error)) from error
        self._callback_states = ()
        if waiting:
            raise CheckpointError(
                "the checkpoint holds the state of callbacks that this run does not have: "
                f"{', '.join(saved['class'] for saved in waiting)}; give learn() the callbacks of the resumed run"
            )

    def _federated_env(self) -> FederatedVecEnv:
        env = self.get_env()
        if not isinstance(env, FederatedVecEnv):
            raise ValueError("a federation without environments has no state to save or load; give it some with set_env()")
        return env

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_callback_states", "_makers"]

    def _forgotten(self, saved: Collection[str]) -> list[str]:
        """Attributes with arrays that are neither saved nor declared as transient."""
        transient = set(self._excluded_save_params())
        return [
            name for name, value in vars(self).items() if name not in saved and name not in transient and _holds_arrays(value)
        ]


def _holds_arrays(value: Any) -> bool:
    if isinstance(value, Mapping):
        return any(map(_holds_arrays, value.values()))
    if isinstance(value, (list, tuple)):
        return any(map(_holds_arrays, value))
    return isinstance(value, (np.ndarray, th.Tensor))
