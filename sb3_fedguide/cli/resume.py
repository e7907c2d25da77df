"""Resume a run: its own settings, its newest checkpoint, its own files."""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.cli.arguments import train_parser
from sb3_fedguide.registry import ALGORITHMS
from sb3_fedguide.settings.names import check_names

if TYPE_CHECKING:
    from fed_envs import Family
    from sb3_fedguide.settings.config import Config

#: Flags that do not change a run's results, so that they may differ from the run's own.
FREE = ("verbose", "progress", "save_freq", "picture_freq", "num_threads", "cache_dir", "gym_packages", "resume", "engine",
        "num_actors", "ray_address", "track", "track_project")  # fmt: skip

PATHS = ("log_folder", "tensorboard_log", "metadata", "client_kwargs")

#: Flags that may make a run longer.
LENGTH = ("rounds", "n_timesteps")


def given_flags(argv: Sequence[str] | None, prog: str) -> dict[str, Any]:
    """The flags on the command line, by their names in ``args.yml``."""
    parser = train_parser(prog)
    for action in parser._actions:
        action.default = argparse.SUPPRESS
    return vars(parser.parse_args(argv))


def read_arguments(folder: Path, given: Mapping[str, Any], prog: str) -> argparse.Namespace:
    """The flags with which a run was started, and the free ones that are given now.

    :raises ValueError: if ``folder`` is not that of a run, or a given flag contradicts the run's own
    """
    saved = _read_yaml(folder, "args.yml")
    parser = train_parser(prog)
    arguments = parser.parse_args([])
    for action in parser._actions:
        name = action.dest
        if name in saved and name != "resume":
            if not _is_possible(action, saved[name]):
                raise ValueError(f"{folder / 'args.yml'} is damaged: {name} is {saved[name]!r}")
            setattr(arguments, name, saved[name])
    if arguments.seed < 0:
        raise ValueError(f"{folder / 'args.yml'} is damaged: the run's own seed is not negative")
    flags = {action.dest: action.option_strings[-1] for action in parser._actions}
    for name, value in given.items():
        if name in FREE:
            setattr(arguments, name, value)
        elif name in LENGTH:
            for other in LENGTH:
                setattr(arguments, other, given.get(other))
        elif _comparable(name, value) != _comparable(name, getattr(arguments, name)):
            raise ValueError(
                f"{flags[name]} {value} contradicts the run in {folder}, whose own is {getattr(arguments, name)}; leave it "
                "out, or start a new run"
            )
    return arguments


def _is_possible(action: argparse.Action, value: Any) -> bool:
    if value is None:
        return action.default is None
    if action.nargs == "+":
        return isinstance(value, list) and all(isinstance(item, str) for item in value)
    kind = bool if action.nargs == 0 else action.type or str
    return type(value) is kind and (action.choices is None or value in action.choices)


def _comparable(name: str, value: Any) -> Any:
    if name == "delays" and value is not None:
        from sb3_fedguide.cli.delays import read_delays

        return str(read_delays(value))
    if name == "trained_agent" and value is not None:
        from sb3_fedguide.cli.run_folder import parameter_file

        return str(parameter_file(value))
    return (
        str(Path(value).absolute())
        if name in ("log_folder", "tensorboard_log", "metadata", "client_kwargs") and value
        else value
    )


def _read_yaml(folder: Path, name: str) -> dict[str, Any]:
    from sb3_fedguide.settings.config import read_yaml

    if not (folder / name).is_file():
        raise ValueError(
            f"{folder} is not the folder of a run to resume: it has no {name}; give one such as logs/fedguide/HopperHard_1"
        )
    content = read_yaml(folder / name)
    if not isinstance(content, dict):
        raise ValueError(f"{folder / name} is damaged: it is not a mapping")
    return content


def read_settings(folder: Path, algo: str) -> tuple[Config, Family]:
    """A run's own hyperparameters and clients.

    :raises ValueError: if one of its files is missing or damaged
    """
    from fed_envs.metadata import read_family
    from sb3_fedguide.settings.config import Config, complete

    check_names([algo], ALGORITHMS, "algorithm")
    try:
        config = Config(algo, "", complete(_read_yaml(folder, "config.yml"), algo))
    except ValueError as error:
        raise ValueError(f"{folder / 'config.yml'}: {error}") from None
    if not (folder / "metadata.json").is_file():
        raise ValueError(f"{folder} is not the folder of a run to resume: it has no metadata.json")
    return config, read_family(folder / "metadata.json")


def with_length(config: Config, family: Family, given: Mapping[str, Any]) -> Config:
    """The run's settings with the new length, if one is given."""
    from sb3_fedguide.settings.config import rounds_of

    n_rounds = given.get("rounds")
    if given.get("n_timesteps") is not None:
        n_rounds = rounds_of(config.values, family.n_clients, given["n_timesteps"])
    return config if n_rounds is None else replace(config, values={**config.values, "n_rounds": n_rounds})


def check_length(folder: Path, config: Config, done: int) -> None:
    """:raises ValueError: if the run has already more rounds than the new length, or cannot have more"""
    from sb3_fedguide.cli.run_folder import CHECKPOINTS
    from sb3_fedguide.state.checkpoint_files import checkpoints

    if config.n_rounds < done:
        raise ValueError(f"the run in {folder} has done {done} rounds, so its length cannot be {config.n_rounds}")
    if config.n_rounds > done and not checkpoints(folder / CHECKPOINTS):
        raise ValueError(
            f"the run in {folder} has done its {done} rounds and has no checkpoint to resume from; start a new run from its "
            f"parameters with -i {folder}"
        )


def finished_rounds(folder: Path) -> int | None:
    """Number of rounds of a finished run; ``None`` for an unfinished one."""
    try:
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        return int(summary["rounds_done"]) if summary["finished"] else None
    except (OSError, ValueError, KeyError, TypeError):
        return None  # it was killed, or interrupted


def load_checkpoint(folder: Path, load: Callable[[Path], Any], prog: str) -> bool:
    """Pass the folder of checkpoints to ``load``; if there are none, the run begins from the beginning.

    :return: whether there was one
    :raises ValueError: if none can be read
    """
    from sb3_fedguide.cli.run_folder import CHECKPOINTS, EVALUATIONS, PLAN, versions
    from sb3_fedguide.common.checkpoint import checkpoints

    if not checkpoints(folder / CHECKPOINTS):
        for table in (EVALUATIONS, PLAN):
            (folder / table).unlink(missing_ok=True)
        return False
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load(folder / CHECKPOINTS)
    messages = [str(warning.message) for warning in caught if warning.category is UserWarning]
    try:
        before = json.loads((folder / "versions.json").read_text(encoding="utf-8"))
        changed = [f"{name} {before[name]}" for name, version in versions().items() if before.get(name, version) != version]
    except (OSError, ValueError, AttributeError):
        changed = []
    if changed:
        messages.append(f"the run began with {', '.join(changed)}; its results may differ from those of an uninterrupted run")
    for message in messages:
        print(f"{prog}: warning: {message}", file=sys.stderr)
    return True
