"""The quantities of the paper's Lemma 2 and Theorem 3 in the logs of runs."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from sb3_fedguide.benchmark.figures.layout import MEDIUM, legend, panels
from sb3_fedguide.benchmark.figures.runs import seeds
from sb3_fedguide.benchmark.figures.styles import Style, style

T = TypeVar("T")
#: Key of the log to round to value.
Scalars = Mapping[str, Mapping[int, float]]
KAPPA = re.compile(r"client_\d+/residual_correlation")
ONLINE, BLEND, OPTIMAL = (f"dice/advantage_variance_{name}" for name in ("online", "blend", "optimal"))
DISPERSION, CHANGE = "federated/policy_dispersion", "eval/averaging_change"


@dataclass(frozen=True)
class Log:
    """What one run has logged.

    :param method: name of its algorithm, which decides on its colour
    :param name: what it is called in figures
    :param variant: number of its setting among those of the same algorithm
    """

    method: str
    name: str
    variant: int
    family: str
    scalars: Scalars

    @property
    def look(self) -> Style:
        return style(self.method, self.variant)


@dataclass(frozen=True)
class Reduction:
    """Lemma 2 by round, ``(n_rounds,)`` each.

    :param kappa: mean over clients of ``Corr(G - V_theta, V_phi - V_theta)``; ``lowest`` and ``highest`` client
    :param ratio: variance of the advantage with V_phi over that without, of the clients' means
    :param optimal: the same with each client's best blend; NaN where the run has not logged it
    """

    rounds: np.ndarray
    kappa: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray
    ratio: np.ndarray
    optimal: np.ndarray


def reduction(scalars: Scalars) -> Reduction:
    """:raises ValueError: if the run has logged nothing of Lemma 2: it has no V_phi"""
    clients = [values for key, values in scalars.items() if KAPPA.fullmatch(key)]
    rounds = sorted(scalars.get(ONLINE, {}).keys() & scalars.get(BLEND, {}).keys())
    rounds = [round for round in rounds if any(round in values for values in clients)]
    if not rounds:
        raise ValueError("it has no V_phi, and logs nothing of Lemma 2")
    kappa = [[values[round] for values in clients if round in values] for round in rounds]
    without = np.array([scalars[ONLINE][round] for round in rounds])
    best = scalars.get(OPTIMAL, {})
    return Reduction(
        rounds=np.array(rounds),
        kappa=np.array([np.mean(values) for values in kappa]),
        lowest=np.array([min(values) for values in kappa]),
        highest=np.array([max(values) for values in kappa]),
        ratio=np.array([scalars[BLEND][round] for round in rounds]) / without,
        optimal=np.array([best.get(round, np.nan) for round in rounds]) / without,
    )


def averaging_points(scalars: Scalars) -> np.ndarray:
    """Theorem 3 in each round that evaluated both sides: dispersion and absolute change of the return, ``(n_rounds, 2)``.

    :raises ValueError: if there is no such round
    """
    rounds = sorted(scalars.get(DISPERSION, {}).keys() & scalars.get(CHANGE, {}).keys())
    if not rounds:
        raise ValueError("it has not evaluated the average of its policies; train it with --eval-average")
    return np.array([[scalars[DISPERSION][round], abs(scalars[CHANGE][round])] for round in rounds])


def bound_constant(points: np.ndarray) -> float:
    """The smallest C for which ``|change| <= C sqrt(dispersion)`` holds at all points, ``(n, 2)``."""
    spread = points[points[:, 0] > 0]
    return float((spread[:, 1] / np.sqrt(spread[:, 0])).max()) if len(spread) else 0.0


def draw_lemma2(logs: Sequence[Log]) -> Figure:
    """A row per family: kappa, and the variance with V_phi over that without it, by round.

    :raises ValueError: if no run has a V_phi
    """
    found = _readable(logs, reduction)
    families = list(dict.fromkeys(log.family for log, _ in found))
    figure, grid = panels(2 * len(families), (3.8, 2.9), columns=2, beside=2.1)
    for place, family in enumerate(families):
        left, right = grid[2 * place : 2 * place + 2]
        for log, values in ((log, values) for log, values in found if log.family == family):
            look = log.look
            left.plot(values.rounds, values.kappa, color=look.color, linestyle=look.line, linewidth=1.4)
            left.fill_between(values.rounds, values.lowest, values.highest, color=look.color, alpha=0.12, linewidth=0)
            right.plot(values.rounds, values.ratio, color=look.color, linestyle=look.line, linewidth=1.4)
            right.plot(values.rounds, values.optimal, color=look.color, linestyle=":", linewidth=1.0)
        left.axhline(0.0, color="black", linewidth=0.8)
        right.axhline(1.0, color="black", linewidth=0.8)
        right.ticklabel_format(axis="y", useOffset=False)
        left.set_ylabel(r"$\kappa = \mathrm{Corr}(G - V_\theta, V_\phi - V_\theta)$", fontsize=MEDIUM)
        right.set_ylabel("variance of the advantage\nwith $V_\\phi$ over that without", fontsize=MEDIUM)
        _frame(left, family)
        _frame(right, family)
    bands = "left: mean over clients,\nband: lowest to highest client"
    title = f"{bands}\nright: with the run's beta;\ndotted: each client's best beta\n"
    legend(figure, _handles([log for log, _ in found], marker=False), title)
    return figure


def draw_theorem3(logs: Sequence[Log]) -> Figure:
    """A panel per family: change of the return by averaging against the dispersion, and the smallest bound of the theorem.

    Both axes are logarithmic, where the bound is a line of slope one half. Rounds in which one of the two is zero are left
    out.

    :raises ValueError: if no run has evaluated its average
    """
    found = _readable(logs, averaging_points)
    families = list(dict.fromkeys(log.family for log, _ in found))
    figure, grid = panels(len(families), (3.9, 3.2), columns=2, beside=2.1)
    for axes, family in zip(grid, families, strict=True):
        own = [(log, points[(points > 0).all(axis=1)]) for log, points in found if log.family == family]
        for log, points in own:
            look = log.look.line_keywords()
            axes.plot(*points.T, **{**look, "linestyle": ""}, markersize=4, alpha=0.7)
        every = np.concatenate([points for _, points in own])
        if len(every):
            ends = np.array([every[:, 0].min(), every[:, 0].max()])
            axes.plot(ends, bound_constant(every) * np.sqrt(ends), color="black", linewidth=1.0, linestyle="--")
            axes.set_xscale("log")
            axes.set_yscale("log")
        axes.set_title(f"{family}: C = {bound_constant(every):.3g}", fontsize=MEDIUM, loc="left")
        axes.set_xlabel(r"policy dispersion $\Gamma_\pi$ (nats)", fontsize=MEDIUM)
        axes.set_ylabel("change of the return\nby averaging, absolute", fontsize=MEDIUM)
        axes.grid(alpha=0.3, linewidth=0.5)
    bound = Line2D([], [], color="black", linewidth=1.0, linestyle="--", label=r"smallest $C\sqrt{\Gamma_\pi}$ above all")
    legend(figure, [*_handles([log for log, _ in found]), bound], "a point: one evaluated round\n")
    return figure


def _readable(logs: Sequence[Log], read: Callable[[Scalars], T]) -> list[tuple[Log, T]]:
    found, reasons = [], []
    for log in logs:
        try:
            found.append((log, read(log.scalars)))
        except ValueError as error:
            reasons.append(f"{log.name} on {log.family}: {error}")
    if not found:
        raise ValueError("; ".join(dict.fromkeys(reasons)))
    return found


def _frame(axes: Axes, family: str) -> None:
    axes.set_title(family, fontsize=MEDIUM, loc="left")
    axes.set_xlabel("round", fontsize=MEDIUM)
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.margins(x=0.02)


def _handles(logs: Sequence[Log], marker: bool = True) -> list[Artist]:
    """One entry per name.

    :param marker: whether points are drawn, and no lines
    """
    handles: list[Artist] = []
    for name in dict.fromkeys(log.name for log in logs):
        of_name = [log for log in logs if log.name == name]
        look, number = (
            of_name[0].look.line_keywords(),
            max(sum(log.family == one.family for log in of_name) for one in of_name),
        )
        look = {**look, "linestyle": ""} if marker else {**look, "marker": ""}
        handles.append(Line2D([], [], **look, markersize=4, linewidth=1.4, label=f"{name} ({seeds(number)})"))
    return handles
