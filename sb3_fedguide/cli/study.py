"""A study: a benchmark with methods, settings, families and seeds from a file, and tables and figures at its end."""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_fedguide.cli.benchmark_arguments import PASSED_ON, parse_benchmark, train_flags
from sb3_fedguide.cli.benchmark_results import require_results
from sb3_fedguide.cli.study_file import Row, Study, read_study
from sb3_fedguide.settings.names import check_names

if TYPE_CHECKING:
    from fed_envs import Family
    from sb3_fedguide.benchmark.figures.runs import Comparison
    from sb3_fedguide.cli.benchmark import Plan
    from sb3_fedguide.cli.benchmark_results import Results
    from sb3_fedguide.cli.benchmark_tables import Tables

#: Inside the folder of all results: tables and figures of studies.
STUDIES = "studies"
#: Names of the files of tables, by form.
FILES = {"markdown": "tables.md", "latex": "tables.tex", "json": "tables.json", "csv": "tables.csv"}


def plan_study(arguments: argparse.Namespace, prog: str) -> Plan:
    """Check every run of the study in ``arguments.study``, or of the part that the flags choose; nothing is created.

    The file's settings for all runs and tables are put into ``arguments``.

    :raises ValueError: for anything that a user can correct
    """
    study = read_study(Path(arguments.study))
    try:
        return _plan(study, arguments, prog)
    except ValueError as error:
        raise ValueError(f"{arguments.study}: {error}") from None


def _plan(study: Study, arguments: argparse.Namespace, prog: str) -> Plan:
    from sb3_fedguide.cli.benchmark import Plan, find_families

    arguments.folder = arguments.folder or study.folder
    arguments.baseline, arguments.at_rounds = study.baseline, list(study.at_rounds)
    arguments.eval_freq = study.eval_freq or arguments.eval_freq
    arguments.eval_episodes = study.eval_episodes or arguments.eval_episodes
    arguments.processes = arguments.processes or study.processes
    arguments.keep_runs = arguments.keep_runs or study.eval_average
    every = argparse.Namespace(**{**vars(arguments), "envs": study.families, "metadata": study.metadata})
    families = find_families(every, prog)
    sources = dict(zip(families, [("--envs", name) for name in study.families]
                       + [("--metadata", file) for file in study.metadata], strict=True))  # fmt: skip
    rows = [_part(row, families, arguments) for row in _chosen(study, arguments)]
    names = [name for name in families if name in (arguments.envs or families)]
    check_names(arguments.envs, families, "family of the study:")
    _check_places(rows, names)
    if not any(row.seeds and (row.families is None or set(row.families) & set(names)) for row in rows):
        given = [flag for flag in ("--algos", "--envs", "--seeds") if getattr(arguments, flag.removeprefix("--"))]
        raise ValueError(f"{' with '.join(given)} leaves no run of the study; give fewer of these flags")
    study = replace(study, rows=rows)
    chosen = {name: families[name] for name in names}
    in_tables = [row.in_tables for row in rows]
    if arguments.table_only:
        return Plan(chosen, in_tables, results=require_results(arguments.folder, chosen, in_tables), study=study)
    parts = [
        _plan_row(row, [sources[name] for name in names if row.families is None or name in row.families], arguments, prog)
        for row in rows
    ]
    cells = [
        (replace(run, title=row.name), config)
        for row, part in zip(rows, parts, strict=True) for run, config in zip(part.runs, part.configs, strict=True)
    ]  # fmt: skip
    cells.sort(key=lambda cell: cell[0].seed)  # every row's first seed before any row's second
    return Plan(
        families=chosen,
        rows=in_tables,
        runs=[run for run, _ in cells],
        configs=[config for _, config in cells],
        done=[replace(run, title=row.name) for row, part in zip(rows, parts, strict=True) for run in part.done],
        study=study,
    )


def _chosen(study: Study, arguments: argparse.Namespace) -> list[Row]:
    """The rows of ``--algos``, by their own name or their algorithm's; all without this flag."""
    asked = arguments.algos
    if asked is None:
        return list(study.rows)
    check_names(asked, dict.fromkeys(name for row in study.rows for name in (row.name, row.algo)), "method of the study:")
    return [row for row in study.rows if row.name in asked or row.algo in asked]


def _part(row: Row, families: Mapping[str, Family], arguments: argparse.Namespace) -> Row:
    """The row with only the seeds of ``--seeds``."""
    check_names(row.families or (), families, f"family of method {row.name!r}:")
    if arguments.seeds is None:
        return row
    return replace(row, seeds=[seed for seed in row.seeds if seed in arguments.seeds])


def _check_places(rows: Sequence[Row], families: Sequence[str]) -> None:
    """:raises ValueError: for two rows whose results would be the same files"""
    taken: dict[tuple[str, str, str], Row] = {}
    for row in rows:
        for family in row.families or families:
            other = taken.setdefault((family, row.label, row.algo), row)
            if other is not row:
                raise ValueError(
                    f"methods {other.name!r} and {row.name!r} are both {row.algo} with the label {row.label!r}, so that their "
                    "results would be the same files; give one of them a label of its own"
                )


def _plan_row(row: Row, sources: Sequence[tuple[str, str]], arguments: argparse.Namespace, prog: str) -> Plan:
    """The plan of ``fedguide benchmark`` for this row alone."""
    from sb3_fedguide.cli.benchmark import Plan, make_plan

    if not sources or not row.seeds:
        return Plan({}, ())
    flags = [*row.flags, "--algos", row.algo, "--seeds", *map(str, row.seeds), "-f", arguments.folder]
    for flag in ("--envs", "--metadata"):
        values = [value for source, value in sources if source == flag]
        flags += [flag, *values] if values else []
    flags += train_flags(arguments, PASSED_ON) + ["--keep-runs"] * arguments.keep_runs + ["--dry-run"] * arguments.dry_run
    try:
        return make_plan(parse_benchmark(flags, prog), prog)
    except ValueError as error:
        raise ValueError(f"method {row.name!r}: {error}") from None


def write_study(plan: Plan, arguments: argparse.Namespace, results: Results, tables: Tables) -> None:
    """Write its tables in every format, and the figures that its results allow, beside the results.

    :raises OSError: if a file cannot be written
    """
    from sb3_fedguide.cli.benchmark_tables import WRITERS
    from sb3_fedguide.cli.run_folder import write_text

    assert plan.study is not None
    folder = Path(arguments.folder) / STUDIES / plan.study.name
    folder.mkdir(parents=True, exist_ok=True)
    for name, file in FILES.items():
        write_text(folder / file, WRITERS[name](tables))
    if importlib.util.find_spec("matplotlib") is None:
        print(f"tables are in {folder}; figures need matplotlib, which is not installed", file=sys.stderr)
        return
    from sb3_fedguide.benchmark.figures.layout import save
    from sb3_fedguide.cli.plot import OF_LOGS, drawable

    figures, left_out = drawable(_comparison(plan, results), plan.families, arguments)
    if plan.study.eval_average and (kept := _kept_runs(plan, results)):
        more, reasons = drawable(kept, plan.families, arguments, OF_LOGS)
        figures, left_out = figures + more, left_out + reasons
    for name, figure in figures:
        save(figure, folder, name)
    for reason in left_out:
        print(reason, file=sys.stderr)
    print(f"tables and {len(figures)} figures are in {folder}", file=sys.stderr)


def _kept_runs(plan: Plan, results: Results) -> Comparison:
    """The runs of the study whose folders still exist."""
    from sb3_fedguide.cli.benchmark_runs import interrupted_folder, log_folder_of
    from sb3_fedguide.cli.plot_runs import read_run_folder

    variants, found = _variants(plan), {}
    for family, rows in results.items():
        folders = {
            name: [interrupted_folder(log_folder_of(result.path), result.method) for result in group]
            for name, group in rows.items()
        }
        runs = {
            name: [replace(read_run_folder(path), name=name, variant=variants[name]) for path in group if path is not None]
            for name, group in folders.items()
        }
        found[family] = {name: group for name, group in runs.items() if group}
    return {family: runs for family, runs in found.items() if runs}


def _variants(plan: Plan) -> dict[str, int]:
    """Name of a row to its number among those of the same method."""
    methods = [row.method for row in plan.rows]
    return {row.name: methods[:place].count(row.method) for place, row in enumerate(plan.rows)}


def _comparison(plan: Plan, results: Results) -> Comparison:
    from sb3_fedguide.benchmark.figures.runs import from_result

    variants = _variants(plan)
    return {
        family: {name: [from_result(result, name, variants[name]) for result in group] for name, group in rows.items()}
        for family, rows in results.items()
        if rows
    }
