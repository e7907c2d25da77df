"""Methods over several families: performance profiles, interquartile means, probabilities of improvement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sb3_fedguide.benchmark.aggregate import aggregate, normalise
from sb3_fedguide.benchmark.figures.comparisons import (
    improvement_interval,
    performance_profile,
    probability_of_improvement,
    profile_band,
)
from sb3_fedguide.benchmark.figures.layout import MEDIUM, SMALL, legend, panels
from sb3_fedguide.benchmark.figures.runs import Comparison, base, require_finished
from sb3_fedguide.benchmark.figures.styles import Style, style

#: Scores at which a profile is drawn.
N_LEVELS = 201
#: A profile begins here, unless the lowest score is above it: how far below random actions a run ends says no more.
LOWEST = -1.0


def complete_methods(comparison: Comparison, baseline: str = "local") -> dict[str, dict[str, np.ndarray]]:
    """Name to family to F of each run, for the methods with finished runs on every family; the baseline is the first.

    :raises ValueError: for a single family, without the baseline on every family, and without another method
    """
    found = require_finished(comparison)
    if len(found) < 2:
        raise ValueError("it needs finished runs on several families")
    first = next(iter(found.values()))
    complete = [name for name in first if all(name in results for results in found.values())]
    reference = base({name: first[name] for name in complete}, baseline)
    if not reference:
        raise ValueError(f"it needs finished runs of the baseline, {baseline}, on every family")
    if len(complete) < 2:
        raise ValueError(f"no method but the baseline, {baseline}, has finished runs on every family")
    complete.sort(key=lambda name: name != reference)
    return {
        name: {family: np.array([result.final for result in results[name]]) for family, results in found.items()}
        for name in complete
    }


def draw_aggregate(comparison: Comparison, random: Mapping[str, float], baseline: str = "local") -> Figure:
    """Three panels. A score of 0 is the return of random actions, 1 the mean F of the baseline.

    :param random: family to the return of random actions
    :raises ValueError: as :func:`complete_methods`, and where the baseline is no better than random actions
    """
    finals = complete_methods(comparison, baseline)
    reference, *others = finals
    levels = {family: (random[family], float(values.mean())) for family, values in finals[reference].items()}
    if low := [family for family, (zero, one) in levels.items() if not zero < one]:
        raise ValueError(f"the baseline, {baseline}, is no better than random actions on {', '.join(low)}")
    scores = {
        name: [normalise(values, *levels[family]) for family, values in of_families.items()]
        for name, of_families in finals.items()
    }
    looks = {name: _look(comparison, name) for name in finals}
    figure, (left, middle, right) = panels(3, (3.6, 1.6 + 0.2 * max(8, len(finals))), beside=2.2)
    _draw_profiles(left, scores, looks)
    rows = {
        name: aggregate(name, {family: list(values) for family, values in finals[name].items()}, levels) for name in finals
    }
    _draw_intervals(middle, {name: row.iqm for name, row in rows.items()},
                    {name: row.interval for name, row in rows.items()}, looks)  # fmt: skip
    middle.set_xlabel("interquartile mean of the scores", fontsize=MEDIUM)
    theirs = list(finals[reference].values())
    resampled = any(len(values) > 1 for values in theirs)
    _draw_intervals(
        right,
        {name: float(probability_of_improvement(list(finals[name].values()), theirs)) for name in others},
        {
            name: improvement_interval(list(finals[name].values()), theirs)
            if resampled or any(len(values) > 1 for values in finals[name].values())
            else None
            for name in others
        },
        looks,
    )
    right.axvline(0.5, color="black", linewidth=0.8, linestyle=":")
    right.set_xlim(-0.02, 1.02)
    right.set_xlabel(f"probability that a run is better\nthan a run of {reference}", fontsize=MEDIUM)
    scale = "\n".join(f"{family}:\n {zero:.4g} to {one:.4g}" for family, (zero, one) in levels.items())
    several = any(len(values) > 1 for of_families in finals.values() for values in of_families.values())
    intervals = "95 % intervals: stratified bootstrap" if several else "one run per family: no intervals"
    title = f"{intervals}\nscore 0: random actions\nscore 1: mean of {reference}\n{scale}\n"
    legend(figure, [_handle(name, sum(map(len, scores[name])), looks[name]) for name in finals], title)
    return figure


def _draw_profiles(axes: Axes, scores: Mapping[str, Sequence[np.ndarray]], looks: Mapping[str, Style]) -> None:
    every = np.concatenate([group for groups in scores.values() for group in groups])
    span = max(float(every.max()), 1.0) - max(float(every.min()), LOWEST)
    levels = np.linspace(max(float(every.min()), LOWEST) - 0.03 * span, max(float(every.max()), 1.0) + 0.03 * span, N_LEVELS)
    for place, (name, groups) in enumerate(scores.items()):
        keywords = {**looks[name].line_keywords(), "markersize": 4, "markevery": (0.03 * place, 0.3), "linewidth": 1.5}
        axes.plot(levels, performance_profile(groups, levels), **keywords)
        if any(len(group) > 1 for group in groups):
            axes.fill_between(levels, *profile_band(groups, levels), color=looks[name].color, alpha=0.12, linewidth=0)
    axes.set_ylim(-0.02, 1.02)
    axes.margins(x=0)
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.set_xlabel("score $\\tau$", fontsize=MEDIUM)
    axes.set_ylabel("share of runs with a score above $\\tau$", fontsize=MEDIUM)


def _draw_intervals(
    axes: Axes,
    values: Mapping[str, float],
    intervals: Mapping[str, tuple[float, float] | None],
    looks: Mapping[str, Style],
) -> None:
    for y, (name, value) in enumerate(values.items()):
        if (interval := intervals[name]) is not None:
            axes.barh(y, interval[1] - interval[0], left=interval[0], height=0.55, color=looks[name].color, alpha=0.4)
        axes.plot([value], [y], marker="|", markersize=13, markeredgewidth=2, color="black", linestyle="")
    axes.set_yticks(range(len(values)), list(values), fontsize=SMALL)
    axes.use_sticky_edges = False
    axes.margins(x=0.06)
    axes.set_ylim(len(values) - 0.4, -0.6)
    axes.grid(axis="x", alpha=0.3, linewidth=0.5)


def _look(comparison: Comparison, name: str) -> Style:
    run = next(iter(comparison.values()))[name][0]
    return style(run.method, run.variant)


def _handle(name: str, n_runs: int, look: Style) -> Artist:
    return Line2D([], [], **look.line_keywords(), markersize=4, linewidth=1.5, label=f"{name} ({n_runs} runs)")
