"""The flags of ``fedguide tune``: those of the training command for its runs, and its own. Imports nothing heavy."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_fedguide.cli.arguments import OneLineParser, train_parser
from sb3_fedguide.cli.benchmark_arguments import check_seeds_and_processes
from sb3_fedguide.registry import ALGORITHMS

#: Flags of the training command that determine a run's results.
SETTINGS = (
    "algo", "env", "client_kwargs", "env_kwargs", "metadata", "dataset", "rounds", "n_timesteps", "n_envs_per_client",
    "conf_file", "hyperparams", "eval_freq", "eval_episodes",
)  # fmt: skip
#: Other flags of the training command.
PASSED_ON = ("gym_packages", "cache_dir", "save_freq", "device")
SAMPLERS = ("tpe", "random", "grid")
PRUNERS = ("median", "halving", "none")
N_TRIALS = 20


def tune_parser(prog: str) -> OneLineParser:
    """Parser of the command."""
    parser = OneLineParser(
        prog=prog,
        allow_abbrev=False,
        description="Search for an algorithm's hyperparameters with Optuna. Every trial has the same environment steps; the "
        "same command resumes the study until it has N trials.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    flag = parser.add_argument
    for action in train_parser(prog)._actions:
        if action.dest in SETTINGS + PASSED_ON:
            parser._add_action(action)
    parser.set_defaults(algo=None)
    flag("--n-trials", type=int, metavar="N", help="trials of the study, earlier ones included; by default "
         f"{N_TRIALS}, and with --sampler grid every combination")  # fmt: skip
    flag("--seeds", nargs="+", type=int, default=[0], metavar="N", help="random seeds of a trial's runs, one after another; "
         "its value is their mean")  # fmt: skip
    flag("--search", metavar="SPACE.yml", help="search space, NAME: [values] or NAME: {low, high, log}; by default a "
         "small space of the algorithm (docs/tuning.md)")  # fmt: skip
    flag("--sampler", default="tpe", choices=SAMPLERS, help="method that proposes settings; grid: every combination once")
    flag("--pruner", default="median", choices=PRUNERS, help="method that ends trials early")
    flag("--storage", metavar="FILE.db", help="SQLite file of the study; by default DIR/STUDY/study.db")
    flag("--study-name", metavar="STUDY", help="by default FAMILY-ALGO")
    flag("--processes", type=int, default=1, metavar="K", help="trials at a time")
    flag("-f", "--folder", default="runs/tune", metavar="DIR", help="results are written to DIR/STUDY")
    return parser


def parse_tune(argv: Sequence[str] | None, prog: str) -> argparse.Namespace:
    """Parse, and refuse errors that the flags alone show."""
    parser = tune_parser(prog)
    arguments = parser.parse_strictly(argv)
    try:
        _check(arguments)
    except ValueError as error:
        parser.error(str(error))
    return arguments


def _check(arguments: argparse.Namespace) -> None:
    if arguments.algo is None:
        raise ValueError(f"give the algorithm with --algo: {', '.join(ALGORITHMS)}")
    if arguments.n_trials is not None and arguments.n_trials < 1:
        raise ValueError(f"--n-trials must be at least 1, not {arguments.n_trials}")
    check_seeds_and_processes(arguments.seeds, arguments.processes)
    if arguments.study_name is not None and not _is_file_name(arguments.study_name):
        raise ValueError(f"--study-name {arguments.study_name!r} is also the name of a folder; leave out / and leading dots")
    if arguments.storage is not None and Path(arguments.storage).is_dir():
        raise ValueError(f"--storage {arguments.storage} is a folder; give the path of an SQLite file")


def _is_file_name(name: str) -> bool:
    return bool(name) and name.isprintable() and "/" not in name and "\\" not in name and not name.startswith(".")
