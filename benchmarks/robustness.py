"""How far the others' returns fall when one or two of eight clients send wrong uploads, and what the server's defences save.

    python benchmarks/robustness.py --env Bandit2D
    python benchmarks/robustness.py --env Reacher --table

Every cell is a training run of 30 rounds in which the last clients lie in what they upload; they train as honestly as the
others. Finished cells are kept in ``benchmarks/results/robustness_<env>.json``, so that an interrupted run goes on where it
stopped, and the table is printed at the end.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from fed_envs import Family, load_family
from fed_envs.generation import generate_family
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.evaluation import evaluate_federation, evaluation_env
from sb3_fedguide.server.strategy import N_SAMPLES, Payload
from sb3_fedguide.settings.config import resolve

RESULTS = Path(__file__).parent / "results"
N_ROUNDS, N_EPISODES = 30, 10

#: Server to algorithm and settings. Median and trimmed mean are alone, without the checks.
SERVERS: dict[str, tuple[str, dict[str, Any]]] = {
    "fedavg, mean": ("fedavg", {"upload_bound": None}),
    "fedavg, mean, checked": ("fedavg", {}),
    "fedguide": ("fedguide", {"upload_bound": None}),
    "fedguide, checked": ("fedguide", {}),
    "fedavg, median": ("fedavg", {"upload_bound": None, "aggregator": "median"}),
    "fedavg, trimmed mean": ("fedavg", {"upload_bound": None, "aggregator": "trimmed_mean"}),
}

#: Smaller than the tuned settings, so that a cell takes seconds.
SETTINGS: dict[str, dict[str, Any]] = {
    "Bandit2D": {},
    "Reacher": {
        "rollout_size": 512,
        "n_envs_per_client": 8,
        "pretraining.dataset_size": 4000,
        "pretraining.bc_updates": 500,
        "pretraining.prior_updates": 600,
        "pretraining.dice_updates": 400,
    },
}

Lie = Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]

#: What a wrong upload has in the place of an array, given what the server last sent under its name (zeros if nothing).
LIES: dict[str, Lie] = {
    "nan": lambda array, sent, rng: np.full_like(array, np.nan),
    "huge": lambda array, sent, rng: np.full_like(array, 1e6),
    "flipped": lambda array, sent, rng: 2 * sent - array,  # the change with the other sign
    "random": lambda array, sent, rng: rng.standard_normal(array.shape).astype(np.float32),
}


def attack(model: Any, liars: list[int], lie: Lie) -> None:
    """Let the clients ``liars`` upload lies."""
    honest_upload, honest_receive = model.upload, model.receive
    sent: dict[int, Payload] = {index: {} for index in liars}
    rng = np.random.default_rng(0)

    def upload(index: int) -> Payload:
        payload = honest_upload(index)
        if index not in liars:
            return payload
        return {
            name: array if name == N_SAMPLES else lie(array, sent[index].get(name, np.zeros_like(array)), rng)
            for name, array in payload.items()
        }

    def receive(index: int, broadcast: Payload) -> None:
        if index in liars:
            sent[index].update(broadcast)
        honest_receive(index, broadcast)

    model.upload, model.receive = upload, receive


class FinalReturns(RoundCallback):
    """Returns of the deployed policies after the last round's training, and how many uploads were rejected."""

    def __init__(self) -> None:
        super().__init__()
        self.returns: list[float] = []
        self.rejected = 0

    def _on_local_training_end(self) -> None:
        if self.model.round + 1 == N_ROUNDS:
            evaluation = evaluate_federation(
                lambda obs: self.model.predict(obs, deterministic=True)[0], evaluation_env(self.model, N_EPISODES)
            )
            self.returns = evaluation.client_returns.tolist()

    def _on_round_end(self) -> None:
        assert self.model.strategy is not None
        self.rejected += len(self.model.strategy.rejected)


def family_of(env: str) -> Family:
    """Eight clients; Bandit2D ships with four."""
    return generate_family("Bandit2D", 8) if env == "Bandit2D" else load_family(env)


def run_cell(env: str, server: str, kind: str, n_liars: int, seed: int) -> dict[str, Any]:
    """Train once; a run that cannot go on is a result as well."""
    algo, settings = SERVERS[server]
    family = family_of(env)
    config = resolve(algo, family, overrides={"n_rounds": N_ROUNDS, **SETTINGS[env], **settings})
    model = config.make(family, seed=seed)
    liars = list(range(family.n_clients - n_liars, family.n_clients))
    if kind != "none":
        attack(model, liars, LIES[kind])
    final, failure, started = FinalReturns(), None, time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            model.learn(N_ROUNDS * model.rollout_size * model.n_clients, final)
        except (ValueError, RuntimeError) as error:
            failure = f"{type(error).__name__}: {error}"
    return {
        "server": server, "attack": kind, "n_liars": n_liars, "seed": seed, "liars": liars, "client_returns": final.returns,
        "rejected": final.rejected, "failure": failure, "rounds_done": model.round,
        "seconds": round(time.perf_counter() - started, 1),
    }  # fmt: skip


def cells(seeds: list[int]) -> list[tuple[str, str, int, int]]:
    """Server, attack, number of liars, seed."""
    attacks = [("none", 0), *((kind, n_liars) for n_liars in (1, 2) for kind in LIES)]
    return [(server, kind, n_liars, seed) for seed in seeds for server in SERVERS for kind, n_liars in attacks]


def run(env: str, seeds: list[int]) -> None:
    path = RESULTS / f"robustness_{env}.json"
    done = json.loads(path.read_text()) if path.exists() else []
    for server, kind, n_liars, seed in cells(seeds):
        if any(
            (cell["server"], cell["attack"], cell["n_liars"], cell["seed"]) == (server, kind, n_liars, seed) for cell in done
        ):
            continue
        done.append(run_cell(env, server, kind, n_liars, seed))
        path.with_suffix(".part").write_text("[\n " + ",\n ".join(json.dumps(cell) for cell in done) + "\n]\n")
        path.with_suffix(".part").replace(path)
        print(f"{env}: {server}, {n_liars} {kind}, seed {seed}: {done[-1]['seconds']} s", flush=True)


def entry(done: list[dict[str, Any]], server: str, kind: str, n_liars: int) -> str:
    """Mean return of clients 0 to 5, who never lie, over seeds; or in how many runs training ended early."""
    found = [cell for cell in done if (cell["server"], cell["attack"], cell["n_liars"]) == (server, kind, n_liars)]
    failed = sum(cell["failure"] is not None for cell in found)
    if failed:
        return "ended" if failed == len(found) else f"ended {failed}/{len(found)}"
    return f"{np.mean([np.mean(cell['client_returns'][:6]) for cell in found]):.2f}" if found else ""


def table(env: str) -> str:
    """A Markdown table: servers by attacks."""
    done = json.loads((RESULTS / f"robustness_{env}.json").read_text())
    columns = [("none", 0), *((kind, n_liars) for n_liars in (1, 2) for kind in LIES)]
    head = "| server | " + " | ".join("none" if kind == "none" else f"{n_liars} {kind}" for kind, n_liars in columns) + " |"
    rows = [f"| {server} | " + " | ".join(entry(done, server, *column) for column in columns) + " |" for server in SERVERS]
    return "\n".join([head, "|---" * (len(columns) + 1) + "|", *rows])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=sorted(SETTINGS), required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--table", action="store_true", help="print the table of what there is, without running anything")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    if not arguments.table:
        run(arguments.env, arguments.seeds)
    print(table(arguments.env))


if __name__ == "__main__":
    main()
