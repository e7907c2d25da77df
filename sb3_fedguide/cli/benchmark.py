"""The benchmark command: methods, families and seeds as resumable runs, and tables of their results."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.cli.arguments import parse_train
from sb3_fedguide.cli.benchmark_arguments import OF_RUNS, PASSED_ON, SETTINGS, check_methods, parse_benchmark, train_flags
from sb3_fedguide.cli.benchmark_results import (
    SEEDS,
    TableRow,
    asked_rows,
    make_tables,
    require_results,
    results_of_rows,
    write_tables,
)
from sb3_fedguide.cli.output import pipe_may_close
from sb3_fedguide.cli.request import Request, find_family, resolve_request
from sb3_fedguide.cli.run import one_message
from sb3_fedguide.cli.train import EXIT_INTERRUPTED, prepare
from sb3_fedguide.exit_codes import EXIT_FAILED, EXIT_USAGE
from sb3_fedguide.registry import ALGORITHMS
from sb3_fedguide.settings.packages import import_packages

if TYPE_CHECKING:
    from fed_envs import Family
    from sb3_fedguide.cli.benchmark_results import Results
    from sb3_fedguide.cli.benchmark_runs import BenchmarkRun, Outcome
    from sb3_fedguide.cli.study_file import Study
    from sb3_fedguide.settings.config import Config


@dataclass(frozen=True)
class Plan:
    """The work of a benchmark.

    :param families: by name, in the given order
    :param rows: of the tables
    :param runs: runs without a result
    :param configs: the settings of each of these runs
    :param done: runs with a result
    :param results: with ``--table-only``, all existing ones
    :param study: the study that it belongs to
    """

    families: Mapping[str, Family]
    rows: Sequence[TableRow]
    runs: Sequence[BenchmarkRun] = ()
    configs: Sequence[Config] = ()
    done: Sequence[BenchmarkRun] = ()
    results: Results | None = None
    study: Study | None = None


@pipe_may_close
def main(argv: Sequence[str] | None = None, prog: str = "fedguide benchmark") -> int:
    """Run the command.

    :return: the exit code: 0, 1 if a run failed or a file could not be written, 2 for wrong input, 130 after an interrupt
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
        if arguments.dry_run:
            from sb3_fedguide.cli.benchmark_costs import print_costs

            print_costs(plan, arguments.eval_freq, arguments.eval_episodes)
            return 0
        code = _run(arguments, plan) if plan.runs else 0
        results = plan.results or results_of_rows(arguments.folder, plan.families, plan.rows)
        tables = make_tables(arguments, plan.families, results, aggregated=code <= EXIT_FAILED)
        if plan.study is not None and len(tables.families) > 1:
            tables = replace(tables, overview=plan.study.overview)
        write_tables(arguments, tables)
        if plan.study is not None and tables.families and code <= EXIT_FAILED:
            from sb3_fedguide.cli.study import write_study

            write_study(plan, arguments, results, tables)
    except (ValueError, OSError) as error:
        print(f"{prog}: error: {one_message(error)}", file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:
        print(f"{prog}: interrupted before the tables were made", file=sys.stderr)
        return EXIT_INTERRUPTED
    return code


def prepare_benchmark(arguments: argparse.Namespace, prog: str) -> Plan:
    """Make the plan, and connect to Ray if it is used.

    :raises ValueError: for anything that a user can correct
    """
    import_packages(arguments.gym_packages)
    if arguments.study is not None:
        from sb3_fedguide.cli.study import plan_study

        plan = plan_study(arguments, prog)
    else:
        check_methods(arguments)
        plan = make_plan(arguments, prog)
    if arguments.engine == "ray" and plan.runs and not arguments.dry_run:
        from sb3_fedguide.cli.benchmark_ray import connect

        connect(arguments.address)
    return plan


def make_plan(arguments: argparse.Namespace, prog: str) -> Plan:
    """Check every missing run; nothing is created. With ``--dry-run`` this constructs no algorithm.

    :raises ValueError: for anything that a user can correct
    """
    methods, flags = arguments.algos or list(ALGORITHMS), train_flags(arguments, SETTINGS + PASSED_ON + OF_RUNS)
    sources, families, rows = _sources(arguments), find_families(arguments, prog), asked_rows(arguments)
    if arguments.table_only:
        return Plan(families, rows, results=require_results(arguments.folder, families, rows))
    checked: list[tuple[list[str], Request]] = []
    for family, source in zip(families.values(), sources, strict=True):
        for method in methods:
            own = ["--algo", method, *source, *flags]
            parsed = parse_train([*own, "-f", arguments.folder, "--seed", str(max(arguments.seeds or SEEDS))], prog)
            checked.append((own, resolve_request(parsed, family)))
    runs: list[BenchmarkRun] = []
    configs: list[Config] = []
    done: list[BenchmarkRun] = []
    missing = []
    for seed in arguments.seeds or SEEDS:
        for number, (own, request) in enumerate(checked):
            run = _benchmark_run(arguments, request, seed, own)
            _check_earlier(run, request)
            if run.result.is_file():
                done.append(run)
            else:
                runs.append(run)
                configs.append(request.config)
                missing.append(number)
    for number in () if arguments.dry_run else sorted(set(missing)):
        prepare(checked[number][1], "")  # checks that the settings fit the environments
    return Plan(families, rows, runs, configs, done)


def _sources(arguments: argparse.Namespace) -> list[tuple[str, str]]:
    return [("--env", name) for name in arguments.envs] + [("--metadata", file) for file in arguments.metadata]


def find_families(arguments: argparse.Namespace, prog: str) -> dict[str, Family]:
    """The families of ``--envs`` and ``--metadata``, by name in the order given.

    :raises ValueError: for a family that is unknown, or is given twice
    """
    families: dict[str, Family] = {}
    for source in _sources(arguments):
        family = find_family(parse_train([*source, *train_flags(arguments, SETTINGS + PASSED_ON)], prog))
        if family.name in families:
            raise ValueError(f"{source[1]}: the family {family.name} is given twice")
        families[family.name] = family
    return families


def _benchmark_run(arguments: argparse.Namespace, request: Request, seed: int, flags: Sequence[str]) -> BenchmarkRun:
    from sb3_fedguide.benchmark.results import result_path
    from sb3_fedguide.cli.benchmark_runs import BenchmarkRun, log_folder_of

    method, family = request.arguments.algo, request.family.name
    result = result_path(Path(arguments.folder).absolute(), family, arguments.label, method, seed)
    log_folder = log_folder_of(result)
    quiet = ("--verbose", "0", *(() if arguments.keep_runs else ("--picture-freq", "0")))
    return BenchmarkRun(
        method=method,
        family=family,
        seed=seed,
        result=result,
        log_folder=log_folder,
        flags=(*flags, "--seed", str(seed), "-f", str(log_folder), *quiet),
        resume_flags=(*train_flags(arguments, PASSED_ON), *quiet),
        folder=Path.cwd(),
    )


def _check_earlier(run: BenchmarkRun, request: Request) -> None:
    """:raises ValueError: if the run has been done, or begun, with other settings than the requested ones"""
    from sb3_fedguide.benchmark.results import read_result
    from sb3_fedguide.cli.benchmark_runs import interrupted_folder
    from sb3_fedguide.settings.config import read_yaml

    now = {
        **request.config.values,
        "clients": request.family.content_hash,
        "--delays": request.arguments.delays,
    }
    if run.result.is_file():
        result, where = read_result(run.result), run.result
        before: dict[str, Any] = {"n_rounds": result.n_rounds, **(result.config or {}), "clients": result.metadata_hash}
        before["--delays"] = result.delays
        before["--eval-episodes"], now["--eval-episodes"] = result.n_episodes, request.arguments.eval_episodes
    elif (folder := interrupted_folder(run.log_folder, run.method)) is not None:
        where = folder
        before = {**read_yaml(folder / "config.yml"), "clients": (folder / "metadata.sha256").read_text().strip()}
        if (folder / "args.yml").is_file():
            before["--delays"] = read_yaml(folder / "args.yml").get("delays")
    else:
        return
    if changed := differences(before, now):
        raise ValueError(
            f"{where} is of a run with other settings: {'; '.join(changed[:3])}; give another --label, or move it away"
        )


def differences(before: Mapping[str, Any], now: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Entries with different values; one of the mappings may be of another version, with more or fewer settings."""
    found = []
    for name in before.keys() & now.keys():
        old, new = json.loads(json.dumps([before[name], now[name]]))  # tuples and lists are the same here
        if isinstance(old, dict) and isinstance(new, dict):
            found += differences(old, new, f"{prefix}{name}.")
        elif old != new:
            found.append(f"{prefix}{name} {old}, not {new}")
    return sorted(found)


def _run(arguments: argparse.Namespace, plan: Plan) -> int:
    """Do the runs and report each."""
    from sb3_fedguide.cli.benchmark_runs import forget, interrupted_folder, run_here
    from sb3_fedguide.cli.run_folder import write_json
    from sb3_fedguide.cli.signals import StopSignals

    total, n_finished = len(plan.runs), 0
    failed: list[BenchmarkRun] = []
    resumed = sum(interrupted_folder(run.log_folder, run.method) is not None for run in plan.runs)
    before = f"{resumed} of them begun before; {len(plan.done)} have their result"
    _say(f"{total} runs to do, {before}; writing to {arguments.folder}")

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
            pass  # the second signal: all runs have been killed, and signals.received has the first one
    unfinished = sum(not run.result.is_file() for run in plan.runs)
    if signals.received is not None:
        _say(f"interrupted; {unfinished} runs are not finished; the same command resumes them")
        return signals.exit_code
    if failed:
        names = "; ".join(run.name for run in failed)
        _say(f"{len(failed)} of {total} runs failed: {names}. The same command tries them again")
    return EXIT_FAILED if failed else 0


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)
