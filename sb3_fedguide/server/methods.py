"""Every method's strategy from its settings alone, for a model in process and for a server without PyTorch."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from importlib import import_module
from typing import Any

from sb3_fedguide.registry import ALGORITHMS, algorithm, registered_names
from sb3_fedguide.seeding import Role, seed_sequence
from sb3_fedguide.server.averaging import Averaging, averaged_prefixes
from sb3_fedguide.server.moments import ObservationMoments
from sb3_fedguide.server.ot_moe import OTMoE
from sb3_fedguide.server.payload import DDPG_ACTOR, DDPG_CRITIC, PPO_ACTOR, PPO_CRITIC
from sb3_fedguide.server.strategy import Composite, Strategy
from sb3_fedguide.server.svrpg import SVRPG
from sb3_fedguide.settings import arguments
from sb3_fedguide.settings.arguments import (
    FedAvgArguments,
    FederationArguments,
    FedGuideAArguments,
    FedGuideArguments,
    FedGuideRArguments,
    FedRLArguments,
)
from sb3_fedguide.settings.ranges import check_normalize, check_values
from sb3_fedguide.settings.signatures import types_of

Settings = Mapping[str, Any]
#: Makes a strategy from complete settings, the number of clients and the federation's seed.
Maker = Callable[[Settings, int, int], Strategy | None]

#: Settings of every server.
COMMON = ("client_fraction", "upload_bound", "normalize")
#: Settings of an averaging method's server. Clipping and noise of uploads are included: all clients must have the same.
OF_AVERAGING = ("average_every", "average_until", "aggregator", "trim_fraction", "server_step", "server_momentum")
AVERAGING = ("average", *OF_AVERAGING, "noise_multiplier", "clipping_norm")
EXPERTISE = ("n_experts", "eta", "cost", "cost_scaling")


@dataclass(frozen=True)
class Method:
    """The server's side of a method.

    :param make: see :data:`Maker`
    :param defaults: its settings beside :data:`COMMON`, under their names in the model's constructor
    :param arguments: the dataclass of the model's constructor, for the ranges of these settings
        Settings that it does not have are checked as the arguments of the shipped algorithms with the same name
    """

    make: Maker
    defaults: Mapping[str, Any]
    arguments: type = FederationArguments

    @classmethod
    def of(cls, make: Maker, arguments: type, names: Sequence[str]) -> Method:
        """A method with the settings ``names`` of ``arguments``, with their defaults there."""
        return cls(make, {name: getattr(arguments, name) for name in names}, arguments)


def _averaging(kind: type[Averaging], actor: tuple[str, ...], critic: tuple[str, ...]) -> Maker:
    def make(settings: Settings, n_clients: int, seed: int) -> Strategy:
        prefixes = averaged_prefixes(settings["average"], actor, critic)
        return kind(prefixes, **{name: settings[name] for name in OF_AVERAGING})

    return make


def _experts(settings: Settings, n_clients: int, seed: int) -> Strategy:
    n_experts = settings["n_experts"] or n_clients
    return OTMoE(n_experts, settings["eta"], settings["cost"], settings["cost_scaling"], seed_sequence(seed, Role.SERVER))


def _experts_and_parameters(settings: Settings, n_clients: int, seed: int) -> Strategy:
    averaging = _averaging(Averaging, PPO_ACTOR, PPO_CRITIC)(settings, n_clients, seed)
    assert averaging is not None
    return Composite([_experts(settings, n_clients, seed), averaging])


#: The methods' servers; :data:`sb3_fedguide.registry.ALGORITHMS` assigns them.
NOTHING = Method(lambda settings, n_clients, seed: None, {})
PPO_AVERAGING = Method.of(_averaging(Averaging, PPO_ACTOR, PPO_CRITIC), FedAvgArguments, AVERAGING)
PPO_AVERAGING_BEYOND = Method.of(PPO_AVERAGING.make, FedGuideRArguments, AVERAGING)
SVRPG_AVERAGING = Method.of(_averaging(SVRPG, PPO_ACTOR, PPO_CRITIC), FedAvgArguments, AVERAGING)
DDPG_AVERAGING = Method.of(_averaging(Averaging, DDPG_ACTOR, DDPG_CRITIC), FedRLArguments, AVERAGING)
EXPERTS = Method.of(_experts, FedGuideArguments, EXPERTISE)
EXPERTS_AND_PARAMETERS = Method.of(_experts_and_parameters, FedGuideAArguments, (*EXPERTISE, *AVERAGING))


def find_method(name: str) -> Method:
    """The server's side of an algorithm, by its command-line name.

    For a user's own algorithm that is registered without a server, that of its base class; this imports the class and PyTorch.

    :raises ValueError: for an unknown algorithm, or one whose class makes its strategy itself
    """
    if name not in ALGORITHMS:
        raise ValueError(f"unknown algorithm {name!r}; known are {', '.join(ALGORITHMS)}")
    server = ALGORITHMS[name].server
    return algorithm(name).registered_method() if server is None else _load(server)


def method_of(cls: type) -> Method:
    """The server's side of the nearest base of a class that is registered with one; without one, nothing is exchanged."""
    servers = (ALGORITHMS[name].server for name in registered_names(cls))
    return next((_load(server) for server in servers if server is not None), NOTHING)


def _load(server: str) -> Method:
    module, _, name = server.partition(":")
    method = getattr(import_module(module), name, None)
    if not isinstance(method, Method):
        raise ValueError(f"server={server!r} of an algorithm must name a sb3_fedguide.server.methods.Method, not {method!r}")
    return method


@functools.cache
def _types_by_name() -> Mapping[str, Any]:
    """Name to type of every argument of the algorithms that are here; where they differ, it may have any of their types."""
    types: dict[str, Any] = {}
    for kind in [kind for kind in vars(arguments).values() if isinstance(kind, type) and is_dataclass(kind)]:
        for name, hint in types_of(kind).items():
            types[name] = hint if types.get(name, hint) == hint else types[name] | hint
    return types


def complete_settings(algorithm: str | Method, given: Settings) -> dict[str, Any]:
    """All settings of a method's server, with defaults for those that are not given.

    :raises ValueError: for a setting that the server does not have, and an unknown ``normalize``
    """
    method = find_method(algorithm) if isinstance(algorithm, str) else algorithm
    settings = {**{name: getattr(FederationArguments, name) for name in COMMON}, **method.defaults}
    if unknown := sorted(given.keys() - settings.keys()):
        whose = f"of {algorithm} " if isinstance(algorithm, str) else ""
        raise ValueError(f"the server {whose}has no setting {unknown[0]!r}; it has {', '.join(sorted(settings))}")
    complete = {**settings, **given}
    check_normalize(complete["normalize"])
    complete["normalize"] = "shared" if complete["normalize"] == "shared" else False  # the server does not use the others
    return complete


def make_strategy(algorithm: str | Method, settings: Settings, n_clients: int, seed: int) -> Strategy | None:
    """The strategy of an algorithm; ``None`` if nothing is exchanged.

    :param algorithm: command-line name, or the method itself
    :param settings: hyperparameters that the server needs, under the names of the constructor's parameters
    :param n_clients: clients of the federation
    :param seed: the federation's
    :raises ValueError: for unknown settings, or values out of range
    """
    complete = complete_settings(algorithm, settings)
    method = find_method(algorithm) if isinstance(algorithm, str) else algorithm
    check_values({**_types_by_name(), **types_of(method.arguments)}, complete)
    strategy = method.make(complete, n_clients, seed)
    if complete["normalize"] == "shared":
        moments = ObservationMoments(**{name: complete[name] for name in ("aggregator", "trim_fraction") if name in complete})
        strategy = moments if strategy is None else Composite([strategy, moments])
    if strategy is not None:
        strategy.upload_bound = complete["upload_bound"]
    return strategy
