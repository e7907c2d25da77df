"""The server's mathematics: averaging, transport, experts."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from sb3_fedguide.server.averaging import Averaging, combine
from sb3_fedguide.server.ot_moe import COST_ROW, EXPERTS, HEAD, MIXTURE_ROW, OTMoE, farthest_points, scale_cost, sinkhorn_plan
from sb3_fedguide.server.strategy import N_SAMPLES, Composite


def random_cost(n, m, seed=0):
    return np.random.default_rng(seed).uniform(size=(n, m))


@pytest.mark.parametrize(("n", "m"), [(8, 8), (10, 8), (4, 7), (1, 3)])
@pytest.mark.parametrize("eta", [0.05, 0.5])
def test_plan_has_its_marginals(n, m, eta):
    plan, error, _ = sinkhorn_plan(random_cost(n, m), eta)
    assert (plan >= 0).all() and error <= 1e-4 / n
    np.testing.assert_allclose(plan.sum(1), 1 / n, atol=1e-6)
    np.testing.assert_allclose(plan.sum(0), 1 / m, atol=1e-6)


def test_plan_limits():
    cost = random_cost(6, 6)
    np.testing.assert_allclose(sinkhorn_plan(cost, 1e4)[0], 1 / 36, rtol=1e-3)
    import ot

    exact = ot.emd(np.full(6, 1 / 6), np.full(6, 1 / 6), cost)
    np.testing.assert_allclose(sinkhorn_plan(cost, 0.003)[0], exact, atol=1e-3)


def test_plan_equals_plain_sinkhorn_iterations():
    cost, eta = random_cost(5, 4), 0.2
    kernel, u, v = np.exp(-cost / eta), np.ones(5), np.ones(4)
    for _ in range(5000):
        u = (1 / 5) / (kernel @ v)
        v = (1 / 4) / (kernel.T @ u)
    np.testing.assert_allclose(sinkhorn_plan(cost, eta)[0], u[:, None] * kernel * v, atol=1e-8)


def test_warm_start_gives_the_same_plan_sooner():
    cost = random_cost(8, 8)
    first = sinkhorn_plan(cost, 0.05)
    nearby = cost + 0.01 * random_cost(8, 8, seed=1)
    cold, warm = sinkhorn_plan(nearby, 0.05), sinkhorn_plan(nearby, 0.05, start=first.potentials)
    np.testing.assert_allclose(warm.mass, cold.mass, atol=1e-5)


def test_plan_refuses_broken_costs_and_unreached_marginals():
    with pytest.raises(ValueError, match="finite"):
        sinkhorn_plan(np.array([[np.nan, 1.0]]), 0.05)
    with pytest.raises(RuntimeError, match="larger eta"):
        sinkhorn_plan(random_cost(30, 30), 1e-9)


def test_cost_scaling():
    cost = np.array([[0.0, 2.0], [4.0, 100.0]])
    assert scale_cost(cost, "max").max() == 1.0
    np.testing.assert_allclose(scale_cost(cost, "median"), cost / 4.0)
    plan, _, _ = sinkhorn_plan(scale_cost(np.zeros((3, 3)), "max"), 0.05)
    np.testing.assert_allclose(plan, 1 / 9)


def test_farthest_points_cover_clusters_whatever_the_order():
    rng = np.random.default_rng(0)
    centres = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    heads = (np.repeat(centres, 3, axis=0) + 0.1 * rng.normal(size=(9, 2))).astype(np.float32)
    order = rng.permutation(9)
    chosen = farthest_points(heads, 3, np.random.default_rng(1))
    nearest = {int(np.argmin(((centres - head) ** 2).sum(1))) for head in chosen}
    assert nearest == {0, 1, 2}
    np.testing.assert_array_equal(chosen, farthest_points(heads[order], 3, np.random.default_rng(1)))


def test_more_experts_than_clients_are_jittered_copies():
    heads = np.random.default_rng(0).normal(size=(2, 3, 4)).astype(np.float32)
    experts = farthest_points(heads, 5, np.random.default_rng(0))
    assert experts.shape == (5, 3, 4) and len(np.unique(experts.reshape(5, -1), axis=0)) == 5
    assert np.abs(experts[2:4] - experts[:2]).max() < 0.1


def rounds_of(strategy, heads, n_rounds, metric=None):
    """Play the clients of an OT-MoE server whose score cost is the plain squared distance."""
    received = {}
    for round in range(-1, n_rounds + 1):
        uploads = {}
        for client, head in heads.items():
            uploads[client] = {HEAD: head}
            if client in received:
                difference = head[None] - received[client][EXPERTS]
                uploads[client][COST_ROW] = (difference**2).reshape(len(difference), -1).sum(1).astype(np.float32)
        received = strategy.aggregate(max(round, 0), uploads)
    return received


def test_setup_takes_two_exchanges_and_then_has_rows():
    strategy = OTMoE(2)
    heads = {k: np.full((2, 3), float(k), dtype=np.float32) for k in range(3)}
    assert strategy.needs_setup
    first = strategy.aggregate(0, {k: {HEAD: head} for k, head in heads.items()})
    assert strategy.needs_setup and MIXTURE_ROW not in first[0]
    row = np.array([0.1, 0.2], dtype=np.float32)
    second = strategy.aggregate(0, {k: {HEAD: head, COST_ROW: row} for k, head in heads.items()})
    assert not strategy.needs_setup and np.isclose(second[0][MIXTURE_ROW].sum(), 1.0)
    np.testing.assert_array_equal(second[0][EXPERTS], first[0][EXPERTS])


def test_score_and_param_costs_agree_where_they_are_the_same():
    rng = np.random.default_rng(0)
    heads = {k: rng.normal(size=(2, 3)).astype(np.float32) for k in range(5)}
    by_score = rounds_of(OTMoE(3, cost="score"), heads, 3)
    param = OTMoE(3, cost="param")
    for round in range(4):
        by_param = param.aggregate(round, {k: {HEAD: head} for k, head in heads.items()})
    # "param" sees the current experts and "score" those received last; on fixed heads both settle on the same.
    np.testing.assert_allclose(by_score[0][EXPERTS], by_param[0][EXPERTS], atol=1e-5)


def test_experts_are_column_normalised_averages():
    rng = np.random.default_rng(0)
    heads = {k: rng.normal(size=(2, 3)).astype(np.float32) for k in range(4)}
    strategy = OTMoE(3, eta=0.5)
    rounds_of(strategy, heads, 1)
    stacked = np.stack(list(heads.values()))
    expected = np.einsum("im,iab->mab", strategy.plan / strategy.plan.sum(0), stacked)
    np.testing.assert_allclose(strategy.experts, expected, atol=1e-6)
    assert 1.0 < strategy.metrics["effective_experts"] < 3.0


def test_an_expert_that_nobody_is_routed_to_stays():
    heads = np.random.default_rng(0).normal(size=(2, 2, 3)).astype(np.float32)
    strategy = OTMoE(2)
    strategy.experts, strategy.plan = np.ones((2, 2, 3), dtype=np.float32), np.array([[0.5, 0.0], [0.5, 0.0]])
    strategy._update_experts(heads)
    np.testing.assert_allclose(strategy.experts, [heads.mean(axis=0), np.ones((2, 3))], atol=1e-6)


def test_equidistant_heads_give_a_permutation_and_clusters_share():
    heads = {k: 10 * np.eye(4, dtype=np.float32)[k].reshape(2, 2) for k in range(4)}
    strategy = OTMoE(4)
    rounds_of(strategy, heads, 5)
    assert strategy.metrics["effective_experts"] == pytest.approx(1.0, abs=0.01)
    centres = np.array([[0.0, 0.0], [10.0, 0.0]], dtype=np.float32)
    heads = {k: (centres[k % 2] + 0.1 * k).reshape(1, 2) for k in range(8)}
    rounds_of(strategy := OTMoE(8), heads, 5)
    assert strategy.metrics["effective_experts"] > 2.0


def test_absent_client_keeps_its_row():
    rng = np.random.default_rng(0)
    heads = {k: rng.normal(size=(1, 2)).astype(np.float32) for k in range(4)}
    strategy = OTMoE(2, cost="param")
    strategy.aggregate(0, {k: {HEAD: head} for k, head in heads.items()})
    row = strategy.rows[3].copy()
    out = strategy.aggregate(1, {k: {HEAD: heads[k] + 1} for k in (0, 1, 2)})
    assert set(out) == {0, 1, 2}
    np.testing.assert_array_equal(strategy.rows[3], row)


@pytest.mark.parametrize("settings", [{"eta": 0.0}, {"n_experts": 0}, {"cost": "euclid"}, {"cost_scaling": "mean"}])
def test_unfit_settings_are_refused(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        OTMoE(**{"n_experts": 2, **settings})


def upload(value, n, name="action_net.weight"):
    return {name: np.full((2, 2), value, dtype=np.float32), N_SAMPLES: np.float32(n)}


def test_average_is_weighted_by_samples_and_independent_of_order():
    uploads = {0: upload(1.0, 100), 1: upload(3.0, 300)}
    np.testing.assert_allclose(combine(uploads, ["action_net.weight"], "mean", 0.0)["action_net.weight"], 2.5)
    backwards = combine({1: uploads[1], 0: uploads[0]}, ["action_net.weight"], "mean", 0.0)
    np.testing.assert_array_equal(backwards["action_net.weight"], np.full((2, 2), 2.5, dtype=np.float32))


def test_averaging_is_due_when_it_says():
    due = [round for round in range(12) if Averaging(average_every=3, average_until=9).is_due(round)]
    assert due == [3, 6, 9]
    uploads = {0: upload(1.0, 1), 1: upload(3.0, 1)}
    assert Averaging(average_every=5).aggregate(4, uploads) == {0: {}, 1: {}}
    only_critic = Averaging(("value_net.",)).aggregate(1, uploads)
    assert only_critic == {0: {}, 1: {}}


def test_composite_merges_broadcasts():
    heads = {k: {HEAD: np.full((1, 2), k, dtype=np.float32), **upload(k, 1)} for k in range(2)}
    strategy = Composite([OTMoE(2, cost="param"), Averaging(("action_net.",))])
    assert strategy.needs_setup
    out = strategy.aggregate(1, heads)
    assert not strategy.needs_setup
    assert set(out[0]) == {EXPERTS, MIXTURE_ROW, "action_net.weight"}


def test_server_imports_neither_torch_nor_gymnasium():
    import subprocess

    imports = "import sys, sb3_fedguide.server.ot_moe, sb3_fedguide.server.averaging"
    code = f"{imports}; print({{'torch', 'gymnasium'}} & set(sys.modules))"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert printed.strip() == "set()"
