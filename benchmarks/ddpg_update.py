"""Seconds of one lockstep DDPG update of eight clients against eight updates of ``stable_baselines3.DDPG``.

    python benchmarks/ddpg_update.py --env HopperHard

Both sides draw their minibatches from replay buffers of the same size and take the same number of gradient steps, in turn.
Writes ``benchmarks/results/ddpg_update_<env>.json``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import torch as th
from record import spread, write_result
from stable_baselines3 import DDPG
from stable_baselines3.common.logger import Logger

from fed_envs import load_family
from sb3_fedguide import FedRL

NETWORKS = ([64, 64], [400, 300])
WARM_UP = 1000  # transitions per client in every replay buffer


def learners(env: str, network: list[int]) -> tuple[FedRL, list[DDPG]]:
    """The federation and the separate learners, with filled replay buffers."""
    family = load_family(env)
    settings: dict[str, Any] = {"learning_rate": 1e-4, "batch_size": 64, "buffer_size": 10_000, "device": "cpu"}
    policy_kwargs = {"net_arch": network}
    federation = FedRL(
        "MlpPolicy", env, rollout_size=WARM_UP, learning_starts=WARM_UP, seed=0, policy_kwargs=policy_kwargs, **settings
    )
    federation.learn(WARM_UP * family.n_clients)
    separate = []
    for client in range(family.n_clients):
        model = DDPG(
            "MlpPolicy", family.make(client), learning_starts=WARM_UP, seed=client, policy_kwargs=policy_kwargs, **settings
        )
        model.learn(WARM_UP)
        separate.append(model)
    for model in (federation, *separate):
        model.set_logger(Logger(None, []))
    return federation, separate


def seconds_of(models: Sequence[DDPG], n_updates: int) -> float:
    started = time.perf_counter()
    for model in models:
        model.train(n_updates, 64)
    return time.perf_counter() - started


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HopperHard")
    parser.add_argument("--updates", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    th.set_num_threads(1)
    table = {}
    for network in NETWORKS:
        federation, separate = learners(args.env, network)
        ours, theirs = [], []
        for _ in range(args.repeats):
            ours.append(seconds_of([federation], args.updates) / args.updates)
            theirs.append(seconds_of(separate, args.updates) / args.updates)
        name = "-".join(map(str, network))
        ratio = spread([b / a for a, b in zip(ours, theirs, strict=True)])
        table[name] = {"lockstep": spread(ours), "sb3": spread(theirs), "ratio": ratio}
        milliseconds = {side: 1e3 * table[name][side]["median"] for side in ("lockstep", "sb3")}
        print(
            f"{name:8} lockstep {milliseconds['lockstep']:.2f} ms, SB3 {milliseconds['sb3']:.2f} ms an update of all clients, "
            f"ratio {ratio['median']:.1f} ({ratio['min']:.1f} to {ratio['max']:.1f})"
        )
    write_result(f"ddpg_update_{args.env}", {"command": vars(args), "seconds_per_update": table})


if __name__ == "__main__":
    main()
