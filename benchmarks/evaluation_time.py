"""Seconds of an evaluation of all clients, batched, against ``evaluate_policy`` of SB3 client by client.

    python benchmarks/evaluation_time.py --env HalfCheetahHard

Both run ten deterministic episodes per client with the same networks, in turn. Writes
``benchmarks/results/evaluation_time_<env>.json``.
"""

from __future__ import annotations

import argparse
import time

import torch as th
from record import spread, write_result
from stable_baselines3.common.evaluation import evaluate_policy

from fed_envs import load_family
from sb3_fedguide import Local
from sb3_fedguide.common.evaluation import evaluate_federation, evaluation_env


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HalfCheetahHard")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    th.set_num_threads(1)
    family = load_family(args.env)
    federation = Local("MlpPolicy", family, seed=0)
    env = evaluation_env(federation, args.episodes)
    separate = [(federation.client(k), family.make(k)) for k in federation.client_ids]
    ours, theirs = [], []
    for _ in range(args.repeats):
        started = time.perf_counter()
        evaluate_federation(lambda obs: federation.predict(obs, deterministic=True)[0], env)
        middle = time.perf_counter()
        for model, single in separate:
            evaluate_policy(model, single, args.episodes, warn=False)
        ours.append(middle - started)
        theirs.append(time.perf_counter() - middle)
    ratio = spread([b / a for a, b in zip(ours, theirs, strict=True)])
    result = {"command": vars(args), "seconds": {"batched": spread(ours), "sb3": spread(theirs)}, "ratio": ratio}
    write_result(f"evaluation_time_{args.env}", result)
    medians = [spread(values)["median"] for values in (ours, theirs)]
    print(f"batched {medians[0]:.2f} s, one at a time {medians[1]:.2f} s, ratio {ratio['median']:.1f}")


if __name__ == "__main__":
    main()
