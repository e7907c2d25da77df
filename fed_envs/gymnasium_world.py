"""Environments that are registered with Gymnasium as clients: several ids, or one id with several keyword arguments."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np

from fed_envs import state
from fed_envs.clients import GymnasiumClient
from fed_envs.factories import FactoryBatch, check_step, reset_env
from fed_envs.metadata import Family, parse_family
from fed_envs.world import ClientEnv

BACKBONE = "Gymnasium"


def gymnasium_family(
    ids: str | Sequence[str], kwargs: Sequence[Mapping[str, Any]] | None = None, name: str | None = None
) -> Family:
    """A family of environments that Gymnasium knows, one client each.

    :param ids: an id for all clients, or one each
    :param kwargs: each client's keyword arguments of ``gymnasium.make``; JSON values
    :param name: the family's; by default made of the ids
    :raises ValueError: for ids that are not registered or have no time limit, and numbers that do not fit
    """
    ids = [ids] * len(kwargs or ()) if isinstance(ids, str) else list(ids)
    kwargs = [{}] * len(ids) if kwargs is None else list(kwargs)
    if not ids or len(ids) != len(kwargs):
        raise ValueError(f"there are {len(ids)} ids and {len(kwargs)} sets of keyword arguments; give each client one of both")
    clients = [
        {"client": client, "id": id, **({"kwargs": dict(own)} if own else {})}
        for client, (id, own) in enumerate(zip(ids, kwargs, strict=True))
    ]
    name = name or re.sub(r"\W", "_", "_".join(dict.fromkeys(ids)), flags=re.ASCII)[:60]
    content = {
        "schema_version": 1, "family": name if name[0].isalpha() else f"Env_{name}", "world": "gymnasium",
        "backbone": BACKBONE, "max_episode_steps": 1, "clients": clients,
    }  # fmt: skip
    parse_family(content, name)  # reports ids that are not registered first
    limits = [_limit(client, id, own) for client, (id, own) in enumerate(zip(ids, kwargs, strict=True))]
    return parse_family({**content, "max_episode_steps": max(limits)}, name)


def _limit(client: int, id: str, kwargs: Mapping[str, Any]) -> int:
    limit = kwargs.get("max_episode_steps", gymnasium.spec(id).max_episode_steps)
    if not isinstance(limit, int) or limit < 1:
        raise ValueError(
            f"client {client}: {id} has no time limit, so that its episodes may never end: register it with "
            "max_episode_steps, or give max_episode_steps among its keyword arguments"
        )
    return limit


class GymnasiumBatch(FactoryBatch):
    """Steps the inner environments one by one; they report truncations themselves."""

    def __init__(self, envs: Sequence[GymnasiumEnv]) -> None:
        super().__init__([env.env for env in envs])


class GymnasiumEnv(ClientEnv[GymnasiumClient]):
    """
    ## Description
    A client's environment as ``gymnasium.make(id, **kwargs)`` makes it.

    ## Arguments
    Those of :class:`fed_envs.world.ClientEnv`; ``id`` and ``kwargs`` are the client's fields.
    """

    world, batch_class = "gymnasium", GymnasiumBatch
    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"]}  # noqa: RUF012 (Gymnasium's own interface)

    def __init__(
        self,
        client: int = 0,
        family: str | None = None,
        metadata: str | dict[str, Any] | Family | None = None,
        render_mode: str | None = None,
        **parameters: Any,
    ) -> None:
        super().__init__(client, family, metadata, render_mode, **parameters)
        drawn = {} if render_mode is None else {"render_mode": render_mode}
        self.env = gymnasium.make(self.client.id, **{**self.client.kwargs, **drawn})
        self.metadata = {"render_modes": [], **self.env.metadata}
        self.observation_space, self.action_space = self.env.observation_space, self.env.action_space  # type: ignore[assignment]
        self._start()

    @property
    def gives_state(self) -> bool:
        """Whether the inner environment does."""
        return state.gives_state(self.env)

    def _reset(self) -> tuple[np.ndarray, dict[str, Any]]:
        return self.reset()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        gymnasium.Env.reset(self, seed=seed)
        observation, info = reset_env(self.env, seed, options, self.observation_space.shape)
        return observation, info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = check_step(self.env.step(action), self.observation_space.shape)
        return observation, float(reward), bool(terminated), bool(truncated), info

    def render(self) -> Any:
        return self.env.render()

    def close(self) -> None:
        self.env.close()

    def save_state(self) -> dict[str, Any]:
        return state.save_state(self.env)

    def load_state(self, saved: dict[str, Any]) -> None:
        state.load_state(self.env, saved)
