"""Offline data of the wrong client: how far methods fall that start from them, and what the log shows.

    python benchmarks/misleading_priors.py --env Bandit2D --seeds 0 1 2

Each misled client has the next one's offline data. Cloning, priors and DICE values are fitted on them. The result has every
client's curve and the log's metrics in the first and the last round, for none, two and all clients misled.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch as th
from curves import Curve
from record import write_result

import fed_envs
from sb3_fedguide.offline.make_dataset import make_dataset
from sb3_fedguide.settings.config import resolve

SHOWN = ("prior/effective_sample_share", "prior/prior_loss", "server/effective_experts", "server/head_agreement", "dice/beta")


class Log(Curve):
    """The curve, and what the log said of the guidance in each round."""

    def __init__(self, n_rounds: int) -> None:
        super().__init__(n_rounds, eval_freq=max(1, n_rounds // 20), n_episodes=10)
        self.figures: list[dict[str, float]] = []

    def _on_round_end(self) -> None:
        super()._on_round_end()
        logged = self.logger.name_to_value
        self.figures.append({name: round(float(logged[name]), 4) for name in SHOWN if name in logged})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="Bandit2D")
    parser.add_argument("--algos", nargs="+", default=["local", "fedguide"])
    parser.add_argument("--misled", nargs="+", type=int, default=[0, 2, 8])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--rounds", type=int, help="those of the settings by default")
    args = parser.parse_args()
    th.set_num_threads(1)
    family = fed_envs.load_family(args.env)
    clients = list(range(len(family.clients)))
    runs = []
    for seed in args.seeds:
        model = resolve("local", family).make(family, clients=clients, seed=seed, device="cpu", verbose=0)
        space, data = model.action_space, model.offline_stage().datasets()
        for misled in args.misled:
            with tempfile.TemporaryDirectory() as folder:
                for client in clients:
                    rows = data[(client + 1) % misled if client < misled else client]
                    make_dataset(
                        Path(folder) / f"client{client}-v0", rows.observations, rows.actions, rows.rewards,
                        space, rows.terminations, rows.truncations, rows.next_observations,
                    )  # fmt: skip
                for algo in args.algos:
                    overrides = {"pretraining.dataset": str(Path(folder) / "client{client}-v0")}
                    config = resolve(algo, family, overrides=overrides)
                    model = config.make(family, clients=clients, seed=seed, device="cpu", verbose=0)
                    n_rounds = args.rounds or config.n_rounds
                    log = Log(n_rounds)
                    model.learn(n_rounds * model.n_clients * model.rollout_size, log)
                    runs.append({
                        "algo": algo, "misled": misled, "seed": seed, "curve": log.points,
                        "log": {"first": log.figures[0], "last": log.figures[-1]},
                    })  # fmt: skip
                    print(algo, misled, seed, np.round(log.points[-1][1], 2), log.figures[-1], flush=True)
        write_result(f"misleading_priors_{args.env}", {"env": args.env, "runs": runs})


if __name__ == "__main__":
    main()
