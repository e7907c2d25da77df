"""Heterogeneous client environments for federated reinforcement learning.

Importing this package registers one Gymnasium id per family, ``fed_envs/<Family>-v0``::

    import gymnasium
    import fed_envs

    env = gymnasium.make("fed_envs/HopperHard-v0", client=3)     # one client's MDP
    clients = fed_envs.FederatedVecEnv("HopperHard")             # all clients side by side, a Stable-Baselines3 VecEnv

The import is light: the simulator, pydantic and Stable-Baselines3 are loaded when the first of their names is used.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from fed_envs.registration import FAMILIES, register_families, register_family, register_world

if TYPE_CHECKING:
    from fed_envs.clients import Client
    from fed_envs.gymnasium_world import gymnasium_family
    from fed_envs.metadata import Family, load_family
    from fed_envs.vec_env import FederatedVecEnv

__all__ = [
    "FAMILIES",
    "Client",
    "Family",
    "FederatedVecEnv",
    "gymnasium_family",
    "load_family",
    "register_family",
    "register_world",
]

_LAZY = {
    "Client": "fed_envs.clients",
    "Family": "fed_envs.metadata",
    "load_family": "fed_envs.metadata",
    "FederatedVecEnv": "fed_envs.vec_env",
    "gymnasium_family": "fed_envs.gymnasium_world",
}

_SUBMODULES = (
    "bandit2d",
    "clients",
    "factories",
    "generation",
    "gymnasium_world",
    "locomotion",
    "metadata",
    "metaworld10",
    "point_maze",
    "reacher",
    "state",
    "vec_env",
)


def __getattr__(name: str) -> Any:
    if name in _SUBMODULES:
        return import_module(f"fed_envs.{name}")
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY, *_SUBMODULES})


if find_spec("gymnasium") is not None:  # a federation's server needs seeds and files from here, and has no environments
    register_families()
