"""Small pictures of a run as arrays. Figures are drawn on a canvas of their own, so that pyplot's state is not touched."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fed_envs import Family, metadata_figures
from fed_envs.metadata_figures import MAX_ANNOTATED, MAX_LABELS, MAX_ROWS, annotate, spread
from sb3_fedguide.benchmark.bandit2d import Policies, Priors
from sb3_fedguide.benchmark.figures.bandit2d import draw_density, draw_outline

#: TensorBoard shows a picture about this wide beside others (inches); a wider figure becomes too small to read.
WIDTH = 4.4
DPI = 90
COLUMNS = 3
#: Largest number of clients whose densities are drawn: each has its own axes, which take long to draw.
MAX_DENSITIES = 30
LEGEND = "colour: policy\n+: its mean\ndashed: the client's\nprior, 2 deviations"


def transport_plan(rows: np.ndarray, client_ids: Sequence[int]) -> np.ndarray:
    """Each client's share of every expert.

    :param rows: mixture weights, ``(n_clients, n_experts)``
    :return: RGB, ``(height, width, 3)`` uint8, like all pictures here
    """
    n_clients, n_experts = rows.shape
    figure = Figure(figsize=(WIDTH, 1.2 + 0.27 * min(n_clients, MAX_ROWS)), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(rows, cmap="viridis", vmin=0.0, vmax=1.0, aspect="auto")
    labelled = spread(n_clients, MAX_ROWS)
    axes.set(xlabel="expert", ylabel="client", xticks=spread(n_experts, MAX_LABELS), yticks=labelled)
    axes.set_yticklabels([str(client_ids[row]) for row in labelled])
    axes.set_title("Transport plan: clients' weights of the experts", fontsize=9, loc="left")
    axes.tick_params(labelsize=8)
    if n_experts <= MAX_ANNOTATED:
        texts = [[f"{share:.2f}".removeprefix("0") if share >= 0.005 else "" for share in row] for row in rows]
        annotate(axes, texts, np.where(rows > 0.6, "black", "white"))
    figure.colorbar(image, ax=axes, ticks=[0, 0.5, 1]).ax.tick_params(labelsize=8)
    return _rgb(figure)


def heterogeneity(family: Family, client_ids: Sequence[int]) -> np.ndarray | None:
    """How the clients differ, see :func:`~fed_envs.metadata_figures.heterogeneity`; ``None`` if no number differs."""
    figure = metadata_figures.heterogeneity(family, client_ids, width=WIDTH)
    return None if figure is None else _rgb(figure)


def bandit_densities(
    policies: Policies, client_ids: Sequence[int], priors: Priors | None = None, broadcast: Policies | None = None
) -> np.ndarray:
    """Bandit2D's policies as densities over actions, with the clients' personal priors and the global one where given.

    With more than :data:`MAX_DENSITIES` clients only the first are drawn, and the title says so.

    :param policies: of the clients after local training
    :param priors: on :func:`~sb3_fedguide.benchmark.figures.bandit2d.grid`
    :param broadcast: the server's broadcast policies after it
    """
    from sb3_fedguide.benchmark.figures.bandit2d import grid

    densities = policies.density(grid())[:MAX_DENSITIES]
    panels = [(f"client {client}", density) for client, density in zip(client_ids, densities, strict=False)]
    if priors is not None:
        panels.append(("global prior", priors.server))
    if broadcast is not None:
        panels.append(("broadcast policy", broadcast.density(grid())[0]))
    n_rows = -(-len(panels) // COLUMNS)
    size = WIDTH / COLUMNS
    figure = Figure(figsize=(WIDTH, n_rows * (size + 0.25)), dpi=DPI, layout="constrained")
    grid_of_axes = figure.subplots(n_rows, COLUMNS, squeeze=False).ravel()
    for index, (axes, (title, density)) in enumerate(zip(grid_of_axes, panels, strict=False)):
        draw_density(axes, density, title)
        if index < len(densities):
            axes.plot(*policies.mean[index], "+", color="white", markersize=8)
            if priors is not None:
                draw_outline(axes, priors.personal[index])
    blanks = grid_of_axes[len(panels) :]
    for axes in blanks:
        axes.axis("off")
    if priors is not None and len(blanks):
        blanks[-1].text(0.0, 0.5, LEGEND, va="center", fontsize=8)
    if len(densities) < len(client_ids):
        figure.suptitle(f"the first {len(densities)} of {len(client_ids)} clients", fontsize=9)
    return _rgb(figure)


def _rgb(figure: Figure) -> np.ndarray:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
