"""All clients of a family side by side, as one Stable-Baselines3 ``VecEnv``."""

from __future__ import annotations

import copy
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from fed_envs.factories import (
    EnvFactory,
    FactoryBatch,
    Positions,
    check_monitor_files,
    check_spaces,
    flattened,
    make_envs,
    monitors_without_files,
    own_record,
    reset_env,
)
from fed_envs.faults import ClientError, ContractError, RowError, run_rows, watched
from fed_envs.metadata import Family, load_family
from fed_envs.plain_data import State
from fed_envs.registration import environment_class
from fed_envs.seeding import integer_seed
from fed_envs.state import load_state, save_state
from fed_envs.world import Batch, action_dtype

#: Waking a thread costs about as much as five simulator steps, so each thread gets at least this many environments.
MIN_ROWS_PER_THREAD = 8


class FederatedVecEnv(VecEnv):
    """The clients of a family, some copies of each, stepped together.

    Environments are ordered client by client: index = position in ``client_ids`` * ``n_envs_per_client`` + copy. Each has its
    own random stream, so that a client's trajectory does not depend on the other clients. Finished environments are reset at
    once, as SB3 expects; ``infos[i]`` of a finished one has ``terminal_observation``, ``TimeLimit.truncated`` and ``episode``
    (``r`` return, ``l`` length, ``t`` seconds since the start, as of ``Monitor``). The info of an unfinished one is empty,
    except for ``success`` and ``is_success`` if the world has them: filling it would cost more than the arithmetic of the
    step.

    Pickles and copies contain the state of simulators and random streams, so that a copy continues exactly like the original.

    :param family: a family's name, the path of a metadata file, a :class:`fed_envs.Family`, or a list of functions that make
        an environment, one per client (those are stepped one by one, and their infos are passed on; observations that are
        not flat arrays are flattened)
    :param n_envs_per_client: copies of each client's environment
    :param clients: ids of the clients in this object; all by default
    :param num_threads: largest number of threads that step the simulators, each at least eight of them; the result does not
        depend on it. Two threads are faster on an idle machine; on a busy one they wait for each other.
    :param role: which of a federation's random streams to use (training, evaluation, ...), see :meth:`seed`
    :param render_mode: ``"rgb_array"`` or ``"human"``
    :raises ValueError: for unknown families and clients, and for environments whose spaces differ
    """

    def __init__(
        self,
        family: str | os.PathLike[str] | Family | Sequence[EnvFactory],
        n_envs_per_client: int = 1,
        clients: Sequence[int] | None = None,
        num_threads: int = 1,
        role: int = 0,
        render_mode: str | None = None,
    ) -> None:
        if n_envs_per_client < 1:
            raise ValueError(f"n_envs_per_client must be at least 1, got {n_envs_per_client}")
        if num_threads < 1:
            raise ValueError(f"num_threads must be at least 1, got {num_threads}")
        self.family: Family | None = None
        if isinstance(family, (str, os.PathLike, Family)):
            self.family = load_family(family)
            self.name = self.family.name
            make = environment_class(self.family.world)
            factories: list[EnvFactory] = [
                lambda client=client: make(client=client, metadata=self.family, render_mode=render_mode)  # type: ignore[misc]
                for client in range(self.family.n_clients)
            ]
        else:
            self.name, factories = "custom", list(family)
            if not factories or not all(callable(factory) for factory in factories):
                raise ValueError(
                    "a list of environments must have one function per client, each returning a new environment; of "
                    "registered ids, make a family with fed_envs.gymnasium_family(ids)"
                )
            if render_mode is not None:
                raise ValueError("environments from functions bring their own render_mode; give it there")
        self.client_ids = _checked_clients(clients, len(factories), self.name)
        self.n_clients = len(self.client_ids)
        self.n_envs_per_client = n_envs_per_client
        self.num_threads = num_threads
        self.role = role
        self.envs = make_envs(factories, self.client_ids, n_envs_per_client)
        check_spaces(self.envs, self.client_ids)
        check_monitor_files(self.envs, self.client_ids)
        #: of the environments themselves
        self.raw_observation_space: spaces.Space = self.envs[0].observation_space
        self.envs = [flattened(env) for env in self.envs]
        super().__init__(len(self.envs), self.envs[0].observation_space, self.envs[0].action_space)
        self._active = np.ones(self.num_envs, dtype=bool)
        self._lengths = np.zeros(self.num_envs, dtype=np.int64)
        self._returns = np.zeros(self.num_envs)
        self._max_steps = self.family.max_episode_steps if self.family is not None else sys.maxsize
        self._actions: np.ndarray | None = None
        self._start_time = time.time()
        self._pool: ThreadPoolExecutor | None = None
        self._pool_process = os.getpid()
        self._batch = self._make_batch()
        self._factories = None if self.family is not None else factories
        self._positions = Positions(self.envs)

    def copies(self, n_envs_per_client: int, role: int) -> FederatedVecEnv:
        """The same clients with another number of copies and other random streams, for example for evaluation.

        :raises ValueError: for an unpickled environment of the user's own functions, which do not pickle
        """
        source = self.family if self.family is not None else self._factories
        if source is None:
            raise ValueError("the functions that made these environments are gone; make a FederatedVecEnv from them again")
        with monitors_without_files():
            return FederatedVecEnv(source, n_envs_per_client, self.client_ids, self.num_threads, role)

    def reordered(self, clients: Sequence[int]) -> FederatedVecEnv:
        """The same environments in their current state, with the clients in the order ``clients``; it replaces this one.

        :raises ValueError: for other clients
        """
        if sorted(clients) != sorted(self.client_ids):
            raise ValueError(f"{list(clients)} is no order of the clients {self.client_ids}")
        first = {client: position * self.n_envs_per_client for position, client in enumerate(self.client_ids)}
        rows = [first[client] + copy for client in clients for copy in range(self.n_envs_per_client)]
        other = copy.copy(self)
        other.client_ids, other._factories = list(clients), self._factories
        for name in ("envs", "_seeds", "_options", "reset_infos"):
            setattr(other, name, [getattr(self, name)[row] for row in rows])
        for name in ("_active", "_lengths", "_returns"):
            setattr(other, name, getattr(self, name)[rows])
        other._batch = other._make_batch()
        other._batch.observations[:] = self._batch.observations[rows]
        return other

    def _make_batch(self) -> Batch[Any]:
        if self.family is None:
            return FactoryBatch(self.envs)
        return type(self.envs[0]).batch_class(self.envs)  # type: ignore[attr-defined]

    @property
    def active(self) -> np.ndarray:
        """``(num_envs,)`` bool, writable: inactive environments are not stepped (same observation, reward 0, not done)."""
        return self._active

    @active.setter
    def active(self, mask: np.ndarray) -> None:
        self._active[:] = mask

    def seed(self, seed: int | None = None) -> Sequence[int]:
        """Seed the next reset: copy ``c`` of client ``k`` gets the stream ``(role, k, c)`` of ``seed``.

        :param seed: the federation's seed; drawn at random if ``None``
        :return: the environments' seeds
        """
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        seeds = [integer_seed(seed, self.role, k, c) for k in self.client_ids for c in range(self.n_envs_per_client)]
        self._seeds = list(seeds)
        return seeds

    def reset(self) -> np.ndarray:
        for row in range(self.num_envs):
            self._reset_row(row, self._seeds[row], self._options[row])
            self._positions.reset(row, self._seeds[row])
        self._reset_seeds()
        self._reset_options()
        return self._batch.observations.copy()

    def _reset_row(self, row: int, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        try:
            observation, self.reset_infos[row] = reset_env(self.envs[row], seed, options, self._batch.observations.shape[1:])
        except Exception as error:
            raise self._fault([row], "reset()", error) from error
        self._batch.observations[row] = observation
        self._lengths[row] = 0
        self._returns[row] = 0.0

    def _fault(self, rows: Sequence[int], call: str, error: Exception) -> ClientError:
        """The error to raise for an exception of the environments ``rows``."""
        clients = sorted({row // self.n_envs_per_client for row in rows})
        what = "" if isinstance(error, ContractError) else f"raised {type(error).__name__}: "
        hint = "; as in Gymnasium, reset() takes seed and options" if "unexpected keyword argument" in str(error) else ""
        reason = f"{call} of its environment {what}{error}{hint}"
        return ClientError([self.client_ids[client] for client in clients], reason)

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        if self._actions is None:
            raise ValueError("step_wait() without step_async(actions) before it")
        batch, actions, active = self._batch, self._actions, self._active
        self._actions = None
        if self.family is not None:
            actions = np.asarray(actions, dtype=action_dtype(self.action_space))
            if actions.shape != (self.num_envs, *self.action_space.shape):  # type: ignore[misc]
                raise ValueError(f"expected actions of shape {(self.num_envs, *self.action_space.shape)}, got {actions.shape}")  # type: ignore[misc]
        all_active = bool(active.all())
        rows = range(self.num_envs) if all_active else np.flatnonzero(active).tolist()
        if not np.isfinite(actions if all_active else actions[active]).all():
            # The simulator would only warn in a log file, and continue without any torque.
            row = next(row for row in rows if not np.isfinite(actions[row]).all())
            seen, client = batch.observations[row], self.client_ids[row // self.n_envs_per_client]
            if not np.isfinite(seen).all():
                raise ClientError([client], f"its environment returned the observation {seen}, which is not finite")
            raise ClientError([client], f"the action {actions[row]} is not finite")
        before = None if all_active else batch.observations[~active]
        try:
            batch.step(actions, rows, self._run)
        except RowError as fault:
            assert isinstance(fault.__cause__, Exception)
            raise self._fault([fault.row], "step()", fault.__cause__) from fault.__cause__
        except Exception as error:  # from a world that steps all its environments at once
            raise self._fault(rows, "step()", error) from error

        rewards, terminated = batch.rewards, batch.terminated
        self._lengths += active
        self._positions.moves += active
        truncated = batch.truncated | (self._lengths >= self._max_steps)
        infos = batch.infos()
        dones = terminated | truncated
        if before is not None:
            batch.observations[~active] = before
            rewards = np.where(active, rewards, 0.0)
            dones &= active
            infos = [info if alive else {} for info, alive in zip(infos, active, strict=True)]
        self._returns += rewards
        if dones.any():
            for row in np.flatnonzero(dones).tolist():
                self._finish(row, infos[row], bool(truncated[row]) and not bool(terminated[row]))
        return batch.observations.copy(), rewards.astype(np.float32), dones, infos

    def _finish(self, row: int, info: dict[str, Any], truncated: bool) -> None:
        info["terminal_observation"] = self._batch.observations[row].copy()
        info["TimeLimit.truncated"] = truncated
        seconds = round(time.time() - self._start_time, 6)
        episode = {"r": float(self._returns[row]), "l": int(self._lengths[row]), "t": seconds}
        info["episode"] = own_record(info, episode)
        self._reset_row(row)

    def _run(self, work: Callable[[Iterator[int]], None], rows: Sequence[int]) -> None:
        """Let the threads share one iterator, so that none waits while another still has several environments to step."""
        threads = min(self.num_threads, len(rows) // MIN_ROWS_PER_THREAD)
        if threads < 2:
            return run_rows(work, rows)
        if self._pool is None or self._pool_process != os.getpid():  # a fork has the pool, but none of its threads
            self._pool = ThreadPoolExecutor(self.num_threads - 1, thread_name_prefix="fed_envs")
            self._pool_process = os.getpid()
        shared, work = iter(rows), watched(work)
        others = [self._pool.submit(work, shared) for _ in range(threads - 1)]
        work(shared)
        for other in others:
            other.result()

    def save_state(self) -> State:
        """The state of all environments, as plain data: simulators, random streams, running returns, which are active.

        For environments without ``save_state`` and ``load_state`` it has only their seeds and number of steps.

        :raises ClientError: if an environment's state is not plain data
        """
        return {
            "clients": list(self.client_ids),
            "envs": [self._save_row(row) for row in range(self.num_envs)],
            "observations": self._batch.observations.copy(),
            "lengths": self._lengths.copy(),
            "returns": self._returns.copy(),
            "active": self._active.copy(),
            "seeds": list(self._seeds),
            "seconds": time.time() - self._start_time,
        }

    def _save_row(self, row: int) -> State:
        if self._positions.ordinary[row]:
            return self._positions.save(row)
        try:
            return save_state(self.envs[row])
        except ValueError as error:
            client = self.client_ids[row // self.n_envs_per_client]
            raise ClientError([client], f"its environment cannot be part of a checkpoint: {error}") from error

    def load_state(self, state: State) -> None:
        """Restore the state of :meth:`save_state` in new environments of the same clients.

        Environments that give no state, and are not in that state already, begin new episodes with
        :meth:`begin_lost_episodes`.

        :raises ValueError: for the state of other environments
        """
        if state["clients"] != self.client_ids or len(state["envs"]) != self.num_envs:
            raise ValueError(
                f"the state is that of {len(state['envs'])} environments of the clients {state['clients']}, not of "
                f"{self.num_envs} of the clients {self.client_ids}"
            )
        for row, (env, saved) in enumerate(zip(self.envs, state["envs"], strict=True)):
            if self._positions.ordinary[row] and "moves" in saved:
                episode = (self._lengths[row], self._returns[row]) == (state["lengths"][row], state["returns"][row])
                seen = np.array_equal(self._batch.observations[row], state["observations"][row])
                self._positions.load(row, saved, episode and seen)
            else:
                load_state(env, saved)
        self._batch.observations[:] = state["observations"]
        self._lengths[:], self._returns[:], self._active[:] = state["lengths"], state["returns"], state["active"]
        self._seeds = list(state["seeds"])
        self._start_time = time.time() - state["seconds"]

    @property
    def lost(self) -> np.ndarray:
        """``(num_envs,)`` bool: the active environments whose state :meth:`load_state` could not restore."""
        return self._positions.lost & self._active

    def begin_lost_episodes(self) -> tuple[np.ndarray, np.ndarray, list[int]]:
        """Reset the environments that are :attr:`lost`.

        :return: their indices, their observations, and the clients that lost an episode (one that had only been reset begins
            again with the same seed)
        """
        positions, rows, clients = self._positions, np.flatnonzero(self.lost), set()
        for row in rows.tolist():
            seed, moves = positions.seeds[row], int(positions.moves[row])
            if moves > 0:
                seed = None if seed is None else integer_seed(seed, moves)
                clients.add(self.client_ids[row // self.n_envs_per_client])
            self._reset_row(row, seed)
            positions.reset(row, seed)
        return rows, self._batch.observations[rows], sorted(clients)

    def close(self) -> None:
        if self._pool is not None and self._pool_process == os.getpid():
            self._pool.shutdown()
        self._pool = None
        for env in self.envs:
            env.close()

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        state["_pool"] = state["_factories"] = None
        state["_batch"] = self._batch.observations.copy()
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        observations = state["_batch"]
        self._batch = self._make_batch()
        self._batch.observations[:] = observations

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [env.get_wrapper_attr(attr_name) for env in self._targets(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        for env in self._targets(indices):
            setattr(env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        return [env.get_wrapper_attr(method_name)(*method_args, **method_kwargs) for env in self._targets(indices)]

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        # This records what Monitor records, so no Monitor wrapper is needed.
        return [wrapper_class is Monitor or is_wrapped(env, wrapper_class) for env in self._targets(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        return [env.render() for env in self.envs]  # type: ignore[misc]

    def _targets(self, indices: VecEnvIndices) -> list[gymnasium.Env]:
        return [self.envs[index] for index in self._get_indices(indices)]


def _checked_clients(clients: Sequence[int] | None, n_clients: int, name: str) -> list[int]:
    ids = list(range(n_clients)) if clients is None else [int(client) for client in clients]
    unknown = [client for client in ids if not 0 <= client < n_clients]
    if unknown:
        raise ValueError(f"{name} has clients 0 to {n_clients - 1}, not {', '.join(map(str, unknown))}")
    if not ids or len(set(ids)) != len(ids):
        raise ValueError(f"clients must name at least one client, each once; got {ids}")
    return ids
