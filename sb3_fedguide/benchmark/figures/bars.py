"""Bars of final returns and of the speed-up, with every seed as a dot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sb3_fedguide.benchmark.figures.layout import MEDIUM, SMALL, fit_scale, legend, panels
from sb3_fedguide.benchmark.figures.runs import Comparison, Runs, base, require_finished, seeds
from sb3_fedguide.benchmark.figures.styles import style
from sb3_fedguide.benchmark.results import measure, speed_up, volatility
from sb3_fedguide.settings.evaluation import LAST_ROUNDS

ROW = 0.27  # inches of one bar
_DOT: dict[str, Any] = {
    "marker": "o",
    "markersize": 4,
    "markerfacecolor": "white",
    "markeredgecolor": "black",
    "markeredgewidth": 0.8,
}
_WORST: dict[str, Any] = {**_DOT, "markersize": 5.5, "markerfacecolor": "black", "markeredgecolor": "white"}


def draw_bars(comparison: Comparison) -> Figure:
    """F and the worst client, a row of two panels per family; the lowest seed's F is W.

    :raises ValueError: if no run is finished
    """
    found = require_finished(comparison)
    rows = max(len(results) for results in found.values())
    figure, grid = panels(2 * len(found), (3.6, 1.1 + ROW * max(rows, 3)), columns=2, beside=1.6)
    for place, (family, results) in enumerate(found.items()):
        left, right = grid[2 * place : 2 * place + 2]
        measures = {name: measure(group) for name, group in results.items()}
        final = {name: [result.final for result in group] for name, group in results.items()}
        worst = {name: [result.worst_client for result in group] for name, group in results.items()}
        runs = comparison[family]
        _bars(left, {name: row.F for name, row in measures.items()}, final, runs)
        for y, row in enumerate(measures.values()):
            if len(row.seeds) > 1:
                left.plot(row.W, y, linestyle="", clip_on=False, zorder=3, **_WORST)
        _bars(right, {name: row.worst_client for name, row in measures.items()}, worst, runs)
        right.set_yticklabels([])
        left.set_title(family, fontsize=MEDIUM, loc="left")
        left.set_xlabel("F: final return, mean over clients", fontsize=MEDIUM)
        right.set_xlabel("final return of the worst client", fontsize=MEDIUM)
        fit_scale(left, [row.F for row in measures.values()], "x")
        fit_scale(right, [row.worst_client for row in measures.values()], "x")
    marks = [("one seed", _DOT)]
    if any(len(group) > 1 for results in found.values() for group in results.values()):
        marks.append(("W: F of the worst seed", _WORST))
    legend(figure, _marks(marks), "bar: mean over seeds")
    return figure


def draw_speed_up(comparison: Comparison, baseline: str = "local") -> Figure:
    """Speed-up: environment steps of a run over those until a method reaches the baseline's F, one panel per family.

    Families without the baseline, or without another method, are left out.

    :raises ValueError: if none is left
    """
    found = {
        family: results
        for family, results in require_finished(comparison).items()
        if len(results) > 1 and base(results, baseline)
    }
    if not found:
        raise ValueError(f"it needs finished runs of the baseline, {baseline}, and of another method on the same family")
    rows = max(len(results) for results in found.values())
    figure, grid = panels(len(found), (4.2, 1.1 + ROW * max(rows, 3)), columns=2, beside=1.9)
    for axes, (family, results) in zip(grid, found.items(), strict=True):
        target = measure(results[base(results, baseline)]).F
        together = {name: speed_up(group, target) for name, group in results.items()}
        alone = {name: [speed_up([result], target) for result in group] for name, group in results.items()}
        dots = {name: [value for value in values if value is not None] for name, values in alone.items()}
        _bars(axes, {name: value or 0.0 for name, value in together.items()}, dots, comparison[family])
        for y, (name, value) in enumerate(together.items()):
            if value is None:
                highest = max(dots[name], default=0.0)
                words = axes.annotate(
                    "not reached", (highest, y), (6, 0), textcoords="offset points", va="center", fontsize=SMALL
                )
                words.set_in_layout(False)  # the panel has room for them
        axes.axvline(1.0, color="black", linewidth=0.8, linestyle=":")
        right = max((max(dots[name], default=0.0) for name, value in together.items() if value is None), default=0.0)
        axes.set_xlim(0.0, max(1.3, 1.05 * axes.get_xlim()[1], right + 0.5 * max(1.0, right)))  # with room for the words
        axes.set_title(family, fontsize=MEDIUM, loc="left")
        axes.set_xlabel(
            f"speed-up: steps of a whole run over steps\nuntil F of {baseline}, {target:.4g}, is reached", fontsize=MEDIUM
        )
    legend(figure, _marks([("one seed's curve\n(none: not reached)", _DOT)]), "bar: mean curve of all seeds")
    return figure


def draw_cv(comparison: Comparison) -> Figure:
    """How much the return still moves in the last twenty rounds, one panel per family.

    :raises ValueError: if no run has evaluated enough of its last rounds
    """
    values = {
        family: {
            name: [value for result in group if (value := volatility(result)) is not None] for name, group in results.items()
        }
        for family, results in require_finished(comparison).items()
    }
    values = {family: {name: found for name, found in groups.items() if found} for family, groups in values.items()}
    values = {family: groups for family, groups in values.items() if groups}
    if not values:
        raise ValueError("no finished run has several evaluations in its last rounds")
    rows = max(len(groups) for groups in values.values())
    figure, grid = panels(len(values), (3.8, 1.1 + ROW * max(rows, 3)), columns=2, beside=1.6)
    for axes, (family, groups) in zip(grid, values.items(), strict=True):
        _bars(axes, {name: float(np.mean(found)) for name, found in groups.items()}, groups, comparison[family])
        axes.set_title(family, fontsize=MEDIUM, loc="left")
        axes.set_xlabel(f"CV: standard deviation over absolute mean of the\nclient-average return, last {LAST_ROUNDS} rounds",
                        fontsize=MEDIUM)  # fmt: skip
    legend(figure, _marks([("one seed", _DOT)]), "bar: mean over seeds\nshorter: steadier")
    return figure


def _bars(axes: Axes, means: Mapping[str, float], dots: Mapping[str, Sequence[float]], runs: Runs) -> None:
    for y, (name, mean) in enumerate(means.items()):
        axes.barh(y, mean, height=0.7, **style(runs[name][0].method, runs[name][0].variant).bar_keywords())
        if len(dots[name]):  # an empty line that is not clipped would count as one at the figure's corner
            axes.plot(dots[name], np.full(len(dots[name]), y), linestyle="", clip_on=False, **_DOT)
    counts = {name: sum(run.result is not None for run in runs[name]) for name in means}
    axes.set_yticks(range(len(means)), [f"{name} ({seeds(count)})" for name, count in counts.items()], fontsize=SMALL)
    axes.set_ylim(len(means) - 0.4, -0.6)
    axes.axvline(0.0, color="black", linewidth=0.8)
    axes.grid(axis="x", alpha=0.3, linewidth=0.5)


def _marks(marks: Sequence[tuple[str, Mapping[str, Any]]]) -> list[Artist]:
    return [Line2D([], [], linestyle="", label=label, **look) for label, look in marks]
