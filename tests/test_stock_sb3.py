"""One client's environment in a script that knows Stable-Baselines3 and Gymnasium, and of this project only the import."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from stable_baselines3 import DDPG, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import fed_envs  # noqa: F401 (registers the environments)


@pytest.mark.parametrize("name", ["HopperHard", "ReacherHard"])
def test_stock_ppo_trains_on_a_registered_id(name):
    env = make_vec_env(f"fed_envs/{name}-v0", n_envs=2, env_kwargs={"client": 3}, seed=0)
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=32, seed=0, device="cpu").learn(256)
    mean, deviation = evaluate_policy(model, env, n_eval_episodes=2)
    assert np.isfinite([mean, deviation]).all()


@pytest.mark.slow
def test_stock_ppo_solves_a_bandit_client():
    env = make_vec_env("fed_envs/Bandit2D-v0", n_envs=8, env_kwargs={"client": 1}, seed=0)
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=64, learning_rate=3e-3, gamma=0.0, seed=0, device="cpu").learn(20_000)
    assert evaluate_policy(model, env, n_eval_episodes=5)[0] > 0.9  # an untrained one: 0.0


def test_stock_ddpg_steps_an_environment_made_by_id():
    model = DDPG("MlpPolicy", gymnasium.make("fed_envs:fed_envs/Reacher-v0", client=2), learning_starts=20, device="cpu")
    assert model.learn(40).num_timesteps == 40
