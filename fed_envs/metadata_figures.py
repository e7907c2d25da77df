"""Figures of a family's metadata: how its clients differ, and how far a Hard family reaches beyond its main one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fed_envs.clients import Client
from fed_envs.metadata import Family

DPI = 90
#: Matrices with at most so many columns get their numbers written into the cells.
MAX_ANNOTATED = 10
#: At most so many rows of a matrix get room and a label of their own, and so many columns a label.
MAX_ROWS, MAX_LABELS = 50, 16
#: Panels of a row in :func:`ranges`.
COLUMNS = 4
#: Colours of the families in :func:`ranges`, for the colour-blind as well.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")


def heterogeneity(family: Family, client_ids: Sequence[int] | None = None, width: float = 6.4) -> Figure | None:
    """How the clients differ: each parameter over its standard deviation; ``None`` if no number differs.

    Parameters that are the same for all clients are left out, and names stand under the client.

    :param client_ids: the clients to show; all by default
    :param width: in inches
    """
    ids = range(family.n_clients) if client_ids is None else client_ids
    clients = [family.client(client) for client in ids]
    names, values = varying_parameters(clients)
    if not names:
        return None
    standardised = (values - values.mean(axis=0)) / values.std(axis=0)
    words = _words(clients)
    height = 1.0 + 0.27 * min(len(names), MAX_ROWS) + (1.2 if any(words) else 0.0)
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    limit = max(2.0, float(np.abs(standardised).max()))
    image = axes.imshow(standardised.T, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto")
    labels = [f"{client.client} {text}".strip() for client, text in zip(clients, words, strict=True)]
    columns, rows = spread(len(clients), MAX_LABELS), spread(len(names), MAX_ROWS)
    turned = any(words) or len(clients) > MAX_ANNOTATED
    axes.set(xlabel="client", ylabel="parameter", xticks=columns, yticks=rows)
    axes.set_xticklabels([labels[column] for column in columns], rotation=90 if turned else 0, fontsize=7)
    axes.set_yticklabels([names[row].replace("_", " ") for row in rows], fontsize=7)
    axes.set_title(f"{family.name}: clients' parameters", fontsize=8, loc="left")
    if len(clients) <= MAX_ANNOTATED:
        texts = [[_short(value) for value in row] for row in values.T]
        annotate(axes, texts, np.where(np.abs(standardised.T) > 0.6 * limit, "white", "black"))
    scale = figure.colorbar(image, ax=axes, ticks=[-2, 0, 2])
    scale.ax.tick_params(labelsize=8)
    scale.set_label("standard deviations from the mean", fontsize=7)
    return figure


def ranges(families: Sequence[Family]) -> Figure:
    """Each parameter's values in families of one world, as violins side by side with a dot for each client.

    :raises ValueError: for families of different worlds, or without a number that differs between clients of one of them
    """
    if len({family.world for family in families}) != 1:
        raise ValueError(f"{', '.join(family.name for family in families)} are not of one world: nothing can be compared")
    found = [dict(zip(*_columns(family), strict=True)) for family in families]
    names = list(dict.fromkeys(name for columns in found for name in columns))
    if not names:
        raise ValueError(f"no number differs between the clients of {', '.join(family.name for family in families)}")
    n_rows = -(-len(names) // COLUMNS)
    figure = Figure(figsize=(1.9 * min(COLUMNS, len(names)) + 0.4, 2.0 * n_rows + 0.4), dpi=2 * DPI, layout="constrained")
    panels = figure.subplots(n_rows, min(COLUMNS, len(names)), squeeze=False).ravel()
    for axes, name in zip(panels, names, strict=False):
        for place, (family, columns) in enumerate(zip(families, found, strict=True)):
            values = columns.get(name)
            if values is None:
                values = np.array(_constant(family, name))
            color = COLORS[place % len(COLORS)]
            if len(values) > 1 and values.std() > 0:
                for body in axes.violinplot(values, [place], widths=0.8, showextrema=False)["bodies"]:  # type: ignore[attr-defined]
                    body.set_facecolor(color)
                    body.set_alpha(0.35)
            axes.plot(np.full(len(values), place), values, ".", color=color, markersize=5)
        axes.set_title(name.replace("_", " "), fontsize=8)
        axes.set_xticks(range(len(families)), [family.name for family in families], fontsize=7)
        axes.set_xlim(-0.6, len(families) - 0.4)
        axes.tick_params(axis="y", labelsize=7)
    for axes in panels[len(names) :]:
        axes.axis("off")
    return figure


def varying_parameters(clients: Sequence[Client]) -> tuple[list[str], np.ndarray]:
    """Names of the numbers in which clients differ and their values, ``(n_clients, n_names)``; those of a tuple are numbered.

    Fields that are no number, or no tuple of equally many, are left out.
    """
    names, columns = [], []
    for name, column in _numbers(clients):
        if column.std() > 1e-9 * max(1.0, np.abs(column).max()):
            names.append(name)
            columns.append(column)
    return names, np.array(columns).T.reshape(len(clients), len(names))


def _numbers(clients: Sequence[Client]) -> list[tuple[str, np.ndarray]]:
    """Every number of the clients by name, with its value of each client."""
    found = []
    for field in type(clients[0]).model_fields:
        if field == "client":
            continue
        entries = [getattr(client, field) for client in clients]
        if not all(_is_numeric(entry) for entry in entries) or len({np.shape(entry) for entry in entries}) != 1:
            continue
        flat = np.array(entries, dtype=np.float64).reshape(len(clients), -1)
        suffixes = [""] if np.ndim(entries[0]) == 0 else [f" {k}" for k in range(flat.shape[1])]
        found += [(field + suffix, column) for suffix, column in zip(suffixes, flat.T, strict=True)]
    return found


def _columns(family: Family) -> tuple[list[str], list[np.ndarray]]:
    names, values = varying_parameters(family.clients)
    return names, list(values.T)


def _constant(family: Family, name: str) -> list[float]:
    """The values of a number that is the same for all clients of a family; nothing where the family has no such number."""
    return next((column.tolist() for other, column in _numbers(family.clients) if other == name), [])


def annotate(axes: Axes, texts: Sequence[Sequence[str]], colors: np.ndarray) -> None:
    """Write ``texts`` into the cells of a matrix, in ``colors`` of its shape."""
    for (row, column), color in np.ndenumerate(colors):
        axes.text(column, row, texts[row][column], ha="center", va="center", color=str(color), fontsize=6.5)


def spread(n: int, most: int) -> list[int]:
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
    varying = [field for field in fields if len({content[field] for content in contents}) > 1]
    return [" ".join(content[field] for field in varying).replace("_", " ") for content in contents]
