"""Seconds per round of a lockstep federation beside as many SB3 PPO learners and beside the physics alone.

    python benchmarks/round_time.py --env HopperHard --repeats 5
    python benchmarks/round_time.py --env HopperHard --n-envs-per-client 4 --sb3-envs 1

Each repeat runs, in turn and with the same settings, one round (rollout and ``train()``, no evaluation) of

* the federation,
* the same federation with its clients in two worker processes (``--engine processes``),
* one ``stable_baselines3.PPO`` per client, one after the other,
* the same learners spread over two processes, and
* the federation once more, single-threaded, with a clock around every ``mj_step``: what the simulator alone takes for the
  states and controls of a round.

Ratios are taken repeat by repeat, so that a change of the machine's speed meets both sides. Writes
``benchmarks/results/round_time_<env>[_x<n>][_sb3x<n>].json``.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

import mujoco
import torch as th
from record import spread, write_result
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from fed_envs import FederatedVecEnv, load_family
from sb3_fedguide import Local
from sb3_fedguide.engines.processes import Processes

SETTINGS: dict[str, Any] = {"learning_rate": 3e-4, "batch_size": 64, "n_epochs": 4, "policy_kwargs": {"net_arch": [64, 64]}}


def sb3_learners(env: str, clients: Sequence[int], rollout_size: int, n_envs: int) -> list[PPO]:
    """One ordinary PPO per client, as a user of SB3 would set it up."""
    family = load_family(env)
    learners = []
    for client in clients:
        vec_env = DummyVecEnv([lambda client=client: Monitor(family.make(client)) for _ in range(n_envs)])
        learners.append(PPO("MlpPolicy", vec_env, n_steps=rollout_size // n_envs, seed=client, device="cpu", **SETTINGS))
    return learners


def timed_round(learners: list[Any], timesteps: int) -> float:
    started = time.perf_counter()
    for learner in learners:
        learner.learn(timesteps, reset_num_timesteps=False)
    return time.perf_counter() - started


def serve_learners(connection: Connection, arguments: tuple[Any, ...], timesteps: int) -> None:
    """One process's share of SB3's learners: a round for every message."""
    th.set_num_threads(1)
    learners = sb3_learners(*arguments)
    timed_round(learners, timesteps)
    connection.send("ready")
    while connection.recv():
        timed_round(learners, timesteps)
        connection.send("done")


class TwoProcesses:
    """SB3's learners spread over two processes, every second client in each."""

    def __init__(self, env: str, n_clients: int, rollout_size: int, n_envs: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.ends = []
        for share in (range(0, n_clients, 2), range(1, n_clients, 2)):
            here, there = context.Pipe()
            arguments = (env, list(share), rollout_size, n_envs)
            context.Process(target=serve_learners, args=(there, arguments, rollout_size), daemon=True).start()
            self.ends.append(here)
        self._wait()

    def _wait(self) -> None:
        for end in self.ends:
            end.recv()

    def round(self) -> float:
        started = time.perf_counter()
        for end in self.ends:
            end.send(True)
        self._wait()
        return time.perf_counter() - started

    def close(self) -> None:
        for end in self.ends:
            end.send(False)


def physics_seconds(federation: Local, per_round: int) -> float:
    """Seconds inside ``mj_step`` during one more round."""
    step, spent = mujoco.mj_step, 0.0

    def timed_step(*args: Any, **options: Any) -> None:
        nonlocal spent
        started = time.perf_counter()
        step(*args, **options)
        spent += time.perf_counter() - started

    mujoco.mj_step = timed_step
    try:
        federation.learn(per_round, reset_num_timesteps=False)
    finally:
        mujoco.mj_step = step
    return spent


def federation(env: str, clients: Sequence[int] | None, rollout_size: int, n_envs: int, num_threads: int = 1) -> list[Local]:
    """The clients in lockstep."""
    vec_env = FederatedVecEnv(env, n_envs_per_client=n_envs, clients=clients, num_threads=num_threads)
    return [Local("MlpPolicy", vec_env, rollout_size=rollout_size, seed=0, **SETTINGS)]


def measure(args: argparse.Namespace) -> dict[str, list[float]]:
    sizes = (args.rollout_size, args.n_envs_per_client)
    theirs_sizes = (args.rollout_size, args.sb3_envs or args.n_envs_per_client)
    (ours,), (alone,) = federation(args.env, None, *sizes, args.num_threads), federation(args.env, None, *sizes)
    per_round = args.rollout_size * ours.n_clients
    learners = sb3_learners(args.env, range(ours.n_clients), *theirs_sizes)
    timed_round([ours, alone], per_round)
    timed_round(learners, args.rollout_size)
    theirs = TwoProcesses(args.env, ours.n_clients, *theirs_sizes)
    (halves,), engine = federation(args.env, None, *sizes), Processes(2)
    engine.attach(halves)
    timed_round([halves], per_round)
    seconds: dict[str, list[float]] = {"of which train()": []}
    train = ours.train

    def timed_train() -> None:
        started = time.perf_counter()
        train()
        seconds["of which train()"].append(time.perf_counter() - started)

    ours.train = timed_train  # type: ignore[method-assign]
    for _ in range(args.repeats):
        for name, run in (
            ("lockstep", lambda: timed_round([ours], per_round)),
            ("lockstep in two processes", lambda: timed_round([halves], per_round)),
            ("sb3", lambda: timed_round(learners, args.rollout_size)),
            ("sb3 in two processes", theirs.round),
            ("mj_step", lambda: physics_seconds(alone, per_round)),
        ):
            seconds.setdefault(name, []).append(run())
    theirs.close()
    engine.close()
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HopperHard")
    parser.add_argument("--rollout-size", type=int, default=4096)
    parser.add_argument("--n-envs-per-client", type=int, default=1, help="for SB3's learners as well")
    parser.add_argument("--sb3-envs", type=int, help="environments of SB3's learners, if others")
    parser.add_argument("--num-threads", type=int, default=1, help="of the federation's simulators")
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    th.set_num_threads(1)

    seconds = measure(args)
    ratios = {
        f"{above} / {below}": spread([b / a for a, b in zip(seconds[below], seconds[above], strict=True)])
        for above, below in (
            ("sb3", "lockstep"),
            ("sb3 in two processes", "lockstep"),
            ("lockstep", "mj_step"),
            ("sb3", "lockstep in two processes"),
            ("sb3 in two processes", "lockstep in two processes"),
            ("lockstep in two processes", "mj_step"),
        )
    }
    suffix = f"_x{args.n_envs_per_client}" if args.n_envs_per_client > 1 else ""
    suffix += f"_sb3x{args.sb3_envs}" if args.sb3_envs else ""
    suffix += f"_{args.num_threads}threads" if args.num_threads > 1 else ""
    all_seconds = {name: spread(values) for name, values in seconds.items()}
    write_result(f"round_time_{args.env}{suffix}", {"command": vars(args), "seconds": all_seconds, "ratios": ratios})
    for title, table in (("seconds a round", all_seconds), ("ratio", ratios)):
        for name, values in table.items():
            print(f"{title:16} {name:48} {values['median']:6.2f} ({values['min']:.2f} to {values['max']:.2f})")


if __name__ == "__main__":
    main()
