"""Mazes from above."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from fed_envs.mazes import WALL


def draw_maze(axes: Axes, rows: tuple[str, ...]) -> None:
    """Walls grey; of the border's walls a strip.

    :param rows: see :func:`fed_envs.mazes.maze_rows`
    """
    height, width = len(rows), len(rows[0])
    walls = np.array([[cell == WALL for cell in row] for row in rows], dtype=float)
    axes.imshow(walls, cmap="Greys", vmin=0, vmax=2, extent=(-width / 2, width / 2, -height / 2, height / 2))
    axes.set(xticks=[], yticks=[], xlim=(0.7 - width / 2, width / 2 - 0.7), ylim=(0.7 - height / 2, height / 2 - 0.7))
