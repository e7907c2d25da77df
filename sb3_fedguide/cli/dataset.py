"""The command that makes a Minari dataset from a user's own logs: CSV or NPZ files of a robot's transitions."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_fedguide.cli.arguments import OneLineParser

if TYPE_CHECKING:
    from gymnasium.spaces import Space


def main(argv: Sequence[str] | None = None, prog: str = "fedguide dataset") -> int:
    """Run the command.

    :return: the exit code: 0, or 2 for wrong input
    """
    from sb3_fedguide.offline.make_dataset import COLUMNS, make_dataset, read_log

    parser = _parser(prog, COLUMNS)
    arguments = parser.parse_strictly(argv)
    try:
        name = arguments.dataset
        target = Path(name) if name.startswith((".", "/", "~")) else name
        columns = read_log(arguments.logs, {entry: given for entry in COLUMNS if (given := getattr(arguments, entry))})
        target = target.expanduser() if isinstance(target, Path) else target
        folder = make_dataset(target, **columns, action_space=_action_space(arguments), overwrite=arguments.overwrite)
    except (ValueError, OSError) as error:
        parser.error(" ".join(str(error).split()))
    print(f"wrote {folder}; train with --dataset {name}")
    return 0


def _parser(prog: str, columns: dict[str, tuple[str, ...]]) -> OneLineParser:
    parser = OneLineParser(prog=prog, description=__doc__, allow_abbrev=False)
    flag = parser.add_argument
    flag("dataset", metavar="DATASET", help="id such as robots/arm0-v0, or a path that begins with . or /")
    flag("logs", nargs="+", metavar="LOG", help="CSV files with a header, or NPZ files, in their order; each ends an episode")
    flag("--env", metavar="ID", help="environment with the action space of the data: a Gymnasium id, or a family")
    flag("--action-low", nargs="+", type=float, metavar="A", help="lower bounds of the actions, instead of --env")
    flag("--action-high", nargs="+", type=float, metavar="A", help="upper bounds of the actions")
    flag("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules to import first")
    for entry, known in columns.items():
        flag(f"--{entry.replace('_', '-')}", nargs="+", metavar="NAME", help=f"columns (CSV) or array (NPZ) of the {entry}, "
             f"by default {' or '.join(known)}, in CSV with numbers or words after an underscore")  # fmt: skip
    flag("--overwrite", action="store_true", help="replace an existing dataset")
    return parser


def _action_space(arguments: argparse.Namespace) -> Space:
    """:raises ValueError: if the flags do not define it"""
    import gymnasium
    import numpy as np

    import fed_envs
    from sb3_fedguide.settings.packages import import_packages

    low, high = arguments.action_low, arguments.action_high
    if (arguments.env is None) == (low is None) or (low is None) != (high is None):
        raise ValueError("give the client's action space: --env ID, or --action-low and --action-high")
    if low is not None:
        if len(low) != len(high) or not all(a < b for a, b in zip(low, high, strict=True)):
            raise ValueError(f"--action-low {low} and --action-high {high} are not bounds of one action")
        return gymnasium.spaces.Box(np.array(low, dtype=np.float32), np.array(high, dtype=np.float32))
    import_packages(arguments.gym_packages)
    try:
        env = (
            fed_envs.load_family(arguments.env).make(0)
            if arguments.env in fed_envs.FAMILIES
            else gymnasium.make(arguments.env)
        )
    except gymnasium.error.Error as error:
        raise ValueError(f"--env {arguments.env}: {error}") from None
    try:
        return env.action_space
    finally:
        env.close()
