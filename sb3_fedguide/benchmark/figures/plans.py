"""The transport plan over rounds: shares of heads in priors, loads of the experts, and the experts that a client uses."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from sb3_fedguide.benchmark.figures.layout import MEDIUM, SMALL, legend, panels
from sb3_fedguide.benchmark.figures.styles import style
from sb3_fedguide.benchmark.plans import Plans

MAP = "cividis"
#: Rounds whose plan is drawn.
N_DRAWN = 3
#: Shares are written into matrices of up to so many clients.
MAX_WRITTEN = 12


def draw_plans(plans: Plans, title: str, method: str = "fedguide") -> Figure:
    """Above, the share of every client's head in each client's prior, in three rounds; below, three measures over rounds.

    :param title: name of the run
    :param method: name of its algorithm
    :raises ValueError: if there is only the plan before the first round
    """
    after = np.flatnonzero(plans.rounds > 0)
    if not len(after):
        raise ValueError("there is no transport plan of a round yet")
    drawn = sorted({int(after[place]) for place in np.linspace(0, len(after) - 1, N_DRAWN).round().astype(int)})
    figure, axes = panels(6, (2.5, 2.5), 3, beside=1.9)
    listening = plans.listening
    for here, index in zip(axes, drawn, strict=False):
        _matrix(here, listening[index], plans.clients, f"round {plans.rounds[index]}")
    for blank in axes[len(drawn) : 3]:
        blank.axis("off")
    _others(axes[3], plans, listening)
    _effective_experts(axes[4], plans, method)
    _effective_clients(axes[5], plans, method)
    for here in axes[3:]:
        here.set_xlabel("round", fontsize=MEDIUM)
    figure.suptitle(title, fontsize=MEDIUM, x=0.01, ha="left")
    look = style(method)
    handles: list[Artist] = [Patch(color=_color(share), label=f"{share:g}") for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
    handles.append(Line2D([], [], color=look.color, linewidth=1.5, label="mean"))
    handles.append(Patch(color=look.color, alpha=0.2, label="lowest to highest"))
    handles.append(Line2D([], [], color="black", linestyle=":", linewidth=0.8, label="1: nothing is shared;\ntop: all alike"))
    legend(figure, handles, "colour: share of a prior")
    return figure


def _color(share: float) -> str:
    return to_hex(colormaps[MAP](share))


def _matrix(axes: Axes, shares: np.ndarray, clients: list[int], title: str) -> None:
    axes.imshow(shares, cmap=MAP, vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_title(title, fontsize=MEDIUM, loc="left")
    axes.set_xlabel("whose head", fontsize=MEDIUM)
    axes.set_ylabel("client's prior", fontsize=MEDIUM)
    _client_ticks(axes, clients, both=True)
    if len(clients) <= MAX_WRITTEN:
        for (row, column), share in np.ndenumerate(shares):
            if share >= 0.005:
                axes.text(column, row, f"{share:.2f}".removeprefix("0"), ha="center", va="center", fontsize=6,
                          color="black" if share > 0.55 else "white")  # fmt: skip


def _client_ticks(axes: Axes, clients: list[int], both: bool = False) -> None:
    places = range(0, len(clients), -(-len(clients) // 20))
    axes.set_yticks(places, [str(clients[place]) for place in places])
    if both:
        axes.set_xticks(places, [str(clients[place]) for place in places])


def _over_rounds(axes: Axes, values: np.ndarray, rounds: np.ndarray) -> None:
    """A column per round, also where some have no plan; colours up to 1."""
    spread = np.full((values.shape[1], int(rounds[-1] - rounds[0]) + 1), np.nan)
    spread[:, rounds - rounds[0]] = values.T
    edges = (rounds[0] - 0.5, rounds[-1] + 0.5, len(spread) - 0.5, -0.5)
    axes.imshow(spread, cmap=MAP, vmin=0.0, vmax=1.0, aspect="auto", extent=edges, interpolation="nearest")
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))


def _others(axes: Axes, plans: Plans, listening: np.ndarray) -> None:
    after = plans.rounds > 0
    others = 1.0 - np.stack([np.diag(given) for given in listening[after]])
    _over_rounds(axes, others, plans.rounds[after])
    axes.set_title("share of others in a client's prior", fontsize=SMALL, loc="left")
    axes.set_ylabel("client", fontsize=MEDIUM)
    _client_ticks(axes, plans.clients)


def _effective_experts(axes: Axes, plans: Plans, method: str) -> None:
    _spread(axes, plans.effective_experts, plans, method, plans.weights.shape[2])
    axes.set_title("effective experts of a client", fontsize=SMALL, loc="left")


def _effective_clients(axes: Axes, plans: Plans, method: str) -> None:
    _spread(axes, plans.effective_clients, plans, method, len(plans.clients))
    low, high = plans.loads.min(), plans.loads.max()
    loads = f"{low:.3g}" if high - low < 1e-3 else f"{low:.3g} to {high:.3g}"
    axes.set_title(f"effective clients of an expert\n(its load: {loads})", fontsize=SMALL, loc="left")


def _spread(axes: Axes, found: np.ndarray, plans: Plans, method: str, highest: int) -> None:
    """:param found: ``(n_rounds, n)``: mean, and band from the lowest to the highest"""
    look = style(method)
    axes.plot(plans.rounds, np.nanmean(found, axis=1), color=look.color, linewidth=1.5)
    edges = np.nanmin(found, axis=1), np.nanmax(found, axis=1)
    axes.fill_between(plans.rounds, *edges, color=look.color, alpha=0.2, linewidth=0)
    for level in (1, highest):
        axes.axhline(level, color="black", linestyle=":", linewidth=0.8)
    axes.set_ylim(0.0, highest + 0.5)
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
