"""Optimal transport over policies by their measured return, beside one shared policy.

    python benchmarks/routing.py --env ReacherHard --experts 1 2 4 --seeds 0 1

The server keeps M policies. Every five rounds each client tests all of them, three episodes each. What a policy returns less
than the best of them, over the client's scale of returns, is its cost, and the entropic plan of these costs (Eq. 8) routes
the clients. A policy moves by a server step of two along its clients' updates, weighted by its column of the plan (Eq. 9). A
client goes on from the mixture of the policies' parameters by its row (Eq. 10). M = 1 is FedAvg with these settings. After
``--until`` rounds everybody goes on alone. Settings are FedGuide-R's, without its tests. The result has the curves at equal
environment steps (tests count), the rows of the plans, and the tests' share of the steps.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from curves import Curve
from record import write_result

import fed_envs
from sb3_fedguide.common.evaluation import evaluate_federation, evaluation_env
from sb3_fedguide.server.ot_moe import farthest_points, sinkhorn_plan
from sb3_fedguide.settings.config import resolve

EVERY, EPISODES, SPLIT = 5, 3, 5


class Routing(Curve):
    """The server and the clients' tests in one callback."""

    def __init__(self, n_rounds: int, n_experts: int, until: int, eta: float, server_step: float) -> None:
        super().__init__(n_rounds)
        self.n_experts, self.until, self.eta, self.server_step = n_experts, until, eta, server_step
        self.curve: list[tuple[float, list[float]]] = []
        self.plans: list[list[list[float]]] = []
        self.test_steps = 0

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self.tests = evaluation_env(self.model, EPISODES)
        self.sent: np.ndarray | None = None  # flat parameters, (n_clients, n)
        self.experts = np.zeros((0, 0))  # likewise, (n_experts, n)
        self.rows = np.ones((self.model.n_clients, 1))

    def _evaluate(self, policy: str, round: int) -> Any:
        evaluation = super()._evaluate(policy, round)
        spent = (self.model.environment_steps + self.test_steps) / self.model.n_clients / self.model.rollout_size
        self.curve.append((spent, evaluation.client_returns.round(2).tolist()))
        return evaluation

    def _parameters(self) -> np.ndarray:
        stacks = [p.detach().numpy().reshape(self.model.n_clients, -1) for _, p in self.model.policy.named_parameters()]
        return np.concatenate(stacks, axis=1).astype(np.float64)

    def _load(self, flat: np.ndarray) -> None:
        for index in range(self.model.n_clients):
            start, arrays = 0, {}
            for name, parameter in self.model.policy.named_parameters():
                size = parameter[index].numel()
                arrays[name] = flat[index, start : start + size].reshape(parameter[index].shape).astype(np.float32)
                start += size
            self.model.policy.load_client(index, arrays)

    def _on_round_end(self) -> None:
        round = self.model.round
        if round > self.until:
            return
        trained = self._parameters()
        if self.sent is None:
            self.experts = trained.mean(axis=0, keepdims=True)
        else:
            columns = self.rows / np.maximum(self.rows.sum(axis=0), 1e-12)
            self.experts = self.experts + self.server_step * columns.T @ (trained - self.sent)
        if round == SPLIT and self.n_experts > 1:  # one policy until clients have learned something to tell them by
            updates = trained - trained.mean(axis=0)
            chosen = farthest_points(updates.astype(np.float32), self.n_experts, np.random.default_rng(0))
            self.experts = self.experts + chosen
        if len(self.experts) > 1 and round % EVERY == 0:
            self._route()
        self.sent = self.rows @ self.experts
        self._load(self.sent)

    def _route(self) -> None:
        returns = []
        for expert in self.experts:
            self._load(np.tile(expert, (self.model.n_clients, 1)))
            tested = evaluate_federation(
                lambda obs: self.model.predict(obs, deterministic=True)[0], self.tests, seed=1000 + self.model.round
            )
            self.test_steps += int(tested.lengths.sum())
            returns.append(tested.client_returns)
        table = np.stack(returns, axis=1)
        scale = np.maximum(np.abs(table).max(axis=1, keepdims=True), 1e-9)
        cost = np.minimum((table.max(axis=1, keepdims=True) - table) / scale, 1.0)
        plan = sinkhorn_plan(cost / max(cost.max(), 1e-9), self.eta).mass
        self.rows = plan / plan.sum(axis=1, keepdims=True)
        self.plans.append(self.rows.round(3).tolist())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="ReacherHard")
    parser.add_argument("--experts", nargs="+", type=int, default=[1, 2, 4])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--until", type=int, default=40)
    parser.add_argument("--eta", type=float, default=0.1)
    args = parser.parse_args()
    th.set_num_threads(1)
    family = fed_envs.load_family(args.env)
    name = f"routing_{args.env}"
    path = Path(__file__).parent / "results" / f"{name}.json"
    runs = json.loads(path.read_text())["runs"] if path.exists() else []
    for n_experts in args.experts:
        for seed in args.seeds:
            if any((run["n_experts"], run["seed"]) == (n_experts, seed) for run in runs):
                continue
            model = resolve("local", family, overrides={"n_epochs": 8, "normalize": "shared"}).make(
                family, clients=list(range(len(family.clients))), seed=seed, device="cpu", verbose=0
            )
            routing = Routing(args.rounds, n_experts, args.until, args.eta, 2.0)
            model.learn(args.rounds * model.n_clients * model.rollout_size, routing)
            runs.append({
                "n_experts": n_experts, "seed": seed, "curve": routing.curve, "rows": routing.plans,
                "test_share": routing.test_steps / (routing.test_steps + model.environment_steps),
            })  # fmt: skip
            print(n_experts, seed, [round(float(np.mean(returns)), 1) for _, returns in routing.curve], flush=True)
            write_result(name, {"env": args.env, "until": args.until, "eta": args.eta, "runs": runs})


if __name__ == "__main__":
    main()
