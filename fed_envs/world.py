"""Base classes of all client environments: one client's environment, and the batch that steps several of them together.

A :class:`Batch` is the one definition of a world's observation, reward and termination, written with NumPy over a leading
axis of environments. A single environment is a batch of one, :class:`fed_envs.FederatedVecEnv` is a batch of many, so that
the two agree bit for bit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar, Generic, TypeVar

import gymnasium
import numpy as np
from pydantic import ValidationError

from fed_envs.clients import Client
from fed_envs.metadata import Family, describe, load_family, parse_family
from fed_envs.state import IDENTITY, attributes, set_attributes

EnvT = TypeVar("EnvT", bound="ClientEnv")
ClientT = TypeVar("ClientT", bound=Client)

_IDENTITY = (*IDENTITY, "family", "client", "_batch")

#: Actions ``(n, action_dim)`` float32 for observations ``(n, obs_dim)`` and a generator.
ScriptedPolicy = Callable[[np.ndarray, np.random.Generator], np.ndarray]

#: Runs a function that consumes an iterator of rows, perhaps in several threads that share the iterator.
Runner = Callable[[Callable[[Iterator[int]], None], Sequence[int]], None]


def run_here(work: Callable[[Iterator[int]], None], rows: Sequence[int]) -> None:
    """The runner without threads."""
    work(iter(rows))


def action_dtype(space: gymnasium.spaces.Space) -> type | np.dtype:
    """The dtype of actions in :meth:`Batch.step`: float32, and integers for discrete actions."""
    return np.float32 if isinstance(space, gymnasium.spaces.Box) else np.dtype(space.dtype)


class Batch(ABC, Generic[EnvT]):
    """Environments of one world, stepped together. The arrays are overwritten by every step.

    :param envs: the environments; they own the simulator's state, the batch reads and writes it in place
    """

    def __init__(self, envs: Sequence[EnvT]) -> None:
        n = len(envs)
        space = envs[0].observation_space
        self.envs = envs
        self.observations = np.zeros((n, *space.shape), dtype=space.dtype)
        self.rewards = np.zeros(n)
        self.terminated = np.zeros(n, dtype=bool)
        self.truncated = np.zeros(n, dtype=bool)  # by the environment itself; time limits are applied outside

    @abstractmethod
    def step(self, actions: np.ndarray, rows: Sequence[int], run: Runner = run_here) -> None:
        """Step the environments in ``rows`` and update the arrays there (other rows' rewards have no meaning).

        :param actions: ``(n, *action_space.shape)`` float32, or integers for discrete actions, one row per environment
        :param rows: the environments to step
        :param run: how to go through the rows
        """

    @abstractmethod
    def info(self, row: int) -> dict[str, Any]:
        """The info of the last step of one environment, as a single environment returns it."""

    def infos(self) -> list[dict[str, Any]]:
        """New dictionaries for the infos of the vectorised step, one per environment."""
        return [{} for _ in self.envs]


class ClientEnv(gymnasium.Env[np.ndarray, np.ndarray], ABC, Generic[ClientT]):
    """One client's environment.

    :param client: the client's id
    :param family: name of a family that ships with the package (the registered ids set it)
    :param metadata: the user's own clients: the path of a metadata file, or its content, or a :class:`fed_envs.Family` (then
        the spec of ``gymnasium.make`` cannot be written as JSON; that of :meth:`fed_envs.Family.make` can)
    :param render_mode: one of ``metadata["render_modes"]``
    :param parameters: client fields to replace, e.g. ``floor_priority=True``
    :raises ValueError: for unknown families, clients, fields and values, and for metadata that do not fit the registered id
    """

    world: ClassVar[str]
    batch_class: ClassVar[type[Batch[Any]]]
    #: increased whenever the scripted policy changes, so that cached data of the old policy are not reused
    script_version: ClassVar[int] = 1
    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own interface)
    observation_space: gymnasium.spaces.Box
    action_space: gymnasium.spaces.Space

    def __init__(
        self,
        client: int = 0,
        family: str | None = None,
        metadata: str | dict[str, Any] | Family | None = None,
        render_mode: str | None = None,
        **parameters: Any,
    ) -> None:
        self.family = _resolve(family, metadata)
        if self.family.world != self.world:
            raise ValueError(
                f"{self.family.name} is a {self.family.world} world, {type(self).__name__} is for {self.world} worlds"
            )
        self.client: ClientT = _with_parameters(self.family, client, parameters)  # type: ignore[assignment]
        self.render_mode = render_mode

    def _start(self) -> None:
        """Subclasses call this at the end of their constructors."""
        if self.render_mode is not None and self.render_mode not in self.metadata["render_modes"]:
            modes = ", ".join(self.metadata["render_modes"]) or "nothing"
            raise ValueError(f"{self.family.name} renders {modes}, not {self.render_mode!r}")
        self._batch: Batch[Any] = self.batch_class([self])

    @classmethod
    def scripted_policy(cls, family: Family, client: int) -> ScriptedPolicy | None:
        """A behaviour policy for a client's offline data, strictly inside the action bounds, if the world has one."""
        return None

    @abstractmethod
    def _reset(self) -> tuple[np.ndarray, dict[str, Any]]:
        """Draw a start state from ``self.np_random``; return the observation and the info."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        observation, info = self._reset()
        if self.render_mode == "human":
            self.render()
        return observation, info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        action = np.asarray(action, dtype=action_dtype(self.action_space))
        if action.shape != self.action_space.shape:
            raise ValueError(f"expected an action of shape {self.action_space.shape}, got {action.shape}")
        batch = self._batch
        batch.step(action[None], (0,))
        if self.render_mode == "human":
            self.render()
        # The time limit belongs to Gymnasium's wrapper, so this is never a truncation.
        return batch.observations[0].copy(), float(batch.rewards[0]), bool(batch.terminated[0]), False, batch.info(0)

    def save_state(self) -> dict[str, Any]:
        """The state of the episode, without the random generator: arrays, JSON values, and lists and dicts of these.

        Worlds whose state is more than the plain attributes of the environment override this and :meth:`load_state`; see
        :func:`fed_envs.state.save_state` for the whole state of an environment and its wrappers.
        """
        return attributes(self, _IDENTITY)

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`save_state` returned, in an environment of the same client."""
        set_attributes(self, state)

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        del state["_batch"]  # it holds views into the simulator's memory
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._batch = self.batch_class([self])


def _resolve(family: str | None, metadata: str | dict[str, Any] | Family | None) -> Family:
    if metadata is None:
        if family is None:
            raise ValueError("say which clients: family=NAME or metadata=PATH")
        return load_family(family)
    if isinstance(metadata, Family):
        own = metadata
    elif isinstance(metadata, dict):
        own = parse_family(metadata, "metadata")
    elif isinstance(metadata, str):
        own = load_family(metadata)
    else:
        raise ValueError(
            "metadata must be a path given as str, or a metadata file's content as dict, so that the environment's spec "
            f"can be written as JSON; got {type(metadata).__name__}"
        )
    if family is not None:
        registered = load_family(family)
        for field in ("world", "backbone", "max_episode_steps"):
            if getattr(own, field) != getattr(registered, field):
                raise ValueError(
                    f"the metadata of {own.name} have {field} {getattr(own, field)!r}, but this id is registered for "
                    f"{getattr(registered, field)!r}; use fed_envs.load_family(...).make(client) instead"
                )
    return own


def _with_parameters(family: Family, client: int, parameters: dict[str, Any]) -> Client:
    own = family.client(client)
    if not parameters:
        return own
    try:
        return type(own).model_validate({**own.model_dump(), **parameters, "client": own.client})
    except ValidationError as error:
        raise ValueError("\n".join(f"{family.name}, client {client}: {line}" for line in describe(error))) from None
