"""The logs of runs, from the TensorBoard events in their folders, for the figures of the paper's theory."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.benchmark.figures.runs import Comparison, Run
from sb3_fedguide.cli.run_folder import events_folder
from sb3_fedguide.settings.config import read_yaml

if TYPE_CHECKING:
    from sb3_fedguide.benchmark.figures.theory import Log, Scalars

ROUND = "time/round"
#: Settings with the value for which the server sends the plain average of all clients' policies.
PLAIN = {"server_step": 1, "server_momentum": 0, "aggregator": "mean", "screening": 0, "client_fraction": 1}


def read_logs(comparison: Comparison) -> list[Log]:
    """The logs of runs.

    :param comparison: runs from their folders
    :raises ValueError: for results of a benchmark, and for a folder without events
    """
    from sb3_fedguide.benchmark.figures.theory import Log

    runs = [run for groups in comparison.values() for group in groups.values() for run in group]
    if not all(run.source.is_dir() for run in runs):
        raise ValueError("it is drawn from the log in the folder of a run; give folders instead of --envs")
    return [Log(run.method, run.name, run.variant, run.family, read_scalars(run)) for run in runs]


def averages(comparison: Comparison) -> Comparison:
    """The runs whose evaluated average is that of Theorem 3: the average of all clients' policies.

    :raises ValueError: if there is none
    """
    other = {run.source: reason for run in _all(comparison) if (reason := _not_the_average(run))}
    chosen = {
        family: {name: kept for name, group in runs.items() if (kept := [run for run in group if run.source not in other])}
        for family, runs in comparison.items()
    }
    if not any(chosen.values()):
        raise ValueError("; ".join(f"{source} {reason}" for source, reason in other.items()))
    return {family: runs for family, runs in chosen.items() if runs}


def _all(comparison: Comparison) -> Iterable[Run]:
    return (run for runs in comparison.values() for group in runs.values() for run in group)


def _not_the_average(run: Run) -> str:
    settings = _settings(run.source, "config.yml")
    for name, value in PLAIN.items():
        if settings.get(name, value) != value:
            return f"has {name} {settings[name]}: its server does not send the average of all policies"
    return "has delays: not all clients take part in a round" if _settings(run.source, "args.yml").get("delays") else ""


def _settings(folder: Path, name: str) -> dict[str, Any]:
    """:raises ValueError: if the file is missing or damaged"""
    content = read_yaml(folder / name)
    if not isinstance(content, dict):
        raise ValueError(f"{folder / name} is damaged: it is not a mapping")
    return content


def read_scalars(run: Run) -> Scalars:
    """Key of the log to round to value, of a run's folder.

    :raises ValueError: if it has no events, or they do not count rounds
    """
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    elsewhere = _settings(run.source, "args.yml").get("tensorboard_log")
    folder = events_folder(run.source, elsewhere, run.family, run.method)
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    keys = events.Tags()["scalars"]
    if ROUND not in keys:
        raise ValueError(f"{run.source} has no log of rounds in {folder}")
    rounds = {event.step: round(event.value) for event in events.Scalars(ROUND)}
    return {key: {rounds[event.step]: event.value for event in events.Scalars(key) if event.step in rounds} for key in keys}
