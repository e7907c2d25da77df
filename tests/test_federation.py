"""A federation as a user meets it: predict, save, load, single clients, callbacks, evaluation."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CheckpointCallback

from fed_envs import FederatedVecEnv
from sb3_fedguide import FedAvg, FederatedEvalCallback, Local, evaluate_federation
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.evaluation import evaluation_env
from tests.conftest import assert_same_parameters, parameters_of


@pytest.mark.parametrize("normalize", [False, True])
def test_client_is_an_ordinary_ppo_with_the_same_actions(point_envs, small, normalize, tmp_path):
    model = Local("MlpPolicy", point_envs(3), normalize=normalize, **small)
    model.learn(2 * 3 * model.rollout_size)
    obs = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32) * 3
    ours, _ = model.predict(obs, deterministic=True)
    for client in range(3):
        single = model.client(client)
        assert type(single) is PPO
        rows = slice(2 * client, 2 * client + 2)
        np.testing.assert_allclose(single.predict(obs[rows], deterministic=True)[0], ours[rows], atol=1e-6)
    single.save(tmp_path / "client")
    loaded = PPO.load(tmp_path / "client", env=point_envs(3)[2]())
    np.testing.assert_allclose(loaded.predict(obs[4:], deterministic=True)[0], ours[4:], atol=1e-6)
    loaded.learn(1)  # and it can be trained further
    model.export(2, tmp_path / "client.pt2")
    exported = th.export.load(tmp_path / "client.pt2").module()(th.as_tensor(obs[4:]))
    np.testing.assert_allclose(exported.numpy(), ours[4:], atol=1e-6)


@pytest.mark.parametrize("normalize", [False, True])
def test_save_and_load(point_envs, small, tmp_path, normalize):
    model = FedAvg("MlpPolicy", point_envs(2), normalize=normalize, average_every=2, **small)
    model.learn(3 * 2 * model.rollout_size)
    model.save(tmp_path / "model")
    loaded = FedAvg.load(tmp_path / "model")
    obs = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])
    assert loaded.average_every == 2 and loaded.strategy.average_every == 2
    resumed = FedAvg.load(tmp_path / "model", env=point_envs(2))
    resumed.learn(2 * resumed.rollout_size, reset_num_timesteps=False)
    assert resumed.num_timesteps == 4 * 2 * resumed.rollout_size and resumed.round == 4


def test_load_by_family_name(small, tmp_path):
    model = Local("MlpPolicy", "Bandit2D", **small)
    model.learn(model.rollout_size * 4)
    model.save(tmp_path / "model")
    loaded = Local.load(tmp_path / "model", env="Bandit2D")
    loaded.learn(model.rollout_size * 4)
    assert loaded.family.name == "Bandit2D"


def test_predict_says_what_it_needs(point_envs, small):
    model = Local("MlpPolicy", point_envs(2), **small)
    for obs in (np.zeros(3), np.zeros((3, 3))):
        with pytest.raises(ValueError, match="client\\(k\\)"):
            model.predict(obs)
    with pytest.raises(ValueError, match=r"\[0, 1\]"):
        model.client(2)


def test_seeds_give_one_initial_network(point_envs, small):
    two, one = Local("MlpPolicy", point_envs(2), **small), FedAvg("MlpPolicy", point_envs(1), **small)
    assert_same_parameters(parameters_of(two, 0), parameters_of(two, 1))
    assert_same_parameters(parameters_of(two, 0), parameters_of(one, 0))


def test_evaluation_counts_every_episode_once_and_repeats(point_envs, small):
    model = Local("MlpPolicy", point_envs(2), **small)
    env = evaluation_env(model, 4)

    def predict(obs):
        return model.predict(obs, deterministic=True)[0]

    first, second = evaluate_federation(predict, env), evaluate_federation(predict, env)
    assert first.returns.shape == (2, 4)
    np.testing.assert_array_equal(first.returns, second.returns)
    assert len(np.unique(first.returns)) == 8, "episodes must be different ones"
    assert first.lengths.max() <= 20
    alone = evaluate_federation(lambda obs: np.zeros((len(obs), 2)), env.copies(2, env.role))
    assert not np.array_equal(alone.returns, first.returns[:, :2])


def test_evaluation_callback_writes_deployed_and_broadcast(point_envs, small, tmp_path):
    model = FedAvg("MlpPolicy", point_envs(2), **small)
    path = tmp_path / "evaluations.csv"
    callback = FederatedEvalCallback(n_rounds=25, eval_freq=2, n_episodes=2, csv_path=path)
    model.learn(25 * 2 * model.rollout_size, callback=callback)
    rows = list(csv.DictReader(path.open()))
    deployed = sorted({int(row["round"]) for row in rows if row["policy"] == "deployed"})
    assert deployed == [2, 4, *range(6, 26)]
    broadcast = sorted({int(row["round"]) for row in rows if row["policy"] == "broadcast"})
    assert broadcast == [*range(2, 25, 2), 25]
    final = [float(row["mean_return"]) for row in rows if row["policy"] == "deployed" and row["round"] == "25"]
    assert np.isclose(np.mean(final), callback.last["deployed"].average, rtol=1e-4)


def test_round_events_and_stock_callbacks(point_envs, small, tmp_path):
    events = []

    class Spy(RoundCallback):
        def _on_local_training_end(self):
            events.append("trained")
            self.before = self.model.policy.client_state_dict(0)

        def _on_round_end(self):
            events.append("exchanged")
            assert any(not th.equal(self.before[k], v) for k, v in self.model.policy.client_state_dict(0).items())

    model = FedAvg("MlpPolicy", point_envs(2), **small)
    checkpoint = CheckpointCallback(save_freq=model.n_steps, save_path=str(tmp_path))
    model.learn(2 * 2 * model.rollout_size, callback=[Spy(), checkpoint])
    assert events == ["trained", "exchanged"] * 2
    assert len(list(tmp_path.glob("*.zip"))) == 2


def test_whole_training_is_one_tensorboard_file_with_schedules(point_envs, small, tmp_path):
    model = Local("MlpPolicy", point_envs(2), learning_rate=lambda left: 1e-3 * left, tensorboard_log=str(tmp_path), **small)
    model.learn(4 * 2 * model.rollout_size)
    assert len(list(tmp_path.rglob("events.out.tfevents.*"))) == 1
    assert model.policy.optimizer.param_groups[0]["lr"] == pytest.approx(0.0)


def test_clients_selects_who_lives_here(point_envs, small):
    model = Local("MlpPolicy", point_envs(4), clients=[1, 3], **small)
    model.learn(2 * model.rollout_size)
    assert model.client_ids == [1, 3] and model.num_timesteps == 2 * model.rollout_size
    assert isinstance(model.get_env(), FederatedVecEnv)
