"""Maze maps as rows of text, and what follows from a map alone: cells, coordinates and paths.

``#`` is a wall, ``.`` is free. Cells are ``(row, column)``, counted from the top left corner; they are 1 m wide, and the
middle of the map is the origin, x to the right and y upwards (as in gymnasium-robotics).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

WALL, FREE = "#", "."

#: gymnasium-robotics' maps by the names in its environment ids.
MAZES: dict[str, tuple[str, ...]] = {
    "Open": ("#######", "#.....#", "#.....#", "#.....#", "#######"),
    "UMaze": ("#####", "#...#", "###.#", "#...#", "#####"),
    "Medium": ("########", "#..##..#", "#..#...#", "##...###", "#..#...#", "#.#..#.#", "#...#..#", "########"),
    "Large": (
        "############",
        "#....#.....#",
        "#.##.#.#.#.#",
        "#......#...#",
        "#.####.###.#",
        "#..#.#.....#",
        "##.#.#.#.###",
        "#..#...#...#",
        "############",
    ),
}

Cell = tuple[int, int]


def maze_rows(maze: Any) -> tuple[str, ...]:
    """The rows of a map that is given by name or by its rows.

    :raises ValueError: for an unknown name, and for rows that are no closed maze
    """
    if isinstance(maze, str) and maze in MAZES:
        return MAZES[maze]
    if not isinstance(maze, (list, tuple)):
        raise ValueError(f"must be one of {', '.join(MAZES)}, or a list of rows of '#' (wall) and '.' (free); got {maze!r}")
    rows = tuple(maze)
    if not rows or not all(isinstance(row, str) and row and set(row) <= {WALL, FREE} for row in rows):
        raise ValueError(f"rows consist of '#' (wall) and '.' (free); got {maze!r}")
    if len({len(row) for row in rows}) != 1:
        raise ValueError(f"all rows must have the same length; they have {[len(row) for row in rows]}")
    border = rows[0] + rows[-1] + "".join(row[0] + row[-1] for row in rows)
    if FREE in border:
        raise ValueError("the map's border must be walls, or the ball rolls out of it")
    if len(free_cells(rows)) < 2:
        raise ValueError("a map needs at least two free cells, a start and a goal")
    return rows


def free_cells(rows: tuple[str, ...]) -> tuple[Cell, ...]:
    """All free cells, row by row."""
    return tuple((i, j) for i, row in enumerate(rows) for j, cell in enumerate(row) if cell == FREE)


def cell_center(rows: tuple[str, ...], cell: Cell) -> tuple[float, float]:
    """The coordinates (x, y) of a cell's middle in metres."""
    return cell[1] + 0.5 - len(rows[0]) / 2, len(rows) / 2 - (cell[0] + 0.5)


def distances(rows: tuple[str, ...], goal: Cell) -> dict[Cell, int]:
    """The number of steps from each cell to ``goal`` along free cells; cells without a path are missing."""
    steps, queue = {goal: 0}, deque([goal])
    while queue:
        i, j = queue.popleft()
        for neighbour in ((i - 1, j), (i, j + 1), (i + 1, j), (i, j - 1)):
            if rows[neighbour[0]][neighbour[1]] == FREE and neighbour not in steps:
                steps[neighbour] = steps[i, j] + 1
                queue.append(neighbour)
    return steps


def check_cells(rows: tuple[str, ...], goals: Sequence[Cell], named_starts: Sequence[Cell], starts: Sequence[Cell]) -> None:
    """Check that goals and starts are free cells with a path between them.

    :param named_starts: start cells in the user's file
    :param starts: all cells in which episodes start
    :raises ValueError: for walls, repeated cells, starts without a path to every goal, and goals without a start elsewhere
    """
    free = free_cells(rows)
    for name, cells in (("goal_cells", goals), ("start_cells", named_starts)):
        walls = [cell for cell in cells if cell not in free]
        if walls:
            raise ValueError(f"{name}: not free in this maze: {', '.join(map(str, walls))}; free are {list(free)}")
        if len(set(cells)) != len(cells):
            raise ValueError(f"{name}: each cell once; they are {list(cells)}")
    for goal in goals:
        near = distances(rows, goal)
        lost = [cell for cell in starts if cell not in near]
        if lost:
            raise ValueError(f"start_cells: no path leads from {lost[0]} to the goal {goal}; leave such cells out")
        if not set(starts) - {goal}:
            raise ValueError(f"start_cells: episodes with the goal {goal} need a start elsewhere; add a start cell")
