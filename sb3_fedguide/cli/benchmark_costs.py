"""``fedguide benchmark --dry-run``: the missing runs, and their estimated cost."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from sb3_fedguide.benchmark.costs import Cost, estimate

if TYPE_CHECKING:
    from sb3_fedguide.cli.benchmark import Plan
    from sb3_fedguide.cli.benchmark_tables import Row

NOTE = (
    "CPU hours of an idle core, estimated from measured rounds (docs/performance.md); a busy machine takes two or three times "
    "as long. The offline stage counts once for each family, seed and setting: its results are kept (--cache-dir)."
)


def costs_of(plan: Plan, eval_freq: int, n_episodes: int) -> list[Cost]:
    """The cost of each missing run, in the plan's order."""
    found = []
    for run, config in zip(plan.runs, plan.configs, strict=True):
        family, eval_average = plan.families[run.family], "--eval-average" in run.flags
        found.append(estimate(run.method, config.values, family, run.seed, eval_freq, n_episodes, eval_average))
    return found


def offline_seconds(plan: Plan, costs: list[Cost]) -> dict[tuple[str, str], float]:
    """Family and piece of the offline stage to the seconds of one such piece."""
    return {
        (run.family, key): seconds for run, cost in zip(plan.runs, costs, strict=True) for key, seconds in cost.offline.items()
    }


def total_hours(plan: Plan, eval_freq: int, n_episodes: int) -> float:
    """CPU hours of all missing runs with their offline stages."""
    costs = costs_of(plan, eval_freq, n_episodes)
    return (sum(cost.rounds + cost.evaluation for cost in costs) + sum(offline_seconds(plan, costs).values())) / 3600


def cost_rows(plan: Plan, costs: list[Cost]) -> list[Row]:
    """A row for each method on each family, the offline stages, and all together, as cells by column."""
    done = Counter((run.title or run.method, run.family) for run in plan.done)
    missing: dict[tuple[str, str], list[tuple[int, float]]] = {}
    for run, config, cost in zip(plan.runs, plan.configs, costs, strict=True):
        hours = (cost.rounds + cost.evaluation) / 3600
        missing.setdefault((run.title or run.method, run.family), []).append((config.n_rounds, hours))
    rows = []
    for family in plan.families:
        for name in (row.name for row in plan.rows if done[row.name, family] or (row.name, family) in missing):
            runs = missing.get((name, family), [])
            hours_of_cell = f"{sum(hours for _, hours in runs):.1f}" if runs else "-"
            rows.append(_row(name, family, runs[0][0] if runs else "-", done[name, family], len(runs), hours_of_cell))
    stages = offline_seconds(plan, costs)
    if stages:
        rows.append(_row("offline stage, once", "-", "-", "-", "-", f"{sum(stages.values()) / 3600:.1f}"))
    total = sum(hours for runs in missing.values() for _, hours in runs) + sum(stages.values()) / 3600
    rows.append(_row("all", "-", "-", len(plan.done), len(plan.runs), f"{total:.1f}"))
    return rows


def _row(*cells: object) -> Row:
    return dict(zip(("method", "family", "rounds", "done", "missing", "CPU hours"), map(str, cells), strict=True))


def print_costs(plan: Plan, eval_freq: int, n_episodes: int) -> None:
    """Print the costs on the terminal."""
    from sb3_fedguide.cli.benchmark_tables import print_rows

    print_rows(
        "missing runs" if plan.runs else "no run is missing", cost_rows(plan, costs_of(plan, eval_freq, n_episodes)), NOTE
    )
