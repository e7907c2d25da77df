"""The user's own environments: how they are made, checked and stepped, and how checkpoints save them."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation
from stable_baselines3.common import monitor
from stable_baselines3.common.monitor import Monitor

from fed_envs.faults import ClientError, ContractError, RowError
from fed_envs.plain_data import State
from fed_envs.state import gives_state
from fed_envs.world import Batch, Runner, run_here

logger = logging.getLogger(__name__)

EnvFactory = Callable[[], gymnasium.Env]

_STEP = "(observation, reward, terminated, truncated, info)"


class FactoryBatch(Batch[Any]):
    """The user's own environments, stepped one by one; they report truncations themselves."""

    def __init__(self, envs: Sequence[gymnasium.Env]) -> None:
        super().__init__(envs)  # type: ignore[arg-type]
        self._infos: list[dict[str, Any]] = [{} for _ in envs]

    def step(self, actions: np.ndarray, rows: Sequence[int], run: Runner = run_here) -> None:
        row, shape = -1, self.observations.shape[1:]
        try:
            for row in rows:
                result = check_step(self.envs[row].step(actions[row]), shape)
                self.observations[row], reward, terminated, truncated, self._infos[row] = result
                self.rewards[row], self.terminated[row] = _scalar(reward), _scalar(terminated)
                self.truncated[row] = _scalar(truncated)
        except Exception as error:
            raise RowError(row) from error

    def info(self, row: int) -> dict[str, Any]:
        return dict(self._infos[row])

    def infos(self) -> list[dict[str, Any]]:
        return [dict(info) for info in self._infos]


class Positions:
    """The position of environments without ``save_state``: their last seed, and the number of steps since then.

    :param envs: all environments; nothing is recorded for those that give their state
    """

    def __init__(self, envs: Sequence[gymnasium.Env]) -> None:
        #: environments without ``save_state``, ``(num_envs,)`` bool
        self.ordinary = np.array([not gives_state(env) for env in envs], dtype=bool)
        #: those of them whose position differs from the recorded one
        self.lost = np.zeros(len(envs), dtype=bool)
        self.seeds: list[int | None] = [None] * len(envs)
        #: steps since the environment was seeded
        self.moves = np.zeros(len(envs), dtype=np.int64)

    def reset(self, row: int, seed: int | None) -> None:
        """The environment in ``row`` was reset, from outside and not at an episode's end."""
        self.lost[row] = False
        self.seeds[row], self.moves[row] = (self.seeds[row], self.moves[row] + 1) if seed is None else (seed, 0)

    def save(self, row: int) -> State:
        return {"seed": self.seeds[row], "moves": int(self.moves[row])}

    def load(self, row: int, state: State, is_the_same: bool) -> None:
        """:param is_the_same: whether observation and episode equal those of the state"""
        here = is_the_same and not self.lost[row] and self.save(row) == state
        self.seeds[row], self.moves[row], self.lost[row] = state["seed"], state["moves"], not here


def make_envs(factories: Sequence[EnvFactory], client_ids: Sequence[int], n_copies: int) -> list[gymnasium.Env]:
    """Call each client's function once for each of its copies.

    :raises ClientError: if a function raises, or does not return a new environment
    """
    envs: list[gymnasium.Env] = []
    for client in client_ids:
        for _ in range(n_copies):
            try:
                env = factories[client]()
            except Exception as error:
                hint = "; it is called without arguments: bind them with functools.partial" if _lacks_argument(error) else ""
                reason = f"the function that makes its environment raised {type(error).__name__}: {error}{hint}"
                raise ClientError([client], reason) from error
            if not isinstance(env, gymnasium.Env):
                hint = "; of a VecEnv, give the function of one environment" if hasattr(env, "num_envs") else ""
                reason = f"the function that makes its environment returned a {type(env).__name__}, which is no gymnasium.Env"
                raise ClientError([client], reason + hint)
            envs.append(env)
    if len({id(env.unwrapped) for env in envs}) != len(envs):
        raise ValueError("each function must return a new environment at every call, not the same one again")
    return envs


def check_spaces(envs: Sequence[gymnasium.Env], client_ids: Sequence[int]) -> None:
    """:raises ValueError: for environments that cannot be trained together"""
    n_copies, first = len(envs) // len(client_ids), envs[0]
    for row, env in enumerate(envs):
        for kind in ("observation_space", "action_space"):
            if not isinstance(getattr(env, kind, None), spaces.Space):
                raise ClientError([client_ids[row // n_copies]], f"its environment has no {kind}; set it in the constructor")
    for row, env in enumerate(envs):
        for kind in ("observation_space", "action_space"):
            if getattr(env, kind) != getattr(first, kind):
                raise ValueError(
                    f"all clients must share their spaces: client {client_ids[row // n_copies]} has {kind} "
                    f"{getattr(env, kind)}, client {client_ids[0]} has {getattr(first, kind)}"
                )


def flattened(env: gymnasium.Env) -> gymnasium.Env:
    """The environment itself if its observations are flat arrays, else Gymnasium's flattening wrapper around it.

    :raises ValueError: if its observations cannot be flattened
    """
    space = env.observation_space
    if isinstance(space, spaces.Box) and len(space.shape) == 1:
        return env
    if not space.is_np_flattenable:
        raise ValueError(f"observations must have one size, to be flat arrays of numbers, but their space is {space}")
    wrapped = FlattenObservation(env)
    _say_flattened(str(space), str(wrapped.observation_space.shape))
    return wrapped


@functools.cache  # once for all copies of all clients
def _say_flattened(space: str, shape: str) -> None:
    logger.warning("observations of the space %s are flattened (gymnasium.wrappers.FlattenObservation) to the shape %s", space,
                   shape)  # fmt: skip


def check_monitor_files(envs: Sequence[gymnasium.Env], client_ids: Sequence[int]) -> None:
    """:raises ValueError: if the ``Monitor`` of two environments write to one file"""
    n_copies = len(envs) // len(client_ids)
    owners: dict[str, int] = {}
    for row, env in enumerate(envs):
        client = client_ids[row // n_copies]
        while isinstance(env, gymnasium.Wrapper):
            if isinstance(env, Monitor) and env.results_writer is not None:
                path = os.path.realpath(env.results_writer.file_handler.name)
                if path in owners:
                    raise ValueError(
                        f"Monitor of client {client} writes to {path}, and so does that of client {owners[path]}: give each a "
                        "name of its own, or none (a function is called once for each of n_envs_per_client)"
                    )
                owners[path] = client
            env = env.env


@contextmanager
def monitors_without_files() -> Iterator[None]:
    """Inside this context a new ``Monitor`` writes no file: a second call of a function would overwrite the first file."""
    before = monitor.ResultsWriter
    monitor.ResultsWriter = lambda *args, **kwargs: None  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        monitor.ResultsWriter = before  # type: ignore[misc]


def check_shape(observation: Any, shape: tuple[int, ...]) -> None:
    """:raises ValueError: for an observation of another shape, which NumPy may broadcast silently"""
    if np.shape(observation) != shape:
        raise ValueError(f"the observation has the shape {np.shape(observation)}, the observation space {shape}")


def check_step(result: Any, shape: tuple[int, ...]) -> Any:
    """The result of a step, unchanged.

    :raises ContractError: if it is not Gymnasium's five values
    """
    if not isinstance(result, (tuple, list)) or len(result) != 5 or not isinstance(result[4], dict):
        raise ContractError(f"has to return {_STEP}, as in Gymnasium, and returned {_described(result)}")
    check_shape(result[0], shape)
    return result


def reset_env(env: gymnasium.Env, seed: int | None, options: dict[str, Any] | None, shape: tuple[int, ...]) -> Any:
    """Reset an environment as Stable-Baselines3 does: arguments that are not given are not passed.

    :return: observation and info
    :raises ContractError: if it returns anything else
    """
    given: dict[str, Any] = {**({} if seed is None else {"seed": seed}), **({"options": options} if options else {})}
    result = env.reset(**given)
    if not isinstance(result, (tuple, list)) or len(result) != 2 or not isinstance(result[1], dict):
        raise ContractError(f"has to return (observation, info), as in Gymnasium, and returned {_described(result)}")
    check_shape(result[0], shape)
    return result


def own_record(info: dict[str, Any], episode: dict[str, Any]) -> dict[str, Any]:
    """The episode's statistics from the environment's ``Monitor`` or ``RecordEpisodeStatistics``, else ``episode``."""
    theirs = info.get("episode")
    if not isinstance(theirs, dict):
        return episode
    try:
        return {**theirs, "r": float(theirs["r"]), "l": int(theirs["l"]), "t": float(theirs.get("t", episode["t"]))}
    except (TypeError, KeyError, ValueError):
        return episode


def _scalar(value: Any) -> Any:
    """The number in an array of one element; other values are unchanged."""
    return value.item() if isinstance(value, np.ndarray) else value


def _described(result: Any) -> str:
    if not isinstance(result, (tuple, list)):
        return f"a {type(result).__name__}"
    return f"{len(result)} values ({', '.join(type(value).__name__ for value in result)})"


def _lacks_argument(error: Exception) -> bool:
    return isinstance(error, TypeError) and "required positional argument" in str(error)
