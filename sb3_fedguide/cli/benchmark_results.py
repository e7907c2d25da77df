"""Results of a benchmark as rows of tables, and the tables."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_fedguide.registry import ALGORITHMS

if TYPE_CHECKING:
    from fed_envs import Family
    from sb3_fedguide.benchmark.results import Result
    from sb3_fedguide.cli.benchmark_tables import Tables

    #: Family to the name of a row to its results.
    Results = dict[str, dict[str, list[Result]]]

SEEDS = (0, 1, 2, 3, 4)
#: Inside the folder of all results: the returns of random actions.
RANDOM_ACTIONS = "random-actions"


@dataclass(frozen=True)
class TableRow:
    """A row of a family's table: a method under a label.

    :param name: in the table
    :param seeds: seeds to include; ``None`` for all existing ones
    :param families: families with this row; ``None`` for all
    """

    name: str
    method: str
    label: str
    seeds: Sequence[int] | None
    families: Sequence[str] | None = None


def asked_rows(arguments: argparse.Namespace) -> list[TableRow]:
    """A row for each requested method."""
    seeds = arguments.seeds or (None if arguments.table_only else SEEDS)
    return [TableRow(method, method, arguments.label, seeds) for method in arguments.algos or ALGORITHMS]


def require_results(folder: str, families: Iterable[str], rows: Sequence[TableRow]) -> Results:
    """:func:`results_of_rows`, with at least one result of each family.

    :raises ValueError: for a family without a result
    """
    found = results_of_rows(folder, families, rows)
    for name, results in found.items():
        if not results:
            raise ValueError(no_results(folder, name))
    return found


def no_results(folder: str, family: str) -> str:
    """The message for a family without results, with the existing folders of results."""
    folders = sorted(path.parent.name for path in Path(folder).glob("*/*-seed*.json"))
    known = f"; there are {', '.join(dict.fromkeys(folders))}" if folders else ""
    return f"{folder} has no results of {family} with these methods and seeds{known}"


def benchmark_results(arguments: argparse.Namespace, families: Iterable[str]) -> Results:
    """The results of the requested methods."""
    return results_of_rows(arguments.folder, families, asked_rows(arguments))


def results_of_rows(folder: str, families: Iterable[str], rows: Sequence[TableRow]) -> Results:
    """The existing results, without rows that have none.

    :raises ValueError: for a damaged file, and for results that do not belong in one table
    """
    from sb3_fedguide.benchmark.results import check_comparable, read_results

    found: Results = {}
    for name in families:
        found[name] = {}
        for row in rows:
            if row.families is None or name in row.families:
                for results in read_results(Path(folder), name, row.label, [row.method], row.seeds).values():
                    found[name][row.name] = results
        check_comparable([result for results in found[name].values() for result in results])
    return found


def make_tables(
    arguments: argparse.Namespace, families: Mapping[str, Family], results: Results, aggregated: bool = True
) -> Tables:
    """Tables of the results.

    :param aggregated: whether several families are aggregated
    """
    from sb3_fedguide.benchmark.results import best_known, measure
    from sb3_fedguide.cli.benchmark_tables import Tables

    found = {name: of_family for name, of_family in results.items() if of_family}
    tables = {}
    for name, of_family in found.items():
        baseline = of_family.get(arguments.baseline)
        baseline = baseline if len(of_family) > 1 else None
        best = best_known(run for runs in of_family.values() for run in runs)
        tables[f"{name}-{arguments.label}" if arguments.study is None else name] = [
            replace(measure(runs, arguments.at_rounds, baseline, best), method=row) for row, runs in of_family.items()
        ]
    if len(found) < 2 or not aggregated:
        return Tables(tables, (), ())
    complete = [method for method in next(iter(found.values())) if all(method in rows for rows in found.values())]
    if arguments.baseline not in complete:
        note = f"no aggregate: it needs results of the baseline, {arguments.baseline}, on every family"
        return Tables(tables, (), (note,))
    from sb3_fedguide.benchmark.aggregate import aggregate

    finals = {name: {method: [run.final for run in rows[method]] for method in complete} for name, rows in found.items()}
    means = {name: sum(values[arguments.baseline]) / len(values[arguments.baseline]) for name, values in finals.items()}
    levels = {name: (random_level(Path(arguments.folder), families[name]), means[name]) for name in found}
    if too_low := [f"{name} ({high:.4g}, random actions {low:.4g})" for name, (low, high) in levels.items() if not low < high]:
        note = f"no aggregate: the baseline, {arguments.baseline}, is no better than random actions on {', '.join(too_low)}"
        return Tables(tables, (), (note,))
    aggregates = [aggregate(method, {name: finals[name][method] for name in found}, levels) for method in complete]
    scale = ", ".join(f"{name} {low:.4g} to {high:.4g}" for name, (low, high) in levels.items())
    notes = [f"Scores are 0 for random actions and 1 for the mean of {arguments.baseline}: {scale}."]
    if partial := sorted({method for rows in found.values() for method in rows} - set(complete)):
        notes.append(f"Without {', '.join(partial)}, of which some families have no run.")
    return Tables(tables, aggregates, notes)


def random_level(folder: Path, family: Family) -> float:
    """The return of random actions, measured once and stored with the results."""
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


def write_tables(arguments: argparse.Namespace, tables: Tables) -> None:
    """Write the tables to the files that the flags name; also print them, unless a flag prints its own format."""
    from sb3_fedguide.cli.benchmark_tables import WRITERS, print_tables
    from sb3_fedguide.cli.run_folder import write_text

    if not tables.families:
        return
    asked = {name: getattr(arguments, name) for name in WRITERS if getattr(arguments, name) is not None}
    for name, file in asked.items():
        if file == "-":
            print(WRITERS[name](tables), end="")
        else:
            write_text(Path(file), WRITERS[name](tables))
    if "-" not in asked.values():
        print_tables(tables)
