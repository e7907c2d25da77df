"""Diffusion prior: tangents, head fit, score cost, density and sampler, on small trained trunks."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th

from sb3_fedguide.offline.trunk import federated_trunk
from sb3_fedguide.priors import DiffusionPrior, HeadStatistics, mixture_log_prob, mixture_sample, score_cost
from sb3_fedguide.priors.density import THETA_MAX, THETA_MIN, training_angle, uniform_step_angle

RNG = np.random.default_rng
STD = 0.25


def draw(n, action_dim, client, rng):
    """Two modes around a mean that depends on the observation and the client, and the true log-density."""
    obs = rng.uniform(-1, 1, (n, 2)).astype(np.float32)
    centre = np.stack([0.3 * np.sin(2 * obs[:, j % 2]) + 0.3 * (-1) ** client for j in range(action_dim)], axis=1)
    modes = centre + np.array([-0.3, 0.3])[rng.integers(2, size=n)][:, None]
    actions = (modes + STD * rng.standard_normal((n, action_dim))).astype(np.float32)
    terms = [
        -0.5 * ((actions - centre - offset) ** 2).sum(1) / STD**2 - action_dim * math.log(STD * math.sqrt(2 * math.pi))
        for offset in (-0.3, 0.3)
    ]
    return obs, actions, np.logaddexp(*terms) - math.log(2)


def trained(action_dim):
    data = [draw(4000, action_dim, client, RNG(client)) for client in range(2)]
    prior = DiffusionPrior(2, action_dim, width=32, encoder_width=32)
    datasets = [SimpleNamespace(observations=obs, actions=actions) for obs, actions, _ in data]
    prior = federated_trunk(prior, datasets, [RNG(10), RNG(11)], n_updates=1000).prior
    heads = np.stack([prior.fit_head(obs, actions, RNG(20)) for obs, actions, _ in data])
    return prior, heads


@pytest.fixture(scope="module")
def one():
    return trained(1)


@pytest.fixture(scope="module")
def two():
    return trained(2)


@pytest.fixture
def random_prior():
    """Untrained, with biases and moments that are not zero: enough for identities."""
    prior = DiffusionPrior(3, 2, width=16, encoder_width=16, rng=RNG(1))
    with th.no_grad():
        for parameter in prior.trunk.parameters():
            parameter.add_(0.3 * th.from_numpy(RNG(2).standard_normal(parameter.shape)).float())
    prior.set_observation_moments(np.array([1.0, -2.0, 0.0]), np.array([2.0, 0.5, 0.0]))
    rng = RNG(3)
    heads = rng.normal(size=(3, *prior.head_shape)).astype(np.float32)
    obs = (rng.normal(size=(200, 3)) * [2.0, 0.5, 0.0] + [1.0, -2.0, 0.0]).astype(np.float32)
    return prior, heads, obs, rng.uniform(-1, 1, (200, 2)).astype(np.float32)


def test_tangents_are_the_jacobian(random_prior):
    prior, _, obs, actions = random_prior
    trunk = prior.trunk.double()
    encoded = trunk.encoder(prior.standardise(th.tensor(obs)).double())
    for theta in (THETA_MIN, 0.3, THETA_MAX):
        angle = th.tensor(theta, dtype=th.float64)
        phi, tangents = trunk.with_tangents(encoded, th.tensor(actions).double(), angle)
        jacobian = th.func.vmap(th.func.jacfwd(lambda e, a, angle=angle: trunk(e, a, angle), argnums=1))(
            encoded, th.tensor(actions).double()
        )
        th.testing.assert_close(phi, trunk(encoded, th.tensor(actions).double(), angle.expand(len(obs))))
        th.testing.assert_close(tangents, jacobian.permute(2, 0, 1))


def test_average_of_heads_is_average_of_noise_predictions(random_prior):
    prior, heads, obs, actions = random_prior
    weights = np.array([0.2, 0.5, 0.3], dtype=np.float32)
    theta = th.tensor(training_angle(RNG(0).random(len(obs))))
    averaged = prior.predict_noise(np.tensordot(weights, heads, 1), th.tensor(obs), th.tensor(actions), theta)
    each = [prior.predict_noise(head, th.tensor(obs), th.tensor(actions), theta) for head in heads]
    expected = sum(float(w) * eps for w, eps in zip(weights, each, strict=True))
    assert (averaged - expected).abs().max() < 1e-6 * max(float(eps.abs().max()) for eps in each)


def test_score_cost_is_the_monte_carlo_mean(random_prior):
    prior, heads, obs, actions = random_prior
    obs, actions = obs[:20], actions[:20]
    prior.n_draws = 2000
    cost = score_cost(heads[0], heads, prior.feature_moment(obs, actions, RNG(0)))
    assert cost[0] == 0.0
    # Apart from the closed form: independent draws, scores from the noise predictions.
    rng, n = RNG(1), 200_000
    rows = rng.integers(20, size=n)
    theta = uniform_step_angle((rng.permutation(n) + rng.random(n)) / n)
    noise = rng.standard_normal((n, 2))
    noisy = np.cos(theta)[:, None] * actions[rows] + np.sin(theta)[:, None] * noise
    eps = [prior.predict_noise(h, th.tensor(obs[rows]), th.tensor(noisy), th.tensor(theta)).double() for h in heads]
    for m in (1, 2):
        monte_carlo = ((eps[0] - eps[m]) / th.tensor(np.sin(theta))[:, None]).square().sum(1).mean()
        assert cost[m] == pytest.approx(float(monte_carlo), rel=0.03)


def rows_of(prior, obs, actions, rng, n_draws):
    parts = list(prior._noised(obs, actions, rng, n_draws, training_angle))
    return tuple(np.concatenate([part[i] for part in parts]) for i in range(4))


def test_head_is_the_weighted_ridge_solution(random_prior):
    prior, _, obs, actions = random_prior
    weights = RNG(5).random(len(obs))
    head = prior.solve_head(prior.head_statistics(obs, actions, RNG(6), weights, n_draws=7))
    rows, theta, features, velocity = rows_of(prior, obs, actions, RNG(6), 7)
    assert len(rows) == 7 * len(obs)
    # Per row one noise level in each seventh of the range.
    level = np.floor(7 * (np.sqrt(theta) - math.sqrt(THETA_MIN)) / (math.sqrt(THETA_MAX) - math.sqrt(THETA_MIN)))
    assert all(sorted(level[rows == row]) == list(range(7)) for row in (0, 57, 199))
    root = np.sqrt(weights[rows])[:, None]
    penalty = prior.ridge * np.square(root * features).sum() / features.shape[1]
    left = np.vstack([root * features, math.sqrt(penalty) * np.eye(features.shape[1])])
    right = np.vstack([root * velocity, np.zeros((features.shape[1], 2))])
    expected = np.linalg.lstsq(left, right, rcond=None)[0].T
    np.testing.assert_allclose(head, expected, rtol=1e-4, atol=1e-5)


def test_the_velocity_target_is_the_noise_target(random_prior):
    """Where the head predicts the velocity exactly, ``predict_noise`` gives the noise itself."""
    prior, _, obs, actions = random_prior
    rng = RNG(0)
    theta = training_angle(rng.random(len(obs)))
    eps = rng.standard_normal(actions.shape)
    alpha, sigma = np.cos(theta)[:, None], np.sin(theta)[:, None]
    noisy = alpha * actions + sigma * eps
    zero_head = np.zeros(prior.head_shape, np.float32)
    predicted = prior.predict_noise(zero_head, th.tensor(obs), th.tensor(noisy), th.tensor(theta)).numpy()
    np.testing.assert_allclose(predicted + alpha * (alpha * eps - sigma * actions), eps, atol=1e-5)


def test_statistics_are_additive_and_scale_free(random_prior):
    prior, _, obs, actions = random_prior
    first = prior.head_statistics(obs[:80], actions[:80], RNG(0), n_draws=4)
    second = prior.head_statistics(obs[80:], actions[80:], RNG(1), n_draws=12)
    assert (first + second).weight == pytest.approx(len(obs))
    np.testing.assert_allclose(
        prior.solve_head(0.01 * (first + second)), prior.solve_head(first + second), rtol=1e-4, atol=1e-6
    )
    # A row counts once, however often it was drawn.
    a, b = rows_of(prior, obs[:80], actions[:80], RNG(0), 4)[2], rows_of(prior, obs[80:], actions[80:], RNG(1), 12)[2]
    np.testing.assert_allclose((first + 0.5 * second).gram, a.T @ a / 4 + 0.5 * b.T @ b / 12, rtol=1e-9)
    with pytest.raises(ValueError, match="different priors"):
        first + HeadStatistics(np.eye(3), np.zeros((3, 2)), 1.0)
    with pytest.raises(ValueError, match="another prior"):
        prior.solve_head(HeadStatistics(np.eye(3), np.zeros((3, 2)), 1.0))


def test_rows_of_one_fit_are_capped(random_prior):
    prior, _, obs, actions = random_prior
    prior.max_rows = 500
    assert len(rows_of(prior, obs, actions, RNG(0), 20)[0]) == 400  # two draws of each row
    prior.max_rows = 150
    chosen = rows_of(prior, obs, actions, RNG(0), 20)[0]
    assert len(chosen) == len(np.unique(chosen)) == 150
    assert prior.head_statistics(obs, actions, RNG(0)).weight == pytest.approx(len(obs))


def test_everything_is_deterministic_in_its_generator(one):
    prior, heads = one
    obs, actions, _ = draw(300, 1, 0, RNG(0))
    for compute in (
        lambda rng: prior.fit_head(obs, actions, rng),
        lambda rng: prior.feature_moment(obs, actions, rng),
        lambda rng: mixture_sample(prior, heads, np.array([0.5, 0.5]), th.tensor(obs), rng).numpy(),
    ):
        state = th.get_rng_state()
        np.testing.assert_array_equal(compute(RNG(4)), compute(RNG(4)))
        assert np.abs(compute(RNG(4)) - compute(RNG(5))).max() > 0
        assert th.equal(th.get_rng_state(), state)


def test_a_zero_head_is_the_standard_normal(random_prior):
    prior, _, obs, actions = random_prior
    log_prob = prior.log_prob(np.zeros(prior.head_shape), th.tensor(obs), th.tensor(actions))
    expected = th.distributions.Normal(0.0, 1.0).log_prob(th.tensor(actions)).sum(1)
    th.testing.assert_close(log_prob, expected)


def test_observations_are_standardised_inside(random_prior):
    prior, heads, obs, actions = random_prior
    plain = DiffusionPrior(**prior.arguments)
    plain.load_state_dict(prior.state_dict())
    th.testing.assert_close(
        plain.log_prob(heads, th.tensor(obs), th.tensor(actions)), prior.log_prob(heads, th.tensor(obs), th.tensor(actions))
    )
    plain.set_observation_moments(np.zeros(3), np.ones(3))
    standard = (obs - [1.0, -2.0, 0.0]) / [2.0, 0.5, 1.0]
    th.testing.assert_close(
        plain.log_prob(heads, th.tensor(standard), th.tensor(actions)),
        prior.log_prob(heads, th.tensor(obs), th.tensor(actions)),
        rtol=1e-4, atol=1e-4,
    )  # fmt: skip


@pytest.mark.parametrize("action_dim", [1, 2])
def test_density_integrates_to_one(action_dim, request):
    prior, heads = request.getfixturevalue(("one", "two")[action_dim - 1])
    n = 400 if action_dim == 1 else 64
    edges = np.linspace(-2.5, 2.5, n)
    grid = np.stack(np.meshgrid(*[edges] * action_dim), axis=-1).reshape(-1, action_dim).astype(np.float32)
    for obs in ([0.0, 0.0], [0.8, -0.5]):
        log_prob = prior.log_prob(heads, th.tensor([obs]).expand(len(grid), 2), th.tensor(grid))
        integral = log_prob.double().exp().sum(1) * (edges[1] - edges[0]) ** action_dim
        np.testing.assert_allclose(integral, 1.0, atol=0.02)


def test_samples_follow_the_density(one):
    prior, heads = one
    edges = np.linspace(-2.5, 2.5, 1001)
    for obs in ([0.0, 0.0], [0.8, -0.5]):
        row = np.array([0.3, 0.7])
        samples = mixture_sample(prior, heads, row, th.tensor([obs]).expand(10_000, 2), RNG(0), n_steps=20)[:, 0].numpy()
        log_prob = mixture_log_prob(
            prior, heads, row, th.tensor([obs]).expand(1001, 2), th.tensor(edges[:, None]).float(), n_steps=16
        )
        density = log_prob.double().exp().numpy()
        cdf = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(edges))])
        empirical = (np.searchsorted(np.sort(samples), edges)) / len(samples)
        # Kolmogorov-Smirnov: 1.63 / sqrt(n) is the one per cent point.
        assert np.abs(cdf / cdf[-1] - empirical).max() < 0.0163 + 0.005


def test_the_prior_has_learned_its_client(two):
    prior, heads = two
    for client in range(2):
        obs, actions, truth = draw(1000, 2, client, RNG(50 + client))
        own, other = prior.log_prob(heads[[client, 1 - client]], th.tensor(obs), th.tensor(actions)).numpy()
        assert own.mean() > truth.mean() - 0.15
        assert own.mean() > other.mean() + 0.5
        assert np.corrcoef(own, truth)[0, 1] > 0.8


def test_one_expert_per_row(two):
    """Shared trunk passes and chunks change nothing: each row is what its own expert draws from the same noise."""
    prior, heads = two
    obs = th.tensor(draw(2500, 2, 0, RNG(0))[0])
    assignment = RNG(1).integers(2, size=2500)
    together = prior.sample(heads, obs, RNG(2), assignment)
    for m in (0, 1):
        alone = prior.sample(heads[m], obs, RNG(2))
        th.testing.assert_close(together[assignment == m], alone[assignment == m], rtol=1e-4, atol=1e-5)


def test_several_heads_and_chunks_are_one_head_each(two):
    prior, heads = two
    obs, actions, _ = (th.tensor(part) for part in draw(1500, 2, 0, RNG(0)))
    both = prior.log_prob(heads, obs, actions, 4)
    assert both.shape == (2, 1500)
    th.testing.assert_close(both[1], prior.log_prob(heads[1], obs, actions, 4))
    th.testing.assert_close(both[:, 1400:], prior.log_prob(heads, obs[1400:], actions[1400:], 4), rtol=1e-4, atol=1e-4)
    row = np.array([0.25, 0.75])
    mixture = mixture_log_prob(prior, heads, row, obs, actions, n_steps=4)
    expected = np.logaddexp(math.log(0.25) + both[0].numpy(), math.log(0.75) + both[1].numpy())
    np.testing.assert_allclose(mixture.numpy(), expected, rtol=1e-5, atol=1e-5)


def test_four_steps_are_close_to_many(two):
    prior, heads = two
    obs, actions, _ = (th.tensor(part) for part in draw(500, 2, 0, RNG(0)))
    reference = prior.log_prob(heads[0], obs, actions, 64)
    assert (prior.log_prob(heads[0], obs, actions, 4) - reference).square().mean().sqrt() < 0.05
    assert (prior.log_prob(heads[0], obs, actions) - reference).square().mean().sqrt() < 0.01


def test_a_trunk_is_frozen_and_starts_the_same_everywhere():
    state = th.get_rng_state()
    a, b = DiffusionPrior(3, 2), DiffusionPrior(3, 2)
    assert th.equal(th.get_rng_state(), state)
    for name, value in a.state_dict().items():
        assert th.equal(value, b.state_dict()[name])
    assert not any(parameter.requires_grad for parameter in a.parameters())


@pytest.mark.parametrize(
    ("arguments", "message"), [({"width": 0}, "width"), ({"n_ode_steps": 0}, "n_ode_steps"), ({"ridge": 0.0}, "ridge")]
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        DiffusionPrior(3, 2, **arguments)


def test_bad_moments_are_refused():
    prior = DiffusionPrior(3, 2, width=8, encoder_width=8)
    with pytest.raises(ValueError, match="shape"):
        prior.set_observation_moments(np.zeros(2), np.ones(3))
    with pytest.raises(ValueError, match="finite"):
        prior.set_observation_moments(np.array([0.0, np.inf, 0.0]), np.ones(3))
