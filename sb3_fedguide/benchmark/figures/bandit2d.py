"""The picture of Bandit2D: reward, priors, and what FedAvg and FedGuide make of them (the paper's figure 2, right)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fed_envs.bandit2d import ACTION_LIMIT, PEAKS, reward
from sb3_fedguide.benchmark.bandit2d import MethodResult, Priors

CLIENT_COLORS = ("#d1495b", "#2e86ab", "#3a7d44", "#8e5ea2")
METHOD_COLORS = ("#999999", "#2e86ab", "#d1495b", "#3a7d44")
DENSITY_MAP = "viridis"
N_GRID = 161


def grid() -> np.ndarray:
    """The points at which the figure wants densities, ``(n_points, 2)``."""
    axis = np.linspace(-ACTION_LIMIT, ACTION_LIMIT, N_GRID)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def draw(
    results: Sequence[MethodResult], drawn: Sequence[str], priors: Priors, data: Sequence[np.ndarray], path: Path
) -> None:
    """Write the figure.

    :param results: one learning curve each
    :param drawn: names of those that get a row of densities
    :param priors: FedGuide's, on :func:`grid`
    :param data: each client's offline actions, ``(n, 2)``
    :param path: a ``.png``, or any other format that matplotlib writes
    """
    points, n_clients = grid(), len(data)
    methods = [result for result in results if result.name in drawn]
    columns = n_clients + 1
    figure = Figure(figsize=(2.5 * columns, 2.75 * (1 + len(methods))), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1 + len(methods), columns)

    top = axes[0]
    draw_density(top[0], reward(points), "reward: four equal peaks", "inferno")
    _data(top[1], data)
    _contours(top[2], priors.clients, "each client's own prior")
    draw_density(top[3], priors.server, "OT-MoE global prior")
    _curves(top[4], results)
    for blank in top[5:]:
        blank.axis("off")

    for row, method in zip(axes[1:], methods, strict=True):
        guided = method.shared is None
        densities = method.deployed.density(points)
        for client in range(n_clients):
            draw_density(row[client], densities[client], f"client {client}")
            if guided:
                draw_outline(row[client], priors.personal[client])
            row[client].plot(*method.deployed.mean[client], "+", color="white", markersize=9, markeredgewidth=2)
        if method.shared is None:
            draw_density(row[-1], densities.mean(axis=0), "all clients' policies")
        else:
            draw_density(row[-1], method.shared.density(points)[0], "broadcast policy")
        row[0].set_ylabel(method.name, fontsize=14, fontweight="bold")
        measures = method.measures()
        row[-1].set_xlabel(
            f"F = {measures['F']:.3f}, peaks kept: {measures['peaks_kept']} of {len(PEAKS)}\n"
            rf"$E_\pi[r]$ = {measures['expected_reward']:.3f}",
            fontsize=9,
        )
        if guided:
            row[0].set_xlabel("colour: policy, cross: its mean, dashed:\nthe client's mixture prior (2 std)", fontsize=8)
    figure.savefig(path, dpi=130)


def draw_density(axes: Axes, values: np.ndarray, title: str, color_map: str = DENSITY_MAP) -> None:
    """A density on :func:`grid` as colours, with the four peaks as circles."""
    extent = (-ACTION_LIMIT, ACTION_LIMIT, -ACTION_LIMIT, ACTION_LIMIT)
    axes.imshow(values.reshape(N_GRID, N_GRID), origin="lower", extent=extent, cmap=color_map)
    _peaks(axes, "white")
    _frame(axes, title)


def _contours(axes: Axes, densities: np.ndarray, title: str) -> None:
    for density, color in zip(densities, _colors(len(densities)), strict=True):
        levels = density.max() * np.exp([-4.5, -2.0, -0.5])  # three, two and one standard deviations of a Gaussian
        axes.contourf(*_mesh(), density.reshape(N_GRID, N_GRID), [*levels, density.max()], colors=[color], alpha=0.3)
        axes.contour(*_mesh(), density.reshape(N_GRID, N_GRID), levels, colors=[color], linewidths=0.8)
    _peaks(axes, "black")
    _frame(axes, title)


def draw_outline(axes: Axes, density: np.ndarray) -> None:
    """Where a density on :func:`grid` has fallen to that of two standard deviations of a Gaussian."""
    level = density.max() * np.exp(-2.0)
    axes.contour(*_mesh(), density.reshape(N_GRID, N_GRID), [level], colors=["#ffb000"], linewidths=1.4, linestyles="dashed")


def _data(axes: Axes, data: Sequence[np.ndarray]) -> None:
    for client, (actions, color) in enumerate(zip(data, _colors(len(data)), strict=True)):
        axes.plot(*actions.T, ".", color=color, markersize=1.2, alpha=0.6)
        x, y = 0.45 * actions.mean(axis=0)
        axes.text(x, y, str(client), color=color, ha="center", va="center", fontsize=11, fontweight="bold")
    _frame(axes, "clients' offline data")


def _curves(axes: Axes, methods: Sequence[MethodResult]) -> None:
    for method, color in zip(methods, METHOD_COLORS, strict=False):
        axes.plot(*np.array(method.curve).T, color=color, label=method.name, linewidth=1.6)
    axes.set_title("average return", fontsize=10)
    axes.set_xlabel("round", fontsize=8, labelpad=1)
    axes.set_ylim(-0.03, 1.05)
    axes.tick_params(labelsize=7)
    axes.set_box_aspect(1)
    axes.legend(fontsize=8, loc="lower right")


def _peaks(axes: Axes, color: str) -> None:
    axes.scatter(PEAKS[:, 0], PEAKS[:, 1], s=70, facecolors="none", edgecolors=color, linewidths=0.8)


def _frame(axes: Axes, title: str) -> None:
    axes.set(xlim=(-ACTION_LIMIT, ACTION_LIMIT), ylim=(-ACTION_LIMIT, ACTION_LIMIT), xticks=[], yticks=[], aspect="equal")
    axes.set_title(title, fontsize=10)


def _mesh() -> tuple[np.ndarray, np.ndarray]:
    points = grid().reshape(N_GRID, N_GRID, 2)
    return points[..., 0], points[..., 1]


def _colors(n: int) -> list[str]:
    return [CLIENT_COLORS[k % len(CLIENT_COLORS)] for k in range(n)]
