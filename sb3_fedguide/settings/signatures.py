"""What constructors take that hand keyword arguments on to their bases."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Iterator
from typing import Any


def constructors(cls: type) -> Iterator[Any]:
    """The constructors of a class, its own first, up to the one that hands nothing on."""
    for base in cls.__mro__:
        constructor = vars(base).get("__init__")
        if constructor is None:
            continue
        yield constructor
        kinds = [parameter.kind for parameter in inspect.signature(constructor).parameters.values()]
        if inspect.Parameter.VAR_KEYWORD not in kinds:
            return


def parameters(cls: type) -> dict[str, inspect.Parameter]:
    """Every parameter of these constructors by name, with its type resolved; what comes from a base takes a keyword only."""
    found: dict[str, inspect.Parameter] = {}
    for number, constructor in enumerate(constructors(cls)):
        hints = typing.get_type_hints(constructor)
        for name, parameter in inspect.signature(constructor).parameters.items():
            if name != "self" and parameter.kind is not parameter.VAR_KEYWORD and name not in found:
                kind = parameter.kind if number == 0 else parameter.KEYWORD_ONLY
                found[name] = parameter.replace(annotation=hints.get(name, Any), kind=kind)
    return found


class CompleteSignature:
    """As ``__signature__`` of a class, it shows :func:`parameters` to ``help()``, ``inspect.signature()`` and IDEs."""

    def __get__(self, instance: Any, owner: type) -> inspect.Signature:
        return inspect.Signature(list(parameters(owner).values()))
