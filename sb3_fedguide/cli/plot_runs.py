"""Runs for figures: from their folders, or from a benchmark's results."""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_fedguide.benchmark.figures.runs import Comparison, Run, bytes_at, from_result, seconds_at
from sb3_fedguide.benchmark.results import Result, check_comparable, parse_result
from sb3_fedguide.cli.benchmark_results import benchmark_results, no_results
from sb3_fedguide.cli.run_folder import EVALUATIONS
from sb3_fedguide.registry import ALGORITHMS

if TYPE_CHECKING:
    from fed_envs import Family


def read_benchmark(arguments: argparse.Namespace, families: Mapping[str, Family], labels: Sequence[str]) -> Comparison:
    """The results of ``fedguide benchmark`` under one label or several.

    With several, a method's title is its name and label.

    :raises ValueError: for a family without results, a damaged file, and for results that cannot be compared
    """
    found: dict[str, dict[str, dict[str, list[Result]]]] = {}
    for label in labels:
        arguments.label = label
        found[label] = benchmark_results(arguments, families)
    comparison: dict[str, dict[str, list[Run]]] = {}
    for family in families:
        check_comparable([result for results in found.values() for group in results[family].values() for result in group])
        comparison[family] = {}
        for method in _methods(method for results in found.values() for method in results[family]):
            having = [label for label in labels if any(method in results for results in found[label].values())]
            for variant, label in enumerate(having):
                name = f"{method}, {label}" if len(labels) > 1 else method
                if group := found[label][family].get(method):
                    comparison[family][name] = [from_result(result, name, variant) for result in group]
        if not comparison[family]:
            raise ValueError(no_results(arguments.folder, family))
    return comparison


def read_run_folders(folders: Sequence[str]) -> Comparison:
    """Runs from their folders, finished or not.

    :raises ValueError: for a folder without a run or without evaluations, and for runs that cannot be compared
    """
    runs = [read_run_folder(Path(folder)) for folder in folders]
    comparison: dict[str, dict[str, list[Run]]] = {}
    for family in dict.fromkeys(run.family for run in runs):
        of_family = [run for run in runs if run.family == family]
        _check_clients(of_family)
        check_comparable([run.result for run in of_family if run.result is not None])
        comparison[family] = {
            method: sorted((run for run in of_family if run.method == method), key=lambda run: run.seed)
            for method in _methods(run.method for run in of_family)
        }
        for method, group in comparison[family].items():
            for one, other in pairwise(group):
                if one.seed == other.seed:
                    raise ValueError(
                        f"{one.source} and {other.source} are both of {method} on {family} with seed {one.seed}; "
                        "give one of them"
                    )
    return comparison


def read_run_folder(folder: Path) -> Run:
    """A run from its ``evaluations.csv``, with the measures of its ``summary.json`` if it is finished.

    :raises ValueError: if the folder is not that of a run, or a file in it is damaged
    """
    if not (folder / EVALUATIONS).is_file():
        raise ValueError(f"{folder} is not the folder of a run with evaluations: it has no {EVALUATIONS}")
    identity, result = _identity(folder)
    rounds, steps, clients, returns = read_evaluations(folder / EVALUATIONS)
    return Run(
        method=identity["algo"],
        name=identity["algo"],
        variant=0,
        family=identity["env"],
        seed=identity["seed"],
        source=folder,
        rounds=rounds,
        average=returns.mean(axis=1),
        clients=clients,
        returns=returns,
        steps=steps,
        seconds=None if result is None else seconds_at(rounds, result),
        n_bytes=None if result is None else bytes_at(rounds, result),
        result=result,
    )


def _identity(folder: Path) -> tuple[dict[str, Any], Result | None]:
    """Algorithm, family and seed; and the result if the run is finished."""
    path = folder / "summary.json"
    try:
        if path.is_file():
            content = json.loads(path.read_text(encoding="utf-8"))
            result = parse_result(path, content) if content["finished"] is True else None
            return {"algo": str(content["algo"]), "env": str(content["env"]), "seed": int(content["seed"])}, result
        from sb3_fedguide.settings.config import read_yaml

        path = folder / "args.yml"  # of a run that is not finished, or was killed
        flags = read_yaml(path)
        path = folder / "metadata.json"
        family = json.loads(path.read_text(encoding="utf-8"))["family"]
        return {"algo": str(flags["algo"]), "env": str(family), "seed": int(flags["seed"])}, None
    except (OSError, ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else getattr(error, "strerror", None) or str(error)
        raise ValueError(f"{folder} is not the folder of a run: {path.name}: {reason}") from None


def read_evaluations(path: Path) -> tuple[np.ndarray, np.ndarray, list[int], np.ndarray]:
    """Rounds and environment steps, ``(n_evaluations,)``, clients' numbers, and returns, ``(n_evaluations, n_clients)``.

    Only of the deployed policies. An incomplete last evaluation is left out.

    :raises ValueError: if the file is damaged, or has no complete evaluation
    """
    found: dict[int, tuple[int, dict[int, float]]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                if row["policy"] == "deployed":
                    _, returns = found.setdefault(int(row["round"]), (int(row["timesteps"]), {}))
                    returns[int(row["client"])] = float(row["mean_return"])
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise ValueError(f"{path} is not a run's table of evaluations ({error})") from None
    clients = sorted(next(iter(found.values()))[1]) if found else []
    if found and sorted(found[max(found)][1]) != clients and len(found) > 1:
        del found[max(found)]
    if not found:
        raise ValueError(f"{path} has no evaluation yet")
    if broken := [round for round, (_, returns) in found.items() if sorted(returns) != clients]:
        raise ValueError(f"{path} is damaged: round {broken[0]} has other clients than the first evaluation")
    rounds = sorted(found)
    steps = np.array([found[round][0] for round in rounds], dtype=float)
    return np.array(rounds), steps, clients, np.array([[found[round][1][k] for k in clients] for round in rounds])


def _check_clients(runs: Sequence[Run]) -> None:
    """:raises ValueError: if runs on one family have different clients"""
    hashes = {run.source: _hash(run.source) for run in runs}
    for run in runs:
        if list(run.clients) != list(runs[0].clients) or hashes[run.source] != hashes[runs[0].source]:
            raise ValueError(
                f"{run.source} and {runs[0].source} cannot be in one figure: their clients of {run.family} differ"
            )


def _hash(folder: Path) -> str:
    try:
        return (folder / "metadata.sha256").read_text(encoding="utf-8").strip()
    except (OSError, ValueError):
        return ""


def _methods(names: Iterable[str]) -> list[str]:
    """Each once, in the order of :data:`ALGORITHMS`, others after them."""
    order = list(ALGORITHMS)
    return sorted(dict.fromkeys(names), key=lambda name: order.index(name) if name in order else len(order))
