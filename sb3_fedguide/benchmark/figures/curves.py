"""Learning curves: the mean over seeds with a band, over rounds, environment steps, seconds or bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from sb3_fedguide.benchmark.bootstrap import mean_interval
from sb3_fedguide.benchmark.figures.layout import MEDIUM, SMALL, fit_scale, legend, panels
from sb3_fedguide.benchmark.figures.runs import Comparison, Run, Runs, names, seeds
from sb3_fedguide.benchmark.figures.styles import style

#: Band to what the legend says about it.
BANDS = {"range": "band: lowest to highest seed", "bootstrap": "band: 95 % bootstrap interval\nof the mean"}
_LABELS = {
    "rounds": "round",
    "steps": "environment steps of all clients{unit}",
    "seconds": "training time{unit},\na run's total spread evenly over its rounds",
    "bytes": "exchanged by all clients, up and down{unit},\na run's total spread evenly over its rounds",
}
_UNITS = {
    "steps": {1e9: " (billions)", 1e6: " (millions)", 1e3: " (thousands)", 1.0: ""},
    "seconds": {3600.0: " (hours)", 60.0: " (minutes)", 1.0: " (seconds)"},
    "bytes": {1e9: " (GB)", 1e6: " (MB)", 1e3: " (kB)", 1.0: " (bytes)"},
}
#: Of a line's markers, in lengths of the panel's diagonal: they lie as far apart where every round was evaluated.
MARKER_SPACING = 0.2


@dataclass(frozen=True)
class Curve:
    """One line with its band.

    :param x: where it is, ``(n,)``: the mean over seeds
    :param mean: over seeds, ``(n,)``
    :param band: lower and upper edge, ``(n,)`` each; ``None`` for one seed
    """

    x: np.ndarray
    mean: np.ndarray
    band: tuple[np.ndarray, np.ndarray] | None


def curve(runs: Sequence[Run], values: Sequence[np.ndarray], x: str = "rounds", band: str = "range") -> Curve:
    """The mean over seeds in the rounds that every one of them evaluated.

    :param runs: one per seed
    :param values: what to average, one array ``(n_evaluations,)`` per run
    :param x: one of :data:`~sb3_fedguide.benchmark.figures.runs.AXES`
    :param band: one of :data:`BANDS`
    :raises ValueError: if a run's files do not say what ``x`` needs
    """
    common = sorted(set.intersection(*(set(run.rounds.tolist()) for run in runs)))
    if not common:
        raise ValueError(f"the runs of {runs[0].name} on {runs[0].family} have no evaluated round in common")
    chosen = [np.searchsorted(run.rounds, common) for run in runs]
    at = np.mean([run.axis(x)[places] for run, places in zip(runs, chosen, strict=True)], axis=0)
    lines = np.stack([value[places] for value, places in zip(values, chosen, strict=True)])
    return Curve(at, lines.mean(axis=0), _band(lines, band) if len(runs) > 1 else None)


def _band(lines: np.ndarray, band: str) -> tuple[np.ndarray, np.ndarray]:
    """:param lines: ``(n_seeds, n)``"""
    if band == "range":
        return lines.min(axis=0), lines.max(axis=0)
    return mean_interval(lines)


def draw_curves(comparison: Comparison, of: str = "average", x: str = "rounds", band: str = "range") -> Figure:
    """One panel per family.

    :param of: ``"average"`` over clients, or the ``"worst"`` client in each evaluation
    :raises ValueError: if a run's files do not say what is asked for
    """
    curves = {
        family: {name: curve(group, [run.of(of) for run in group], x, band) for name, group in runs.items()}
        for family, runs in comparison.items()
    }
    what = {"average": "mean over clients", "worst": "client with the lowest one"}[of]
    figure, grid = panels(len(curves), (3.6, 3.0), beside=1.9)
    unit = _unit(x, [line for lines in curves.values() for line in lines.values()])
    for axes, (family, lines) in zip(grid, curves.items(), strict=True):
        _draw(axes, lines, comparison[family], unit[0])
        axes.set_title(family, fontsize=MEDIUM, loc="left")
        axes.set_xlabel(unit[1], fontsize=MEDIUM)
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=x == "rounds"))
        axes.set_ylabel(f"return of an episode,\n{what}", fontsize=MEDIUM)
        fit_scale(axes, [float(line.mean[-1]) for line in lines.values()])
    legend(figure, _handles(comparison), _title(comparison, band))
    return figure


def draw_client_curves(family: str, runs: Runs, x: str = "rounds", band: str = "range") -> Figure:
    """One small panel per client of a family.

    :raises ValueError: if a run's files do not say what is asked for
    """
    every = [run for group in runs.values() for run in group]
    returns = {run.source: run.client_returns() for run in every}
    clients = every[0].clients or range(returns[every[0].source].shape[1])
    n = len(clients)
    figure, grid = panels(n, (2.1, 1.8), columns=4, beside=1.9)
    curves = [
        {name: curve(group, [returns[run.source][:, k] for run in group], x, band) for name, group in runs.items()}
        for k in range(n)
    ]
    unit = _unit(x, [line for lines in curves for line in lines.values()])
    for axes, client, lines in zip(grid, clients, curves, strict=True):
        _draw(axes, lines, runs, unit[0], width=1.0)
        axes.set_title(f"client {client}", fontsize=SMALL, loc="left")
        axes.xaxis.set_major_locator(MaxNLocator(4, integer=x == "rounds"))
        fit_scale(axes, [float(line.mean[-1]) for line in lines.values()])
        axes.set_ylabel("(symmetric log)" if axes.get_yscale() == "symlog" else "", fontsize=SMALL)
    figure.suptitle(f"{family}: clients", fontsize=MEDIUM)
    figure.supxlabel(unit[1], fontsize=MEDIUM)
    figure.supylabel("return of an episode", fontsize=MEDIUM)
    legend(figure, _handles({family: runs}), _title({family: runs}, band))
    return figure


def _draw(axes: Axes, lines: Mapping[str, Curve], runs: Runs, unit: float, width: float = 1.5) -> None:
    for place, (name, line) in enumerate(lines.items()):
        look = style(runs[name][0].method, runs[name][0].variant)
        axes.plot(
            line.x / unit,
            line.mean,
            **look.line_keywords(),
            linewidth=width,
            markersize=4,
            markevery=(0.02 * place, MARKER_SPACING) if np.isfinite(line.mean).any() else None,
        )
        if line.band is not None:
            axes.fill_between(line.x / unit, *line.band, color=look.color, alpha=0.15, linewidth=0)
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.margins(x=0.02)


def _unit(x: str, lines: Sequence[Curve]) -> tuple[float, str]:
    """Size and label of the axis's unit."""
    largest = max(float(line.x.max()) for line in lines)
    units = _UNITS.get(x, {1.0: ""})
    size = next((size for size in units if largest >= 2 * size), min(units))
    return size, _LABELS[x].format(unit=units[size])


def _handles(comparison: Comparison) -> list[Artist]:
    """One entry per method, with its number of seeds, or the numbers of its families where they differ."""
    handles: list[Artist] = []
    for name in names(comparison):
        groups = [runs[name] for runs in comparison.values() if name in runs]
        counts = sorted({len(group) for group in groups})
        number = seeds(counts[0]) if len(counts) == 1 else f"{counts[0]} to {counts[-1]} seeds"
        look = style(groups[0][0].method, groups[0][0].variant)
        handles.append(Line2D([], [], **look.line_keywords(), markersize=4, linewidth=1.5, label=f"{name} ({number})"))
    return handles


def _title(comparison: Comparison, band: str) -> str:
    several = any(len(group) > 1 for runs in comparison.values() for group in runs.values())
    return f"line: mean over seeds\n{BANDS[band]}" if several else "one seed of each method"
