"""Seconds of a round and memory by number of clients, on generated families of HopperHard's kind.

    python benchmarks/growth.py --clients 8 16 32 64 128 --rounds 5

Every case runs in a process of its own: a federation of that many clients, one round to warm up and ``--rounds`` that are
timed. ``fedguide`` has its losses, DICE values and exchange, but an offline stage of a few updates, which says nothing about
what it learns and everything about what a round costs. Memory is the process's peak over what it held before the federation
was built. Writes ``benchmarks/results/growth_<env>.json``.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import resource
import sys
import tempfile
import time
from typing import Any

import torch as th
from record import spread, write_result

from fed_envs.generation import generate_family
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.registry import algorithm

PHASES = ("rollout", "train", "exchange")
SETTINGS: dict[str, Any] = {"learning_rate": 3e-4, "batch_size": 64, "n_epochs": 4, "policy_kwargs": {"net_arch": [64, 64]}}
SHORT_STAGE = {"dataset_size": 200, "prior_updates": 20, "dice_updates": 10}


class PhaseClock(RoundCallback):
    """Wall and CPU seconds of the phases of every round."""

    def __init__(self) -> None:
        super().__init__()
        self.wall: dict[str, list[float]] = {phase: [] for phase in PHASES}
        self.cpu: dict[str, list[float]] = {phase: [] for phase in PHASES}

    def _on_round_start(self) -> None:
        self._last = time.perf_counter(), time.process_time()

    def _on_rollout_end(self) -> None:
        self._ends("rollout")

    def _on_local_training_end(self) -> None:
        self._ends("train")

    def _on_round_end(self) -> None:
        self._ends("exchange")

    def _ends(self, phase: str) -> None:
        now = time.perf_counter(), time.process_time()
        self.wall[phase].append(now[0] - self._last[0])
        self.cpu[phase].append(now[1] - self._last[1])
        self._last = now


def peak_bytes() -> int:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def measure(arguments: dict[str, Any]) -> dict[str, Any]:
    """One case, in a process of its own."""
    th.set_num_threads(1)
    family = generate_family(arguments["env"], arguments["n_clients"])
    extra: dict[str, Any] = {}
    if arguments["algo"].startswith("fedguide"):
        extra = {"n_experts": arguments["experts"], "prior_loss": "sample", "pretraining": SHORT_STAGE}
    before, clock = peak_bytes(), PhaseClock()
    with tempfile.TemporaryDirectory() as cache:
        federation = algorithm(arguments["algo"])(
            "MlpPolicy",
            family,
            rollout_size=arguments["rollout_size"],
            n_envs_per_client=arguments["n_envs_per_client"],
            normalize=True,
            seed=0,
            cache_dir=cache,
            **SETTINGS,
            **extra,
        )
        rounds = 1 + arguments["rounds"]
        federation.learn(rounds * arguments["rollout_size"] * arguments["n_clients"], clock)
    return {
        "n_clients": arguments["n_clients"],
        "algo": arguments["algo"],
        "seconds": {phase: spread(clock.wall[phase][1:]) for phase in PHASES},
        "cpu_seconds": {phase: spread(clock.cpu[phase][1:]) for phase in PHASES},
        "round_seconds": spread([sum(parts) for parts in zip(*clock.wall.values(), strict=True)][1:]),
        "round_cpu_seconds": spread([sum(parts) for parts in zip(*clock.cpu.values(), strict=True)][1:]),
        "peak_bytes": peak_bytes() - before,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HopperHard")
    parser.add_argument("--clients", type=int, nargs="+", default=[8, 16, 32, 64, 128])
    parser.add_argument("--algos", nargs="+", default=["local", "fedguide"])
    parser.add_argument("--experts", type=int, default=8)
    parser.add_argument("--rollout-size", type=int, default=4096)
    parser.add_argument("--n-envs-per-client", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()

    cases = []
    print("clients algo        round  rollout    train exchange   CPU   peak MB   (seconds, medians)")
    context = multiprocessing.get_context("spawn")
    for n_clients, algo in itertools.product(args.clients, args.algos):
        with context.Pool(1) as pool:
            case = pool.apply(measure, ({**vars(args), "n_clients": n_clients, "algo": algo},))
        cases.append(case)
        phases = " ".join(f"{case['seconds'][phase]['median']:8.3f}" for phase in PHASES)
        print(
            f"{n_clients:7} {algo:10} {case['round_seconds']['median']:6.2f} {phases} "
            f"{case['round_cpu_seconds']['median']:5.2f} {case['peak_bytes'] / 1e6:9.0f}",
            flush=True,
        )
        path = write_result(f"growth_{args.env}", {"command": vars(args), "cases": cases})
    print(f"written to {path}")


if __name__ == "__main__":
    main()
