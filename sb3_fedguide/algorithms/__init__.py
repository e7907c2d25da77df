"""The algorithms by name. Looking one up imports it; listing them imports nothing."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sb3_fedguide.common.federated_ppo import FederatedPPO

#: command-line name to module and class
ALGORITHMS: dict[str, tuple[str, str]] = {
    "local": ("sb3_fedguide.algorithms.local", "Local"),
    "fedavg": ("sb3_fedguide.algorithms.fedavg", "FedAvg"),
    "fedguide": ("sb3_fedguide.algorithms.fedguide", "FedGuide"),
    "fedguide-p": ("sb3_fedguide.algorithms.fedguide", "FedGuideP"),
    "fedguide-a": ("sb3_fedguide.algorithms.fedguide", "FedGuideA"),
}


def algorithm(name: str) -> type[FederatedPPO]:
    """The class of the algorithm ``name``.

    :raises KeyError: for an unknown name
    """
    module, cls = ALGORITHMS[name]
    return getattr(import_module(module), cls)
