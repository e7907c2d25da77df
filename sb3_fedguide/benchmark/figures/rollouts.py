"""One episode of each client and method, each in one picture (the paper's appendix of visualisations)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from fed_envs import Family
from fed_envs.bandit2d import ACTION_LIMIT, PEAKS
from fed_envs.mazes import maze_rows
from sb3_fedguide.benchmark.bandit2d import Policies
from sb3_fedguide.benchmark.figures import layout
from sb3_fedguide.benchmark.figures.bandit2d import grid as bandit_grid
from sb3_fedguide.benchmark.figures.layout import MEDIUM, SMALL, legend, panels
from sb3_fedguide.benchmark.figures.mazes import draw_maze
from sb3_fedguide.benchmark.figures.styles import Style
from sb3_fedguide.benchmark.rollouts import GROUND, Episode
from sb3_fedguide.common.digits import shown

#: Width and height of a cell, inches: of walking bodies, and of all other worlds.
WIDE, SQUARE = (1.75, 0.95), (1.0, 1.0)
#: Cells side by side.
_COLUMNS = {WIDE: 4, SQUARE: 8}
N_SAMPLES = 60
_TEXT = 6.5


@dataclass(frozen=True)
class Cell:
    """What is drawn of one client of one method.

    :param picture: ``(height, width, 3)`` uint8, of worlds that are photographed
    :param policy: of Bandit2D
    """

    episode: Episode
    picture: np.ndarray | None = None
    policy: Policies | None = None


@dataclass(frozen=True)
class Row:
    """A method's cells, one per client.

    :param note: what else is said about it, such as its seed
    """

    name: str
    look: Style
    cells: Sequence[Cell]
    note: str = ""


def cell_size(family: Family) -> tuple[float, float]:
    """Inches."""
    return WIDE if family.world == "locomotion" else SQUARE


def pixels(family: Family) -> tuple[int, int]:
    """Width and height of a photograph that fills a cell."""
    width, height = cell_size(family)
    return round(width * layout.DPI), round(height * layout.DPI)


def draw_rollouts(family: Family, rows: Sequence[Row]) -> Figure:
    """Blocks of clients, and in each block a row per method."""
    size = cell_size(family)
    clients = [cell.episode.client for cell in rows[0].cells]
    across = min(len(clients), _COLUMNS[size])
    blocks = [range(start, min(start + across, len(clients))) for start in range(0, len(clients), across)]
    figure, axes = panels(len(blocks) * len(rows) * across, (size[0], size[1] + 0.3), across, beside=1.75)
    engine = figure.get_layout_engine()
    assert isinstance(engine, ConstrainedLayoutEngine)
    engine.set(w_pad=0.02, h_pad=0.02, wspace=0.0, hspace=0.0)
    rng = np.random.default_rng(0)
    for place, here in enumerate(axes):
        line, column = divmod(place, across)
        block, row = blocks[line // len(rows)], rows[line % len(rows)]
        if column >= len(block):
            here.axis("off")
            continue
        cell = row.cells[block[column]]
        _draw_cell(here, family, cell, row.look, rng)
        here.set(xticks=[], yticks=[])
        here.spines[:].set(visible=True, color=row.look.color, linewidth=1.2)
        here.set_title(_title(cell.episode), fontsize=_TEXT, pad=2, loc="left")
        if column == 0:
            here.set_ylabel(row.name, fontsize=SMALL, color=row.look.color, fontweight="bold")
    title = f"{family.name}: an episode of each client, and its return" if across * size[0] > 3.0 else family.name
    figure.suptitle(title, fontsize=MEDIUM, x=0.01, ha="left")
    legend(figure, _handles(rows, family), _explanation(family))
    return figure


def _title(episode: Episode) -> str:
    text = f"client {episode.client}: {shown(episode.episode_return)}"
    if len(episode.positions) and episode.seconds:
        way = episode.positions[-1] - episode.positions[0]
        text += f"; {way:.1f} m in {len(episode) * episode.seconds:.1f} s"
    return text


def _draw_cell(axes: Axes, family: Family, cell: Cell, look: Style, rng: np.random.Generator) -> None:
    if cell.picture is not None:
        axes.imshow(cell.picture, interpolation="antialiased")
    elif cell.policy is not None:
        _draw_bandit(axes, family, cell, rng)
    else:
        _draw_path(axes, family, cell.episode, look)


def _draw_path(axes: Axes, family: Family, episode: Episode, look: Style) -> None:
    """PointMaze's observations begin with the ball's position and end with the goal's."""
    path = episode.observations
    draw_maze(axes, maze_rows(family.client(episode.client).maze))  # type: ignore[attr-defined]
    axes.plot(path[:, 0], path[:, 1], color=look.color, linewidth=1.2)
    axes.plot(*path[0, :2], "o", color="black", markersize=3)
    axes.plot(*path[-1, 4:], "*", color="#F0E442", markeredgecolor="black", markeredgewidth=0.5, markersize=7)
    axes.plot(*path[-1, :2], "x", color="black", markersize=4, markeredgewidth=1.2)


def _draw_bandit(axes: Axes, family: Family, cell: Cell, rng: np.random.Generator) -> None:
    assert cell.policy is not None
    policy, edge = cell.policy, (-ACTION_LIMIT, ACTION_LIMIT)
    points = bandit_grid()
    side = round(len(points) ** 0.5)
    density = policy.density(points).reshape(side, side)
    lightest = 2 * float(density.max())  # marks stay visible on it
    axes.imshow(density, origin="lower", extent=(*edge, *edge), cmap="Greys", vmin=0.0, vmax=lightest)
    for peak in PEAKS:
        own = (peak == family.client(cell.episode.client).peak).all()  # type: ignore[attr-defined]
        axes.add_patch(Circle(tuple(peak), 0.2, fill=False, linewidth=1.2 if own else 0.6, linestyle="-" if own else ":"))
    drawn = policy.mean[0] + policy.std[0] * rng.standard_normal((N_SAMPLES, 2))
    axes.plot(*np.clip(drawn, *edge).T, ".", color="#0072B2", markersize=2.2, markeredgewidth=0)
    axes.plot(*np.clip(cell.episode.actions[0], *edge), "+", color="#D55E00", markersize=6, markeredgewidth=1.3)
    axes.set(xlim=edge, ylim=edge, aspect="equal")


def _handles(rows: Sequence[Row], family: Family) -> list[Artist]:
    handles: list[Artist] = [Line2D([], [], color=row.look.color, linewidth=3, label=f"{row.name}{row.note}") for row in rows]
    marks = {
        "point_maze": [("o", "black", "start"), ("*", "#F0E442", "goal"), ("x", "black", "end")],
        "bandit2d": [("+", "#D55E00", "mean action"), (".", "#0072B2", f"{N_SAMPLES} sampled actions")],
    }.get(family.world, [])
    edge = {"*": "black"}
    return handles + [
        Line2D([], [], linestyle="", marker=marker, color=color, markeredgecolor=edge.get(marker, color), label=label)
        for marker, color, label in marks
    ]


def _explanation(family: Family) -> str:
    if family.world == "bandit2d":
        return "grey: the policy's density\ncircles: peaks of the reward,\nthe client's own solid"
    if family.world == "point_maze":
        return "line: way of the ball"
    if family.world == "locomotion":
        return f"poses at even times on the\nfirst {GROUND:g} m, the last one\nopaque; way and time of\nthe whole episode"
    return "poses at even times,\nthe last one opaque"
