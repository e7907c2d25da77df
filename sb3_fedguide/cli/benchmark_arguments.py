"""The flags of ``fedguide benchmark``: those of the training command for its runs, and its own. Imports nothing heavy."""

from __future__ import annotations

import argparse
import functools
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_fedguide.cli.arguments import OneLineParser, train_parser
from sb3_fedguide.registry import ALGORITHMS
from sb3_fedguide.settings.names import check_names

#: Flags of the training command that determine a run's results; a resumed run has them in its own settings.
SETTINGS = ("dataset", "rounds", "n_envs_per_client", "conf_file", "hyperparams")
#: Other flags of the training command.
PASSED_ON = ("gym_packages", "cache_dir", "eval_freq", "eval_episodes", "save_freq", "device")
#: Such flags that only a benchmark takes.
OF_RUNS = ("delays", "eval_average")
#: With ``--study``, the study's file sets these instead.
OF_STUDY = (*SETTINGS, "delays", "metadata", "label", "eval_freq", "eval_episodes", "at_rounds", "baseline")
ENGINES = ("local", "ray")
FOLDER = "runs/benchmark"
#: Method that others are compared with, by default.
BASELINE = "local"
#: Rounds of the learning curve that tables show, by default.
AT_ROUNDS = (25, 50)
#: Of tables in files.
FORMATS = ("markdown", "latex", "json", "csv")


def benchmark_parser(prog: str) -> OneLineParser:
    """Parser of the command."""
    parser = OneLineParser(
        prog=prog,
        allow_abbrev=False,
        description="Train methods on families with seeds, one result file per run, and print tables of the results. Runs "
        "with a result are not repeated, interrupted runs are resumed. A study describes all of this in a file.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    flag = parser.add_argument
    flag("--study", metavar="FILE", help="YAML file of a study: methods, families, seeds and settings; --algos, --envs and "
         "--seeds then choose a part of it, and tables and figures are written to DIR/studies/NAME")  # fmt: skip
    flag("--algos", nargs="+", metavar="ALGO", help=f"methods; by default all: {', '.join(ALGORITHMS)}")
    flag("--envs", nargs="+", default=[], metavar="FAMILY", help="families of client environments, such as HopperHard")
    flag("--metadata", nargs="+", default=[], metavar="FILE", help="metadata files of your own families")
    flag(
        "--seeds",
        nargs="+",
        type=int,
        metavar="N",
        help="random seeds; by default 0 1 2 3 4, and with --table-only all existing ones",
    )
    for action in train_parser(prog)._actions:
        if action.dest in SETTINGS + PASSED_ON + OF_RUNS:
            parser._add_action(action)
    flag("-f", "--folder", metavar="DIR", help=f"results are written to DIR/FAMILY-LABEL/ALGO-seedN.json, and "
         f"checkpoints to DIR/FAMILY-LABEL/runs; by default {FOLDER}, or that of the study")  # fmt: skip
    flag("--label", help="name of the results; by default the configuration's")
    flag("--keep-runs", action="store_true", help="keep the folders of finished runs: models, TensorBoard events")
    flag(
        "--processes", type=int, metavar="K", help="runs at a time; by default 1, and with Ray as many as the cluster has CPUs"
    )
    flag("--engine", default="local", choices=ENGINES, help="where runs are done: in local processes, or as tasks of Ray")
    flag("--address", "--ray-address", metavar="HOST:PORT", help="Ray cluster; by default "
         "$RAY_ADDRESS, the cluster of this machine, or a new one")  # fmt: skip
    flag("--table-only", action="store_true", help="do no runs, only print the tables of existing results")
    flag("--dry-run", action="store_true", help="do no runs, only list the missing ones and estimate their CPU hours")
    flag("--at-rounds", nargs="*", type=int, default=list(AT_ROUNDS), metavar="N", help="rounds of the learning curve to show")
    flag("--baseline", default=BASELINE, metavar="ALGO", help="method whose mean return has score 1 if several families are "
         "aggregated")  # fmt: skip
    for name in FORMATS:
        flag(f"--{name}", nargs="?", const="-", metavar="FILE", help=f"write the tables as {name} to FILE, or to the terminal")
    return parser


def parse_benchmark(argv: Sequence[str] | None, prog: str) -> argparse.Namespace:
    """Parse, and refuse errors that the flags alone show."""
    parser = benchmark_parser(prog)
    arguments = parser.parse_strictly(argv)
    try:
        if arguments.study is not None:
            _check_study(arguments, parser)
        _check(arguments)
    except ValueError as error:
        parser.error(str(error))
    if arguments.folder is None and arguments.study is None:
        arguments.folder = FOLDER
    arguments.label = arguments.label if arguments.label is not None else Path(arguments.conf_file).stem
    if not re.fullmatch(r"[\w.+=-]+", arguments.label):
        parser.error(f"--label {arguments.label!r} becomes part of a folder's name: use only letters, digits and . _ + = -")
    return arguments


def _check(arguments: argparse.Namespace) -> None:
    if not arguments.envs and not arguments.metadata and arguments.study is None:
        raise ValueError("give the families with --envs FAMILY ..., or --metadata FILE ...")
    for flag, values in (("--algos", arguments.algos), ("--envs", arguments.envs)):
        check_once(flag, values or ())
    check_seeds_and_processes(arguments.seeds or (), arguments.processes)
    if wrong := [value for value in arguments.at_rounds if value < 1]:
        raise ValueError(f"--at-rounds counts from 1, but got {wrong[0]}")
    if arguments.address is not None and arguments.engine != "ray":
        raise ValueError("--address is the address of a Ray cluster; give --engine ray as well")
    if arguments.dry_run and arguments.table_only:
        raise ValueError("--dry-run and --table-only contradict each other; give one of them")
    for file in [file for name in FORMATS if (file := getattr(arguments, name)) not in (None, "-")]:
        if not Path(file).absolute().parent.is_dir() or Path(file).is_dir():
            raise ValueError(f"the tables cannot be written to {file}: {_reason(Path(file))}")


def _check_study(arguments: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """:raises ValueError: for a flag whose meaning the study's file decides"""
    for action in parser._actions:
        if action.dest in OF_STUDY and getattr(arguments, action.dest) != action.default:
            raise ValueError(f"the study's file sets {action.option_strings[0]}; leave out the flag, or --study")


def check_once(flag: str, values: Sequence[Any]) -> None:
    """:raises ValueError: for a value that is given twice"""
    if repeated := [value for value, count in Counter(values).items() if count > 1]:
        raise ValueError(f"{flag} names {repeated[0]} twice")


def check_seeds_and_processes(seeds: Sequence[int], processes: int | None) -> None:
    """Check the seeds and processes of several runs.

    :raises ValueError: for seeds that are negative or given twice, and for fewer than one process
    """
    check_once("--seeds", seeds)
    if processes is not None and processes < 1:
        raise ValueError(f"--processes must be at least 1, not {processes}")
    if negative := [seed for seed in seeds if seed < 0]:
        raise ValueError(f"--seeds must not be negative, as {negative[0]} is: a run with a random seed cannot be resumed")


def _reason(path: Path) -> str:
    return "it is a folder" if path.is_dir() else f"there is no folder {path.parent}"


def check_methods(arguments: argparse.Namespace) -> None:
    """Check the methods, after the user's own are registered.

    :raises ValueError: for an unknown one
    """
    check_names([*(arguments.algos or ()), arguments.baseline], ALGORITHMS, "algorithm")


@functools.cache
def _train_actions() -> Sequence[argparse.Action]:
    """Flags of the training command, made once for the many runs of a study, and never changed."""
    return tuple(train_parser("")._actions)


def train_flags(arguments: argparse.Namespace, names: Sequence[str]) -> list[str]:
    """The flags ``names`` for the training command, with their values here."""
    flags: list[str] = []
    for action in _train_actions():
        value = getattr(arguments, action.dest, None) if action.dest in names else None
        if value is True:
            flags.append(action.option_strings[-1])
        elif value is not None and value is not False and value != []:
            flags += [action.option_strings[-1], *(map(str, value) if isinstance(value, list) else [str(value)])]
    return flags
