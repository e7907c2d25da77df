"""Seconds per round of one federation in this process, in worker processes and in Ray actors.

    python benchmarks/engines.py --env HopperHard --n-envs-per-client 4

Each repeat runs one round (rollout, ``train()`` and exchange, no evaluation) of FedAvg with every engine in turn; ratios are
taken repeat by repeat. Writes ``benchmarks/results/engines_<env>.json``. Ray has to be installed
(``pip install 'sb3-fedguide[ray]'``).
"""

from __future__ import annotations

import argparse
import time

import ray
import torch as th
from record import spread, write_result
from round_time import SETTINGS

from fed_envs import FederatedVecEnv
from sb3_fedguide import FedAvg
from sb3_fedguide.engines import make_engine

ENGINES = (("lockstep", 1), ("processes", 1), ("processes", 2), ("ray", 1), ("ray", 2))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HopperHard")
    parser.add_argument("--rollout-size", type=int, default=4096)
    parser.add_argument("--n-envs-per-client", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    th.set_num_threads(1)
    ray.init(num_cpus=sum(num_actors for name, num_actors in ENGINES if name == "ray"), include_dashboard=False)

    models, engines = {}, []
    for name, num_actors in ENGINES:
        vec_env = FederatedVecEnv(args.env, n_envs_per_client=args.n_envs_per_client)
        model = FedAvg("MlpPolicy", vec_env, rollout_size=args.rollout_size, seed=0, **SETTINGS)
        engine = make_engine(name, num_actors)
        if engine is not None:
            engine.attach(model)
            engines.append(engine)
        per_round = model.rollout_size * model.n_clients
        model.learn(per_round)  # caches and just-in-time work
        models[name if engine is None else f"{name}, {num_actors}"] = model
    seconds: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(args.repeats):
        for name, model in models.items():
            started = time.perf_counter()
            model.learn(per_round, reset_num_timesteps=False)
            seconds[name].append(time.perf_counter() - started)
    for engine in engines:
        engine.close()
    base = seconds["lockstep"]
    ratios = {
        f"lockstep / {name}": spread([a / b for a, b in zip(base, seconds[name], strict=True)])
        for name in seconds
        if name != "lockstep"
    }
    all_seconds = {name: spread(values) for name, values in seconds.items()}
    write_result(f"engines_{args.env}", {"command": vars(args), "seconds": all_seconds, "ratios": ratios})
    for title, table in (("seconds a round", all_seconds), ("ratio", ratios)):
        for name, values in table.items():
            print(f"{title:16} {name:28} {values['median']:6.2f} ({values['min']:.2f} to {values['max']:.2f})")


if __name__ == "__main__":
    main()
