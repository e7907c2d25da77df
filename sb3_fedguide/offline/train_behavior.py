"""Train a medium-quality behaviour policy of a nominal Gymnasium backbone with stock Stable-Baselines3 PPO.

Run ``python -m sb3_fedguide.offline.train_behavior --env Hopper-v5``; it stops as soon as the mean return of the
stochastic, squashed policy reaches the target, so that the data shows a working but improvable controller.
"""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_fedguide.offline.behavior import POLICY_FOLDER, BehaviorPolicy, squash

logger = logging.getLogger(__name__)

# Mean return at which training stops. Standing still gives a Hopper or a Walker2D about 1000, so theirs lie above it.
TARGET_RETURNS = {"Hopper-v5": 1300.0, "Walker2d-v5": 1300.0, "HalfCheetah-v5": 1800.0, "Reacher-v5": -7.5}


class SquashedActions(gym.ActionWrapper):
    """Executes ``tanh(u)`` for a raw action ``u``, so that a Gaussian policy leaves no atoms at the action bounds.

    :raises ValueError: if the environment's actions are not in [-1, 1]
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        space = env.action_space
        if not isinstance(space, gym.spaces.Box) or not (np.all(space.low == -1) and np.all(space.high == 1)):
            raise ValueError(f"a squashed behaviour policy needs actions in [-1, 1], got {space}")
        self.action_space = gym.spaces.Box(-10.0, 10.0, space.shape, np.float32)  # PPO needs finite bounds; tanh(10) = 1

    def action(self, action: np.ndarray) -> np.ndarray:
        return squash(action)


def extract_policy(model: PPO, normalizer: VecNormalize, **description: str | float) -> BehaviorPolicy:
    """The actor of ``model`` with the observation moments of ``normalizer`` baked in."""
    policy, moments = model.policy, normalizer.obs_rms
    if not isinstance(policy, ActorCriticPolicy) or not isinstance(moments, RunningMeanStd):
        raise ValueError("a behaviour policy is made from an MlpPolicy and flat observations")
    arrays: dict[str, np.ndarray] = {}
    linear = [module for module in policy.mlp_extractor.policy_net.modules() if isinstance(module, th.nn.Linear)]
    for layer, module in enumerate([*linear, policy.action_net]):
        for name, parameter in zip(("weight", "bias"), module.parameters(), strict=True):
            arrays[f"{name}_{layer}"] = parameter.detach().cpu().numpy().copy()
    arrays["log_std"] = policy.log_std.detach().cpu().numpy().copy()
    arrays["obs_mean"] = moments.mean.copy()
    arrays["obs_var"] = moments.var.copy()
    arrays["obs_clip"] = np.asarray(normalizer.clip_obs, dtype=np.float64)
    arrays["obs_epsilon"] = np.asarray(normalizer.epsilon, dtype=np.float64)
    arrays.update({name: np.asarray(value) for name, value in description.items()})
    return BehaviorPolicy(arrays)


def evaluate_behavior(policy: BehaviorPolicy, env: gym.Env, n_episodes: int, seed: int) -> np.ndarray:
    """Returns of ``n_episodes`` episodes, ``(n_episodes,)``, of the noisy policy in ``env``."""
    rng = np.random.default_rng(seed)
    returns = np.zeros(n_episodes)
    for episode in range(n_episodes):
        observation, _ = env.reset(seed=seed + episode)
        done = False
        while not done:
            observation, reward, terminated, truncated, _ = env.step(policy(observation, rng))
            returns[episode] += float(reward)
            done = terminated or truncated
    return returns


class _StopAtTarget(BaseCallback):
    """Evaluates every ``eval_freq`` steps and stops at the target; keeps the policy of the last evaluation."""

    def __init__(self, env_id: str, target: float, eval_freq: int, n_episodes: int, seed: int) -> None:
        super().__init__()
        self.env_id, self.target, self.eval_freq, self.n_episodes, self.seed = env_id, target, eval_freq, n_episodes, seed
        self.eval_env = gym.make(env_id)
        self.next_evaluation = eval_freq
        self.policy: BehaviorPolicy | None = None

    def _on_rollout_start(self) -> None:
        # Between updates: the parameters and the moments then belong to one policy.
        self.reached = False
        if self.num_timesteps >= self.next_evaluation:
            self.next_evaluation += self.eval_freq
            self.reached = self.evaluate() >= self.target

    def _on_step(self) -> bool:
        return not self.reached

    def evaluate(self) -> float:
        normalizer = self.model.get_vec_normalize_env()
        if normalizer is None or not isinstance(self.model, PPO):
            raise ValueError("behaviour policies are trained by PPO on a VecNormalize")
        policy = extract_policy(self.model, normalizer)
        mean_return = float(evaluate_behavior(policy, self.eval_env, self.n_episodes, self.seed).mean())
        self.policy = extract_policy(
            self.model,
            normalizer,
            env_id=self.env_id,
            mean_return=mean_return,
            timesteps=self.num_timesteps,
            seed=self.model.seed or 0,
        )
        logger.info("%s: %d steps, mean return %.1f", self.env_id, self.num_timesteps, mean_return)
        return mean_return


def train_behavior(
    env_id: str,
    timesteps: int,
    target: float,
    seed: int = 0,
    n_envs: int = 8,
    eval_freq: int = 20_000,
    eval_episodes: int = 20,
) -> BehaviorPolicy:
    """Train until the noisy policy's mean return reaches ``target``, or for ``timesteps`` steps.

    :param env_id: a Gymnasium id with actions in [-1, 1]
    :param eval_freq: environment steps between evaluations of ``eval_episodes`` episodes
    """
    env = DummyVecEnv([lambda: SquashedActions(Monitor(gym.make(env_id))) for _ in range(n_envs)])
    normalizer = VecNormalize(env, gamma=0.99)
    model = PPO(
        "MlpPolicy",
        normalizer,
        n_steps=512,
        batch_size=256,
        n_epochs=10,
        learning_rate=3e-4,
        policy_kwargs={"net_arch": [64, 64], "activation_fn": th.nn.Tanh, "log_std_init": -0.5},
        seed=seed,
        device="cpu",
    )
    callback = _StopAtTarget(env_id, target, eval_freq, eval_episodes, seed=10_000)
    model.learn(timesteps, callback=callback)
    if callback.policy is None or not callback.reached:
        callback.evaluate()
    env.close()
    if callback.policy is None:
        raise RuntimeError("the policy was not evaluated")
    return callback.policy


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", required=True, help="a Gymnasium id, such as Hopper-v5")
    parser.add_argument("--timesteps", type=int, default=1_000_000, help="at most this many environment steps")
    parser.add_argument("--target", type=float, help="mean return at which to stop; default: the backbone's medium level")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, help="npz file; default: the package's behavior_policies folder")
    args = parser.parse_args(argv)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    th.set_num_threads(1)
    target = args.target if args.target is not None else TARGET_RETURNS.get(args.env)
    if target is None:
        parser.error(f"no medium level is known for {args.env!r} (known: {sorted(TARGET_RETURNS)}); pass --target")
    policy = train_behavior(args.env, args.timesteps, target, args.seed)
    output = args.output or POLICY_FOLDER / f"{args.env.split('-')[0]}.npz"
    output.parent.mkdir(parents=True, exist_ok=True)
    policy.save(output)
    logger.info(
        "%s: return %.1f after %d steps -> %s", args.env, policy.arrays["mean_return"], policy.arrays["timesteps"], output
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
