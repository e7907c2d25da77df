"""Seconds per round of a lockstep federation against as many SB3 PPO learners, one after the other.

    python benchmarks/round_time.py --env HopperHard --algo local --repeats 5

Both train with the same settings for one round (rollout and train, no evaluation), in turn, so that a change of the
machine's speed meets both; the ratio is taken pair by pair. Writes ``benchmarks/results/round_time_<env>_<algo>.json``.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from pathlib import Path
from typing import Any

import mujoco
import stable_baselines3
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from fed_envs import load_family
from sb3_fedguide.algorithms import algorithm

SETTINGS: dict[str, Any] = {"learning_rate": 3e-4, "batch_size": 64, "n_epochs": 4, "policy_kwargs": {"net_arch": [64, 64]}}


def sb3_learners(env: str, rollout_size: int, normalize: bool) -> list[PPO]:
    """One ordinary PPO per client, as a user of SB3 would set it up."""
    family = load_family(env)
    learners = []
    for client in range(family.n_clients):
        vec_env: Any = DummyVecEnv([lambda client=client: Monitor(family.make(client))])
        if normalize:
            vec_env = VecNormalize(vec_env)
        learners.append(PPO("MlpPolicy", vec_env, n_steps=rollout_size, seed=client, device="cpu", **SETTINGS))
    return learners


def timed_round(learners: list[Any], timesteps: int) -> float:
    started = time.perf_counter()
    for learner in learners:
        learner.learn(timesteps, reset_num_timesteps=False)
    return time.perf_counter() - started


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HopperHard")
    parser.add_argument("--algo", default="local")
    parser.add_argument("--rollout-size", type=int, default=4096)
    parser.add_argument("--n-envs-per-client", type=int, default=1)
    parser.add_argument("--normalize", action="store_true")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("-params", nargs="*", default=[], help="further arguments of the algorithm, name=JSON")
    args = parser.parse_args()
    th.set_num_threads(1)

    extra = {name: json.loads(value) for name, value in (item.split("=", 1) for item in args.params)}
    federation = algorithm(args.algo)(
        "MlpPolicy",
        args.env,
        rollout_size=args.rollout_size,
        n_envs_per_client=args.n_envs_per_client,
        normalize=args.normalize,
        seed=0,
        **SETTINGS,
        **extra,
    )
    per_round = args.rollout_size * federation.n_clients
    federation.learn(per_round)  # offline stage and warm-up are not timed
    learners = sb3_learners(args.env, args.rollout_size, args.normalize)
    timed_round(learners, args.rollout_size)
    ours, theirs = [], []
    for _ in range(args.repeats):
        ours.append(timed_round([federation], per_round))
        theirs.append(timed_round(learners, args.rollout_size))
    ratios = [b / a for a, b in zip(ours, theirs, strict=True)]
    result = {
        "command": vars(args),
        "seconds_per_round": {"lockstep": statistics.median(ours), "sb3": statistics.median(theirs)},
        "ratio": {"median": statistics.median(ratios), "min": min(ratios), "max": max(ratios)},
        "all": {"lockstep": ours, "sb3": theirs},
        "machine": {"processor": platform.processor() or platform.machine(), "torch_threads": th.get_num_threads()},
        "versions": {
            "torch": th.__version__,
            "stable_baselines3": stable_baselines3.__version__,
            "mujoco": mujoco.__version__,
        },
    }
    suffix = f"_x{args.n_envs_per_client}" if args.n_envs_per_client > 1 else ""
    path = Path(__file__).parent / "results" / f"round_time_{args.env}_{args.algo}{suffix}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(result, indent=1) + "\n")
    print(
        f"lockstep {result['seconds_per_round']['lockstep']:.2f} s, SB3 {result['seconds_per_round']['sb3']:.2f} s a round, "
        f"ratio {result['ratio']['median']:.1f} ({min(ratios):.1f} to {max(ratios):.1f})"
    )


if __name__ == "__main__":
    main()
