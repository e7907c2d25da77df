"""The hyperparameters of an algorithm, read from its constructors, and the check of plain values against them."""

from __future__ import annotations

import functools
import operator
import re
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

import pydantic

from sb3_fedguide.registry import ALGORITHMS, algorithm
from sb3_fedguide.settings.arguments import FederationArguments
from sb3_fedguide.settings.names import check_names
from sb3_fedguide.settings.ranges import check_number, is_schedule, options, range_of
from sb3_fedguide.settings.signatures import declared

#: Constructor parameters that have their own flag, or no meaning on the command line.
NOT_HYPERPARAMETERS = {
    "policy", "env", "clients", "num_threads", "cache_dir", "tensorboard_log", "verbose", "seed", "device",
    "_init_setup_model",
}  # fmt: skip

#: ``lin_``: falls linearly to zero over the run, as in rl-baselines3-zoo; ``until_``: one for a share of the run, then zero.
SCHEDULE = re.compile(r"^(?P<kind>lin|until)_(?P<value>\d+(\.\d*)?([eE][-+]?\d+)?)$")


def declared_arguments(algo: str) -> type[FederationArguments]:
    """The dataclass that an algorithm's constructor takes; for a user's own algorithm, that of its nearest base."""
    known = ALGORITHMS[algo].arguments
    if known is None:
        taken: list[Any] = [getattr(vars(base).get("__init__"), "arguments", object) for base in algorithm(algo).__mro__]
        return next(kind for kind in taken if issubclass(kind, FederationArguments))
    module, _, name = known.partition(":")
    return getattr(import_module(module), name)


def policies(algo: str) -> tuple[str, ...]:
    """Names of the policies that an algorithm has."""
    own = ALGORITHMS[algo].arguments is None
    return tuple(algorithm(algo).policy_aliases) if own else declared_arguments(algo).policies


def hyperparameters(algorithm: type) -> Mapping[str, tuple[Any, Any]]:
    """Name to (type, default) of every hyperparameter of an algorithm, its own first, then those of its bases.

    :param algorithm: its class, or the dataclass that its constructor takes
    """
    return {name: known for name, known in declared(algorithm).items() if name not in NOT_HYPERPARAMETERS}


def hyperparameters_of(algo: str) -> Mapping[str, tuple[Any, Any]]:
    """:func:`hyperparameters` by command-line name. For the shipped algorithms this does not import PyTorch."""
    entry = ALGORITHMS[algo]
    return hyperparameters(algorithm(algo) if entry.arguments is None else declared_arguments(algo))


def all_names() -> list[str]:
    """Hyperparameters of all algorithms together, each once."""
    return list(dict.fromkeys(name for known in ALGORITHMS for name in hyperparameters_of(known)))


def check_value(name: str, value: Any, hint: Any) -> Any:
    """One hyperparameter as plain data: numbers, strings, lists; a schedule is a string such as ``lin_3e-4``.

    :raises ValueError: for a value of another type or out of range
    """
    every = options(hint)
    kinds = [kind for kind in every if not is_schedule(kind)]
    schedule, scheduled = len(kinds) < len(every), False
    number = value
    if schedule and isinstance(value, str) and (match := SCHEDULE.match(value)):
        number, scheduled = float(match["value"]), True
        if match["kind"] == "until":
            if name != "mix":
                raise ValueError(f"{name}={value!r} is a schedule for mix only; other values take one such as lin_3e-4")
            Until(number)
    else:
        try:
            union: Any = functools.reduce(operator.or_, kinds)
            value = number = pydantic.TypeAdapter(union).validate_python(value, strict=True)
        except pydantic.ValidationError:
            expected = " or ".join([_describe(kind) for kind in kinds] + ["a schedule such as lin_3e-4"] * schedule)
            raise ValueError(f"{name} must be {expected}, but it is {_show(value)}") from None
    if isinstance(number, float | int) and not isinstance(number, bool):
        check_number(name, number, range_of(hint), scheduled)
    return value


def check_model(name: str, model: type[pydantic.BaseModel], value: Any, excluded: Mapping[str, str]) -> pydantic.BaseModel:
    """A nested mapping against its model.

    :param excluded: fields that must not be set here, with the remedy
    :raises ValueError: one line that names the field
    """
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a mapping of {', '.join(model.model_fields)}, but it is {_show(value)}")
    for field, instead in excluded.items():
        if field in value:
            raise ValueError(f"{name}.{field} cannot be set here: {instead}")
    check_names((str(key) for key in value), model.model_fields, f"key in {name}:")
    for field, given in value.items():
        try:
            model.model_validate({field: given}, strict=True)
        except pydantic.ValidationError as error:
            reasons = dict.fromkeys(_reason(problem) for problem in error.errors(include_url=False))
            raise ValueError(f"{name}.{field}: {' or '.join(reasons)} (it is {_show(given)})") from None
    return model.model_validate(dict(value))


def schedule_or_value(value: Any) -> Any:
    """The schedule of a string such as ``lin_3e-4`` or ``until_0.5``; other values unchanged."""
    if isinstance(value, str) and (match := SCHEDULE.match(value)):
        if match["kind"] == "until":
            return Until(float(match["value"]))
        from stable_baselines3.common.utils import LinearSchedule

        return LinearSchedule(float(match["value"]), 0.0, 1.0)
    return value


@dataclass(frozen=True)
class Until:
    """One for the first ``share`` of the run, then zero; a function of the remaining progress, as SB3's schedules.

    :raises ValueError: for a share outside [0, 1]
    """

    share: float

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1:
            raise ValueError(f"until_{self.share:g} must be between until_0 and until_1: it is a share of the run")

    def __call__(self, progress_remaining: float) -> float:
        return 1.0 if progress_remaining > 1 - self.share + 1e-9 else 0.0


def _reason(problem: Any) -> str:
    message = problem["msg"].removeprefix("Value error, ").removeprefix("Input ")
    return message[0].lower() + message[1:]


def _describe(hint: Any) -> str:
    if typing.get_origin(hint) is Literal:
        return " or ".join(repr(choice) for choice in typing.get_args(hint))
    names = {int: "an integer", float: "a number", bool: "true or false", str: "a string", type(None): "null"}
    return names.get(hint, str(hint))


def _show(value: Any) -> str:
    shown = f"the text {value!r}" if isinstance(value, str) else f"{value!r}"
    return shown if len(shown) <= 200 else f"{shown[:200]} ..."
