"""The plot command: figures of a benchmark's results, or of runs from their folders, as PNG and PDF."""

from __future__ import annotations

import argparse
import importlib.util
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_fedguide.cli.arguments import OneLineParser
from sb3_fedguide.cli.benchmark_arguments import benchmark_parser, check_methods, parse_benchmark
from sb3_fedguide.cli.output import pipe_may_close
from sb3_fedguide.cli.run import one_message
from sb3_fedguide.exit_codes import EXIT_FAILED, EXIT_USAGE
from sb3_fedguide.registry import ALGORITHMS
from sb3_fedguide.settings.names import check_names
from sb3_fedguide.settings.packages import import_packages

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fed_envs import Family
    from sb3_fedguide.benchmark.figures.runs import Comparison

#: Flags that mean the same as for ``fedguide benchmark``.
SHARED = ("algos", "envs", "metadata", "seeds", "folder", "baseline", "gym_packages")
#: Flags that choose results of a benchmark, and do not apply to run folders.
OF_BENCHMARK = ("algos", "metadata", "seeds", "label")
FIGURES = ("curves", "bars", "cv", "clients", "aggregate", "speedup")
#: Figures that are drawn only from folders of runs, and only on request: from their logs, and from their policies.
OF_LOGS, OF_POLICIES = ("lemma2", "theorem3"), ("rollouts", "plan")
OF_FOLDERS = OF_LOGS + OF_POLICIES
#: Flags of the learning curves, and their defaults.
OF_CURVES = {"x": "rounds", "of": "average", "band": "range"}

Drawn = list[tuple[str, "Figure"]]


@pipe_may_close
def main(argv: Sequence[str] | None = None, prog: str = "fedguide plot") -> int:
    """Run the command.

    :return: the exit code: 0, 1 if a file could not be written, 2 for wrong input
    """
    arguments = _parse(argv, prog)
    try:
        _check(arguments)
        figures, left_out = _draw_all(arguments, *_read(arguments, prog))
    except (ValueError, OSError) as error:
        print(f"{prog}: error: {' '.join(one_message(error).split())}", file=sys.stderr)
        return EXIT_USAGE
    from sb3_fedguide.benchmark.figures.layout import save

    try:
        Path(arguments.output).mkdir(parents=True, exist_ok=True)
        for name, figure in figures:
            print("wrote", " ".join(map(str, save(figure, Path(arguments.output), name))))
    except OSError as error:
        print(f"{prog}: error: {one_message(error)}", file=sys.stderr)
        return EXIT_FAILED
    for reason in left_out:
        print(f"{prog}: {reason}", file=sys.stderr)
    return 0


def _parse(argv: Sequence[str] | None, prog: str) -> argparse.Namespace:
    parser = OneLineParser(
        prog=prog,
        allow_abbrev=False,
        description="Draw figures of a benchmark's results (--envs), or of runs from their folders, as PNG and PDF.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    flag = parser.add_argument
    flag("runs", nargs="*", default=[], metavar="RUN", help="folders of runs, finished or not, e.g. logs/*/HopperHard_1, "
         "instead of --envs")  # fmt: skip
    for action in benchmark_parser(prog)._actions:
        if action.dest in SHARED:
            parser._add_action(action)
    flag("--label", nargs="+", metavar="LABEL", help="names of the results; by default tuned; with several, legends "
         "show the method's name and label")  # fmt: skip
    flag(
        "--figures",
        nargs="+",
        metavar="FIGURE",
        help=f"{', '.join(FIGURES)}; by default all that the data allow; and from run folders: lemma2, theorem3, "
        "rollouts (an episode of each client), plan (FedGuide's transport plan)",
    )
    flag("--clients", nargs="+", type=int, metavar="K", help="clients to draw in rollouts; by default all")
    flag("-x", choices=("rounds", "steps", "seconds", "bytes"), help="x axis of learning curves; by default rounds")
    flag("--of", choices=("average", "worst", "clients"), help="content of learning curves: the clients' average (default), "
         "the worst client, or each client in its own panel")  # fmt: skip
    flag("--band", choices=("range", "bootstrap"), help="band of learning curves: lowest to highest seed (default), "
         "or the 95 %% bootstrap interval of the mean over seeds")  # fmt: skip
    flag("-o", "--output", default="figures", metavar="DIR", help="folder to write to")
    for action in parser._actions:
        if action.dest in ("seeds", "folder", "baseline"):
            action.help = {
                "seeds": "random seeds; by default all existing ones",
                "folder": "results are in DIR/FAMILY-LABEL/ALGO-seedN.json; by default runs/benchmark",
                "baseline": "method to compare with: its mean return has score 1, and is the target of the speed-up",
            }[action.dest]
    return parser.parse_strictly(argv)


def _check(arguments: argparse.Namespace) -> None:
    """:raises ValueError: for errors that the flags alone show"""
    from sb3_fedguide.cli.run_folder import check_log_folder

    if importlib.util.find_spec("matplotlib") is None:
        raise ValueError("drawing needs matplotlib, which is not installed; install it with 'pip install matplotlib'")
    if not arguments.runs and not arguments.envs and not arguments.metadata:
        raise ValueError("give folders of runs, or the families of a benchmark's results with --envs FAMILY ...")
    if arguments.runs and arguments.envs:
        raise ValueError("give folders of runs or --envs, not both")
    if arguments.runs and (given := [name for name in OF_BENCHMARK if getattr(arguments, name)]):
        raise ValueError(f"--{given[0]} chooses results of a benchmark (--envs); with folders of runs, leave it out")
    check_names(arguments.figures or (), (*FIGURES, *OF_FOLDERS), "figure")
    if arguments.clients and "rollouts" not in (arguments.figures or ()):
        raise ValueError("--clients is for rollouts; add rollouts to --figures")
    if not arguments.runs and (given := [name for name in OF_FOLDERS if name in (arguments.figures or ())]):
        raise ValueError(f"{given[0]} is drawn from folders of runs, e.g. logs/*/HopperHard_1; give them instead of --envs")
    given = [name for name in OF_CURVES if getattr(arguments, name) is not None]
    if given and arguments.figures and "curves" not in arguments.figures:
        raise ValueError(f"-{'' if given[0] == 'x' else '-'}{given[0]} is for learning curves; add curves to --figures")
    if len(set(arguments.label or ())) < len(arguments.label or ()):
        raise ValueError("--label names the same results twice")
    check_log_folder(Path(arguments.output), "output folder", "-o")


def _read(arguments: argparse.Namespace, prog: str) -> tuple[Comparison, Callable[[str], float]]:
    """The runs, and a family's return of random actions.

    :raises ValueError: for anything that a user can correct
    """
    import_packages(arguments.gym_packages)
    if arguments.runs:
        from sb3_fedguide.cli.plot_runs import read_run_folders

        comparison = read_run_folders(arguments.runs)
        methods = [name for runs in comparison.values() for name in runs]
        check_names([arguments.baseline], dict.fromkeys([*ALGORITHMS, *methods]), "algorithm")
        return comparison, lambda family: _random_of(next(iter(comparison[family].values()))[0].source)
    labels = arguments.label or ["tuned"]
    parsed = [parse_benchmark(_benchmark_flags(arguments, label), prog) for label in labels]
    check_methods(parsed[0])
    from sb3_fedguide.cli.benchmark import find_families
    from sb3_fedguide.cli.benchmark_results import random_level
    from sb3_fedguide.cli.plot_runs import read_benchmark

    families: Mapping[str, Family] = find_families(parsed[0], prog)
    comparison = read_benchmark(parsed[0], families, labels)
    return comparison, lambda family: random_level(Path(parsed[0].folder), families[family])


def _random_of(folder: Path) -> float:
    import fed_envs
    from sb3_fedguide.benchmark.aggregate import random_actions

    return random_actions(fed_envs.load_family((folder / "metadata.json").absolute())).average


def _benchmark_flags(arguments: argparse.Namespace, label: str) -> list[str]:
    """Flags of ``fedguide benchmark`` for the same results: we use its checks."""
    flags = ["--table-only", f"--label={label}"]
    for name in SHARED:
        value = getattr(arguments, name)
        if value:
            flags += [f"--{name.replace('_', '-')}", *(map(str, value) if isinstance(value, list) else [str(value)])]
    return flags


def drawable(
    comparison: Comparison, families: Mapping[str, Family], benchmark: argparse.Namespace, figures: Sequence[str] | None = None
) -> tuple[Drawn, list[str]]:
    """Every figure that runs of a benchmark allow, and the reasons why the others are left out.

    :param benchmark: its flags; only the folder and the baseline are used
    :param figures: figures to try; by default those of results
    """
    from sb3_fedguide.cli.benchmark_results import random_level

    options = argparse.Namespace(baseline=benchmark.baseline, **OF_CURVES)
    drawn: Drawn = []
    left_out: list[str] = []
    for figure in figures or FIGURES:
        try:
            drawn += _draw(
                figure, options, comparison, lambda name: random_level(Path(benchmark.folder), families[name]), left_out
            )
        except ValueError as error:
            left_out.append(f"left out {figure}: {error}")
    return drawn, left_out


def _draw_all(
    arguments: argparse.Namespace, comparison: Comparison, random: Callable[[str], float]
) -> tuple[Drawn, list[str]]:
    """Every requested figure, or every figure that the data allow; and the reasons why the others are left out.

    :raises ValueError: if a requested figure, or no figure at all, can be drawn
    """
    asked = set(arguments.figures or ())
    if any(getattr(arguments, name) is not None for name in OF_CURVES):
        asked.add("curves")  # its flags request it
    for name, default in OF_CURVES.items():
        if getattr(arguments, name) is None:
            setattr(arguments, name, default)
    drawn: Drawn = []
    left_out = [f"{run.source} is not finished, and is drawn only in learning curves"
                for runs in comparison.values() for group in runs.values() for run in group if run.result is None]  # fmt: skip
    for figure in arguments.figures or FIGURES:
        try:
            drawn += _draw(figure, arguments, comparison, random, left_out)
        except ValueError as error:
            if figure in asked:
                raise ValueError(f"{figure}: {error}") from None
            left_out.append(f"left out {figure}: {error}")
    if not drawn:
        raise ValueError(f"there is nothing to draw: {'; '.join(left_out)}")
    return drawn, left_out


def _draw(
    figure: str, arguments: argparse.Namespace, comparison: Comparison, random: Callable[[str], float], notes: list[str]
) -> Drawn:
    """:param notes: receives remarks about the figure"""
    from sb3_fedguide.benchmark.figures import bars, clients, curves

    if figure in OF_LOGS:
        from sb3_fedguide.benchmark.figures.theory import draw_lemma2, draw_theorem3
        from sb3_fedguide.cli.plot_logs import averages, read_logs

        if figure == "lemma2":
            return [(figure, draw_lemma2(read_logs(comparison)))]
        return [(figure, draw_theorem3(read_logs(averages(comparison))))]
    if figure in OF_POLICIES:
        from sb3_fedguide.cli import plot_rollouts as folders

        if figure == "rollouts":
            return [(f"rollouts-{_file_name(family)}", folders.rollouts(runs, arguments.clients))
                    for family, runs in comparison.items()]  # fmt: skip
        return folders.plans(comparison, _file_name, notes)
    if figure == "curves":
        name = f"curves-{arguments.of}-{arguments.x}"
        if arguments.of != "clients":
            return [(name, curves.draw_curves(comparison, arguments.of, arguments.x, arguments.band))]
        return [
            (f"{name}-{_file_name(family)}", curves.draw_client_curves(family, runs, arguments.x, arguments.band))
            for family, runs in comparison.items()
        ]
    if figure == "bars":
        return [("bars", bars.draw_bars(comparison))]
    if figure == "cv":
        return [("cv", bars.draw_cv(comparison))]
    if figure == "clients":
        return [(f"clients-{_file_name(family)}", clients.draw_clients(family, runs)) for family, runs in comparison.items()]
    if figure == "speedup":
        return [("speedup", bars.draw_speed_up(comparison, arguments.baseline))]
    if len(comparison) < 2:
        raise ValueError("it needs finished runs on several families")
    from sb3_fedguide.benchmark.figures import aggregates  # PyTorch comes with it

    complete = aggregates.complete_methods(comparison, arguments.baseline)  # before the measurement of random actions
    if partial := sorted({name for runs in comparison.values() for name in runs} - set(complete)):
        notes.append(f"aggregate is without {', '.join(partial)}: some families have no finished run")
    return [("aggregate", aggregates.draw_aggregate(comparison, {family: random(family) for family in comparison},
                                                    arguments.baseline))]  # fmt: skip


def _file_name(family: str) -> str:
    return re.sub(r"[^\w.+=-]+", "_", family).lstrip(".") or "family"
