"""Small pictures of a run as arrays. Figures are drawn on a canvas of their own, so that pyplot's state is not touched."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fed_envs import Client, Family
from sb3_fedguide.benchmark.bandit2d import Policies, Priors
from sb3_fedguide.benchmark.figures.bandit2d import draw_density, draw_outline

#: TensorBoard shows a picture about this wide beside others (inches); what is drawn wider gets too small to read.
WIDTH = 4.4
DPI = 90
#: Matrices with at most so many columns get their numbers written into the cells.
MAX_ANNOTATED = 10
COLUMNS = 3
#: At most so many rows of a matrix get room and a label of their own, and so many columns a label.
MAX_ROWS, MAX_LABELS = 50, 16
#: Densities are drawn of the first so many clients: every one has axes of its own, which take long to draw.
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
    labelled = _spread(n_clients, MAX_ROWS)
    axes.set(xlabel="expert", ylabel="client", xticks=_spread(n_experts, MAX_LABELS), yticks=labelled)
    axes.set_yticklabels([str(client_ids[row]) for row in labelled])
    axes.set_title("Transport plan: clients' weights of the experts", fontsize=9, loc="left")
    axes.tick_params(labelsize=8)
    if n_experts <= MAX_ANNOTATED:
        texts = [[f"{share:.2f}".removeprefix("0") if share >= 0.005 else "" for share in row] for row in rows]
        _annotate(axes, texts, np.where(rows > 0.6, "black", "white"))
    figure.colorbar(image, ax=axes, ticks=[0, 0.5, 1]).ax.tick_params(labelsize=8)
    return _rgb(figure)


def heterogeneity(family: Family, client_ids: Sequence[int]) -> np.ndarray | None:
    """How the clients differ: each parameter over its deviation; ``None`` where no number differs.

    What is the same for all clients is left out, and names stand under the client.
    """
    clients = [family.client(client) for client in client_ids]
    names, values = varying_parameters(clients)
    if not names:
        return None
    standardised = (values - values.mean(axis=0)) / values.std(axis=0)
    words = _words(clients)
    height = 1.0 + 0.27 * min(len(names), MAX_ROWS) + (1.2 if any(words) else 0.0)
    figure = Figure(figsize=(WIDTH, height), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    limit = max(2.0, float(np.abs(standardised).max()))
    image = axes.imshow(standardised.T, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto")
    labels = [f"{client.client} {text}".strip() for client, text in zip(clients, words, strict=True)]
    columns, rows = _spread(len(clients), MAX_LABELS), _spread(len(names), MAX_ROWS)
    turned = any(words) or len(clients) > MAX_ANNOTATED
    axes.set(xlabel="client", xticks=columns, yticks=rows)
    axes.set_xticklabels([labels[column] for column in columns], rotation=90 if turned else 0, fontsize=7)
    axes.set_yticklabels([names[row].replace("_", " ") for row in rows], fontsize=7)
    axes.set_title(f"{family.name}: clients' parameters\ncolours: deviations from the mean", fontsize=8, loc="left")
    if len(clients) <= MAX_ANNOTATED:
        texts = [[_short(value) for value in row] for row in values.T]
        _annotate(axes, texts, np.where(np.abs(standardised.T) > 0.6 * limit, "white", "black"))
    figure.colorbar(image, ax=axes, ticks=[-2, 0, 2]).ax.tick_params(labelsize=8)
    return _rgb(figure)


def varying_parameters(clients: Sequence[Client]) -> tuple[list[str], np.ndarray]:
    """Names of the numbers in which clients differ and their values, ``(n_clients, n_names)``; those of a tuple are numbered.

    Fields that are no number, or no tuple of equally many, are left out.
    """
    names, columns = [], []
    for field in type(clients[0]).model_fields:
        if field == "client":
            continue
        entries = [getattr(client, field) for client in clients]
        if not all(_is_numeric(entry) for entry in entries) or len({np.shape(entry) for entry in entries}) != 1:
            continue
        flat = np.array(entries, dtype=np.float64).reshape(len(clients), -1)
        suffixes = [""] if np.ndim(entries[0]) == 0 else [f" {k}" for k in range(flat.shape[1])]
        for suffix, column in zip(suffixes, flat.T, strict=True):
            if column.std() > 1e-9 * max(1.0, np.abs(column).max()):
                names.append(field + suffix)
                columns.append(column)
    return names, np.array(columns).T.reshape(len(clients), len(names))


def bandit_densities(
    policies: Policies, client_ids: Sequence[int], priors: Priors | None = None, broadcast: Policies | None = None
) -> np.ndarray:
    """Bandit2D's policies as densities over actions, with the clients' personal priors and the global one where given.

    Of more than :data:`MAX_DENSITIES` clients the first are drawn, and the title says so.

    :param policies: of the clients after local training
    :param priors: on :func:`~sb3_fedguide.benchmark.figures.bandit2d.grid`
    :param broadcast: what the server sent after it
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


def _annotate(axes: Axes, texts: Sequence[Sequence[str]], colors: np.ndarray) -> None:
    for (row, column), color in np.ndenumerate(colors):
        axes.text(column, row, texts[row][column], ha="center", va="center", color=str(color), fontsize=6.5)


def _spread(n: int, most: int) -> list[int]:
    """Positions out of ``n`` with equal steps, at most ``most`` of them."""
    return list(range(0, n, -(-n // most)))


def _short(value: float) -> str:
    """Two digits in as little room as they take: ``1.2``, ``.034``, ``-.5``, ``315``."""
    text = f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}"
    return text.replace("0.", ".", 1) if abs(value) < 1 else text


def _is_numeric(entry: object) -> bool:
    if isinstance(entry, tuple):
        return all(_is_numeric(part) for part in entry)
    return isinstance(entry, int | float)


def _words(clients: Sequence[Client]) -> list[str]:
    """Each client's names, of presets for instance, where the clients' differ."""
    contents = [client.parameters() for client in clients]
    fields = [field for field in contents[0] if all(isinstance(content[field], str) for content in contents)]
    told = [field for field in fields if len({content[field] for content in contents}) > 1]
    return [" ".join(content[field] for field in told).replace("_", " ") for content in contents]


def _rgb(figure: Figure) -> np.ndarray:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
