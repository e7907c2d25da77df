"""What FedGuide's guidance is worth while clients learn: its experts as policies, and a DICE value of recent data.

    python benchmarks/guidance.py --env HopperHard --seeds 0 -params eta:1 adapt_weight:1

Every ten rounds each client runs three policies in its own environments: its own, the personal prior that guides it (Eq. 10),
and the prior of its own head alone. Where the prior returns less than the client's policy, nothing can be learned by leaning
towards it. And in rounds 20 and 40 a DICE value is trained on the round's rollout; the next round says what it explains of
the Monte Carlo returns, beside the critic, and the variance that the best blend of both would leave (Lemma 2).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from curves import Curve
from record import write_result

import fed_envs
from sb3_fedguide.common.evaluation import evaluate_federation, evaluation_env
from sb3_fedguide.common.rollout_buffer import FederatedRolloutBuffer, generalized_advantage
from sb3_fedguide.common.value_blend import baseline_metrics, optimal_blend
from sb3_fedguide.offline.data import OfflineData
from sb3_fedguide.offline.dice import calibrate, train_dice
from sb3_fedguide.priors.mixture import mixture_sample
from sb3_fedguide.settings.config import parse_params, resolve

DICE_ROUNDS = (20, 40)


class Guidance(Curve):
    """Curves of the three policies, and the two values' metrics."""

    def __init__(self, n_rounds: int) -> None:
        super().__init__(n_rounds)
        self.returns: dict[str, list[tuple[int, list[float]]]] = {"policy": self.points, "prior": [], "own_head": []}
        self.values: list[dict[str, Any]] = []
        self.dice: Any = None

    def _on_local_training_end(self) -> None:
        super()._on_local_training_end()
        model: Any = self.model
        buffer = model.rollout_buffer
        round = model.round + 1
        if self.dice is not None:
            self.values.append({"round": round, **self._measure(buffer)})
            self.dice = None
        if round in DICE_ROUNDS:
            rngs = [np.random.default_rng([round, index]) for index in range(model.n_clients)]
            data = [_transitions(buffer, index) for index in range(model.n_clients)]
            self.dice = train_dice(data, rngs, gamma=model.gamma, tau=0.02)

    def _measure(self, buffer: FederatedRolloutBuffer) -> dict[str, list[float]]:
        model = self.model
        ends = np.zeros(buffer.values.shape[1:], dtype=bool)
        monte_carlo = buffer.values + generalized_advantage(
            buffer.bootstrapped_rewards(model.gamma, np.zeros(len(buffer.truncations))),
            buffer.values, buffer.values[-1], buffer.episode_starts, ends, model.gamma, 1.0,
        )  # fmt: skip
        returns, online = buffer.rows(monte_carlo), buffer.rows(buffer.values)
        raw = buffer.rows(buffer.raw_observations)
        dice = np.stack([self.dice.client_values(index, raw[index]) for index in range(model.n_clients)])
        for index in range(model.n_clients):
            slope, offset = calibrate(dice[index], returns[index])
            dice[index] = slope * dice[index] + offset
        best = optimal_blend(returns, online, dice)[:, None]
        metrics = baseline_metrics(returns, online, dice, best * online + (1 - best) * dice)
        return {name: np.round(values, 4).tolist() for name, values in metrics.items()}

    def _on_round_end(self) -> None:
        model: Any = self.model
        if model.round % 10:
            return
        env = evaluation_env(model, 3)
        alone = model.heads[:, None], np.ones((model.n_clients, 1))
        for name, (experts, rows) in {"prior": (model.experts, model.mixture_rows), "own_head": alone}.items():
            tested = evaluate_federation(_prior_policy(model, experts, rows), env)
            self.returns[name].append((model.round, tested.client_returns.round(2).tolist()))
        env.close()


def _prior_policy(model: Any, experts: np.ndarray, rows: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Actions drawn from every client's mixture of ``experts`` ``(n_clients, n_experts, ...)`` by its row."""
    rng = np.random.default_rng(0)
    low, high = model.action_space.low, model.action_space.high

    def predict(obs: np.ndarray) -> np.ndarray:
        split = th.as_tensor(obs, dtype=th.float32).reshape(model.n_clients, -1, obs.shape[-1])
        with th.no_grad():
            drawn = [
                mixture_sample(model.prior, experts[index], rows[index], split[index], rng, n_steps=model.sampling_steps)
                for index in range(model.n_clients)
            ]
        return np.clip(th.cat(drawn).numpy(), low, high)

    return predict


def _transitions(buffer: FederatedRolloutBuffer, index: int) -> OfflineData:
    """A client's rollout as offline data, in the scale of its rewards; the last step of each environment is left out."""
    parts = []
    cut = {(step, env): raw for step, client, env, raw, _ in buffer.truncations if client == index}
    for env in range(buffer.n_envs_per_client):
        obs = buffer.raw_observations[:, index, env]
        following, ends = obs[1:].copy(), buffer.episode_starts[1:, index, env] > 0
        for step in range(len(following)):
            if (step, env) in cut:
                following[step], ends[step] = cut[step, env], False
        parts.append((obs[:-1], buffer.actions[:-1, index, env], buffer.rewards[:-1, index, env], following, ends))
    observations, actions, rewards, following, ends = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return OfflineData(observations, actions, rewards, following, ends)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HopperHard")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--name", default="tuned", help="of the setting, in the result's file name")
    parser.add_argument("-params", nargs="*", default=[], help="settings of FedGuide beside the tuned ones")
    args = parser.parse_args()
    th.set_num_threads(1)
    family = fed_envs.load_family(args.env)
    runs = []
    for seed in args.seeds:
        model = resolve("fedguide", family, overrides=parse_params(args.params)).make(
            family, clients=list(range(len(family.clients))), seed=seed, device="cpu", verbose=0
        )
        guidance = Guidance(args.rounds)
        model.learn(args.rounds * model.n_clients * model.rollout_size, guidance)
        runs.append({"seed": seed, "returns": guidance.returns, "values": guidance.values})
        for name, curve in guidance.returns.items():
            print(seed, name, [round(float(np.mean(returns))) for _, returns in curve], flush=True)
        write_result(f"guidance_{args.env}_{args.name}", {"env": args.env, "params": args.params, "runs": runs})


if __name__ == "__main__":
    main()
