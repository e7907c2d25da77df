"""Clients that come late: from what the others have learned, and by themselves.

    python benchmarks/newcomers.py --env ReacherHard --seeds 0 1

Half of a family's clients train together for 40 rounds (FedGuide-R in its tuned settings, before its hand-over). The other
half then train alone, each from the others' mean policy and statistics, and each from its own start. The result has the
curves, and the rounds to 90 % of the way from where they begin alone to the best that they reach alone.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from curves import Curve
from record import write_result

import fed_envs
from sb3_fedguide.common.newcomers import start_from
from sb3_fedguide.settings.config import resolve


def train(algo: str, family: Any, clients: list[int], seed: int, rounds: int, path: str | None = None, **more: Any) -> Any:
    model = resolve(algo, family, overrides=more).make(family, clients=clients, seed=seed, device="cpu", verbose=0)
    if path is not None:
        start_from(model, path)
    curve = Curve(rounds, eval_freq=2, start=True)
    model.learn(rounds * model.n_clients * model.rollout_size, curve)
    return model, curve.points


def rounds_to(points: list[tuple[int, list[float]]], level: float) -> int | None:
    return next((round for round, returns in points if np.mean(returns) >= level), None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="ReacherHard")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--rounds", type=int, default=100, help="of the newcomers by themselves")
    parser.add_argument("--before", type=int, default=40, help="of the others")
    args = parser.parse_args()
    th.set_num_threads(1)
    family = fed_envs.load_family(args.env)
    clients = list(range(len(family.clients)))
    first, late = clients[: len(clients) // 2], clients[len(clients) // 2 :]
    runs = []
    for seed in args.seeds:
        with tempfile.TemporaryDirectory() as folder:
            model, others = train("fedguide-r", family, first, seed, args.before, mix=1.0)
            path = str(Path(folder) / "parameters.npz")
            model.export_parameters(path)
            _, joined = train("local", family, late, seed, args.rounds, path)
        _, alone = train("local", family, late, seed, args.rounds)
        begin, best = np.mean(alone[0][1]), max(np.mean(returns) for _, returns in alone)
        level = float(begin + 0.9 * (best - begin))
        runs.append({
            "seed": seed, "others": others, "joined": joined, "alone": alone, "level": level,
            "rounds_joined": rounds_to(joined, level), "rounds_alone": rounds_to(alone, level),
        })  # fmt: skip
        print(json.dumps({key: runs[-1][key] for key in ("seed", "level", "rounds_joined", "rounds_alone")}), flush=True)
        write_result(f"newcomers_{args.env}", {"env": args.env, "before": args.before, "runs": runs})


if __name__ == "__main__":
    main()
