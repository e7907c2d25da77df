"""Values as plain data: dicts and lists of NumPy arrays and JSON values. Needs only NumPy."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np

#: Names to arrays, JSON values, lists and states again.
State = dict[str, Any]

#: Key of a dict that represents another type, such as a tuple or a generator.
TAG = "__type__"


def freeze(value: Any) -> Any:
    """A copy of ``value`` as plain data: numbers, texts, arrays, generators, and lists, tuples, deques and dicts of these.

    :raises ValueError: for anything else
    """
    if value is None or isinstance(value, (bool, str)) or type(value) is int:
        return value
    if isinstance(value, np.generic):
        return {TAG: "scalar", "value": np.asarray(value)}
    if isinstance(value, int):  # an IntEnum
        return int(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else {TAG: "float", "value": str(value)}
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise ValueError(f"an array of objects (dtype {value.dtype}) is no plain data")
        return value.copy()
    if isinstance(value, np.random.Generator):
        return {TAG: "generator", "value": freeze(value.bit_generator.state)}
    if isinstance(value, list):
        return [freeze(item) for item in value]
    if isinstance(value, deque):
        return {TAG: "deque", "value": [freeze(item) for item in value], "maxlen": value.maxlen}
    if type(value) is tuple:
        return {TAG: "tuple", "value": [freeze(item) for item in value]}
    if isinstance(value, dict):
        if all(isinstance(key, str) for key in value) and TAG not in value:
            return {key: _freeze_item(key, item) for key, item in value.items()}
        pairs = [[freeze(key), freeze(item)] for key, item in value.items()]
        return {TAG: "dict", "value": pairs}
    raise ValueError(f"a {type(value).__name__} is no plain data")


def _freeze_item(key: str, item: Any) -> Any:
    try:
        return freeze(item)
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from None


def thaw(value: Any) -> Any:
    """The inverse of :func:`freeze`; its arrays and generators are copies.

    :raises ValueError: for a value that :func:`freeze` cannot have returned
    """
    if isinstance(value, list):
        return [thaw(item) for item in value]
    if isinstance(value, np.ndarray):
        return value.copy()
    if not isinstance(value, dict):
        return value
    if TAG not in value:
        return {key: thaw(item) for key, item in value.items()}
    kind, content = value[TAG], value.get("value")
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
    """A generator with this ``bit_generator.state``.

    :raises ValueError: for a state that is not one of NumPy's
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
