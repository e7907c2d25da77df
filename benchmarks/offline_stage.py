"""Where the offline stage's time goes: data, behaviour cloning, trunk, heads, DICE.

    python benchmarks/offline_stage.py --env HopperHard
    python benchmarks/offline_stage.py --env HopperHard --updates 40

The first makes the whole stage at its default sizes in an empty cache and takes minutes. The second trains every piece for
``--updates`` and for twice as many updates, makes one client's data and fits heads on a tenth of the rows, and extrapolates
the CPU seconds: a piece's time is affine in its updates and proportional to clients and rows. Writes
``benchmarks/results/offline_stage_<env>.json``.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from typing import Any

import torch as th
from record import write_result

from fed_envs import load_family
from sb3_fedguide import FedGuide
from sb3_fedguide.offline.groups import client_groups
from sb3_fedguide.offline.pretraining import Pretraining, PretrainingConfig

SETTINGS: dict[str, Any] = {"policy_kwargs": {"net_arch": [64, 64]}}
TRAINED = {"bc": "bc_updates", "trunk": "prior_updates", "dice": "dice_updates"}


def timed(work: Callable[[], Any]) -> dict[str, float]:
    started, used = time.perf_counter(), time.process_time()
    work()
    return {"seconds": time.perf_counter() - started, "cpu_seconds": time.process_time() - used}


def stage_of(env: str, clients: list[int], cache: str, **config: Any) -> dict[str, Callable[[], Any]]:
    """The pieces of the stage by name, each to be called after those before it."""
    stage = Pretraining(env, clients, PretrainingConfig(**config), seed=0, cache_dir=cache)
    actors = FedGuide("MlpPolicy", env, clients=clients, seed=0, **SETTINGS).policy.actor()
    return {
        "data": stage.datasets,
        "bc": lambda: stage.behavior_cloning(actors),
        "trunk": stage.trunk,
        "heads": stage.prior,
        "dice": stage.dice,
    }


def whole_stage(env: str, clients: list[int]) -> dict[str, dict[str, float]]:
    with tempfile.TemporaryDirectory() as cache:
        return {name: timed(work) for name, work in stage_of(env, clients, cache).items()}


def extrapolated_stage(env: str, clients: list[int], updates: int) -> dict[str, dict[str, float]]:
    """CPU seconds of the same from short runs, on fewer rows where their number only matters for memory."""
    cpu: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as cache:
        cpu["data"] = len(clients) * timed(stage_of(env, clients[:1], cache)["data"])["cpu_seconds"]
    with tempfile.TemporaryDirectory() as cache:
        runs = []
        for factor in (0, 1, 2):  # the first warms up
            pieces = stage_of(
                env, clients, cache, dataset_size=2000, **{u: max(factor * updates, 2) for u in TRAINED.values()}
            )
            pieces["data"]()
            runs.append({name: timed(pieces[name])["cpu_seconds"] for name in TRAINED})
        for name, field in TRAINED.items():
            more = PretrainingConfig.model_fields[field].default - updates
            cpu[name] = runs[1][name] + (runs[2][name] - runs[1][name]) * more / updates
        cpu["heads"] = 10 * timed(pieces["heads"])["cpu_seconds"]
    return {name: {"cpu_seconds": seconds} for name, seconds in cpu.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HopperHard")
    parser.add_argument("--updates", type=int, default=0, help="extrapolate from so many updates; 0: make the whole stage")
    args = parser.parse_args()
    th.set_num_threads(1)

    clients = list(range(load_family(args.env).n_clients))
    split = extrapolated_stage(args.env, clients, args.updates) if args.updates else whole_stage(args.env, clients)
    units = list(split["data"])
    total = {unit: sum(piece[unit] for piece in split.values()) for unit in units}
    print("piece  " + " ".join(f"{unit:>11}" for unit in units) + "   share of CPU")
    for name, piece in {**split, "total": total}.items():
        figures = " ".join(f"{piece[unit]:11.1f}" for unit in units)
        print(f"{name:6} {figures} {piece['cpu_seconds'] / total['cpu_seconds']:14.0%}")
    result = {"command": vars(args), "threads": len(client_groups(len(clients))), "split": split, "total": total}
    print(f"written to {write_result(f'offline_stage_{args.env}', result)}")


if __name__ == "__main__":
    main()
