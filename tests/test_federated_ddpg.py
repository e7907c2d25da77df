"""Lockstep DDPG: SB3's update, clients that do not know of each other, replay, noise and warm-up."""

from __future__ import annotations

import hashlib
import inspect

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.td3.td3 import TD3

from fed_envs import FederatedVecEnv
from sb3_fedguide import FederatedDDPG, FedRL
from sb3_fedguide.common.noise import OrnsteinUhlenbeckNoise
from sb3_fedguide.common.replay_buffer import FederatedReplayBuffer
from sb3_fedguide.seeding import Role
from tests.conftest import assert_same_parameters, parameters_of
from tests.small_runs import SMALL

# The code of Stable-Baselines3 that FederatedDDPG reimplements in lockstep. When this fails after an upgrade of SB3, read
# what changed there, carry it over, and update the digest.
UPSTREAM = {
    TD3.train: "4f3638f813b0efba",
    OffPolicyAlgorithm.collect_rollouts: "2210891104720d7c",
    OffPolicyAlgorithm.learn: "180dc4ca47ad67fb",
    OffPolicyAlgorithm._sample_action: "91b38e02c7784347",
}


@pytest.mark.parametrize("function", UPSTREAM, ids=lambda f: f.__qualname__)
def test_upstream_method_is_the_one_we_mirror(function):
    assert hashlib.sha256(inspect.getsource(function).encode()).hexdigest()[:16] == UPSTREAM[function]


def copy_moments(ours: th.optim.Optimizer, theirs: th.optim.Optimizer, index: int) -> None:
    state = {
        key: {name: (value[index] if value.dim() else value).clone() for name, value in moments.items()}
        for key, moments in ours.state_dict()["state"].items()
    }
    assert len(state) == len(theirs.param_groups[0]["params"])
    theirs.load_state_dict({"state": state, "param_groups": theirs.state_dict()["param_groups"]})


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize(("n_clients", "index"), [(1, 0), (3, 1)])
def test_gradient_steps_equal_sb3(point_envs, n_clients, index, normalize):
    model = FederatedDDPG("MlpPolicy", point_envs(n_clients), normalize=normalize, **SMALL)
    model.learn(2 * n_clients * model.rollout_size)  # so that targets and moments have moved away from their start
    # Minibatches are normalised already: the twin has the parameters alone.
    twin = DDPG(
        "MlpPolicy", point_envs(1)[0](), learning_rate=1e-3, tau=0.01, policy_kwargs=SMALL["policy_kwargs"], device="cpu"
    )
    twin.policy.load_state_dict(model.policy.client_state_dict(index))
    copy_moments(model.actor.optimizer, twin.actor.optimizer, index)
    copy_moments(model.critic.optimizer, twin.critic.optimizer, index)
    twin._logger, twin._current_progress_remaining = model.logger, model._current_progress_remaining
    model.replay_buffer.terminations[::5] = 1.0
    streams = list(model.present_streams(Role.MINIBATCH))
    samples = [model.replay_buffer.sample(16, streams, model.normalizer) for _ in range(6)]
    ours, theirs = iter(samples), iter(samples)
    model.replay_buffer.sample = lambda *args: next(ours)

    def sample(*args, **kwargs):
        data = next(theirs)
        rows = [data.observations, data.actions, data.next_observations]
        columns = [data.terminations, data.rewards]
        return ReplayBufferSamples(*(x[index] for x in rows), *(x[index, :, None] for x in columns))

    twin.replay_buffer.sample = sample
    before = model.policy.client_state_dict(index)
    model.train(6, 16)
    twin.train(6, 16)
    after = model.policy.client_state_dict(index)
    assert all((before[name] - after[name]).abs().max() > 1e-5 for name in after), "every network must have moved"
    assert_same_parameters(after, twin.policy.state_dict(), tolerance=1e-6)


@pytest.mark.parametrize(("n_clients", "n_envs", "normalize"), [(2, 1, False), (3, 2, True), (8, 1, False)])
def test_clients_equal_federations_of_one(point_envs, n_clients, n_envs, normalize):
    """Bit for bit: what a client learns without exchange does not depend on its neighbours."""
    factories, options = point_envs(n_clients), {"n_envs_per_client": n_envs, "normalize": normalize, **SMALL}
    together = FederatedDDPG("MlpPolicy", factories, **options)
    together.learn(3 * n_clients * together.rollout_size)
    for client in {0, n_clients - 1}:
        alone = FederatedDDPG("MlpPolicy", factories, clients=[client], **options)
        alone.learn(3 * alone.rollout_size)
        assert_same_parameters(parameters_of(together, client), parameters_of(alone, client))
    assert not th.equal(together.policy.actor.mu[0].weight[0], together.policy.actor.mu[0].weight[-1])


def test_neighbours_do_not_matter_on_hopper():
    together = FederatedDDPG("MlpPolicy", FederatedVecEnv("HopperHard", clients=[2, 5, 7]), **SMALL)
    together.learn(2 * 3 * 64)
    alone = FederatedDDPG("MlpPolicy", "HopperHard", clients=[5], **SMALL)
    alone.learn(2 * 64)
    assert_same_parameters(parameters_of(together, 5), parameters_of(alone, 5))


def test_training_is_seeded(point_envs):
    def trained(seed):
        model = FedRL("MlpPolicy", point_envs(2), **{**SMALL, "seed": seed})
        return parameters_of(model.learn(2 * 2 * model.rollout_size), 1)

    first = trained(3)
    assert_same_parameters(first, trained(3))
    assert any(not th.equal(first[name], other) for name, other in trained(4).items())


@pytest.mark.parametrize("n_envs", [1, 2])
def test_replay_holds_what_happened(point_envs, n_envs):
    """Each transition leads to the next one, or to the final observation of its episode; only a termination ends its value."""
    model = FederatedDDPG("MlpPolicy", point_envs(3), n_envs_per_client=n_envs, **{**SMALL, "rollout_size": 400})
    model.learn(3 * model.rollout_size)
    buffer = model.replay_buffer
    assert buffer.sizes.tolist() == [400] * 3
    truncated = terminated = 0
    for row in range(400 - n_envs):
        for client in range(3):
            final, following = buffer.next_observations[row, client], buffer.observations[row + n_envs, client]
            left = np.abs(final[:2]).max() > 2.5
            assert buffer.terminations[row, client] == left
            assert (final[2] == 1.0 or left) != np.array_equal(final, following)
            target = -0.5 + 0.3 * client
            assert np.isclose(buffer.rewards[row, client], -np.square(final[:2] - target).sum(), rtol=1e-4)
            truncated, terminated = truncated + (final[2] == 1.0 and not left), terminated + left
    assert truncated and terminated, "both ends must occur for this to test anything"


def test_each_client_has_its_own_ring_and_samples_it_with_its_own_stream(point_envs):
    env = FederatedVecEnv(point_envs(2))
    model = FederatedDDPG("MlpPolicy", env, **SMALL)
    buffer = FederatedReplayBuffer(5, env.observation_space, env.action_space, n_clients=2)
    for step in range(8):
        value = np.array([[step], [100 + step]], dtype=np.float32)
        rows = np.repeat(value[..., None], 3, axis=2)
        buffer.add(rows, rows + 0.5, rows[..., :2], value, value > 105)
    assert buffer.sizes.tolist() == [5, 5] and buffer.positions.tolist() == [3, 3]
    data = buffer.sample(400, enumerate([np.random.default_rng(0), np.random.default_rng(1)]), model.normalizer)
    assert data.observations.shape == (2, 400, 3) and data.actions.shape == (2, 400, 2)
    for client, offset in enumerate((0, 100)):
        assert set(data.rewards[client].tolist()) == {offset + step for step in range(3, 8)}
        expected = np.arange(8)[[5, 6, 7, 3, 4]][np.random.default_rng(client).integers(0, 5, 400)] + offset
        np.testing.assert_array_equal(data.rewards[client].numpy(), expected)
    np.testing.assert_array_equal(data.observations[..., 0].numpy(), data.rewards.numpy())
    np.testing.assert_array_equal(data.next_observations[..., 1].numpy(), data.rewards.numpy() + 0.5)
    np.testing.assert_array_equal(data.terminations.numpy(), (data.rewards > 105).float().numpy())


@pytest.mark.parametrize(
    ("n_envs", "train_freq", "gradient_steps", "expected"), [(1, 1, 1, 32), (2, 1, 1, 15 + 1), (2, 1, -1, 32), (1, 4, 2, 16)]
)
def test_warm_up_counts_each_clients_own_steps(point_envs, n_envs, train_freq, gradient_steps, expected):
    options = {"n_envs_per_client": n_envs, "train_freq": train_freq, "gradient_steps": gradient_steps}
    model = FederatedDDPG("MlpPolicy", point_envs(3), **SMALL, **options)
    model.learn(3 * model.rollout_size)
    assert model._n_updates == expected


def test_noise_equals_sb3(monkeypatch):
    normal = np.random.default_rng(0).standard_normal((50, 1, 1, 2))
    draws = iter(normal[:, 0, 0])
    monkeypatch.setattr(np.random, "normal", lambda size: next(draws))
    ours = OrnsteinUhlenbeckNoise((1, 1, 2), theta=0.15, sigma=0.2, dt=0.5)
    theirs = OrnsteinUhlenbeckActionNoise(np.zeros(2), np.full(2, 0.2), theta=0.15, dt=0.5, dtype=np.float64)
    for row in normal:
        np.testing.assert_allclose(ours(row)[0, 0], theirs(), rtol=1e-12)


def test_noise_is_each_clients_own(point_envs):
    n = 20_000
    model = FederatedDDPG("MlpPolicy", point_envs(2), n_envs_per_client=2, **SMALL)
    walks = np.stack([model.noise(row).copy() for row in model._noise_draws(n)]).reshape(n, -1)
    np.testing.assert_allclose(walks.std(axis=0), 0.2 / np.sqrt(1 - 0.85**2), rtol=0.06)
    np.testing.assert_allclose(walks.mean(axis=0), 0.0, atol=0.04)
    lag = [np.corrcoef(walk[1:], walk[:-1])[0, 1] for walk in walks.T]
    np.testing.assert_allclose(lag, 0.85, atol=0.02)
    correlation = np.corrcoef(walks.T) - np.eye(walks.shape[1])
    assert np.abs(correlation).max() < 0.1, "clients, environments and dimensions must be independent"
    alone = FederatedDDPG("MlpPolicy", point_envs(2), clients=[1], n_envs_per_client=2, **SMALL)
    np.testing.assert_array_equal(
        alone._noise_draws(10)[:, 0],
        FederatedDDPG("MlpPolicy", point_envs(2), n_envs_per_client=2, **SMALL)._noise_draws(10)[:, 1],
    )
    state = model.noise.state.copy()
    model.noise.reset(np.array([[False, True], [False, False]]))
    assert not model.noise.state[0, 1].any()
    np.testing.assert_array_equal(model.noise.state[[0, 1, 1], [0, 0, 1]], state[[0, 1, 1], [0, 0, 1]])
