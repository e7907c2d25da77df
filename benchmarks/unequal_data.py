"""Clients with a tenth of the data: two of a family's clients take part in every tenth round only.

    python benchmarks/unequal_data.py --env HopperHard --seeds 0

The result has every client's return after each of these rounds, in FedGuide-R with its tuned settings, and the two clients'
returns alone (Local) with as many steps of their own.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import torch as th
from curves import Curve
from record import write_result

import fed_envs
from sb3_fedguide.settings.config import resolve

EVERY = 10


def federated(family: Any, poor: list[int], seed: int, rounds: int) -> list[tuple[int, list[float]]]:
    n_clients = len(family.clients)
    rich = 1 - len(poor) / n_clients
    model: Any = resolve("fedguide-r", family, overrides={"client_fraction": rich}).make(
        family, clients=list(range(n_clients)), seed=seed, device="cpu", verbose=0
    )
    few = np.array([client not in poor for client in range(n_clients)])
    model._draw_participants = lambda: model.take_part(np.ones_like(few) if model.round % EVERY == EVERY - 1 else few)
    curve = Curve(rounds, EVERY, n_episodes=10)
    steps = (few.sum() * rounds + len(poor) * (rounds // EVERY)) * model.rollout_size
    model.learn(int(steps), curve)
    return curve.points


def alone(family: Any, poor: list[int], seed: int, rounds: int) -> list[tuple[int, list[float]]]:
    model = resolve("local", family).make(family, clients=poor, seed=seed, device="cpu", verbose=0)
    curve = Curve(rounds, 1, n_episodes=10)
    model.learn(rounds * len(poor) * model.rollout_size, curve)
    return curve.points


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HopperHard")
    parser.add_argument("--poor", nargs="+", type=int, default=[0, 1], help="the clients with little data")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--rounds", type=int, default=100)
    args = parser.parse_args()
    th.set_num_threads(1)
    family = fed_envs.load_family(args.env)
    runs = []
    for seed in args.seeds:
        runs.append({
            "seed": seed, "alone": alone(family, args.poor, seed, args.rounds // EVERY),
            "federated": federated(family, args.poor, seed, args.rounds),
        })  # fmt: skip
        write_result(f"unequal_data_{args.env}", {"env": args.env, "poor": args.poor, "every": EVERY, "runs": runs})
        print(seed, "alone", runs[-1]["alone"][-1], "federated", runs[-1]["federated"][-1], flush=True)


if __name__ == "__main__":
    main()
