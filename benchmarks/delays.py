"""What stragglers and dropouts cost: returns by round and by simulated wall time, for many clients.

    python benchmarks/delays.py --clients 64 256
    python benchmarks/delays.py --table
    python benchmarks/delays.py --figure docs/delays.png

Clients are generated: Bandit2D, where half of them own the same peak, and another's peak pays half as much as one's own.
Every cell is a training run; finished ones are kept in ``benchmarks/results/delays_Bandit2D.json``, so that an interrupted
benchmark goes on where it stopped. A return is that of the deterministic policies which the clients have at that simulated
second: of the last training that each has finished.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from fed_envs import Family
from fed_envs.bandit2d import ACTION_LIMIT, reward
from fed_envs.clients import BANDIT2D_PEAKS
from fed_envs.generation import generate_family
from fed_envs.metadata import parse_family
from sb3_fedguide.benchmark.bandit2d import policies
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.participation import simulate_delays
from sb3_fedguide.server.delays import Delays, parse_delays
from sb3_fedguide.settings.config import resolve

PATH = Path(__file__).parent / "results" / "delays_Bandit2D.json"
ALGOS = ("local", "fedavg", "fedguide")
OFF_PEAK_WEIGHT = 0.5
AT_ROUNDS, AT_MINUTES, THRESHOLD = (10, 20, 40), (10, 20, 40), 0.7

#: The same clients, equally slow under all three, and what the server waits for.
CLIENTS = "median=60,spread=0.8,jitter=0.3,dropout=0.05,timeout=120"
WAITING = {"sync": f"sync:{CLIENTS}", "deadline": f"deadline:{CLIENTS},deadline=90", "async": f"async:{CLIENTS},tick=30"}
#: The server's rounds in a cell. A tick is half of the median client's round.
ROUNDS = {"sync": 40, "deadline": 40, "async": 80}

#: The tuned settings with smaller rollouts, fewer updates offline and fewer experts, so that a cell takes seconds.
SETTINGS: dict[str, Any] = {
    "rollout_size": 100,
    "n_envs_per_client": 10,
    "batch_size": 50,
    "learning_rate": 5e-4,
    "pretraining.dataset_size": 100,
    "pretraining.bc_updates": 300,
}
GUIDED: dict[str, Any] = {
    "n_experts": 8,
    "prior_loss": "sample",
    "pretraining.dice_updates": 100,
    "pretraining.dice_width": 16,
}


def family_of(n_clients: int) -> Family:
    """Every second client owns the first peak, the others the other three in turn; each likes the others' half as much."""
    family = generate_family("Bandit2D", n_clients)
    peaks = [0 if k % 2 == 0 else 1 + k // 2 % 3 for k in range(n_clients)]
    content = family.to_dict()
    for client, peak in zip(content["clients"], peaks, strict=True):
        client.update(peak=list(BANDIT2D_PEAKS[peak]), off_peak_weight=OFF_PEAK_WEIGHT)
    return parse_family(content, family.name)


class Course(RoundCallback):
    """Second, average and worst return after every round, and who was heard."""

    def __init__(self, family: Family) -> None:
        super().__init__()
        self.family = family
        self.rows: list[tuple[float, float]] = []
        self.arrived: list[float] = []
        self.staleness: list[float] = []

    def _returns(self) -> np.ndarray:
        means = policies(self.model).mean  # type: ignore[arg-type]
        actions = np.clip(means, -ACTION_LIMIT, ACTION_LIMIT)
        return np.array([reward(action, client) for action, client in zip(actions, self.family.clients, strict=True)])

    def _on_training_start(self) -> None:
        self.deployed = self.trained = self._returns()
        self.rows.append((0.0, float(self.deployed.mean())))

    def _on_local_training_end(self) -> None:
        self.trained = np.where(self.model.present, self._returns(), self.trained)

    def _on_round_end(self) -> None:
        delays = self.model.delays
        assert delays is not None
        self.deployed = np.where(delays.finished, self.trained, self.deployed)
        self.rows.append((delays.seconds, float(self.deployed.mean())))
        self.arrived.append(delays.metrics["federated/arrived"])
        self.staleness.append(delays.metrics.get("federated/staleness", np.nan))


def run_cell(n_clients: int, algo: str, waiting: str, seed: int) -> dict[str, Any]:
    family, n_rounds = family_of(n_clients), ROUNDS[waiting]
    settings = {**SETTINGS, **(GUIDED if algo == "fedguide" else {}), "n_rounds": n_rounds}
    started = time.process_time()
    model = resolve(algo, family, overrides=settings).make(family, seed=seed)
    simulate_delays(model, parse_delays(WAITING[waiting]))
    course = Course(family)
    model.learn(n_rounds * model.rollout_size * model.n_clients, course)
    every = n_rounds // 40
    return {
        "n_clients": n_clients, "algo": algo, "waiting": waiting, "seed": seed,
        "rounds": list(range(0, n_rounds + 1, every)),
        "seconds": [round(second) for second, _ in course.rows[::every]],
        "returns": [round(value, 4) for _, value in course.rows[::every]],
        "arrived": round(float(np.mean(course.arrived)), 1),
        "staleness": round(float(np.nanmean(course.staleness)), 2),
        "cpu_seconds": round(time.process_time() - started, 1),
    }  # fmt: skip


def run(clients: list[int], algos: list[str], seeds: list[int]) -> None:
    done = json.loads(PATH.read_text()) if PATH.exists() else []
    names = ("n_clients", "algo", "waiting", "seed")
    finished = {tuple(cell[name] for name in names) for cell in done}
    for seed, n_clients, algo, waiting in itertools.product(seeds, clients, algos, WAITING):
        if (n_clients, algo, waiting, seed) in finished:
            continue
        done.append(run_cell(n_clients, algo, waiting, seed))
        PATH.with_suffix(".part").write_text("[\n " + ",\n ".join(json.dumps(cell) for cell in done) + "\n]\n")
        PATH.with_suffix(".part").replace(PATH)
        cell = done[-1]
        print(
            f"{n_clients} {algo} {waiting} seed {seed}: {cell['returns'][-1]} after {cell['seconds'][-1]} s, "
            f"{cell['arrived']} arrived, staleness {cell['staleness']}, {cell['cpu_seconds']} CPU s",
            flush=True,
        )


def read() -> list[dict[str, Any]]:
    return json.loads(PATH.read_text())


def select(done: list[dict[str, Any]], n_clients: int, algo: str, waiting: str) -> list[dict[str, Any]]:
    return [cell for cell in done if (cell["n_clients"], cell["algo"], cell["waiting"]) == (n_clients, algo, waiting)]


def value_at(cell: dict[str, Any], axis: str, position: float) -> float:
    """The last return up to a round or second; NaN after the end of the run."""
    if position > cell[axis][-1]:
        return float("nan")
    return cell["returns"][int(np.searchsorted(cell[axis], position, side="right")) - 1]


def reached(cell: dict[str, Any]) -> float:
    """Minutes until the return is :data:`THRESHOLD`."""
    return next((second / 60 for second, value in zip(cell["seconds"], cell["returns"], strict=True) if value >= THRESHOLD),
                float("nan"))  # fmt: skip


def replay(n_clients: int, waiting: str, seed: int) -> tuple[float, float, float, float]:
    """Of a whole run, without training: seconds of a round, share of clients heard in one, share never heard, staleness."""
    delays = Delays(parse_delays(WAITING[waiting]), seed, range(n_clients))
    heard, staleness = np.zeros(n_clients), []
    for round in range(ROUNDS[waiting]):
        delays.begin(round)
        heard += delays.end()
        staleness.append(delays.metrics.get("federated/staleness", 0.0))
    n_rounds = ROUNDS[waiting]
    return delays.seconds / n_rounds, heard.mean() / n_rounds, float((heard == 0).mean()), float(np.mean(staleness))


def tables() -> str:
    """Two Markdown tables: what the rounds are like, and returns by round and by minute."""
    done = read()
    seeds = sorted({cell["seed"] for cell in done})
    sizes = sorted({cell["n_clients"] for cell in done})
    lines = [
        "| clients | policy | seconds per round | uploads arrived in a round | never arrived | staleness |",
        "|--:|:--|--:|--:|--:|--:|",
    ]
    for n_clients, waiting in itertools.product(sizes, WAITING):
        seconds, heard, never, stale = np.mean([replay(n_clients, waiting, seed) for seed in seeds], axis=0)
        lines.append(f"| {n_clients} | {waiting} | {seconds:.0f} | {100 * heard:.0f} % | {100 * never:.0f} % | {stale:.1f} |")
    columns = [*(f"round {round}" for round in AT_ROUNDS), *(f"minute {minute}" for minute in AT_MINUTES)]
    lines += ["", f"| clients | method | policy | seeds | {' | '.join(columns)} | minutes to {THRESHOLD} |"]
    lines.append("|--:|:--|:--|--:|" + "--:|" * (len(columns) + 1))
    for n_clients, algo, waiting in itertools.product(sizes, ALGOS, WAITING):
        cells = select(done, n_clients, algo, waiting)
        if cells:
            values = [[value_at(cell, "rounds", round) for cell in cells] for round in AT_ROUNDS]
            values += [[value_at(cell, "seconds", 60 * minute) for cell in cells] for minute in AT_MINUTES]
            shown = [f"{np.mean(column):.2f}" for column in values] + [f"{np.mean([reached(cell) for cell in cells]):.0f}"]
            lines.append(f"| {n_clients} | {algo} | {waiting} | {len(cells)} | {' | '.join(shown)} |")
    return "\n".join(lines)


def draw(path: Path) -> None:
    """Mean curves over seeds, by round on the left and by simulated minute on the right."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    done = read()
    sizes = sorted({cell["n_clients"] for cell in done})
    colors = dict(zip(ALGOS, ("tab:gray", "tab:orange", "tab:blue"), strict=True))
    styles = dict(zip(WAITING, ("-", "--", ":"), strict=True))
    figure, axes = plt.subplots(len(sizes), 2, figsize=(10, 3.2 * len(sizes)), squeeze=False, sharey=True)
    for row, n_clients in zip(axes, sizes, strict=True):
        for algo, waiting in itertools.product(ALGOS, WAITING):
            cells = select(done, n_clients, algo, waiting)
            if not cells:
                continue
            line = {"color": colors[algo], "linestyle": styles[waiting], "label": f"{algo}, {waiting}"}
            row[0].plot(cells[0]["rounds"], np.mean([cell["returns"] for cell in cells], axis=0), **line)
            seconds = np.geomspace(60, min(cell["seconds"][-1] for cell in cells), 300)
            means = [np.mean([value_at(cell, "seconds", second) for cell in cells]) for second in seconds]
            row[1].plot(seconds / 60, means, **line)
        row[0].set(xlabel="round of the server", ylabel=f"return, {n_clients} clients")
        row[1].set(xlabel="simulated minutes", xscale="log")
        for panel in row:
            panel.grid(alpha=0.3)
    axes[0][1].legend(fontsize=7, loc="upper left")
    figure.tight_layout()
    figure.savefig(path, dpi=85, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clients", type=int, nargs="+", default=[64, 256])
    parser.add_argument("--algos", nargs="+", choices=ALGOS, default=list(ALGOS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--table", action="store_true", help="print the tables of what there is, without running anything")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="likewise, draw the curves")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    if not arguments.table and arguments.figure is None:
        run(arguments.clients, arguments.algos, arguments.seeds)
    if arguments.figure is not None:
        draw(arguments.figure)
    print(tables())


if __name__ == "__main__":
    main()
