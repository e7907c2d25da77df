"""Complete signatures of constructors that pass keyword arguments on to their bases."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import sys
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import import_module
from typing import Any, Concatenate, ParamSpec, TypeVar

from sb3_fedguide.settings.ranges import plain

P = ParamSpec("P")
A = TypeVar("A")
#: Positional arguments.
FIRST = ("policy", "env")


def takes(arguments: Callable[P, A]) -> Callable[[Callable[[Any, A], None]], Callable[Concatenate[Any, P], None]]:
    """Decorate a constructor: callers give the fields of a dataclass, and it gets them as one object with all defaults.

    :param arguments: the dataclass, such as :class:`~sb3_fedguide.settings.arguments.FedAvgArguments`
    """

    def decorate(constructor: Callable[[Any, A], None]) -> Callable[Concatenate[Any, P], None]:
        @functools.wraps(constructor)
        def __init__(self: Any, *args: P.args, **kwargs: P.kwargs) -> None:
            own = type(self).__init__ is __init__  # or it is called by a subclass's
            whose = type(self).__name__ if own else constructor.__qualname__.rpartition(".")[0]
            constructor(self, _given(arguments, whose, *args, **kwargs))

        __init__.arguments, __init__.hands_on = arguments, False  # type: ignore[attr-defined]
        own = inspect.Parameter("self", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        __init__.__signature__ = _shown([own, *_stated(__init__)])  # type: ignore[attr-defined]
        return typing.cast(Callable[Concatenate[Any, P], None], __init__)

    return decorate


def adds(arguments: Callable[..., A]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate a mixin's constructor: as :func:`takes`, and arguments that the dataclass does not have are passed on."""
    names = [field.name for field in dataclasses.fields(arguments)]  # type: ignore[arg-type]

    def decorate(constructor: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(constructor)
        def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
            given = arguments(**{name: kwargs.pop(name) for name in names if name in kwargs})
            constructor(self, given, *args, **kwargs)

        __init__.arguments, __init__.hands_on = arguments, True  # type: ignore[attr-defined]
        return __init__

    return decorate


def _given(arguments: Callable[P, A], whose: str, *args: P.args, **kwargs: P.kwargs) -> A:
    """:raises TypeError: for a wrong call, in the name of the class ``whose``"""
    if len(args) > len(FIRST):
        raise TypeError(
            f"{whose}() takes {' and '.join(FIRST)} by position and everything else by keyword, but got {len(args)} arguments "
            "by position"
        )
    try:
        return arguments(*args, **kwargs)
    except TypeError as error:
        name = getattr(arguments, "__qualname__", "")
        raise TypeError(str(error).replace(f"{name}.__init__()", f"{whose}()")) from None


@functools.cache
def declared(kind: Any) -> Mapping[str, tuple[Any, Any]]:
    """Name to (type, default) of the arguments of a class or dataclass: policy and environments, its own, then those of its
    bases."""
    if not dataclasses.is_dataclass(kind):
        return {name: (parameter.annotation, parameter.default) for name, parameter in parameters(kind).items()}
    known = {field.name: field for field in dataclasses.fields(kind)}
    bases: tuple[type, ...] = kind.__mro__  # type: ignore[union-attr]
    own = [(name, cls) for cls in bases for name in vars(cls).get("__annotations__", ()) if name in known]
    says = {name: cls for name, cls in reversed(own)}
    missing, empty = dataclasses.MISSING, inspect.Parameter.empty
    return {
        name: (_hint(says[name], known[name].type), empty if known[name].default is missing else known[name].default)
        for name in dict.fromkeys([name for name in FIRST if name in known] + [name for name, _ in own])
    }


def _hint(cls: type, hint: Any) -> Any:
    """The type of a dataclass's field. In modules that import annotations from the future it is a string."""
    if not isinstance(hint, str):
        return hint
    field = types.SimpleNamespace(__annotations__={"field": hint})
    try:
        return typing.get_type_hints(field, vars(sys.modules[cls.__module__]), include_extras=True)["field"]
    except NameError:  # one of sb3_fedguide.settings.argument_types
        return hint


@functools.cache
def types_of(kind: Any) -> Mapping[str, Any]:
    """Name to type, with its range, of the arguments of a class or dataclass."""
    return {name: hint for name, (hint, _) in declared(kind).items()}


def constructors(cls: type) -> Iterator[Any]:
    """The constructors of a class, its own first, up to the one that passes nothing on."""
    for base in cls.__mro__:
        constructor = vars(base).get("__init__")
        if constructor is None:
            continue
        yield constructor
        kinds = [parameter.kind for parameter in inspect.signature(constructor).parameters.values()]
        if not getattr(constructor, "hands_on", inspect.Parameter.VAR_KEYWORD in kinds):
            return


def parameters(cls: type) -> dict[str, inspect.Parameter]:
    """Every parameter of these constructors by name, with its type resolved; those of bases are keyword-only."""
    found: dict[str, inspect.Parameter] = {}
    for number, constructor in enumerate(constructors(cls)):
        for parameter in _stated(constructor):
            if parameter.name not in found:
                found[parameter.name] = parameter if number == 0 else parameter.replace(kind=parameter.KEYWORD_ONLY)
    return dict(sorted(found.items(), key=lambda item: item[1].kind))


def _stated(constructor: Any) -> list[inspect.Parameter]:
    """The parameters of one constructor, without those that it passes on."""
    positional, keyword = inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY
    if hasattr(constructor, "arguments"):
        return [
            inspect.Parameter(name, positional if name in FIRST else keyword, default=default, annotation=hint)
            for name, (hint, default) in declared(constructor.arguments).items()
        ]
    hints = typing.get_type_hints(constructor, include_extras=True)
    return [
        parameter.replace(annotation=hints.get(name, Any))
        for name, parameter in inspect.signature(constructor).parameters.items()
        if name != "self" and parameter.kind in (positional, keyword)
    ]


class CompleteSignature:
    """As ``__signature__`` of a class, it shows :func:`parameters` to ``help()``, ``inspect.signature()`` and IDEs: types are
    resolved and without ranges."""

    def __get__(self, instance: Any, owner: type) -> inspect.Signature:
        return _shown(parameters(owner).values())


def _shown(known: Iterable[inspect.Parameter]) -> inspect.Signature:
    return inspect.Signature([parameter.replace(annotation=_resolved(parameter.annotation)) for parameter in known])


def _resolved(hint: Any) -> Any:
    """A type without ranges. One that is a name is looked up with PyTorch, which whoever shows a constructor has loaded."""
    if isinstance(hint, str):
        return getattr(import_module("sb3_fedguide.settings.argument_types"), hint, hint)
    return plain(hint)
