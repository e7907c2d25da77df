"""Lockstep PPO is SB3's PPO, N times over."""

from __future__ import annotations

import hashlib
import inspect

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from fed_envs import FederatedVecEnv
from sb3_fedguide import Local
from sb3_fedguide.common.normalization import FederatedNormalizer
from sb3_fedguide.common.rollout_buffer import generalized_advantage
from sb3_fedguide.state.stacked import clip_grad_norm_per_client
from tests.comparisons import assert_train_equals, sb3_twin
from tests.conftest import assert_same_parameters, parameters_of

# Sources of the upstream methods that this package re-implements. When one of these fails after an upgrade of SB3, read
# what changed there, carry it over, and update the digest.
UPSTREAM = {
    PPO.train: "7c8d09940123242f",
    OnPolicyAlgorithm.collect_rollouts: "07f9eed35d9d7392",
    OnPolicyAlgorithm.learn: "193ab72530ae02ce",
    RolloutBuffer.compute_returns_and_advantage: "1a229ef50a037a1e",
}


@pytest.mark.parametrize("function", UPSTREAM, ids=lambda f: f.__qualname__)
def test_upstream_method_is_the_one_we_mirror(function):
    assert hashlib.sha256(inspect.getsource(function).encode()).hexdigest()[:16] == UPSTREAM[function]


@pytest.mark.parametrize(("ent_coef", "clip_range_vf"), [(0.0, None), (0.01, 0.001)])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_train_equals_sb3(point_envs, small, monkeypatch, ent_coef, clip_range_vf, n_envs):
    settings = {"clip_range": 0.001, "clip_range_vf": clip_range_vf, "ent_coef": ent_coef}
    model = Local("MlpPolicy", point_envs(1), n_envs_per_client=n_envs, **settings, **small)
    twin = sb3_twin(model, DummyVecEnv([point_envs(1)[0]] * n_envs))
    assert_train_equals(model, twin, monkeypatch)
    assert 0.1 < model.logger.name_to_value["train/clip_fraction"] < 0.9  # so narrow that clipping counts


@pytest.mark.parametrize("n_envs", [1, 2])
def test_rollout_advantages_equal_sb3_buffer(point_envs, small, n_envs):
    model = Local("MlpPolicy", point_envs(2), n_envs_per_client=n_envs, **small)
    model.learn(2 * model.rollout_size)
    buffer = model.rollout_buffer
    assert buffer.truncations, "the rollout must contain truncated episodes for this to test anything"
    flat = (model.n_steps, 2 * n_envs)
    theirs = RolloutBuffer(*flat[:1], model.observation_space, model.action_space, "cpu", 0.95, 0.99, n_envs=flat[1])
    theirs.rewards = buffer.bootstrapped_rewards(0.99, model._truncation_values()).reshape(flat)
    theirs.values, theirs.episode_starts = buffer.values.reshape(flat), buffer.episode_starts.reshape(flat)
    last, dones = np.full(flat[1], 0.3, dtype=np.float32), np.arange(flat[1]) % 2 == 0
    theirs.compute_returns_and_advantage(th.as_tensor(last), dones)
    ours = generalized_advantage(theirs.rewards, theirs.values, last, theirs.episode_starts, dones, 0.99, 0.95)
    np.testing.assert_array_equal(ours, theirs.advantages)


def test_truncation_bootstraps_and_termination_does_not(point_envs, small):
    model = Local("MlpPolicy", point_envs(2), **small)
    model.learn(2 * model.rollout_size)
    buffer = model.rollout_buffer
    values = np.full(len(buffer.truncations), 7.0, dtype=np.float32)
    change = buffer.bootstrapped_rewards(0.5, values) - buffer.rewards
    expected = np.zeros_like(change)
    for step, client, env, _, _ in buffer.truncations:
        expected[step, client, env] = 3.5
    np.testing.assert_allclose(change, expected, atol=1e-5)


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("n_clients", [2, 3, 8])
def test_clients_equal_federations_of_one(point_envs, small, n_clients, normalize):
    """Bit for bit: what a client learns without exchange does not depend on its neighbours."""
    factories = point_envs(n_clients)
    together = Local("MlpPolicy", factories, normalize=normalize, **small)
    together.learn(3 * n_clients * together.rollout_size)
    for client in {0, n_clients - 1}:
        alone = Local("MlpPolicy", factories, clients=[client], normalize=normalize, **small)
        alone.learn(3 * alone.rollout_size)
        assert_same_parameters(parameters_of(together, client), parameters_of(alone, client))


def test_neighbours_do_not_matter_on_hopper(small):
    args = {**small, "normalize": True, "rollout_size": 128}
    together = Local("MlpPolicy", FederatedVecEnv("HopperHard", clients=[2, 5, 7]), **args)
    together.learn(2 * 3 * 128)
    alone = Local("MlpPolicy", "HopperHard", clients=[5], **args)
    alone.learn(2 * 128)
    assert_same_parameters(parameters_of(together, 5), parameters_of(alone, 5))


def test_training_is_deterministic_and_seeded(point_envs, small):
    def trained(seed):
        model = Local("MlpPolicy", point_envs(2), **{**small, "seed": seed})
        return parameters_of(model.learn(2 * 2 * model.rollout_size), 1)

    first = trained(3)
    assert_same_parameters(first, trained(3))
    assert any(not th.equal(first[name], other) for name, other in trained(4).items())


def test_normalizer_equals_vec_normalize(point_envs):
    env = VecNormalize(DummyVecEnv([point_envs(1)[0]] * 3), gamma=0.9)
    env.seed(0)
    ours = FederatedNormalizer(1, 3, 3, gamma=0.9)
    normalized = env.reset()
    ours.update_obs(env.get_original_obs()[None])
    np.testing.assert_allclose(ours.normalize_obs(env.get_original_obs()[None])[0], normalized, atol=1e-6)
    rng = np.random.default_rng(0)
    for _ in range(60):
        normalized, rewards, dones, _ = env.step(rng.uniform(-1, 1, (3, 2)))
        raw = env.get_original_obs()
        ours.update_obs(raw[None])
        scaled = ours.scale_reward(env.get_original_reward()[None], dones[None])
        np.testing.assert_allclose(scaled[0], rewards, rtol=1e-6)
        np.testing.assert_allclose(ours.normalize_obs(raw[None])[0], normalized, atol=1e-6)
    np.testing.assert_allclose(ours.ret.var, env.ret_rms.var)


def test_gradient_norms_are_clipped_per_client():
    big, small_ = th.nn.Parameter(th.zeros(2, 3)), th.nn.Parameter(th.zeros(2, 2, 2))
    big.grad, small_.grad = th.tensor([[3.0, 0, 0], [0.1, 0, 0]]), th.zeros(2, 2, 2)
    small_.grad[0, 0, 0] = 4.0
    norms = clip_grad_norm_per_client([big, small_], 0.5)
    np.testing.assert_allclose(norms.numpy(), [5.0, 0.1], rtol=1e-6)
    np.testing.assert_allclose(big.grad.numpy(), [[0.3, 0, 0], [0.1, 0, 0]], rtol=1e-5)


def test_learning_improves_every_client(point_envs, small):
    args = {**small, "rollout_size": 256, "n_epochs": 6, "learning_rate": 3e-3}
    model = Local("MlpPolicy", point_envs(3), **args)
    model.learn(3 * 256)
    before = [np.mean([info["r"] for info in infos]) for infos in model.episode_infos]
    model.learn(25 * 3 * 256)
    after = [np.mean([info["r"] for info in list(infos)[-10:]]) for infos in model.episode_infos]
    assert all(b < -8 for b in before), before
    assert all(a > -5 for a in after), after


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_envs_per_client": 3}, "must divide rollout_size"),
        ({"batch_size": 65}, "batch_size=65"),
        ({"bc_weight": 1.5}, "bc_weight"),
        ({"policy_kwargs": {"use_sde": True}}, "use_sde"),
    ],
)
def test_unfit_settings_are_refused(point_envs, small, arguments, message):
    with pytest.raises(ValueError, match=message):
        Local("MlpPolicy", point_envs(2), **{**small, **arguments})


def test_a_single_environment_is_refused(point_envs, small):
    with pytest.raises(ValueError, match="one environment per client"):
        Local("MlpPolicy", point_envs(1)[0](), **small)
