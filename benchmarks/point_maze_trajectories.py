"""Draw where each client's ball rolls in its maze, one row per method, from the folders of finished runs.

    python train.py --algo fedavg --env PointMazeHard
    python train.py --algo fedguide --env PointMazeHard
    python benchmarks/point_maze_trajectories.py logs/fedavg/PointMazeHard_1 logs/fedguide/PointMazeHard_1 -o mazes.png

All methods start in the same states (``--seed``) and act without noise, with the policies that the clients deploy: their own
after local training. Titles have the mean return and the share of episodes that end within 0.45 m of the goal.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fed_envs import Family, FederatedVecEnv
from fed_envs.clients import PointMazeClient
from fed_envs.mazes import maze_rows
from fed_envs.point_maze import SUCCESS_DISTANCE
from sb3_fedguide.benchmark.figures.mazes import draw_maze
from sb3_fedguide.cli import saved_run
from sb3_fedguide.seeding import EVALUATION_SEED, Role

COLORS = ("#2e86ab", "#d1495b", "#3a7d44", "#8e5ea2", "#d98c21", "#777777")


class Episodes(NamedTuple):
    """A method's episodes.

    :param observations: ``(n_clients, n_episodes, steps + 1, 6)``
    :param returns: ``(n_clients, n_episodes)``
    """

    method: str
    observations: np.ndarray
    returns: np.ndarray

    @property
    def successes(self) -> np.ndarray:
        """Whether the ball is at its goal in the end, ``(n_clients, n_episodes)``."""
        last = self.observations[:, :, -1]
        return np.linalg.norm(last[..., :2] - last[..., 4:], axis=-1) <= SUCCESS_DISTANCE


def read_run(folder: Path) -> tuple[str, Family, Any]:
    """A run's method, family and saved federation with the deployed policies in place.

    :raises ValueError: if the folder is none of a finished run on a PointMaze family
    """
    summary, config, family = saved_run.read_run(folder)
    if family.world != "point_maze":
        raise ValueError(f"{folder} is a run on {family.name}; only PointMaze families have mazes to draw")
    model = saved_run.load_model(folder, config, family)
    model.set_acting_arrays(saved_run.read_deployed_policies(folder, model))
    return summary["algo"], family, model


def roll_out(method: str, family: Family, model: Any, n_episodes: int, seed: int) -> Episodes:
    """One seeded episode in each of ``n_episodes`` copies of every client's environment."""
    env = FederatedVecEnv(family, n_episodes, role=int(Role.EVAL_ENV))
    env.seed(seed)
    observations = env.reset()
    path, returns = [observations], np.zeros(env.num_envs)
    for _ in range(family.max_episode_steps):
        actions, _ = model.predict(observations, deterministic=True)
        observations, rewards, dones, infos = env.step(actions)
        returns += rewards
        # The environment restarts at the end: the path ends with the state before that.
        path.append(np.array([infos[i]["terminal_observation"] if done else observations[i] for i, done in enumerate(dones)]))
    env.close()
    shape = (family.n_clients, n_episodes)
    return Episodes(method, np.stack(path, axis=1).reshape(*shape, len(path), -1), returns.reshape(shape))


def draw(family: Family, methods: Sequence[Episodes], path: Path) -> None:
    """Write the figure.

    :param methods: one row each
    :param path: a ``.png``, or any other format that matplotlib writes
    """
    figure = Figure(figsize=(1.6 * family.n_clients + 0.4, 1.8 * len(methods) + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(methods), family.n_clients, squeeze=False)
    for number, (line, episodes) in enumerate(zip(grid, methods, strict=True)):
        for axes, client, paths, returns, successes in zip(
            line, family.clients, episodes.observations, episodes.returns, episodes.successes, strict=True
        ):
            assert isinstance(client, PointMazeClient)
            draw_maze(axes, maze_rows(client.maze))
            for one in paths:
                axes.plot(one[:, 0], one[:, 1], color=COLORS[number % len(COLORS)], linewidth=1.1, alpha=0.8)
            axes.plot(*paths[:, 0, :2].T, "o", color="black", markersize=3, label="start")
            axes.plot(*paths[:, 0, 4:].T, "*", color="#f2c14e", markeredgecolor="black", markeredgewidth=0.4, label="goal")
            ends = paths[~successes, -1, :2]
            axes.plot(*ends.T, "X", color="black", markeredgecolor="white", markeredgewidth=0.5, label="end, not at the goal")
            axes.set_title(f"client {client.client}: {returns.mean():.0f}, {successes.mean():.0%}", fontsize=8)
        line[0].set_ylabel(episodes.method, fontsize=10)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    figure.savefig(path, dpi=100)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folders of runs on the same family")
    parser.add_argument("-o", "--output", type=Path, default=Path("point_maze.png"), help="the picture")
    parser.add_argument("--episodes", type=int, default=5, help="per client (default: 5)")
    parser.add_argument("--seed", type=int, default=EVALUATION_SEED, help="of the episodes")
    args = parser.parse_args(arguments)
    th.set_num_threads(1)
    try:
        if args.episodes < 1:
            raise ValueError(f"--episodes must be at least 1, not {args.episodes}")
        runs = [read_run(folder) for folder in args.runs]
        family = runs[0][1]
        for folder, (_, other, _) in zip(args.runs, runs, strict=True):
            if other.content_hash != family.content_hash:
                raise ValueError(f"{folder} is a run on {other.name}, {args.runs[0]} on {family.name}; draw them apart")
    except ValueError as error:
        parser.error(str(error))
    methods = [roll_out(method, own, model, args.episodes, args.seed) for method, own, model in runs]
    draw(family, methods, args.output)
    for episodes in methods:
        shares = " ".join(f"{share:.0%}" for share in episodes.successes.mean(axis=1))
        print(f"{episodes.method}: average {episodes.returns.mean():.1f}, at the goal in the end by client: {shares}")
    print(args.output)


if __name__ == "__main__":
    main()
