"""FedGuide: its losses, its baseline, its exchange, and what it reduces to."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th

from fed_envs import FederatedVecEnv
from sb3_fedguide import FedAvg, FedGuide, FedGuideA, FedGuideP, Local
from sb3_fedguide.common import gaussian
from sb3_fedguide.common.ppo_policy import ACTOR_PREFIXES
from sb3_fedguide.common.value_blend import explained_variances, optimal_blend
from sb3_fedguide.priors.base import score_cost
from sb3_fedguide.priors.importance import importance_weights
from sb3_fedguide.server.ot_moe import COST_ROW, HEAD
from sb3_fedguide.server.strategy import N_SAMPLES
from tests.conftest import assert_same_parameters, parameters_of

OFFLINE = {
    "dataset_size": 400,
    "bc_updates": 20,
    "prior_updates": 100,
    "prior_width": 16,
    "dice_updates": 30,
    "dice_width": 16,
    "dice_batch_size": 32,
}


@pytest.fixture
def tiny(small):
    """Constructor arguments with a tiny offline stage."""
    return {**small, "pretraining": OFFLINE}


def hopper():
    return FederatedVecEnv("HopperHard", clients=[1, 4])


ROUND = 2 * 64


def test_gaussian_closed_forms_equal_torch_distributions():
    generator = th.Generator().manual_seed(0)
    mean_p, mean_q, actions = (th.randn(2, 5, 3, generator=generator) for _ in range(3))
    log_std_p, log_std_q = (0.3 * th.randn(2, 3, generator=generator) for _ in range(2))
    p = th.distributions.Normal(mean_p, log_std_p.exp().unsqueeze(1).expand_as(mean_p))
    q = th.distributions.Normal(mean_q, log_std_q.exp().unsqueeze(1).expand_as(mean_q))
    th.testing.assert_close(gaussian.log_prob(mean_p, log_std_p, actions), p.log_prob(actions).sum(-1))
    th.testing.assert_close(gaussian.entropy(log_std_p).unsqueeze(1).expand(2, 5), p.entropy().sum(-1))
    kl = th.distributions.kl_divergence(p, q).sum(-1)
    th.testing.assert_close(gaussian.kl_divergence(mean_p, log_std_p, mean_q, log_std_q), kl)


def test_importance_weights_give_the_known_gradient_on_a_gaussian_pair():
    """d/d mean of E_prior[-log N(a; m, s)] at m = 0 is -prior_mean / s^2; d/d log_std is 1 - E_prior[a^2] / s^2."""
    rng = np.random.default_rng(0)
    n, prior_mean, prior_std = 200_000, 0.6, 0.4
    actions = rng.normal(size=n)
    log_prior = -0.5 * ((actions - prior_mean) / prior_std) ** 2 - np.log(prior_std)
    weights, size = importance_weights(log_prior + 0.5 * actions**2)
    assert np.mean(weights * -actions) == pytest.approx(-prior_mean, abs=0.01)
    assert np.mean(weights * (1 - actions**2)) == pytest.approx(1 - prior_mean**2 - prior_std**2, abs=0.01)
    assert 0.2 * n < size < n


def test_importance_weights_truncate_normalise_and_ignore():
    log_ratio = np.zeros(100)
    log_ratio[0] = 50.0
    weights, size = importance_weights(log_ratio)
    assert weights.mean() == pytest.approx(1.0)
    assert weights[0] == weights.max() and size == pytest.approx(1.0, rel=0.01)
    equal, size = importance_weights(np.full(10, -3.0))
    np.testing.assert_allclose(equal, 1.0)
    assert size == pytest.approx(10)
    half, _ = importance_weights(np.zeros(10), supported=np.arange(10) < 5)
    np.testing.assert_allclose(half, [2.0] * 5 + [0.0] * 5)
    nothing, size = importance_weights(np.zeros(4), supported=np.zeros(4, dtype=bool))
    assert not nothing.any() and size == 0.0


def test_minibatch_prior_loss_averages_to_the_rollouts(tiny):
    model = FedGuideP("MlpPolicy", "Bandit2D", prior_states=None, **{**tiny, "bc_weight": 0.3})
    model.learn(4 * 64)
    with th.no_grad():
        model._prepare_training()
        buffer = model.rollout_buffer
        log_probs = th.as_tensor(buffer.rows(buffer.log_probs))
        whole = -(buffer.extras["prior_weights"] * log_probs).mean(dim=1) * model._prior_weight
        assert th.allclose(buffer.extras["prior_weights"].mean(dim=1), th.ones(4), atol=1e-4)
        parts = []
        rngs = [np.random.default_rng(k) for k in range(4)]
        for data in buffer.get(16, enumerate(rngs)):
            mean = model.policy.actor_mean(data.observations)
            parts.append(model._extra_losses(data, mean, data.old_log_prob)["prior_loss"])
    th.testing.assert_close(th.stack(parts).mean(dim=0), whole)


def test_subsampled_weights_estimate_the_same_loss(tiny):
    model = FedGuideP("MlpPolicy", "Bandit2D", **{**tiny, "rollout_size": 2048})
    model.learn(4 * 2048)
    losses = []
    for states in (None, 512):
        model.prior_states = states
        with th.no_grad():
            model._prepare_training()
            log_probs = th.as_tensor(model.rollout_buffer.rows(model.rollout_buffer.log_probs))
            losses.append(-(model.rollout_buffer.extras["prior_weights"] * log_probs).mean(dim=1))
    th.testing.assert_close(losses[1], losses[0], rtol=0.1, atol=0.1)


@pytest.mark.parametrize("prior_loss", ["snis", "sample"])
def test_prior_term_pulls_the_policy_towards_the_prior(tiny, prior_loss):
    model = FedGuideP(
        "MlpPolicy",
        "Bandit2D",
        prior_loss=prior_loss,
        prior_states=None,
        lambda_prior=5.0,
        **{**tiny, "learning_rate": 3e-3, "rollout_size": 256, "batch_size": 64, "n_epochs": 4},
    )
    model.learn(12 * 4 * 256)
    means, _ = model.predict(np.zeros((4, 2)), deterministic=True)
    peaks = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    assert np.linalg.norm(means - peaks, axis=1).max() < 0.3, means


def test_prior_weight_falls_linearly_from_the_first_round(tiny):
    model = FedGuide("MlpPolicy", hopper(), lambda_prior=0.5, prior_horizon=50, **tiny)
    assert [model.prior_weight(h) for h in (0, 25, 50, 80)] == [0.5, 0.25, 0.0, 0.0]


def test_beta_one_is_the_online_critic_and_blend_is_in_between(tiny):
    model = FedGuide("MlpPolicy", hopper(), beta=1.0, **{**tiny, "rollout_size": 128})
    model.learn(2 * 128)
    buffer = model.rollout_buffer
    advantages = {}
    last = np.zeros((2, 1), dtype=np.float32)
    raw_last, dones = buffer.raw_observations[-1], np.zeros((2, 1), dtype=bool)
    online = super(FedGuide, model)
    online._compute_advantages(last, model._truncation_values(), raw_last, dones)
    expected = buffer.advantages.copy()
    for beta in (1.0, 0.5, 0.0):
        model.beta = beta
        model._compute_advantages(last, model._truncation_values(), raw_last, dones)
        advantages[beta] = buffer.advantages.copy()
    np.testing.assert_allclose(advantages[1.0], expected, atol=1e-5)
    # GAE is linear in the baseline.
    np.testing.assert_allclose(advantages[0.5], (advantages[0.0] + advantages[1.0]) / 2, atol=1e-3)
    assert np.abs(advantages[0.0] - advantages[1.0]).max() > 0.1


def test_dice_values_are_in_the_scale_of_normalised_rewards(tiny):
    model = FedGuide("MlpPolicy", hopper(), **{**tiny, "normalize": True})
    model.learn(ROUND)
    raw = model.rollout_buffer.rows(model.rollout_buffer.raw_observations)[0]
    ratio = model.dice.client_values(0, raw) / model._dice_values(0, raw)
    np.testing.assert_allclose(ratio, model.normalizer.reward_std[0], rtol=1e-4)


def test_optimal_blend_minimises_the_variance():
    rng = np.random.default_rng(0)
    online, noise = rng.normal(size=(3, 500)), rng.normal(size=(3, 500))
    dice = rng.normal(size=(3, 500))
    returns = 0.3 * online + 0.7 * dice + 0.2 * noise
    beta = optimal_blend(returns, online, dice)
    np.testing.assert_allclose(beta, 0.3, atol=0.05)
    grid = np.linspace(0, 1, 101)
    variances = [(returns - b * online - (1 - b) * dice).var(axis=1) for b in grid]
    np.testing.assert_allclose(beta, grid[np.argmin(variances, axis=0)], atol=0.011)
    np.testing.assert_allclose(optimal_blend(returns, online, online + 1.0), 1.0)
    assert (explained_variances(online, online) == 1.0).all()


def test_only_heads_and_cost_rows_leave_a_client(tiny):
    model = FedGuide("MlpPolicy", hopper(), n_experts=3, **tiny)
    model.learn(ROUND)
    payload = model.upload(0)
    assert set(payload) == {HEAD, COST_ROW}
    assert payload[HEAD].shape == (3, 17) and payload[COST_ROW].shape == (3,)
    assert all(array.dtype == np.float32 for array in payload.values())
    np.testing.assert_allclose(
        payload[COST_ROW], score_cost(model.heads[0], model.experts[0], model.score_moments[0]), rtol=1e-5
    )
    assert model.mixture_rows.shape == (2, 3)
    np.testing.assert_allclose(model.mixture_rows.sum(axis=1), 1.0, rtol=1e-5)


def test_param_cost_uploads_the_head_alone(tiny):
    model = FedGuideP("MlpPolicy", "Bandit2D", cost="param", **tiny)
    model.learn(4 * 64)
    assert set(model.upload(0)) == {HEAD}


def test_fedguide_a_averages_actors_when_due(tiny):
    model = FedGuideA("MlpPolicy", hopper(), average_every=2, **tiny)
    model.learn(ROUND)
    first, second = parameters_of(model, 1), parameters_of(model, 4)
    assert all(not th.equal(first[name], second[name]) for name in first if name.startswith("action_net"))
    model.learn(ROUND, reset_num_timesteps=False)
    first, second = parameters_of(model, 1), parameters_of(model, 4)
    for name in first:
        same = th.equal(first[name], second[name])
        assert same == name.startswith(ACTOR_PREFIXES), name
    assert N_SAMPLES in model.upload(0)


def test_adaptation_moves_heads_and_none_does_not(tiny):
    still = FedGuideP("MlpPolicy", hopper(), **tiny)
    still.learn(2 * ROUND)
    moving = FedGuideP("MlpPolicy", hopper(), adapt="advantage", **tiny)
    moving.pretrain()
    np.testing.assert_allclose(moving.heads, still.heads)
    before = moving.heads.copy()
    moving.learn(2 * ROUND)
    assert np.abs(moving.heads - before).max() > 1e-3
    zero = FedGuideP("MlpPolicy", hopper(), adapt="advantage", adapt_weight=0.0, **tiny)
    zero.learn(ROUND)
    np.testing.assert_allclose(zero.heads, before, atol=1e-4)


@pytest.mark.parametrize("normalize", [False, True])
def test_fedguide_p_without_weights_is_local(tiny, normalize):
    args = {**tiny, "normalize": normalize, "bc_weight": 0.3}
    guided = FedGuideP("MlpPolicy", hopper(), lambda_trust=0.0, lambda_prior=0.0, **args).learn(2 * ROUND)
    local = Local("MlpPolicy", hopper(), **args).learn(2 * ROUND)
    for client in (1, 4):
        assert_same_parameters(parameters_of(guided, client), parameters_of(local, client))


def test_fedguide_p_is_fedguide_with_beta_one(tiny):
    a = FedGuide("MlpPolicy", hopper(), beta=1.0, **tiny).learn(2 * ROUND)
    b = FedGuideP("MlpPolicy", hopper(), **tiny).learn(2 * ROUND)
    assert_same_parameters(parameters_of(a, 1), parameters_of(b, 1), tolerance=1e-5)


def test_fedavg_of_one_client_is_local(point_envs, small):
    a = FedAvg("MlpPolicy", point_envs(1), **small).learn(3 * 64)
    b = Local("MlpPolicy", point_envs(1), **small).learn(3 * 64)
    assert_same_parameters(parameters_of(a, 0), parameters_of(b, 0))


def test_fedavg_averages_and_never_is_local(point_envs, small):
    averaged = FedAvg("MlpPolicy", point_envs(3), **small).learn(2 * 3 * 64)
    assert_same_parameters(parameters_of(averaged, 0), parameters_of(averaged, 2))
    never = FedAvg("MlpPolicy", point_envs(3), average_every=3, **small).learn(2 * 3 * 64)
    local = Local("MlpPolicy", point_envs(3), **small).learn(2 * 3 * 64)
    assert_same_parameters(parameters_of(never, 2), parameters_of(local, 2))


def test_behaviour_cloning_weight_blends_from_one_initial_network(tiny):
    weights = {}
    for alpha in (0.0, 0.5, 1.0):
        model = Local("MlpPolicy", hopper(), bc_weight=alpha, **tiny)
        model.pretrain()
        weights[alpha] = parameters_of(model, 1)
    for name in weights[0.0]:
        middle = (weights[0.0][name] + weights[1.0][name]) / 2
        th.testing.assert_close(weights[0.5][name], middle)
        moved = not th.equal(weights[0.0][name], weights[1.0][name])
        assert moved == (name.startswith(ACTOR_PREFIXES) and name != "log_std"), name


def test_save_load_and_go_on(tiny, tmp_path):
    model = FedGuide("MlpPolicy", hopper(), adapt="advantage", normalize=True, bc_weight=0.3, **tiny)
    model.learn(2 * ROUND)
    model.save(tmp_path / "model")
    loaded = FedGuide.load(tmp_path / "model", env=hopper())
    obs = np.random.default_rng(0).normal(size=(2, 11))
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])
    np.testing.assert_array_equal(model.mixture_rows, loaded.mixture_rows)
    np.testing.assert_array_equal(model.dice.client_values(1, obs), loaded.dice.client_values(1, obs))
    loaded.learn(ROUND, reset_num_timesteps=False)
    assert loaded.round == 3 and not loaded.strategy.needs_setup


@pytest.mark.parametrize(
    "settings",
    [{"prior_loss": "elbo"}, {"beta": 1.5}, {"beta": "best"}, {"adapt": "always"}, {"lambda_prior": -1.0}, {"eta": 0.0}],
)
def test_unfit_settings_are_refused(tiny, settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        FedGuide("MlpPolicy", hopper(), **settings, **tiny)
