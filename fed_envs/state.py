"""The state of environments and other objects as plain data: dicts and lists of NumPy arrays and of what JSON knows.

Nothing in such a state is an object of a class, so that it can be stored without pickle and read without running anything.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Space

#: Names to arrays, JSON values, lists and states again.
State = dict[str, Any]

#: Attributes of Gymnasium's classes that say what an environment is, not where it stands.
IDENTITY = (
    "env", "spec", "metadata", "render_mode", "observation_space", "action_space", "_np_random", "_np_random_seed",
    "_action_space", "_observation_space", "_metadata", "_cached_spec", "_saved_kwargs",
)  # fmt: skip

_TAG = "__type__"


def freeze(value: Any) -> Any:
    """A copy of ``value`` as plain data: numbers, texts, arrays, generators, and lists, tuples, deques and dicts of these.

    :raises ValueError: for anything else
    """
    if value is None or isinstance(value, (bool, str)) or type(value) is int:
        return value
    if isinstance(value, np.generic):
        return {_TAG: "scalar", "value": np.asarray(value)}
    if isinstance(value, int):  # an IntEnum
        return int(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else {_TAG: "float", "value": str(value)}
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise ValueError(f"an array of objects (dtype {value.dtype}) is no plain data")
        return value.copy()
    if isinstance(value, np.random.Generator):
        return {_TAG: "generator", "value": freeze(value.bit_generator.state)}
    if isinstance(value, list):
        return [freeze(item) for item in value]
    if isinstance(value, deque):
        return {_TAG: "deque", "value": [freeze(item) for item in value], "maxlen": value.maxlen}
    if type(value) is tuple:
        return {_TAG: "tuple", "value": [freeze(item) for item in value]}
    if isinstance(value, dict):
        if all(isinstance(key, str) for key in value) and _TAG not in value:
            return {key: _freeze_item(key, item) for key, item in value.items()}
        pairs = [[freeze(key), freeze(item)] for key, item in value.items()]
        return {_TAG: "dict", "value": pairs}
    raise ValueError(f"a {type(value).__name__} is no plain data")


def _freeze_item(key: str, item: Any) -> Any:
    try:
        return freeze(item)
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from None


def thaw(value: Any) -> Any:
    """The inverse of :func:`freeze`; its arrays and generators are copies.

    :raises ValueError: for what no :func:`freeze` returned
    """
    if isinstance(value, list):
        return [thaw(item) for item in value]
    if isinstance(value, np.ndarray):
        return value.copy()
    if not isinstance(value, dict):
        return value
    if _TAG not in value:
        return {key: thaw(item) for key, item in value.items()}
    kind, content = value[_TAG], value.get("value")
    if kind == "scalar" and isinstance(content, np.ndarray):
        return content[()]
    if kind == "float":
        return float(content)  # type: ignore[arg-type]
    if kind == "generator":
        return generator(thaw(content))
    if isinstance(content, list):
        items = [thaw(item) for item in content]
        if kind == "deque":
            return deque(items, value.get("maxlen"))
        if kind == "tuple":
            return tuple(items)
        if kind == "dict":
            return {key: item for key, item in items}
    raise ValueError(f"a state has an entry of unknown type {kind!r}")


def generator(state: State) -> np.random.Generator:
    """A generator that goes on where the one with this ``bit_generator.state`` stood.

    :raises ValueError: for a state that is none of NumPy's
    """
    name = state.get("bit_generator") if isinstance(state, dict) else None
    kinds = {kind.__name__: kind for kind in np.random.BitGenerator.__subclasses__() if kind.__module__.startswith("numpy.")}
    if name not in kinds:
        raise ValueError(f"there is no random generator {name!r}")
    bits = kinds[name]()
    try:
        bits.state = state
    except (KeyError, TypeError) as error:
        raise ValueError(f"the state of a random generator is damaged: {error!r}") from None
    return np.random.Generator(bits)


def attributes(owner: Any, skip: Collection[str] = ()) -> dict[str, Any]:
    """The attributes of an object by name, without spaces, environments and functions, which say what it is."""
    found: dict[str, Any] = {}
    for name, value in vars(owner).items():
        if name in skip or callable(value) or isinstance(value, (gymnasium.Env, Space)):
            continue
        found[name] = attributes(value) if _has_state(value) else value
    return found


def set_attributes(owner: Any, values: dict[str, Any]) -> None:
    """Put back what :func:`attributes` returned."""
    for name, value in values.items():
        own = getattr(owner, name, None)
        if _has_state(own):
            set_attributes(own, value)
        else:
            setattr(owner, name, value)


def _has_state(value: Any) -> bool:
    """Whether it is one of the objects that Gymnasium's wrappers keep numbers in, such as running moments."""
    return type(value).__module__.startswith("gymnasium.wrappers")


def declared_state(owner: Any) -> State:
    """The attributes that the classes of ``owner`` name in ``state_attributes``, as plain data.

    :raises ValueError: for an attribute that is no plain data
    """
    declared = [name for kind in type(owner).__mro__ for name in vars(kind).get("state_attributes", ())]
    return freeze({name: getattr(owner, name) for name in dict.fromkeys(declared) if hasattr(owner, name)})


def load_declared(owner: Any, state: State) -> None:
    """Put back what :func:`declared_state` returned."""
    for name, value in thaw(state).items():
        setattr(owner, name, value)


def save_state(env: gymnasium.Env) -> State:
    """Where an environment stands: its own state, its random generator's, and that of Gymnasium's wrappers around it.

    An environment of the user's own has to have the methods ``save_state()``, which returns a dict of arrays and JSON
    values, and ``load_state(state)``. So do wrappers other than Gymnasium's. The generator ``np_random`` is taken care of.

    :raises ValueError: where they are missing
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
    """Bring a new environment of the same kind to where :func:`save_state` was called: from there on both do the same.

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
    state = attributes(wrapper, IDENTITY) if _is_gymnasiums(wrapper) else _method(wrapper, "save_state")()
    return {"class": type(wrapper).__name__, "state": freeze(state)}


def _load_wrapper(wrapper: gymnasium.Wrapper, state: State) -> None:
    if _is_gymnasiums(wrapper):
        set_attributes(wrapper, thaw(state))
    else:
        _method(wrapper, "load_state")(thaw(state))


def _is_gymnasiums(wrapper: gymnasium.Wrapper) -> bool:
    return type(wrapper).__module__.startswith("gymnasium.")


def _method(env: gymnasium.Env, name: str) -> Callable[..., Any]:
    method = getattr(env, name, None)
    if method is None:
        raise ValueError(
            f"{type(env).__name__} cannot be part of a checkpoint: give it the methods save_state(), which returns a dict of "
            "arrays and JSON values that say where an episode stands, and load_state(state), which continues from there"
        )
    return method
