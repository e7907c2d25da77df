"""Common parts of a comparison's figures: panels, scales, legends beside the data, and files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fed_envs.files import atomic_file

FORMATS = ("png", "pdf")
DPI = 200
#: Panels side by side.
COLUMNS = 3
SMALL, MEDIUM = 8, 9
#: Returns of which none is positive, or that have both signs, get a symmetric log scale from this ratio of levels on.
WIDE = 50.0


def panels(n: int, size: tuple[float, float], columns: int = COLUMNS, beside: float = 0.0) -> tuple[Figure, list[Axes]]:
    """A figure of ``n`` panels of equal size.

    :param size: of a panel, inches
    :param beside: inches that a legend at the right needs
    """
    across = min(n, columns)
    down = -(-n // across)
    figure = Figure(figsize=(across * size[0] + beside, down * size[1]), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(down, across, squeeze=False).ravel()
    for blank in grid[n:]:
        blank.axis("off")
    for axes in grid[:n]:
        axes.tick_params(labelsize=SMALL)
        axes.spines[["top", "right"]].set_visible(False)
    return figure, list(grid[:n])


def legend(figure: Figure, handles: Sequence[Artist], title: str) -> None:
    """Beside the panels, never over them; ``title`` says what is drawn."""
    box = figure.legend(
        handles=handles, loc="outside right upper", title=title, fontsize=SMALL, title_fontsize=SMALL, frameon=False
    )
    box.set_alignment("left")


def fit_scale(axes: Axes, levels: Iterable[float], direction: str = "y") -> None:
    """A symmetric log scale for the returns where levels lie so far apart that a linear one would hide the best methods.

    :param levels: returns of each method; where all are positive, the scale stays linear
    """
    sizes = np.abs(found := np.array([level for level in levels if np.isfinite(level) and level != 0]))
    if len(sizes) and found.min() < 0 and sizes.max() > WIDE * sizes.min():
        linear = 10.0 ** np.floor(np.log10(sizes.min()))
        getattr(axes, f"set_{direction}scale")("symlog", linthresh=linear)
        label = axes.get_ylabel() if direction == "y" else axes.get_xlabel()
        getattr(axes, f"set_{direction}label")(f"{label}\n(symmetric log scale)", fontsize=MEDIUM)


def files(name: str) -> list[str]:
    """The files of the figure ``name``."""
    return [f"{name}.{suffix}" for suffix in FORMATS]


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as PNG and PDF; the same figure gives the same bytes.

    :raises OSError: if a file cannot be written
    """
    paths = [folder / file for file in files(name)]
    for path, suffix in zip(paths, FORMATS, strict=True):
        with rc_context({"pdf.fonttype": 42, "hatch.linewidth": 0.6}), atomic_file(path, "wb") as file:  # text stays text
            figure.savefig(file, format=suffix, dpi=DPI, metadata={"CreationDate": None} if suffix == "pdf" else None)
        figure.set_layout_engine("none")  # panels stay where the first file has them
    return paths
