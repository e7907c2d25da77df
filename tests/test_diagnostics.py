"""The quantities of the paper's theory against closed forms, and which policies count as sent."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.logger import KVWriter, Logger

from sb3_fedguide import FedAvg, FedGuide, FedGuideA, Local
from sb3_fedguide.common import gaussian
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.evaluation import FederatedEvalCallback, evaluate_federation
from sb3_fedguide.common.value_blend import advantage_variances, optimal_blend, residual_correlations
from sb3_fedguide.monitoring.diagnostics import DiagnosticsCallback, compare_costs, cost_proxy, policy_divergences
from sb3_fedguide.server.ot_moe import head_costs
from tests.conftest import assert_same_parameters, parameters_of

OFFLINE = {"dataset_size": 50, "bc_updates": 2, "dice_updates": 2, "dice_width": 8, "dice_batch_size": 16}


class Values(KVWriter):
    """Every logged round."""

    def __init__(self) -> None:
        self.rounds: list[dict] = []

    def write(self, key_values, key_excluded, step=0):
        self.rounds.append(dict(key_values))

    def close(self):
        pass


def logged(model, rounds: int, callbacks) -> list[dict]:
    values = Values()
    model.set_logger(Logger(None, [values]))
    model.learn(rounds * model.rollout_size * model.n_participants, callbacks)
    return values.rounds


# Lemma 2


def test_residual_correlation_is_pearsons_and_zero_where_nothing_varies():
    rng = np.random.default_rng(0)
    returns, online, dice = rng.normal(size=(3, 4, 500)).astype(np.float32)
    kappa = residual_correlations(returns, online, dice)
    expected = [np.corrcoef(g - v, phi - v)[0, 1] for g, v, phi in zip(returns, online, dice, strict=True)]
    np.testing.assert_allclose(kappa, expected, atol=1e-6)
    np.testing.assert_allclose(residual_correlations(returns, online, 3 * returns - 2 * online + 7), 1, atol=1e-6)
    np.testing.assert_allclose(residual_correlations(returns, online, 2 * online - returns), -1, atol=1e-6)
    np.testing.assert_array_equal(residual_correlations(returns, online, online + 2), 0)
    np.testing.assert_array_equal(residual_correlations(online + 3, online, dice), 0)


def test_least_variance_of_the_advantage_is_one_minus_kappa_squared():
    """Var(A at beta*) = Var(X) (1 - kappa^2) where beta* lies inside [0, 1], and no other beta does better."""
    rng = np.random.default_rng(1)
    online, noise, truth = rng.normal(size=(3, 5, 400))
    returns = online + truth
    dice = online + np.linspace(0.8, 2.0, 5)[:, None] * truth + noise
    kappa, beta = residual_correlations(returns, online, dice), optimal_blend(returns, online, dice)
    assert ((beta > 0.05) & (beta < 0.95)).all()
    blend = beta[:, None] * online + (1 - beta)[:, None] * dice
    without = advantage_variances(returns, online)
    np.testing.assert_allclose(without, (returns - online).var(axis=1))
    np.testing.assert_allclose(advantage_variances(returns, blend), without * (1 - kappa**2))
    for other in np.linspace(0, 1, 21):
        assert (advantage_variances(returns, other * online + (1 - other) * dice) >= without * (1 - kappa**2) - 1e-12).all()


def test_fedguide_logs_the_quantities_of_lemma_2(small):
    model = FedGuide("MlpPolicy", "Bandit2D", beta=0.3, pretraining=OFFLINE, **small)
    row = logged(model, 1, [])[0]
    buffer = model.rollout_buffer
    returns, online = buffer.rows(buffer.rewards), buffer.rows(buffer.values)  # an episode is one step: G = r
    raw = buffer.rows(buffer.raw_observations)
    dice = np.stack([model._dice_values(i, raw[i]) for i in range(4)])
    kappa = residual_correlations(returns, online, dice)
    assert row["dice/residual_correlation"] == pytest.approx(kappa.mean(), abs=1e-6)
    assert [row[f"client_{k}/residual_correlation"] for k in range(4)] == pytest.approx(list(kappa), abs=1e-6)
    assert row["dice/beta"] == pytest.approx(0.3)
    assert row["dice/beta_optimal"] == pytest.approx(optimal_blend(returns, online, dice).mean())
    assert row["dice/advantage_variance_online"] == pytest.approx((returns - online).var(axis=1).mean(), rel=1e-5)
    blend = returns - 0.3 * online - 0.7 * dice
    assert row["dice/advantage_variance_blend"] == pytest.approx(blend.var(axis=1).mean(), rel=1e-5)


# Theorem 3


def with_gaussians(model, means, log_stds):
    """The model with state-independent policies."""
    with th.no_grad():
        model.policy.action_net.weight.zero_()
        model.policy.action_net.bias.copy_(th.as_tensor(means).reshape(model.policy.action_net.bias.shape))
        model.policy.log_std.copy_(th.as_tensor(log_stds))
    return model


def test_divergence_from_the_averaged_policy_is_the_gaussians_closed_form(point_envs, small):
    rng = np.random.default_rng(0)
    means, log_stds = rng.normal(size=(2, 3, 2)).astype(np.float32)
    model = with_gaussians(Local("MlpPolicy", point_envs(3), **small), means, log_stds)
    std, average_std = np.exp(log_stds), np.exp(log_stds.mean(axis=0))
    gap = means - means.mean(axis=0)
    expected = (np.log(average_std / std) + (std**2 + gap**2) / (2 * average_std**2) - 0.5).sum(axis=1)
    np.testing.assert_allclose(policy_divergences(model), expected, rtol=1e-5)
    model.present = np.array([True, False, True])
    half = 0.5 * (means[0] - means[2])
    with th.no_grad():
        model.policy.log_std.fill_(-1.0)
    np.testing.assert_allclose(policy_divergences(model), (half**2).sum() / (2 * np.exp(-2.0)), rtol=1e-5)


def test_equal_policies_have_no_dispersion_and_states_count(point_envs, small):
    model = Local("MlpPolicy", point_envs(2), **small)
    model.rollout_buffer.observations[:] = np.random.default_rng(0).normal(size=model.rollout_buffer.observations.shape)
    np.testing.assert_allclose(policy_divergences(model), 0, atol=1e-6)
    with th.no_grad():
        model.policy.action_net.weight[0] += 0.5
    assert (policy_divergences(model) > 1e-3).all()
    before = policy_divergences(model, n_states=10_000)
    model.rollout_buffer.observations[:] *= 0
    assert not np.allclose(policy_divergences(model, n_states=10_000), before, rtol=0.05)


def test_the_averaged_policy_is_the_one_that_fedavg_broadcasts(point_envs, small):
    """Gamma_pi after local training is the mean KL between what clients deploy and what they then receive."""

    class Compare(RoundCallback):
        def states(self):
            buffer = self.model.rollout_buffer
            return th.as_tensor(buffer.rows(buffer.observations))

        @th.no_grad()
        def _on_local_training_end(self):
            self.own = self.model.policy.actor_mean(self.states()), self.model.policy.log_std.clone()

        @th.no_grad()
        def _on_round_end(self):
            sent = self.model.policy.actor_mean(self.states()), self.model.policy.log_std
            self.divergence = gaussian.kl_divergence(*self.own, *sent).mean().item()

    model, compare = FedAvg("MlpPolicy", point_envs(3), **small), Compare()
    row = logged(model, 1, [DiagnosticsCallback(), compare])[0]
    assert row["federated/policy_dispersion"] == pytest.approx(compare.divergence, rel=1e-4)
    assert compare.divergence > 1e-6


def test_the_return_change_is_that_between_deployed_and_broadcast_policy(small):
    model = FedGuideA("MlpPolicy", "Bandit2D", average_every=2, pretraining=OFFLINE, **small)
    evaluation = FederatedEvalCallback(n_rounds=5, eval_freq=2, n_episodes=2)
    rows = logged(model, 4, [evaluation])
    assert [("eval/averaging_change" in row, "eval/broadcast_mean_reward" in row) for row in rows] == [
        (False, False), (True, True), (False, False), (True, True),
    ]  # fmt: skip
    for row in (rows[1], rows[3]):
        assert row["eval/averaging_change"] == row["eval/broadcast_mean_reward"] - row["eval/mean_reward"]
    env = model.get_env().copies(2, 1)
    now = evaluate_federation(lambda obs: model.predict(obs, deterministic=True)[0], env)
    assert rows[3]["eval/broadcast_mean_reward"] == now.average == evaluation.last["broadcast"].average


def test_only_policies_that_are_sent_are_evaluated_as_broadcast(point_envs, small, tmp_path):
    path = tmp_path / "evaluations.csv"
    model = FedAvg("MlpPolicy", point_envs(2), average_every=2, average_until=4, **small)
    evaluation = FederatedEvalCallback(n_rounds=6, eval_freq=1, n_episodes=1, csv_path=path)
    logged(model, 6, [evaluation])
    assert sorted(set(re.findall(r"^(\d+),\d+,broadcast", path.read_text(), flags=re.MULTILINE))) == ["2", "4"]
    assert set(evaluation.last) == {"deployed"}, "after round 6 nobody has the policy of round 4"
    assert not FedAvg("MlpPolicy", point_envs(2), average="critic", **small).sends_policy(1)
    assert not any(Local("MlpPolicy", point_envs(2), **small).sends_policy(round) for round in range(5))


def test_the_average_is_evaluated_where_no_policy_is_sent_and_every_client_keeps_its_own(point_envs, small):
    model = Local("MlpPolicy", point_envs(3), **small)
    evaluation = FederatedEvalCallback(n_rounds=1, n_episodes=2)

    class Check(RoundCallback):
        def _on_local_training_end(self):
            self.own = [parameters_of(self.model, client) for client in range(3)]

        def _on_round_end(self):
            for client in range(3):
                assert_same_parameters(self.own[client], parameters_of(self.model, client))

    row = logged(model, 1, [Check(), evaluation, DiagnosticsCallback(evaluation)])[0]
    means = {name: th.stack([parameters_of(model, k)[name] for k in range(3)]).mean(dim=0) for name in parameters_of(model, 0)}
    for client in range(3):
        model.policy.load_client(client, {name: tensor.numpy() for name, tensor in means.items()})
    env = model.get_env().copies(2, 1)
    average = evaluate_federation(lambda obs: model.predict(obs, deterministic=True)[0], env).average
    assert row["eval/averaging_change"] == pytest.approx(average - row["eval/mean_reward"], abs=1e-4)
    assert row["eval/averaging_change"] != 0 and "eval/broadcast_mean_reward" not in row
    without = logged(Local("MlpPolicy", point_envs(2), **small), 1, [evaluation, DiagnosticsCallback()])[0]
    assert "eval/averaging_change" not in without


# The cost proxy


def test_costs_that_are_proportional_agree_and_others_are_compared_after_scaling():
    cost = np.random.default_rng(0).random((4, 3))
    assert compare_costs(5 * cost, cost) == pytest.approx((0, 1))
    assert compare_costs(np.array([[0.0, 2.0], [1.0, 4.0]]), np.array([[0.0, 3.0], [3.0, 12.0]])).error == 0.25
    worse = compare_costs(cost.max() - cost, cost)
    assert worse.correlation == pytest.approx(-1) and 0 < worse.error <= 1
    assert np.isnan(compare_costs(np.ones((2, 2)), cost[:2, :2]).correlation)


def test_param_and_score_cost_agree_exactly_where_features_are_white():
    rng = np.random.default_rng(0)
    heads = rng.normal(size=(3, 2, 5)).astype(np.float32)
    experts = np.tile(rng.normal(size=(4, 2, 5)).astype(np.float32), (3, 1, 1, 1))
    model = SimpleNamespace(
        heads=heads, experts=experts, score_moments=np.tile(np.eye(5), (3, 1, 1)), present=np.ones(3, bool), cost_scaling="max"
    )
    np.testing.assert_allclose(
        head_costs(heads, experts[0]), [[np.sum((h.astype(float) - e) ** 2) for e in experts[0]] for h in heads]
    )
    assert cost_proxy(model) == pytest.approx((0, 1), abs=1e-6)
    model.score_moments = np.tile(np.diag([100.0, 1, 1, 1, 0]), (3, 1, 1))
    assert cost_proxy(model).error > 0.05 and cost_proxy(model).correlation < 0.99
