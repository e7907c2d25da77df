"""The state of environments and other objects as plain data: dicts and lists of NumPy arrays and JSON values.

Nothing in such a state is an object of a class, so that it can be stored without pickle and read without running anything.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import gymnasium
from gymnasium.spaces import Space

from fed_envs.plain_data import State, freeze, generator, thaw

__all__ = ["attributes", "gives_state", "load_state", "save_state", "set_attributes"]

#: Attributes of Gymnasium's classes (and the file of SB3's Monitor) that are not state.
IDENTITY = (
    "env", "spec", "metadata", "render_mode", "observation_space", "action_space", "_np_random", "_np_random_seed",
    "_action_space", "_observation_space", "_metadata", "_cached_spec", "_saved_kwargs", "results_writer",
)  # fmt: skip


def attributes(owner: Any, skip: Collection[str] = ()) -> dict[str, Any]:
    """The attributes of an object by name, without spaces, environments and functions, which are not state."""
    found: dict[str, Any] = {}
    for name, value in vars(owner).items():
        if name in skip or callable(value) or isinstance(value, (gymnasium.Env, Space)):
            continue
        found[name] = attributes(value) if _has_state(value) else value
    return found


def set_attributes(owner: Any, values: dict[str, Any]) -> None:
    """Restore the attributes that :func:`attributes` returned."""
    for name, value in values.items():
        own = getattr(owner, name, None)
        if _has_state(own):
            set_attributes(own, value)
        else:
            setattr(owner, name, value)


def _has_state(value: Any) -> bool:
    """Whether it is an object in which Gymnasium's wrappers keep numbers, such as running moments."""
    return type(value).__module__.startswith("gymnasium.wrappers")


def gives_state(env: gymnasium.Env) -> bool:
    """Whether an environment's state can be saved and restored: see :func:`save_state`."""
    while isinstance(env, gymnasium.Wrapper):
        if not _is_known(env) and not _has_methods(env):
            return False
        env = env.env
    return _has_methods(env)


def _has_methods(env: gymnasium.Env) -> bool:
    # With only one of the two methods, save_state reports the other as missing. ``gives_state``: that of an inner environment.
    return getattr(env, "gives_state", True) and (hasattr(env, "save_state") or hasattr(env, "load_state"))


def save_state(env: gymnasium.Env) -> State:
    """The state of an environment, of its random generator, and of known wrappers around it.

    The user's own environment needs the methods ``save_state()``, which returns a dict of arrays and JSON
    values, and ``load_state(state)``. So do wrappers other than Gymnasium's and Stable-Baselines3's ``Monitor``. The
    state of the generator ``np_random`` is saved here.

    :raises ValueError: if these methods are missing
    """
    wrappers = []
    while isinstance(env, gymnasium.Wrapper):
        wrappers.append(_wrapper_state(env))
        env = env.env
    random = env._np_random  # the property would draw a seed
    return {
        "wrappers": wrappers,
        "np_random": None if random is None else freeze(random.bit_generator.state),
        "env": freeze(_method(env, "save_state")()),
    }


def load_state(env: gymnasium.Env, state: State) -> None:
    """Restore the state of :func:`save_state` in a new environment of the same kind: from then on both behave the same.

    :raises ValueError: for the state of another kind of environment
    """
    for saved in state["wrappers"]:
        if not isinstance(env, gymnasium.Wrapper) or saved["class"] != type(env).__name__:
            raise ValueError(
                f"the state is that of an environment with the wrapper {saved['class']}, which {type(env).__name__} is not"
            )
        _load_wrapper(env, saved["state"])
        env = env.env
    if isinstance(env, gymnasium.Wrapper):
        raise ValueError(f"the state is that of an environment without the wrapper {type(env).__name__}")
    if state["np_random"] is not None:
        env._np_random = generator(thaw(state["np_random"]))
    _method(env, "load_state")(thaw(state["env"]))


def _wrapper_state(wrapper: gymnasium.Wrapper) -> State:
    state = attributes(wrapper, IDENTITY) if _is_known(wrapper) else _method(wrapper, "save_state")()
    return {"class": type(wrapper).__name__, "state": freeze(state)}


def _load_wrapper(wrapper: gymnasium.Wrapper, state: State) -> None:
    if _is_known(wrapper):
        set_attributes(wrapper, thaw(state))
    else:
        _method(wrapper, "load_state")(thaw(state))


def _is_known(wrapper: gymnasium.Wrapper) -> bool:
    """Whether the wrapper's state is in plain attributes: Gymnasium's own, and SB3's ``Monitor``."""
    return type(wrapper).__module__.startswith(("gymnasium.", "stable_baselines3.common.monitor"))


def _method(env: gymnasium.Env, name: str) -> Callable[..., Any]:
    method = getattr(env, name, None)
    if method is None:
        raise ValueError(
            f"{type(env).__name__} has no {name}(): give it save_state(), which returns a dict of arrays and JSON values that "
            "say where an episode stands, and load_state(state), which continues from there, or neither of them"
        )
    return method
