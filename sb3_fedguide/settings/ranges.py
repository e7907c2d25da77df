"""Numbers and choices that a parameter takes: read from its type, and checked in one way."""

from __future__ import annotations

import functools
import math
import operator
import types
import typing
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import Any, Literal, NamedTuple

#: Smallest value of a positive parameter.
OPEN = 1e-12
#: Upper bound of any integer.
MAX_INTEGER = 2**31


class Range(NamedTuple):
    """A range of numbers, in the type of a parameter: ``mu: Annotated[float, Range(0)]``.

    :param why: reason that an error message adds to the bounds
    :param without_high: ``high`` itself is excluded
    :param start: largest first value of a schedule, if that is more than ``high``
    """

    low: float
    high: float = math.inf
    why: str = ""
    without_high: bool = False
    start: float = 0.0

    def __str__(self) -> str:
        """As an interval."""
        high = "∞)" if self.high == math.inf else f"{self.high:g}{')' if self.without_high else ']'}"
        return f"{'(0' if self.low == OPEN else f'[{self.low:g}'}, {high}"

    def expected(self, number: float) -> str:
        """The requirement, for the message about a number out of range."""
        if self.high <= 1:
            within = self.low == OPEN or self.without_high
            return f"in {self}" if within else f"between {self.low:g} and {self.high:g}"
        if number < self.low:
            return "positive" if self.low == OPEN else f"at least {self.low:g}"
        return f"at most {self.high:.0f}"


def options(hint: Any) -> list[Any]:
    """The alternative types of a value, without ranges."""
    if typing.get_origin(hint) is typing.Annotated:
        return options(typing.get_args(hint)[0])
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return [option for part in typing.get_args(hint) for option in options(part)]
    return [hint]


def plain(hint: Any) -> Any:
    """A type without ranges."""
    return functools.reduce(operator.or_, options(hint))


def is_schedule(option: Any) -> bool:
    return typing.get_origin(option) is Callable or option is Callable


def range_of(hint: Any) -> Range | None:
    """The first range in a type."""
    if typing.get_origin(hint) is typing.Annotated:
        found = [part for part in hint.__metadata__ if isinstance(part, Range)]
        return found[0] if found else range_of(typing.get_args(hint)[0])
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return next((limits for part in typing.get_args(hint) if (limits := range_of(part)) is not None), None)
    return None


def choices(hint: Any) -> list[Any]:
    """The words among the values of a type; ``None`` is one."""
    found = [typing.get_args(option) if typing.get_origin(option) is Literal else () for option in options(hint)]
    return [word for words in found for word in words] + [None] * (type(None) in options(hint))


def check_values(hints: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """Check all ``values`` that have a range or choices; of a schedule of the remaining progress, its first value.

    :param hints: types by name
    :raises ValueError: for the first that is not one of its choices, not a number or out of its range
    """
    for name, hint in hints.items():
        if name in values:
            _check(name, values[name], hint)


def _check(name: str, value: Any, hint: Any) -> None:
    kinds, words, limits = options(hint), choices(hint), range_of(hint)
    if any(value is word or (isinstance(word, str) and value == word) for word in words):
        return
    named = [word for word in words if word is not None]
    if limits is None:
        if named and all(typing.get_origin(kind) is Literal or kind is type(None) for kind in kinds):
            raise ValueError(f"{name}={value!r} must be one of {', '.join(named)}")
        return
    scheduled = callable(value)
    value = value(1.0) if scheduled else value
    whole = float not in kinds
    if not isinstance(value, Real) or isinstance(value, bool) or (whole and not isinstance(value, Integral)):
        expected = " or ".join(["an integer" if whole else "a number", *map(repr, named)])
        raise ValueError(f"{name} must be {expected}, but it is {value!r}")
    check_number(name, value, limits, scheduled)


def check_number(name: str, number: Real | float, limits: Range | None = None, scheduled: bool = False) -> None:
    """:raises ValueError: for a number that is not finite or not in its range"""
    if isinstance(number, Integral) and abs(int(number)) >= MAX_INTEGER:
        raise ValueError(f"{name} must be below 2^31, but it has {len(str(abs(int(number))))} digits")
    value = float(number)
    if not math.isfinite(value):
        raise ValueError(f"{name}={value} must be finite")
    if limits is None:
        return
    high = max(limits.high, limits.start) if scheduled else limits.high
    if not limits.low <= value <= high or (limits.without_high and value == high):
        raise ValueError(f"{name}={value:g} must be {limits.expected(value)}{limits.why and ': ' + limits.why}")


def check_normalize(normalize: Any) -> None:
    """:raises ValueError: for what is none of the choices"""
    if normalize not in (True, False, "shared"):
        raise ValueError(f"normalize={normalize!r} must be True, False or 'shared' (observation statistics of all clients)")
