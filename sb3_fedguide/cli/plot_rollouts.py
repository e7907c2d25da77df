"""Figures from the folders of runs: rollouts of their policies, and their transport plans."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from sb3_fedguide.benchmark.figures.plans import draw_plans
from sb3_fedguide.benchmark.figures.rollouts import Cell, Row, draw_rollouts, pixels
from sb3_fedguide.benchmark.figures.runs import Comparison, Runs
from sb3_fedguide.benchmark.figures.styles import style
from sb3_fedguide.benchmark.plans import read_plans
from sb3_fedguide.benchmark.rollouts import overlay, pose_steps, poses, record
from sb3_fedguide.cli.rendering import check_rendering
from sb3_fedguide.cli.run_folder import PLAN
from sb3_fedguide.cli.saved_run import in_place, load_model, read_deployed_policies, read_run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fed_envs import Family
    from sb3_fedguide.common.federation import Federation

#: Worlds whose episodes are drawn without OpenGL.
DRAWN = ("bandit2d", "point_maze")


def rollouts(runs: Runs, clients: Sequence[int] | None = None) -> Figure:
    """One episode of each client with its deployed policy, a row per method.

    Of several seeds of a method, the one with the highest final return is drawn, as in the paper.

    :param runs: of one family, by method
    :param clients: to draw; all by default
    :raises ValueError: for a run without its policies, for unknown clients, and if nothing can be drawn
    """
    rows, family = [], None
    for name, group in runs.items():
        best = max(group, key=lambda run: float(run.average[-1]))
        summary, config, family = read_run(best.source)
        if family.world not in DRAWN:
            check_rendering(family, "rollouts")
        model = load_model(best.source, config, family)
        chosen = _clients(model, clients, family)
        with in_place(model, read_deployed_policies(best.source, model)):
            cells = _cells(model, family, chosen)
        seed = f"seed {best.seed}, best of {len(group)}" if len(group) > 1 else f"seed {best.seed}"
        note = f"\n({seed}, {summary['rounds_done']} rounds)"
        rows.append(Row(name, style(best.method, best.variant), cells, note))
    assert family is not None
    return draw_rollouts(family, rows)


def _clients(model: Federation, asked: Sequence[int] | None, family: Family) -> list[int]:
    if unknown := [client for client in asked or () if client not in model.client_ids]:
        raise ValueError(f"{family.name} has no client {unknown[0]}; there are {', '.join(map(str, model.client_ids))}")
    return list(asked or model.client_ids)


def _cells(model: Federation, family: Family, clients: Sequence[int]) -> list[Cell]:
    episodes = [record(family, client, model.client(client)) for client in clients]
    if family.world == "point_maze":
        return [Cell(episode) for episode in episodes]
    if family.world == "bandit2d":
        from sb3_fedguide.benchmark.bandit2d import Policies, policies

        found = policies(model)  # type: ignore[arg-type]
        places = [[model.client_ids.index(client)] for client in clients]
        own = [Policies(found.mean[place], found.std[place]) for place in places]
        return [Cell(episode, policy=policy) for episode, policy in zip(episodes, own, strict=True)]
    size = pixels(family)
    return [Cell(episode, overlay(poses(family, episode, pose_steps(episode), size))) for episode in episodes]


def plans(comparison: Comparison, file_name: Callable[[str], str], notes: list[str]) -> list[tuple[str, Figure]]:
    """Name and figure of every run with a transport plan; ``notes`` receives the runs without one.

    :raises ValueError: if no run has one
    """
    drawn, without = [], []
    for family, runs in comparison.items():
        for run in (run for group in runs.values() for run in group):
            if (run.source / PLAN).is_file():
                title = f"{run.name} on {family}, seed {run.seed}: transport plan"
                name = f"plan-{file_name(family)}-{file_name(run.name)}-seed{run.seed}"
                drawn.append((name, draw_plans(read_plans(run.source / PLAN), title, run.method)))
            else:
                without.append(str(run.source))
    reason = f"no {PLAN} in {', '.join(without)}: the method has no transport plan, or the run is of an earlier version"
    if not drawn:
        raise ValueError(reason)
    if without:
        notes.append(f"plan: {reason}")
    return drawn
