"""Observation and action spaces as plain data, and a check whether Stable-Baselines3 takes them unflattened."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces


def describe_space(space: spaces.Space) -> dict[str, Any]:
    """A space as JSON; the inverse of :func:`space_from`.

    :raises ValueError: for a kind of space that no policy supports
    """
    if isinstance(space, spaces.Box):
        bounds = {name: _bound(getattr(space, name)) for name in ("low", "high")}
        return {"type": "Box", **bounds, "shape": list(space.shape), "dtype": str(space.dtype)}
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
    if isinstance(space, spaces.MultiDiscrete):
        return {"type": "MultiDiscrete", "nvec": space.nvec.tolist(), "start": space.start.tolist()}
    if isinstance(space, spaces.MultiBinary):
        return {"type": "MultiBinary", "n": list(space.shape)}
    if isinstance(space, spaces.Dict):
        return {"type": "Dict", "spaces": {name: describe_space(part) for name, part in space.spaces.items()}}
    raise ValueError(f"the space {space} has no description")


def space_from(description: Any) -> spaces.Space:
    """The space that :func:`describe_space` described.

    :raises ValueError: for anything else
    """
    try:
        kind = description["type"]
        if kind == "Box":
            shape, dtype = tuple(description["shape"]), np.dtype(description["dtype"])
            low, high = (_array(description[name], shape, dtype) for name in ("low", "high"))
            return spaces.Box(low, high, shape, dtype.type)  # type: ignore[arg-type]
        if kind == "Discrete":
            return spaces.Discrete(description["n"], start=description["start"])
        if kind == "MultiDiscrete":
            return spaces.MultiDiscrete(description["nvec"], start=description["start"])
        if kind == "MultiBinary":
            (n,) = description["n"]
            return spaces.MultiBinary(n)
        if kind == "Dict":
            parts = {name: space_from(part) for name, part in description["spaces"].items()}
            return spaces.Dict(list(parts.items()))  # a list keeps its order, a mapping is sorted
    except Exception as error:  # foreign JSON may be wrong in any way
        raise ValueError(f"it describes no space: {error}") from None
    raise ValueError(f"it describes no space: the type is {kind!r}")


def is_plain(space: spaces.Space) -> bool:
    """Whether SB3's policies see an observation in the same form as ``gymnasium.spaces.flatten``.

    This holds for arrays, discrete values that are counted from 0, and a Dict of these.
    """
    if isinstance(space, spaces.Dict):
        return all(is_plain(part) and not isinstance(part, spaces.Dict) for part in space.spaces.values())
    if isinstance(space, spaces.MultiDiscrete):
        return len(space.shape) == 1 and not space.start.any()
    return isinstance(space, spaces.Box | spaces.MultiBinary) or (isinstance(space, spaces.Discrete) and space.start == 0)


def _bound(array: np.ndarray) -> list[str]:
    """As text, since a bound may be infinite; one entry if all are the same."""
    values = [str(value) for value in array.ravel().tolist()]
    return values[:1] if len(set(values)) == 1 else values


def _array(values: list[str], shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    numbers = np.array([float(value) for value in values]).astype(dtype)
    return np.broadcast_to(numbers, shape) if len(numbers) == 1 else numbers.reshape(shape)
