"""The data of a comparison's figures: runs with their evaluations, by family and by method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sb3_fedguide.benchmark.results import Result
from sb3_fedguide.registry import ALGORITHMS

#: What a learning curve can be drawn over.
AXES = ("rounds", "steps", "seconds", "bytes")
#: Why a run may not have it.
_MISSING = {
    "steps": "environment steps (timesteps)",
    "seconds": "seconds of rollout, training and exchange",
    "bytes": "bytes that were exchanged",
}


@dataclass(frozen=True)
class Run:
    """One run with its evaluations of the deployed policies.

    :param method: name of its algorithm, which decides on its colour
    :param name: what it is called in figures: its method, with the label of its results where there are several
    :param variant: number of that label, which decides on its lines
    :param source: where it was read
    :param rounds: those that were evaluated, ``(n_evaluations,)``
    :param average: client-average return, ``(n_evaluations,)``
    :param clients: the clients' numbers; empty where an older file does not say
    :param returns: of each client, ``(n_evaluations, n_clients)``; ``None`` if an older file does not say
    :param steps: environment steps of all clients until the evaluation, those of tests included, ``(n_evaluations,)``
    :param seconds: of rollout, training and exchange until then, the run's total spread evenly over its rounds
    :param n_bytes: up and down, of all clients together, until then; those of the rounds are spread evenly over them
    :param result: final measures; ``None`` if the run is not finished
    """

    method: str
    name: str
    variant: int
    family: str
    seed: int
    source: Path
    rounds: np.ndarray
    average: np.ndarray
    clients: Sequence[int]
    returns: np.ndarray | None
    steps: np.ndarray | None
    seconds: np.ndarray | None
    n_bytes: np.ndarray | None
    result: Result | None

    def axis(self, x: str) -> np.ndarray:
        """Where the evaluations lie on the axis ``x``, one of :data:`AXES`.

        :raises ValueError: if the run's files do not say
        """
        found = {"rounds": self.rounds, "steps": self.steps, "seconds": self.seconds, "bytes": self.n_bytes}[x]
        if found is None:
            raise ValueError(f"{self.source} does not say the {_MISSING[x]}; draw the curves over rounds (-x rounds)")
        return found

    def of(self, what: str) -> np.ndarray:
        """The curve of the clients' ``"average"``, or of the ``"worst"`` client of each evaluation.

        :raises ValueError: if the run's files do not say
        """
        return self.average if what == "average" else self.client_returns().min(axis=1)

    def client_returns(self) -> np.ndarray:
        """``returns``.

        :raises ValueError: if the run's files do not have them
        """
        if self.returns is None:
            raise ValueError(
                f"{self.source} has no returns of single clients in each evaluation: it is of an earlier version; draw the "
                "average (--of average), or choose other methods (--algos)"
            )
        return self.returns


#: Runs of one family: name of a method in figures to its runs, one per seed.
Runs = Mapping[str, Sequence[Run]]
#: Family to its runs.
Comparison = Mapping[str, Runs]


def from_result(result: Result, name: str | None = None, variant: int = 0) -> Run:
    """A run from its result file.

    :param name: what it is called in figures; its method by default
    """
    rounds = np.array(sorted(result.curve))
    complete = set(result.curve) <= set(result.client_curve)
    spent = np.array([result.spent[round] for round in rounds])
    return Run(
        method=result.method,
        name=name or result.method,
        variant=variant,
        family=result.family,
        seed=result.seed,
        source=result.path,
        rounds=rounds,
        average=np.array([result.curve[round] for round in rounds]),
        clients=result.clients,
        returns=np.array([result.client_curve[round] for round in rounds]) if complete else None,
        steps=None if result.steps_per_round is None else spent * result.steps_per_round,
        seconds=seconds_at(rounds, result),
        n_bytes=bytes_at(rounds, result),
        result=result,
    )


def seconds_at(rounds: np.ndarray, result: Result) -> np.ndarray | None:
    """Seconds of rollout, training and exchange until the end of each round; ``None`` if the file does not say."""
    return None if result.round_seconds is None else result.round_seconds * rounds / result.n_rounds


def bytes_at(rounds: np.ndarray, result: Result) -> np.ndarray:
    """Bytes of all clients until the end of each round.

    If a file of an earlier version does not separate the bytes before the first round, they are spread like the rest.
    """
    before = (result.offline_bytes_up or 0.0) + (result.offline_bytes_down or 0.0)
    return before + (result.total_bytes - before) * rounds / result.n_rounds


def finished(runs: Runs) -> dict[str, list[Result]]:
    """Results of the runs that are finished, by name; without names that have none."""
    found = {name: [run.result for run in group if run.result is not None] for name, group in runs.items()}
    return {name: results for name, results in found.items() if results}


def require_finished(comparison: Comparison) -> dict[str, dict[str, list[Result]]]:
    """Family to name to results.

    :raises ValueError: if no run is finished
    """
    found = {family: finished(runs) for family, runs in comparison.items()}
    found = {family: results for family, results in found.items() if results}
    if not found:
        raise ValueError("no run is finished")
    return found


def base(results: Mapping[str, Sequence[Result]], baseline: str) -> str:
    """The name under which the baseline's results are, by that name or its method's; empty where there are none."""
    if baseline in results:
        return baseline
    return next((name for name, group in results.items() if group[0].method == baseline), "")


def names(comparison: Comparison) -> list[str]:
    """Of the methods of all families, in the order in which their algorithms were registered."""
    order = list(ALGORITHMS)
    method = {name: group[0].method for runs in comparison.values() for name, group in runs.items()}
    return sorted(method, key=lambda name: order.index(method[name]) if method[name] in order else len(order))


def seeds(n: int) -> str:
    """How many, in words."""
    return "1 seed" if n == 1 else f"{n} seeds"
