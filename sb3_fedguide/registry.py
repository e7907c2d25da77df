"""The one table of algorithms: class, server, arguments and settings. A look-up imports the algorithm."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from sb3_fedguide.common.federated_ddpg import FederatedDDPG
    from sb3_fedguide.common.federated_ppo import FederatedPPO


class Entry(NamedTuple):
    """An algorithm.

    :param module: of its class
    :param cls: the class's name
    :param server: ``"module:name"`` of its server's :class:`~sb3_fedguide.server.methods.Method`; ``None`` for that of its
        base class
    :param arguments: ``"module:name"`` of the dataclass that its constructor takes, if it is known without the class;
        a configuration is then checked without PyTorch
    :param settings: its YAML file; ``None`` for ``<name>.yml`` in ``zoo_configs``, or that of the nearest base class
    """

    module: str
    cls: str
    server: str | None = None
    settings: Path | None = None
    arguments: str | None = None


def _ours(module: str, cls: str, server: str, arguments: str) -> Entry:
    known = f"sb3_fedguide.settings.arguments:{arguments}Arguments"
    return Entry(f"sb3_fedguide.algorithms.{module}", cls, f"sb3_fedguide.server.methods:{server}", None, known)


#: by command-line name
ALGORITHMS: dict[str, Entry] = {
    "local": _ours("local", "Local", "NOTHING", "FederatedPPO"),
    "pooled": _ours("pooled", "Pooled", "NOTHING", "FederatedPPO"),
    "fedavg": _ours("fedavg", "FedAvg", "PPO_AVERAGING", "FedAvg"),
    "fedprox": _ours("fedprox", "FedProx", "PPO_AVERAGING", "FedProx"),
    "fedkl": _ours("fedkl", "FedKL", "PPO_AVERAGING", "FedKL"),
    "fedsvrpgm": _ours("fedsvrpgm", "FedSVRPGM", "SVRPG_AVERAGING", "FedSVRPGM"),
    "fedrl": _ours("fedrl", "FedRL", "DDPG_AVERAGING", "FedRL"),
    "fedguide": _ours("fedguide", "FedGuide", "EXPERTS", "FedGuide"),
    "fedguide-p": _ours("fedguide", "FedGuideP", "EXPERTS", "FedGuide"),
    "fedguide-a": _ours("fedguide", "FedGuideA", "EXPERTS_AND_PARAMETERS", "FedGuideA"),
    "fedguide-r": _ours("fedguide_r", "FedGuideR", "PPO_AVERAGING_BEYOND", "FedGuideR"),
}


def register_algorithm(name: str, entry_point: str, server: str | None = None, settings: str | Path | None = None) -> None:
    """Register your own algorithm under a name, also for the command line (``--gym-packages``).

    :param name: for ``--algo``
    :param entry_point: ``"module:Class"``, imported when it is first used
    :param server: ``"module:name"`` of its :class:`~sb3_fedguide.server.methods.Method`, which a server
        imports, if possible without PyTorch; by default the nearest base class's
    :param settings: YAML file with its hyperparameters; by default those of the nearest base class
    :raises ValueError: for a name that is already taken
    """
    for what, value in (("entry_point", entry_point), ("server", server)):
        if value is not None and not all(value.partition(":")):
            raise ValueError(f"{what}={value!r} must be 'module:{'Class' if what == 'entry_point' else 'name'}'")
    module, _, cls = entry_point.partition(":")
    entry = Entry(module, cls, server, None if settings is None else Path(settings).absolute())
    known = ALGORITHMS.setdefault(name, entry)
    if entry not in (known, Entry(known.module, known.cls)):
        raise ValueError(f"the name {name!r} is taken by {known.module}:{known.cls}; choose another")


def algorithm(name: str) -> type[FederatedPPO] | type[FederatedDDPG]:
    """The class of the algorithm ``name``.

    :raises KeyError: for an unknown name
    """
    entry = ALGORITHMS[name]
    return getattr(import_module(entry.module), entry.cls)


def algorithm_name(cls: type) -> str:
    """The command-line name of an algorithm's class.

    :raises ValueError: for a class that no name is registered for
    """
    for name, entry in ALGORITHMS.items():
        if (entry.module, entry.cls) == (cls.__module__, cls.__name__):
            return name
    raise ValueError(f"{cls.__name__} has no name; give it one with register_algorithm()")


def registered_names(cls: type) -> list[str]:
    """The names of a class and of its bases, nearest first."""
    return [
        name
        for base in cls.__mro__
        for name, entry in ALGORITHMS.items()
        if (entry.module, entry.cls) == (base.__module__, base.__name__)
    ]
