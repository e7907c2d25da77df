"""The request of a training command, resolved once: its clients, its hyperparameters, its simulated delays.

All users of a command (a run, a benchmark's list of runs, a trial) take the result; nothing of it is parsed or read
again. This imports neither PyTorch nor the simulator, except for a user's own algorithm.
"""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.cli.gymnasium_ids import is_registered, registered_family
from sb3_fedguide.registry import ALGORITHMS
from sb3_fedguide.settings.names import check_names

if TYPE_CHECKING:
    from fed_envs import Family
    from sb3_fedguide.server.delays import DelaySettings
    from sb3_fedguide.settings.config import Config

ID_PREFIX, ID_SUFFIX = "fed_envs/", "-v0"


@dataclass(frozen=True)
class Request:
    """The algorithm and all settings of a training.

    :param arguments: the flags, as in ``args.yml``
    :param config: every hyperparameter, checked
    :param delays: to simulate; ``None`` for none
    :param overrides: the hyperparameters from the command itself, by flags or ``-params``
    """

    arguments: argparse.Namespace
    family: Family
    config: Config
    delays: DelaySettings | None = None
    overrides: Mapping[str, Any] = field(default_factory=dict)


def resolve_request(arguments: argparse.Namespace, family: Family) -> Request:
    """Check the flags and the files that they name, and fill in the rest.

    :param family: from :func:`find_family`
    :raises ValueError: for anything that a user can correct
    """
    from sb3_fedguide.cli.delays import read_delays
    from sb3_fedguide.cli.run_folder import check_log_folder, parameter_file
    from sb3_fedguide.offline.cache import cache_folder, check_cache_folder
    from sb3_fedguide.settings.config import resolve

    check_names([arguments.algo], ALGORITHMS, "algorithm")
    if arguments.engine == "ray" and importlib.util.find_spec("ray") is None:
        raise ValueError("--engine ray needs Ray: pip install 'sb3-fedguide[ray]'")
    check_tracker(arguments.track)
    check_log_folder(Path(arguments.log_folder))
    if arguments.tensorboard_log is not None:
        check_log_folder(Path(arguments.tensorboard_log))
    check_cache_folder(cache_folder(arguments.cache_dir))
    delays = None if arguments.delays is None else read_delays(arguments.delays)
    trained = None if arguments.trained_agent is None else str(parameter_file(arguments.trained_agent))
    given, entry = _overrides(arguments), settings_entry(arguments.env)
    config = resolve(arguments.algo, family, arguments.conf_file, entry, given, arguments.n_timesteps)
    # the run's own, should a file change or the working directory be another
    kept = {"delays": None if delays is None else str(delays), "trained_agent": trained}
    return Request(argparse.Namespace(**{**vars(arguments), **kept}), family, config, delays, given)


def find_family(arguments: argparse.Namespace) -> Family:
    """The clients of ``--env`` or ``--metadata``.

    :raises ValueError: for an unknown family, a wrong file, or two that do not belong together
    """
    import fed_envs

    named = None
    if arguments.env is not None:
        name = arguments.env
        if name.startswith(ID_PREFIX) and name.endswith(ID_SUFFIX):
            name = name[len(ID_PREFIX) : -len(ID_SUFFIX)]
        ids = name.split(",")
        if name in fed_envs.FAMILIES or not (len(ids) > 1 or is_registered(name) or arguments.client_kwargs):
            check_names([name], fed_envs.FAMILIES, "environment")
            named = fed_envs.load_family(name)
        else:
            named = registered_family(ids, arguments.client_kwargs, arguments.env_kwargs)
    if (arguments.client_kwargs or arguments.env_kwargs) and (named is None or named.world != "gymnasium"):
        raise ValueError("--client-kwargs and --env-kwargs are for the ids of registered environments, --env Pendulum-v1")
    if arguments.metadata is None:
        assert named is not None  # one of the two is required
        return named
    if not Path(arguments.metadata).is_file():
        raise ValueError(f"--metadata: there is no file {arguments.metadata}")
    family = fed_envs.load_family(Path(arguments.metadata).absolute())
    if named is not None and named.backbone != family.backbone:
        raise ValueError(
            f"--env {named.name} and --metadata {arguments.metadata} do not belong together: the file's clients are "
            f"{family.backbone}, not {named.backbone}; leave --env out to take the settings of the file's own family"
        )
    return family


def check_tracker(name: str | None) -> None:
    """:raises ValueError: if the package that ``--track`` needs is missing"""
    if name is not None and importlib.util.find_spec(name) is None:
        raise ValueError(f"--track {name} needs the package {name}: pip install 'sb3-fedguide[{name}]'")


def _overrides(arguments: argparse.Namespace) -> dict[str, Any]:
    """Hyperparameters given on the command line, flags included.

    :raises ValueError: if two of them set the same hyperparameter
    """
    from sb3_fedguide.settings.config import parse_params

    given = parse_params(arguments.hyperparams)
    flags = {
        "n_rounds": ("--rounds", arguments.rounds),
        "n_envs_per_client": ("--n-envs-per-client", arguments.n_envs_per_client),
        "pretraining.dataset": ("--dataset", arguments.dataset),
    }
    for name, (flag, value) in flags.items():
        if value is not None:
            if name in given:
                raise ValueError(f"{flag} and -params {name} set the same thing; give one of them")
            given[name] = value
    if arguments.n_timesteps is not None and "n_rounds" in given:
        raise ValueError("-n/--n-timesteps and -params n_rounds both set the length; give one of them")
    return given


def settings_entry(env: str | None) -> str | None:
    """The entry of a configuration file for ``--env``; ``None`` for that of the family."""
    return None if env is None else env.removeprefix(ID_PREFIX).removesuffix(ID_SUFFIX)
