"""Gaussian prior, mixture, and the probability-flow ODE against closed forms."""

import math

import numpy as np
import pytest
import torch as th

from sb3_fedguide.priors import GaussianPrior, active_experts, mixture_log_prob, mixture_sample, score_cost
from sb3_fedguide.priors.density import K, flow_sample, noise_angle, ode_log_density

RNG = np.random.default_rng


def gaussian_log_prob(x, mean, covariance):
    difference = x - mean
    return -0.5 * (
        np.einsum("bi,ij,bj->b", difference, np.linalg.inv(covariance), difference)
        + np.linalg.slogdet(covariance)[1]
        + len(mean) * math.log(2 * math.pi)
    )


class AnalyticMixture:
    """One-dimensional Gaussian mixture: densities and velocities at every noise level in closed form."""

    def __init__(self, means, stds, weights):
        self.means, self.stds, self.weights = (th.tensor(v, dtype=th.float64) for v in (means, stds, weights))

    def _terms(self, x, theta):
        variance = (math.cos(theta) * self.stds) ** 2 + math.sin(theta) ** 2
        distance = x - math.cos(theta) * self.means  # x: (batch, 1)
        return variance, distance, self.weights.log() - 0.5 * distance**2 / variance - 0.5 * (2 * math.pi * variance).log()

    def log_prob(self, x, theta):
        return th.logsumexp(self._terms(x, theta)[2], dim=-1)

    def velocity(self, x, theta):
        variance, distance, logits = self._terms(x, theta)
        share, scores = th.softmax(logits, dim=-1), -distance / variance
        score = (share * scores).sum(-1)
        slope = (share * (scores**2 - 1 / variance)).sum(-1) - score**2
        sigma, alpha = math.sin(theta), math.cos(theta)
        return ((-sigma * score - sigma * x[:, 0]) / alpha)[:, None], (-sigma * slope - sigma) / alpha

    def draw(self, n, rng):
        which = rng.choice(len(self.means), n, p=self.weights.numpy())
        return th.tensor(self.means.numpy()[which] + self.stds.numpy()[which] * rng.standard_normal(n))[:, None]


def test_noise_levels_are_those_of_ddpm():
    alpha_bar = np.cumprod(1.0 - np.linspace(1e-4, 2e-2, K))
    ours = np.cos(noise_angle((np.arange(K) + 1) / K)) ** 2
    # The continuous limit: they differ by sum beta^2 / 2 in the logarithm.
    assert np.abs(np.log(ours) - np.log(alpha_bar)).max() < 0.08
    assert np.abs(ours - alpha_bar).max() < 2e-3


def anisotropic(x, theta):
    """Velocity and trace of a three-dimensional Gaussian."""
    mean, std = th.tensor([0.4, -0.3, 0.0], dtype=th.float64), th.tensor([0.1, 0.25, 0.6], dtype=th.float64)
    variance = (math.cos(theta) * std) ** 2 + math.sin(theta) ** 2
    alpha, sigma = math.cos(theta), math.sin(theta)
    trace = (sigma / variance - sigma).sum() / alpha
    return (sigma * (x - alpha * mean) / variance - sigma * x) / alpha, trace.expand(len(x)), mean, variance


def test_ode_density_of_an_analytic_gaussian():
    z = th.tensor(RNG(0).uniform(-3, 3, (500, 3)))
    mean, std = anisotropic(z, 0.5)[2], th.tensor([0.1, 0.25, 0.6], dtype=th.float64)
    x = mean + std * z

    def velocity(y, theta):
        return anisotropic(y, theta)[:2]

    def exact(y, theta):
        variance = anisotropic(y, theta)[3]
        return (-0.5 * (y - math.cos(theta) * mean) ** 2 / variance - 0.5 * (2 * math.pi * variance).log()).sum(-1)

    first, last = float(noise_angle(1 / K)), float(noise_angle(1.0))
    fine = ode_log_density(velocity, x, 32, lambda y: exact(y, last), from_clean=False)
    assert (fine - exact(x, first)).abs().max() < 1e-3
    clean = ode_log_density(velocity, x, 32, lambda y: exact(y, last))
    assert (clean - exact(x, 0.0)).abs().max() < 1e-3
    # What the smallest trained noise level is away from clean, in the corners: from_clean is worth having.
    assert (fine - exact(x, 0.0)).abs().max() > 0.03
    # The defaults: eight steps, or four, and p_1 taken for standard normal.
    assert (ode_log_density(velocity, x, 8) - exact(x, 0.0)).abs().max() < 0.05
    assert (ode_log_density(velocity, x, 4) - exact(x, 0.0)).square().mean().sqrt() < 0.05


def test_ode_density_of_an_analytic_mixture_converges_at_fourth_order():
    mixture = AnalyticMixture([-0.6, 0.5], [0.2, 0.3], [0.4, 0.6])
    x = mixture.draw(1000, RNG(1))
    first, last = float(noise_angle(1 / K)), float(noise_angle(1.0))
    errors = []
    for n_steps in (4, 8, 16, 32):
        log_prob = ode_log_density(mixture.velocity, x, n_steps, lambda y: mixture.log_prob(y, last), from_clean=False)
        errors.append(float((log_prob - mixture.log_prob(x, first)).square().mean().sqrt()))
    assert errors[0] < 0.02 and errors[1] < 2e-3 and errors[3] < 2e-5
    assert errors[2] / errors[3] > 8.0  # 16 in the limit


@pytest.mark.parametrize(("n_steps", "second_order", "tolerance"), [(10, True, 0.02), (50, False, 0.012), (30, True, 0.003)])
def test_flow_samples_an_analytic_mixture(n_steps, second_order, tolerance):
    mixture = AnalyticMixture([-0.6, 0.5], [0.1, 0.2], [0.4, 0.6])
    # The flow is monotone in one dimension, so evenly spread quantiles of the noise show its own error without sampling noise.
    quantiles = (np.arange(5000) + 0.5) / 5000
    noise = th.special.ndtri(th.tensor(quantiles))[:, None]
    samples = np.sort(flow_sample(lambda x, t: mixture.velocity(x, t)[0], noise, n_steps, second_order)[:, 0].numpy())
    cdf = (mixture.weights * th.special.ndtr((th.tensor(samples)[:, None] - mixture.means) / mixture.stds)).sum(-1).numpy()
    assert np.abs(cdf - quantiles).max() < tolerance


def test_zero_steps_are_refused():
    with pytest.raises(ValueError, match="n_steps=0"):
        ode_log_density(anisotropic, th.zeros(1, 3), 0)
    with pytest.raises(ValueError, match="n_steps=0"):
        flow_sample(lambda x, t: x, th.zeros(1, 3), 0)


def make_gaussian_data(n=4000, seed=0):
    rng = RNG(seed)
    mixing = np.array([[0.3, 0.0], [0.1, 0.2]])
    actions = (np.array([0.5, -0.2]) + rng.standard_normal((n, 2)) @ mixing.T).astype(np.float32)
    return np.zeros((n, 3), np.float32), actions, rng


def test_gaussian_head_is_the_weighted_mean_and_covariance():
    obs, actions, rng = make_gaussian_data()
    weights = rng.random(len(actions))
    prior = GaussianPrior(3, 2)
    head = prior.fit_head(obs, actions, rng, weights)
    mean = np.average(actions, axis=0, weights=weights)
    covariance = np.cov(actions.T.astype(float), aweights=weights, ddof=0)
    got_mean, got_covariance = prior.mean_and_covariance(head)
    np.testing.assert_allclose(got_mean, mean, atol=1e-5)
    np.testing.assert_allclose(got_covariance, covariance, atol=1e-6)
    log_prob = prior.log_prob(head, th.tensor(obs[:50]), th.tensor(actions[:50])).numpy()
    np.testing.assert_allclose(log_prob, gaussian_log_prob(actions[:50], mean, covariance), atol=1e-4)


def test_gaussian_statistics_are_additive_and_scale_free():
    obs, actions, rng = make_gaussian_data(300)
    prior = GaussianPrior(3, 2)
    parts = prior.head_statistics(obs[:100], actions[:100], rng) + prior.head_statistics(obs[100:], actions[100:], rng)
    np.testing.assert_allclose(prior.solve_head(0.3 * parts), prior.fit_head(obs, actions, rng), rtol=1e-5)
    # A row of weight three is the row three times.
    weights = np.ones(300)
    weights[:100] = 3.0
    thrice = 3 * prior.head_statistics(obs[:100], actions[:100], rng) + prior.head_statistics(obs[100:], actions[100:], rng)
    np.testing.assert_allclose(prior.solve_head(thrice), prior.fit_head(obs, actions, rng, weights), rtol=1e-5)


def test_gaussian_covariance_floor():
    obs = np.zeros((10, 3), np.float32)
    actions = np.tile(np.float32([0.3, 0.1]), (10, 1))
    prior = GaussianPrior(3, 2, min_std=0.05)
    mean, covariance = prior.mean_and_covariance(prior.fit_head(obs, actions, RNG(0)))
    np.testing.assert_allclose(mean, [0.3, 0.1], atol=1e-5)
    np.testing.assert_allclose(covariance, 0.05**2 * np.eye(2), rtol=1e-5)


def test_gaussian_average_of_heads_is_average_of_scores():
    prior = GaussianPrior(3, 2)
    heads = []
    for seed in (0, 1):
        obs, actions, rng = make_gaussian_data(200, seed)
        heads.append(prior.fit_head(obs, actions + seed, rng))
    weights = np.array([0.3, 0.7])
    x = th.tensor(RNG(3).normal(size=(20, 2)), dtype=th.float64)

    def score(head):
        mean, covariance = prior.mean_and_covariance(head)
        return -(x.numpy() - mean) @ np.linalg.inv(covariance)

    average = np.tensordot(weights, heads, 1)
    np.testing.assert_allclose(score(average), 0.3 * score(heads[0]) + 0.7 * score(heads[1]), rtol=1e-4, atol=1e-4)


def test_gaussian_score_cost_is_the_mean_squared_score_distance():
    obs, actions, rng = make_gaussian_data()
    prior = GaussianPrior(3, 2)
    own = prior.fit_head(obs, actions, rng)
    experts = np.stack([own, prior.fit_head(obs, actions + 0.4, rng), prior.fit_head(obs, 2 * actions, rng)])
    cost = score_cost(own, experts, prior.feature_moment(obs, actions, rng))

    def score(head):
        mean, covariance = prior.mean_and_covariance(head)
        return -(actions - mean) @ np.linalg.inv(covariance)

    expected = [np.mean(np.sum((score(own) - score(expert)) ** 2, axis=1)) for expert in experts]
    assert cost[0] == 0.0
    np.testing.assert_allclose(cost, expected, rtol=1e-4)


def test_gaussian_samples_have_its_moments():
    obs, actions, rng = make_gaussian_data()
    prior = GaussianPrior(3, 2)
    heads = np.stack([prior.fit_head(obs, actions, rng), prior.fit_head(obs, 0.5 - actions, rng)])
    assignment = np.arange(40_000) % 2
    samples = prior.sample(heads, th.zeros(40_000, 3), RNG(5), assignment).numpy()
    for m in (0, 1):
        mean, covariance = prior.mean_and_covariance(heads[m])
        np.testing.assert_allclose(samples[assignment == m].mean(axis=0), mean, atol=0.01)
        np.testing.assert_allclose(np.cov(samples[assignment == m].T), covariance, atol=0.004)


def test_a_head_that_is_no_gaussian_is_refused():
    prior = GaussianPrior(3, 2)
    head = np.column_stack([np.diag([-1.0, 0.5]), np.zeros(2)]).astype(np.float32)
    with pytest.raises(ValueError, match="no Gaussian"):
        prior.log_prob(head, th.zeros(1, 3), th.zeros(1, 2))
    with pytest.raises(ValueError, match="no Gaussian"):
        prior.sample(head, th.zeros(1, 3), RNG(0))


@pytest.fixture(scope="module")
def experts():
    prior = GaussianPrior(3, 2)
    obs, actions, rng = make_gaussian_data()
    return prior, np.stack([prior.fit_head(obs, s * actions + m, rng) for s, m in ((1, 0), (0.5, -1), (0.7, 1), (1, 2))])


def test_mixture_log_prob_is_logsumexp(experts):
    prior, heads = experts
    row = np.array([0.5, 0.3, 0.2, 0.0])
    x = RNG(1).normal(size=(100, 2)).astype(np.float32)
    dense = sum(
        w * np.exp(gaussian_log_prob(x.astype(float), *prior.mean_and_covariance(head)))
        for w, head in zip(row, heads, strict=True)
    )
    log_prob = mixture_log_prob(prior, heads, row, th.zeros(100, 3), th.tensor(x)).numpy()
    np.testing.assert_allclose(log_prob, np.log(dense), rtol=1e-4, atol=1e-4)


def test_small_weights_are_dropped_and_the_rest_renormalised(experts):
    prior, heads = experts
    row = np.array([0.6, 0.3995, 0.0005, 0.0])
    active, weights = active_experts(row, 4)
    np.testing.assert_array_equal(active, [0, 1])
    np.testing.assert_allclose(weights, np.array([0.6, 0.3995]) / 0.9995)
    x = th.tensor(RNG(1).normal(size=(50, 2)), dtype=th.float32)
    dropped = mixture_log_prob(prior, heads, row, th.zeros(50, 3), x)
    th.testing.assert_close(dropped, mixture_log_prob(prior, heads[:2], weights, th.zeros(50, 3), x))
    everything = mixture_log_prob(prior, heads, row, th.zeros(50, 3), x, min_weight=1e-4)
    assert not th.allclose(dropped, everything, atol=1e-2)


def test_mixture_samples_follow_the_mixture(experts):
    prior, heads = experts
    row = np.array([0.2, 0.5, 0.0, 0.3], dtype=np.float32)
    samples = mixture_sample(prior, heads, row, th.zeros(30_000, 3), RNG(2)).numpy()
    means = [prior.mean_and_covariance(head)[0] for head in heads]
    np.testing.assert_allclose(samples.mean(axis=0), row @ np.array(means), atol=0.03)
    nearest = np.argmin([np.square(samples - mean).sum(axis=1) for mean in means[:2] + means[3:]], axis=0)
    np.testing.assert_allclose(np.bincount(nearest) / len(samples), [0.2, 0.5, 0.3], atol=0.03)
    again = mixture_sample(prior, heads, row, th.zeros(30_000, 3), RNG(2)).numpy()
    np.testing.assert_array_equal(samples, again)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ([0.5, 0.5], "one entry per expert"),
        ([0.5, 0.6, -0.1, 0.0], "sum to one"),
        ([0.5, 0.1, 0.1, 0.1], "sum to one"),
        ([np.nan, 0.5, 0.5, 0.0], "sum to one"),
    ],
)
def test_bad_rows_are_refused(experts, row, message):
    prior, heads = experts
    with pytest.raises(ValueError, match=message):
        mixture_log_prob(prior, heads, np.array(row), th.zeros(1, 3), th.zeros(1, 2))


def test_a_row_without_any_active_expert_is_refused():
    with pytest.raises(ValueError, match="lower it"):
        active_experts(np.full(4, 0.25), 4, min_weight=0.3)


def test_bad_data_is_refused():
    prior = GaussianPrior(3, 2)
    obs, actions, rng = make_gaussian_data(10)
    with pytest.raises(ValueError, match="observations"):
        prior.fit_head(obs[:, :2], actions, rng)
    with pytest.raises(ValueError, match="at least one"):
        prior.fit_head(obs[:0], actions[:0], rng)
    with pytest.raises(ValueError, match="not finite"):
        prior.fit_head(obs, actions * np.nan, rng)
    with pytest.raises(ValueError, match="Weights"):
        prior.fit_head(obs, actions, rng, np.zeros(10))
    with pytest.raises(ValueError, match="assignment"):
        prior.sample(np.zeros((2, *prior.head_shape)), th.zeros(4, 3), rng)
    with pytest.raises(ValueError, match="scaled"):
        prior.head_statistics(obs, actions, rng) * -1.0
    with pytest.raises(ValueError, match="shape"):
        prior.log_prob(np.zeros((3, 3)), th.zeros(4, 3), th.zeros(4, 2))
    with pytest.raises(ValueError, match="score_cost"):
        score_cost(np.zeros((2, 3)), np.zeros((4, 2, 3)), np.zeros((2, 2)))
