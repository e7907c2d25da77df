"""The benchmark command: methods, families and seeds as runs that can be interrupted, and tables of their results."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.cli.arguments import parse_train
from sb3_fedguide.cli.benchmark_arguments import PASSED_ON, SETTINGS, check_methods, parse_benchmark, train_flags
from sb3_fedguide.cli.output import pipe_may_close
from sb3_fedguide.cli.run import one_message
from sb3_fedguide.cli.train import (
    EXIT_INTERRUPTED,
    check_before_imports,
    find_family,
    prepare,
)
from sb3_fedguide.exit_codes import EXIT_FAILED, EXIT_USAGE
from sb3_fedguide.registry import ALGORITHMS
from sb3_fedguide.settings.packages import import_packages

if TYPE_CHECKING:
    from fed_envs import Family
    from sb3_fedguide.benchmark.results import Result
    from sb3_fedguide.cli.benchmark_runs import BenchmarkRun, Outcome
    from sb3_fedguide.cli.benchmark_tables import Tables
    from sb3_fedguide.settings.config import Config

SEEDS = (0, 1, 2, 3, 4)
#: Inside the folder of a family's results: what runs need to go on.
RUNS = "runs"
#: Inside the folder of all results: what the returns of random actions are.
RANDOM_ACTIONS = "random-actions"


@dataclass(frozen=True)
class Plan:
    """What is to be done.

    :param families: by name, in the order given
    :param runs: those without a result
    :param n_done: how many have theirs
    """

    families: Mapping[str, Family]
    runs: Sequence[BenchmarkRun]
    n_done: int


@pipe_may_close
def main(argv: Sequence[str] | None = None, prog: str = "fedguide benchmark") -> int:
    """Run the command.

    :return: the exit code: 0, 1 where a run failed or a file could not be written, 2 for wrong input, 130 after an interrupt
        (SIGINT), 143 after SIGTERM
    """
    arguments = parse_benchmark(argv, prog)
    try:
        plan = prepare_benchmark(arguments, prog)
    except (ValueError, OSError) as error:
        print(f"{prog}: error: {one_message(error)}", file=sys.stderr)
        return EXIT_USAGE
    except KeyboardInterrupt:
        print(f"{prog}: interrupted before the runs began", file=sys.stderr)
        return EXIT_INTERRUPTED
    try:
        code = _run(arguments, plan) if plan.runs else 0
        _write(arguments, make_tables(arguments, plan.families, aggregated=code <= EXIT_FAILED))
    except (ValueError, OSError) as error:
        print(f"{prog}: error: {one_message(error)}", file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:
        print(f"{prog}: interrupted before the tables were made", file=sys.stderr)
        return EXIT_INTERRUPTED
    return code


def prepare_benchmark(arguments: argparse.Namespace, prog: str) -> Plan:
    """The plan, and Ray where it is to be used.

    :raises ValueError: for anything that a user can put right
    """
    import_packages(arguments.gym_packages)
    check_methods(arguments)
    plan = make_plan(arguments, prog)
    if arguments.engine == "ray" and plan.runs:
        from sb3_fedguide.cli.benchmark_ray import connect

        connect(arguments.address)
    return plan


def make_plan(arguments: argparse.Namespace, prog: str) -> Plan:
    """Check every run that is to be done; nothing is created.

    :raises ValueError: for anything that a user can put right
    """
    methods, flags = arguments.algos or list(ALGORITHMS), train_flags(arguments, SETTINGS + PASSED_ON)
    sources, families = _sources(arguments), find_families(arguments, prog)
    if arguments.table_only:
        _require_results(arguments, families)
        return Plan(families, (), 0)
    combinations = []
    for family, source in zip(families.values(), sources, strict=True):
        for method in methods:
            own = ["--algo", method, *source, *flags]
            parsed = parse_train([*own, "-f", arguments.folder, "--seed", str(max(arguments.seeds or SEEDS))], prog)
            check_before_imports(parsed)
            combinations.append((method, family, own, parsed))
    checked = [(method, family, own, prepare(parsed, family, "").config) for method, family, own, parsed in combinations]
    runs, n_done = [], 0
    for seed in arguments.seeds or SEEDS:
        for method, family, own, config in checked:
            run = _benchmark_run(arguments, method, family, seed, own)
            n_done += run.result.is_file()
            _check_earlier(run, family, config, arguments.eval_episodes)
            if not run.result.is_file():
                runs.append(run)
    return Plan(families, runs, n_done)


def _sources(arguments: argparse.Namespace) -> list[tuple[str, str]]:
    return [("--env", name) for name in arguments.envs] + [("--metadata", file) for file in arguments.metadata]


def find_families(arguments: argparse.Namespace, prog: str) -> dict[str, Family]:
    """The families of ``--envs`` and ``--metadata``, by name in the order given.

    :raises ValueError: for one that is unknown, or is given twice
    """
    families: dict[str, Family] = {}
    for source in _sources(arguments):
        family = find_family(parse_train([*source, *train_flags(arguments, SETTINGS + PASSED_ON)], prog))
        if family.name in families:
            raise ValueError(f"{source[1]}: the family {family.name} is given twice")
        families[family.name] = family
    return families


def _benchmark_run(
    arguments: argparse.Namespace, method: str, family: Family, seed: int, flags: Sequence[str]
) -> BenchmarkRun:
    from sb3_fedguide.benchmark.results import result_path
    from sb3_fedguide.cli.benchmark_runs import BenchmarkRun

    result = result_path(Path(arguments.folder).absolute(), family.name, arguments.label, method, seed)
    log_folder = result.parent / RUNS / result.stem
    quiet = ("--verbose", "0", *(() if arguments.keep_runs else ("--picture-freq", "0")))
    return BenchmarkRun(
        method=method,
        family=family.name,
        seed=seed,
        result=result,
        log_folder=log_folder,
        flags=(*flags, "--seed", str(seed), "-f", str(log_folder), *quiet),
        resume_flags=(*train_flags(arguments, PASSED_ON), *quiet),
        folder=Path.cwd(),
    )


def _check_earlier(run: BenchmarkRun, family: Family, config: Config, n_episodes: int) -> None:
    """:raises ValueError: if the run has been done, or begun, with other settings than those that are asked for"""
    from sb3_fedguide.benchmark.results import read_result
    from sb3_fedguide.cli.benchmark_runs import interrupted_folder
    from sb3_fedguide.settings.config import read_yaml

    now = {**config.values, "clients": family.content_hash}
    if run.result.is_file():
        result, where = read_result(run.result), run.result
        before: dict[str, Any] = {"n_rounds": result.n_rounds, **(result.config or {}), "clients": result.metadata_hash}
        before["--eval-episodes"], now["--eval-episodes"] = result.n_episodes, n_episodes
    elif (folder := interrupted_folder(run.log_folder, run.method)) is not None:
        where = folder
        before = {**read_yaml(folder / "config.yml"), "clients": (folder / "metadata.sha256").read_text().strip()}
    else:
        return
    if changed := differences(before, now):
        raise ValueError(
            f"{where} is of a run with other settings: {'; '.join(changed[:3])}; give another --label, or move that away"
        )


def differences(before: Mapping[str, Any], now: Mapping[str, Any], prefix: str = "") -> list[str]:
    """What both mappings have and have differently; one of them may be of another version, with more or fewer settings."""
    found = []
    for name in before.keys() & now.keys():
        old, new = json.loads(json.dumps([before[name], now[name]]))  # tuples and lists are the same here
        if isinstance(old, dict) and isinstance(new, dict):
            found += differences(old, new, f"{prefix}{name}.")
        elif old != new:
            found.append(f"{prefix}{name} {old}, not {new}")
    return sorted(found)


def _require_results(arguments: argparse.Namespace, families: Mapping[str, Family]) -> None:
    for name, measures in benchmark_results(arguments, families).items():
        if not measures:
            raise ValueError(no_results(arguments.folder, name))


def no_results(folder: str, family: str) -> str:
    """The message for a family without results, with the folders of results that there are."""
    there = sorted(path.parent.name for path in Path(folder).glob("*/*-seed*.json"))
    known = f"; there are {', '.join(dict.fromkeys(there))}" if there else ""
    return f"{folder} has no results of {family} with these methods and seeds{known}"


def _run(arguments: argparse.Namespace, plan: Plan) -> int:
    """Do the runs and report each."""
    from sb3_fedguide.cli.benchmark_runs import forget, interrupted_folder, run_here
    from sb3_fedguide.cli.run_folder import write_json
    from sb3_fedguide.cli.signals import StopSignals

    total, n_finished = len(plan.runs), 0
    failed: list[BenchmarkRun] = []
    resumed = sum(interrupted_folder(run.log_folder, run.method) is not None for run in plan.runs)
    _say(f"{total} runs to do, {resumed} of them begun before; {plan.n_done} have their result; writing to {arguments.folder}")

    def done(run: BenchmarkRun, outcome: Outcome) -> None:
        nonlocal n_finished
        problem = outcome.problem
        if outcome.content is not None:
            n_finished += 1
            try:
                write_json(run.result, outcome.content)
            except OSError as error:
                problem = f"its result cannot be written to {run.result}: {error.strerror}"
            else:
                if not arguments.keep_runs:
                    forget(run)
                seconds = outcome.content["seconds"]["total"]
                _say(f"[{n_finished} of {total}] {run.name}: {outcome.content['deployed']['average']:.4g} ({seconds:.0f} s)")
        if problem and not outcome.interrupted:
            failed.append(run)
            _say(f"{run.name} failed: {problem}")

    with StopSignals() as signals:
        signals.can_wait = True
        try:
            if arguments.engine == "ray":
                from sb3_fedguide.cli.benchmark_ray import run_on_ray

                run_on_ray(plan.runs, arguments.processes, signals, done)
            else:
                run_here(plan.runs, arguments.processes or 1, signals, done, _say)
        except KeyboardInterrupt:
            pass  # the second signal: the runs are ended, and the first one is in signals.received
    unfinished = sum(not run.result.is_file() for run in plan.runs)
    if signals.received is not None:
        _say(f"interrupted; {unfinished} runs are not finished, and the same command goes on with them")
        return signals.exit_code
    if failed:
        names = "; ".join(run.name for run in failed)
        _say(f"{len(failed)} of {total} runs failed: {names}. The same command tries them again")
    return EXIT_FAILED if failed else 0


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


def benchmark_results(arguments: argparse.Namespace, families: Iterable[str]) -> dict[str, dict[str, list[Result]]]:
    """Family to method to its results."""
    from sb3_fedguide.benchmark.results import read_results

    seeds = arguments.seeds or (None if arguments.table_only else SEEDS)
    methods = arguments.algos or list(ALGORITHMS)
    return {name: read_results(Path(arguments.folder), name, arguments.label, methods, seeds) for name in families}


def make_tables(arguments: argparse.Namespace, families: Mapping[str, Family], aggregated: bool = True) -> Tables:
    """Tables of all results that there are.

    :param aggregated: whether several families are aggregated
    :raises ValueError: for a damaged result file
    """
    from sb3_fedguide.benchmark.results import best_known, measure
    from sb3_fedguide.cli.benchmark_tables import Tables

    found = {name: results for name, results in benchmark_results(arguments, families).items() if results}
    rows = {}
    for name, results in found.items():
        baseline = results.get(arguments.baseline)
        baseline = baseline if len(results) > 1 else None
        best = best_known(run for runs in results.values() for run in runs)
        rows[f"{name}-{arguments.label}"] = [measure(runs, arguments.at_rounds, baseline, best) for runs in results.values()]
    if len(found) < 2 or not aggregated:
        return Tables(rows, (), ())
    complete = [method for method in next(iter(found.values())) if all(method in results for results in found.values())]
    if arguments.baseline not in complete:
        note = f"no aggregate: it needs results of the baseline, {arguments.baseline}, on every family"
        return Tables(rows, (), (note,))
    from sb3_fedguide.benchmark.aggregate import aggregate

    finals = {name: {method: [run.final for run in results[method]] for method in complete} for name, results in found.items()}
    means = {name: sum(values[arguments.baseline]) / len(values[arguments.baseline]) for name, values in finals.items()}
    levels = {name: (random_level(Path(arguments.folder), families[name]), means[name]) for name in found}
    if too_low := [f"{name} ({high:.4g}, random actions {low:.4g})" for name, (low, high) in levels.items() if not low < high]:
        note = f"no aggregate: the baseline, {arguments.baseline}, is no better than random actions on {', '.join(too_low)}"
        return Tables(rows, (), (note,))
    aggregates = [aggregate(method, {name: finals[name][method] for name in found}, levels) for method in complete]
    scale = ", ".join(f"{name} {low:.4g} to {high:.4g}" for name, (low, high) in levels.items())
    notes = [f"Scores are 0 for random actions and 1 for the mean of {arguments.baseline}: {scale}."]
    if partial := sorted({method for results in found.values() for method in results} - set(complete)):
        notes.append(f"Without {', '.join(partial)}, of which some families have no run.")
    return Tables(rows, aggregates, notes)


def random_level(folder: Path, family: Family) -> float:
    """What random actions return, measured once and kept with the results."""
    from sb3_fedguide.benchmark.aggregate import random_actions
    from sb3_fedguide.cli.run_folder import write_json

    path = folder / RANDOM_ACTIONS / f"{family.name}.json"
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        if kept["metadata_hash"] == family.content_hash:
            return float(kept["average"])
    except (OSError, ValueError, KeyError, TypeError):
        pass  # not measured yet, or of other clients
    evaluation = random_actions(family)
    content = {
        "env": family.name,
        "metadata_hash": family.content_hash,
        "average": evaluation.average,
        "client_returns": evaluation.client_returns.tolist(),
        "n_episodes": evaluation.returns.shape[1],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, content)
    return evaluation.average


def _write(arguments: argparse.Namespace, tables: Tables) -> None:
    from sb3_fedguide.cli.benchmark_tables import as_csv, as_json, markdown, print_tables
    from sb3_fedguide.cli.run_folder import write_text

    if not tables.families:
        return
    formats = {"markdown": markdown, "json": as_json, "csv": as_csv}
    asked = {name: getattr(arguments, name) for name in formats if getattr(arguments, name) is not None}
    for name, file in asked.items():
        if file == "-":
            print(formats[name](tables), end="")
        else:
            write_text(Path(file), formats[name](tables))
    if "-" not in asked.values():
        print_tables(tables)
