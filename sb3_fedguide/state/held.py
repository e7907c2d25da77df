"""State that an algorithm keeps between rounds: declared once, for checkpoints, engines and parameter files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.save_util import recursive_getattr, recursive_setattr
from torch import nn

from fed_envs.plain_data import State, freeze, thaw
from sb3_fedguide.state.stacked import to_arrays, to_tensors


@dataclass(frozen=True)
class Held:
    """An entry of an algorithm's ``state_attributes``; a name alone is one with all defaults.

    The attribute is plain data (see :func:`fed_envs.plain_data.freeze`), an ``nn.Module``, or has ``save_state()`` and
    ``load_state(state)``. The first axis of its arrays and lists is the client.

    :param name: of the attribute, with dots for nested attributes (``"noise.state"``)
    :param shared: all clients have the same; it has no client axis
    :param part: its part of parameter files, which several attributes may share; without one, the files leave it out
    :param file: in parameter files, the name of its array, or the prefix of its arrays' names; without one, the files do
        not hold it, and it begins anew if its part is read from a file
    :param later: rounds make it, not the offline stage; files leave it out as long as it is NaN
    """

    name: str
    shared: bool = False
    part: str = ""
    file: str = ""
    later: bool = False


def held_by(owner: Any) -> dict[str, Held]:
    """The declarations of ``owner``'s classes in ``state_attributes``, by attribute."""
    entries = [entry for kind in reversed(type(owner).__mro__) for entry in vars(kind).get("state_attributes", ())]
    return {held.name: held for held in (entry if isinstance(entry, Held) else Held(entry) for entry in entries)}


def save_held(owner: Any, shared: bool = False) -> State:
    """The state of ``owner`` for each client, or the state that all share, as plain data by attribute.

    :raises ValueError: for an attribute that is not plain data
    """
    names = [held.name for held in held_by(owner).values() if held.shared == shared]
    values = {name: value for name in names if (value := recursive_getattr(owner, name, owner)) is not owner}
    modules = {name: to_arrays(value.state_dict()) for name, value in values.items() if isinstance(value, nn.Module)}
    objects = {name: value.save_state() for name, value in values.items() if hasattr(value, "save_state")}
    own = {**modules, **objects}
    return {**freeze({name: value for name, value in values.items() if name not in own}), **own}


def load_held(owner: Any, state: State) -> None:
    """Restore the state from :func:`save_held`."""
    for name, saved in state.items():
        value: Any = recursive_getattr(owner, name, None) if isinstance(saved, dict) else None  # arrays need none to go into
        if isinstance(value, nn.Module):
            value.load_state_dict(to_tensors(saved))
        elif hasattr(value, "load_state"):
            value.load_state(saved)
        else:
            recursive_setattr(owner, name, thaw(saved))


def file_arrays(owner: Any, held: Held) -> dict[str, np.ndarray]:
    """The arrays of an attribute, not copied, by their names in parameter files."""
    if not held.file:
        return {}
    value = recursive_getattr(owner, held.name)
    if isinstance(value, np.ndarray):
        return {held.file: value}
    named = {name: tensor.numpy() for name, tensor in value.state_dict().items()} if isinstance(value, nn.Module) else value
    return {held.file + name: array for name, array in named.items()}
