"""The result of ``fedguide tune``: the best trials, and the best settings as a configuration."""

from __future__ import annotations

import json
from collections import Counter
from typing import TYPE_CHECKING, Any

import yaml
from rich.console import Console
from rich.table import Table

from sb3_fedguide.cli.request import settings_entry
from sb3_fedguide.cli.run_folder import write_text

if TYPE_CHECKING:
    import optuna

    from sb3_fedguide.cli.tune import Tuning

SHOWN_TRIALS = 10


def conclude(tuning: Tuning, study: optuna.Study) -> None:
    """Print the table of the best trials, and write the best settings as a configuration."""
    from optuna.trial import TrialState

    trials = study.get_trials(deepcopy=False)
    done = [trial for trial in trials if trial.state == TrialState.COMPLETE and "same_as" not in trial.user_attrs]
    best = sorted(done, key=lambda trial: (-trial.values[0], trial.number))
    if not best:
        return
    counts = Counter(trial.state.name.lower() for trial in trials)
    states = ", ".join(f"{count} {state}" for state, count in sorted(counts.items()))
    title = f"{tuning.arguments.algo} on {tuning.family.name}: {len(trials)} trials ({states})"
    table = Table()
    for name in ("trial", "F", *tuning.space.entries):
        table.add_column(name, justify="right")
    for trial in best[:SHOWN_TRIALS]:
        values = [str(_plain(trial.params[name])) for name in tuning.space.entries]
        table.add_row(str(trial.number), f"{trial.values[0]:.4g}", *values)
    console = Console(width=None if Console().is_terminal else 160)
    console.print(title, highlight=False, soft_wrap=True)  # as a table's title it would wrap at the table's width
    console.print(table)
    settings = {name: _plain(best[0].params[name]) for name in tuning.space.entries}
    entry = settings_entry(tuning.arguments.env) or tuning.family.name
    text = yaml.safe_dump({entry: tuning.resolve(settings).values}, sort_keys=False, default_flow_style=None)
    path = tuning.folder / "best.yml"
    write_text(path, f"# {title}; trial {best[0].number}, F {best[0].values[0]:.6g}\n{text}")
    console.print(f"best settings: -conf {path}", highlight=False, soft_wrap=True)


def _plain(parameter: Any) -> Any:
    """An Optuna value as plain data: entries of lists are JSON in Optuna."""
    return json.loads(parameter) if isinstance(parameter, str) else parameter
