"""Final returns of every client with every method, as a heat map in which stuck clients stand out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sb3_fedguide.benchmark.figures.layout import MEDIUM, SMALL, legend, panels
from sb3_fedguide.benchmark.figures.runs import Runs, finished, seeds
from sb3_fedguide.benchmark.results import STUCK, Result
from sb3_fedguide.common.digits import shown

_STUCK_COLOR = "#D55E00"


@dataclass(frozen=True)
class ClientReturns:
    """Final returns of one family's clients.

    :param names: of methods, ``n_methods``
    :param clients: numbers, ``n_clients``
    :param mean: over seeds, ``(n_methods, n_clients)``
    :param best: of any run that was read, ``(n_clients,)``
    :param stuck: seeds with which a client is stuck, ``(n_methods, n_clients)``
    :param n_seeds: of each method
    """

    names: Sequence[str]
    clients: Sequence[int]
    mean: np.ndarray
    best: np.ndarray
    stuck: np.ndarray
    n_seeds: Sequence[int]

    @property
    def share(self) -> np.ndarray:
        """The mean as a share of the best, ``(n_methods, n_clients)``."""
        return share_of_best(self.mean, self.best)


def share_of_best(returns: np.ndarray, best: np.ndarray) -> np.ndarray:
    """``1 - (best - return) / |best|``: ``return / best`` where the best return is positive.

    Where it is negative, a client that falls short of it by 40 % of its size has a share of 0.6 as well. Where it is 0, every
    return below it has a share of minus infinity.

    :param returns: ``(..., n_clients)``
    :param best: ``(n_clients,)``
    """
    short = best - returns
    with np.errstate(divide="ignore", invalid="ignore"):
        return 1.0 - np.where(short == 0.0, 0.0, short / np.abs(best))


def client_returns(results: Mapping[str, Sequence[Result]]) -> ClientReturns:
    """Final returns of one family's clients.

    :param results: name of a method to its results
    :raises ValueError: if a file does not have the clients' returns
    """
    for group in results.values():
        for result in group:
            if not len(result.client_finals):
                raise ValueError(f"{result.path} does not say the clients' final returns (client_returns)")
    returns = {name: np.array([result.client_finals for result in group]) for name, group in results.items()}
    best = np.max(np.concatenate(list(returns.values())), axis=0)
    first = next(iter(results.values()))[0]
    return ClientReturns(
        names=list(results),
        clients=first.clients or range(len(best)),
        mean=np.stack([values.mean(axis=0) for values in returns.values()]),
        best=best,
        stuck=np.stack([(share_of_best(values, best) < STUCK).sum(axis=0) for values in returns.values()]),
        n_seeds=[len(values) for values in returns.values()],
    )


def draw_clients(family: str, runs: Runs) -> Figure:
    """A row per method and a column per client; colours are shares of a client's best return, numbers are returns.

    :raises ValueError: if no run is finished, or a file does not have the clients' returns
    """
    if not (results := finished(runs)):
        raise ValueError(f"no run on {family} is finished")
    found = client_returns(results)
    n_methods, n_clients = found.mean.shape
    figure, (axes,) = panels(1, (1.9 + 0.62 * n_clients, max(2.4, 1.1 + 0.42 * n_methods)), beside=2.1)
    image = axes.imshow(np.clip(found.share, 0.0, 1.0), cmap="cividis", vmin=0.0, vmax=1.0, aspect="auto")
    for (row, column), share in np.ndenumerate(found.share):
        text = shown(float(found.mean[row, column]))
        if found.stuck[row, column]:
            text += f"\n{found.stuck[row, column]} of {found.n_seeds[row]}"
        axes.text(column, row, text, ha="center", va="center", fontsize=6.5, color="black" if share > 0.6 else "white")
        if share < STUCK:
            axes.add_patch(
                Rectangle((column - 0.45, row - 0.44), 0.9, 0.88, fill=False, edgecolor=_STUCK_COLOR, linewidth=1.8)
            )
    labels = [f"{name} ({seeds(n)})" for name, n in zip(found.names, found.n_seeds, strict=True)]
    axes.set_yticks(range(n_methods), labels, fontsize=SMALL)
    axes.set_xticks(
        range(n_clients), [f"{client}\n{shown(best)}" for client, best in zip(found.clients, found.best, strict=True)]
    )
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    axes.set_title(f"{family}: final return of each client, mean over seeds", fontsize=MEDIUM, loc="left")
    axes.set_xlabel("client, and the best return that a run has reached for it", fontsize=MEDIUM)
    bar = figure.colorbar(image, ax=axes, ticks=[0, STUCK, 1], aspect=30)
    bar.ax.tick_params(labelsize=SMALL)
    bar.set_label("share of the best return", fontsize=SMALL, labelpad=6)
    box: list[Artist] = [
        Rectangle((0, 0), 1, 1, fill=False, edgecolor=_STUCK_COLOR, linewidth=1.8, label="stuck: mean below\n60 % of the best")
    ]
    note = "\n\nwhere the best is negative:\nshort of it by 40 % of its size" if (found.best < 0).any() else ""
    legend(figure, box, f"k of n: stuck with k\nof n seeds{note}")
    return figure
