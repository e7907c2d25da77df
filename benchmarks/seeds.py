"""What several seeds in lockstep could save: S federations at once against S federations one after the other, on one core.

    python benchmarks/seeds.py --envs HopperHard ReacherHard Bandit2D

The seeds are stood for by copies of the family's clients, which cost exactly what further seeds would. One round of Local
(rollout and ``train()``), in turn, single-threaded. Writes ``benchmarks/results/seeds.json``.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import torch as th
from record import spread, write_result
from round_time import SETTINGS

from fed_envs import Family, FederatedVecEnv, load_family
from fed_envs.metadata import parse_family
from sb3_fedguide import Local


def repeated(name: str, n_seeds: int) -> Family:
    """The family with each of its clients ``n_seeds`` times."""
    content = load_family(name).to_dict()
    clients = [dict(client) for _ in range(n_seeds) for client in content["clients"]]
    for number, client in enumerate(clients):
        client["client"] = number
    return parse_family({**content, "family": f"{name}Repeated", "clients": clients}, name)


def local(family: Family, n_envs: int, rollout_size: int) -> Local:
    env = FederatedVecEnv(family, n_envs_per_client=n_envs, num_threads=1)
    return Local("MlpPolicy", env, rollout_size=rollout_size, seed=0, **SETTINGS)


def timed_round(model: Local) -> float:
    started = time.perf_counter()
    model.learn(model.rollout_size * model.n_clients, reset_num_timesteps=False)
    return time.perf_counter() - started


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="+", default=["HopperHard", "ReacherHard", "Bandit2D"])
    parser.add_argument("--n-envs-per-client", nargs="+", type=int, default=[1, 4])
    parser.add_argument("--n-seeds", type=int, default=5)
    parser.add_argument("--rollout-size", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    th.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    for env in args.envs:
        for n_envs in args.n_envs_per_client:
            one, many = (local(repeated(env, n), n_envs, args.rollout_size) for n in (1, args.n_seeds))
            timed_round(one)
            timed_round(many)
            gains = []
            for _ in range(args.repeats):
                alone = sum(timed_round(one) for _ in range(args.n_seeds))
                gains.append(alone / timed_round(many))
            rows.append({"env": env, "n_envs_per_client": n_envs, "gain": spread(gains)})
            print(f"{env:12} {n_envs} environments a client: {args.n_seeds} seeds in lockstep are "
                  f"{rows[-1]['gain']['median']:.2f} times as fast ({min(gains):.2f} to {max(gains):.2f})")  # fmt: skip
    write_result("seeds", {"command": vars(args), "rows": rows})


if __name__ == "__main__":
    main()
