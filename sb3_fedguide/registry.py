"""The algorithms by name. Looking one up imports it; listing them imports nothing."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sb3_fedguide.common.federated_ddpg import FederatedDDPG
    from sb3_fedguide.common.federated_ppo import FederatedPPO

#: command-line name to module and class
ALGORITHMS: dict[str, tuple[str, str]] = {
    "local": ("sb3_fedguide.algorithms.local", "Local"),
    "pooled": ("sb3_fedguide.algorithms.pooled", "Pooled"),
    "fedavg": ("sb3_fedguide.algorithms.fedavg", "FedAvg"),
    "fedprox": ("sb3_fedguide.algorithms.fedprox", "FedProx"),
    "fedkl": ("sb3_fedguide.algorithms.fedkl", "FedKL"),
    "fedsvrpgm": ("sb3_fedguide.algorithms.fedsvrpgm", "FedSVRPGM"),
    "fedrl": ("sb3_fedguide.algorithms.fedrl", "FedRL"),
    "fedguide": ("sb3_fedguide.algorithms.fedguide", "FedGuide"),
    "fedguide-p": ("sb3_fedguide.algorithms.fedguide", "FedGuideP"),
    "fedguide-a": ("sb3_fedguide.algorithms.fedguide", "FedGuideA"),
    "fedguide-r": ("sb3_fedguide.algorithms.fedguide_r", "FedGuideR"),
}


def register_algorithm(name: str, entry_point: str) -> None:
    """Make an algorithm of one's own known by name, on the command line too (``--gym-packages``).

    :param name: what ``--algo`` takes
    :param entry_point: ``"module:Class"``, imported when it is first used
    :raises ValueError: for a name that means something else already
    """
    module, _, cls = entry_point.partition(":")
    if not module or not cls:
        raise ValueError(f"entry_point={entry_point!r} must be 'module:Class'")
    if ALGORITHMS.get(name, (module, cls)) != (module, cls):
        raise ValueError(f"the name {name!r} is taken by {':'.join(ALGORITHMS[name])}; choose another")
    ALGORITHMS[name] = (module, cls)


def algorithm(name: str) -> type[FederatedPPO] | type[FederatedDDPG]:
    """The class of the algorithm ``name``.

    :raises KeyError: for an unknown name
    """
    module, cls = ALGORITHMS[name]
    return getattr(import_module(module), cls)


def algorithm_name(cls: type) -> str:
    """The command-line name of an algorithm's class.

    :raises ValueError: for a class that no name is registered for
    """
    for name, entry_point in ALGORITHMS.items():
        if entry_point == (cls.__module__, cls.__name__):
            return name
    raise ValueError(f"{cls.__name__} has no name; give it one with register_algorithm()")
