"""One trial of ``fedguide tune``: a training command for each seed; the pruner sees its evaluations during the run."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.benchmark.results import read_result
from sb3_fedguide.cli.benchmark_runs import BenchmarkRun, RunProcess, forget, interrupted_folder
from sb3_fedguide.cli.run_folder import EVALUATIONS, exclusive, write_json

if TYPE_CHECKING:
    import optuna


class ActiveTrial:
    """A trial of this process, with the exclusive right to do it until :meth:`release`.

    A step in Optuna is a round of the trial, with its seeds one after another: two seeds of 60 rounds are 120 steps. The
    value of a step is the client-average return of the deployed policies in that round, the mean of the seeds that had it.

    :param reported: steps that Optuna already has, from an earlier part of the trial
    """

    def __init__(
        self,
        trial: optuna.Trial,
        settings: Mapping[str, Any],
        runs: Sequence[BenchmarkRun],
        n_rounds: int,
        n_clients: int,
        reported: set[int],
    ) -> None:
        self.trial, self.settings, self.runs = trial, settings, runs
        self.n_rounds, self.n_clients = n_rounds, n_clients
        #: the outcome: a value, or the reason why there is none; neither until it is known
        self.value: float | None = None
        self.problem, self.pruned = "", False
        self.rounds_done = 0
        self._reported = reported
        self._curves: list[dict[int, float]] = [{} for _ in runs]
        self._finals: list[float] = []
        self._process: RunProcess | None = None
        self._stopped, self._lock = False, ExitStack()

    def claim(self, folder: Path) -> None:
        """:raises ValueError: if another process does this trial"""
        folder.mkdir(parents=True, exist_ok=True)
        self._lock.enter_context(exclusive(folder))

    def stop(self) -> None:
        """Let the run end after its round, with a checkpoint, and begin no other."""
        self._stopped = True
        if self._process is not None:
            self._process.stop()

    def release(self) -> None:
        """Kill the current run, and let other processes do the trial."""
        if self._process is not None:
            self._process.kill()
        self._lock.close()

    def is_over(self) -> bool:
        """Do the next actions: start the next run, report evaluations to Optuna, take a result."""
        try:
            return self._advance()
        except (ValueError, OSError) as error:
            self.problem = str(error)
            return True

    def _advance(self) -> bool:
        index = len(self._finals)
        run = self.runs[index]
        if self._process is None:
            if self._stopped:
                return True
            self._process = RunProcess(run)
            self._process.start()
        running = self._process.is_running()
        self._report(index, evaluated(run, self.n_clients))
        if self.pruned:
            self._process.kill()
            forget(run)
            return True
        if running:
            return False
        outcome = self._process.outcome()
        if outcome.content is None:
            self.problem = "" if outcome.interrupted else outcome.problem
            return True
        write_json(run.result, outcome.content)
        result = read_result(run.result)
        self._report(index, result.curve)
        forget(run)
        self._process.release()
        self._process = None
        if not math.isfinite(result.final):
            raise ValueError(f"the client-average return is {result.final}")
        self._finals.append(result.final)
        if self.pruned:
            return True
        if len(self._finals) == len(self.runs):
            self.value = sum(self._finals) / len(self._finals)
            return True
        return self._stopped

    def _report(self, index: int, curve: Mapping[int, float]) -> None:
        for round in sorted(curve.keys() - self._curves[index].keys()):
            self._curves[index][round] = curve[round]
            step = index * self.n_rounds + round
            self.rounds_done = step
            if step not in self._reported:
                seeds = [curve[round] for curve in self._curves[: index + 1] if round in curve]
                self.trial.report(sum(seeds) / len(seeds), step)
                self._reported.add(step)
            # In order of the rounds, for any number of new ones: pruning does not depend on the machine.
            if step < len(self.runs) * self.n_rounds and self.trial.should_prune():
                self.pruned = True
                return


def evaluated(run: BenchmarkRun, n_clients: int) -> dict[int, float]:
    """Round to client-average return of the deployed policies, as far as a run has written them."""
    folder = interrupted_folder(run.log_folder, run.method)
    if folder is None or not (folder / EVALUATIONS).is_file():
        return {}
    complete, _, _ = (folder / EVALUATIONS).read_text(encoding="utf-8").rpartition("\n")
    returns: dict[int, list[float]] = {}
    for row in csv.DictReader(complete.splitlines()):
        if row["policy"] == "deployed":
            returns.setdefault(int(row["round"]), []).append(float(row["mean_return"]))
    return {round: sum(values) / n_clients for round, values in returns.items() if len(values) == n_clients}
