"""The transport plan where plain Sinkhorn is slow, and a server whose work grows with the number of clients and no faster."""

from __future__ import annotations

import tracemalloc

import numpy as np
import ot
import pytest
from scipy.optimize import root
from scipy.special import logsumexp

from sb3_fedguide.server.ot_moe import EXPERTS, HEAD, OTMoE, _newton_step, head_costs, sinkhorn_plan


def near_permutation(n: int, m: int, near: float, far: float, seed: int = 0) -> np.ndarray:
    """Costs up to ``near`` for a client's own expert and from ``far`` to 1 for the others."""
    rng = np.random.default_rng(seed)
    cost = rng.uniform(far, 1.0, (n, m))
    cost[np.arange(n), rng.permutation(n) % m] = rng.uniform(0.0, near, n)
    return cost


COSTS = {
    "far from all others": near_permutation(8, 8, 0.01, 0.95),
    "some others are near": near_permutation(8, 8, 0.3, 0.4),
    "own and others alike": near_permutation(8, 8, 0.6, 0.5),
    "one outlier": np.where(np.arange(8)[:, None] == 7, 1.0, 0.05 * near_permutation(8, 8, 0.3, 0.4)),
    "more clients than experts": near_permutation(10, 8, 0.3, 0.4),
    "two groups that do not divide": near_permutation(31, 8, 0.1, 0.8),
}


def exact_plan(cost: np.ndarray, eta: float, log_v: np.ndarray) -> np.ndarray:
    """The plan whose columns are right to rounding, by MINPACK's hybrid method from given column potentials."""
    n, m = cost.shape

    def plan(log_v: np.ndarray) -> np.ndarray:
        log_kernel = log_v - cost / eta
        return np.exp(log_kernel - logsumexp(log_kernel, axis=1, keepdims=True)) / n

    # One potential is free; equations in units of the off-diagonal mass would be singular otherwise.
    def columns(rest: np.ndarray) -> np.ndarray:
        return (m * plan(np.append(rest, log_v[-1])).sum(axis=0) - 1.0)[:-1]

    def jacobian(rest: np.ndarray) -> np.ndarray:
        mass = plan(np.append(rest, log_v[-1]))
        return m * (np.diag(mass.sum(axis=0)) - n * mass.T @ mass)[:-1, :-1]

    solution = root(columns, log_v[:-1], jac=jacobian, tol=1e-14)
    mass = plan(np.append(solution.x, log_v[-1]))
    # MINPACK stops where rounding ends its progress, on some processors at 1e-10; plans are compared with 3e-5 / n
    assert np.abs(mass.sum(axis=0) - 1 / m).max() < 1e-7 / n
    return mass


@pytest.fixture
def iterations(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of iterations of every call of POT."""
    counts: list[int] = []
    sinkhorn = ot.sinkhorn

    def counting(*args, **kwargs):
        mass, log = sinkhorn(*args, **kwargs)
        counts.append(log["niter"] + 1)
        return mass, log

    monkeypatch.setattr(ot, "sinkhorn", counting)
    return counts


@pytest.mark.parametrize("eta", [0.05, 0.01])
@pytest.mark.parametrize("name", COSTS)
def test_plan_is_that_of_a_tight_solve_after_few_iterations(name: str, eta: float, iterations: list[int]) -> None:
    cost = COSTS[name]
    n = len(cost)
    mass, error, (log_u, log_v) = sinkhorn_plan(cost, eta)
    assert sum(iterations) <= 300
    assert error <= 1e-5 / n
    # Of the optimal form for whatever marginals it has, and these are right: together the definition of the plan.
    np.testing.assert_allclose(mass, np.exp(log_u[:, None] + log_v - cost / eta), rtol=1e-9)
    np.testing.assert_allclose(mass, exact_plan(cost, eta, log_v), rtol=0, atol=3e-5 / n)


def test_plain_iterations_would_take_thousands() -> None:
    """The reason for the Newton steps: without them POT takes 3,700 iterations, and then agrees."""
    cost = COSTS["some others are near"]
    marginal = np.full(8, 1 / 8)
    plain, log = ot.sinkhorn(
        marginal, marginal, cost, 0.05, method="sinkhorn_log", numItermax=5000, stopThr=1e-5 / 8, log=True, warn=False
    )
    assert log["niter"] > 3000
    np.testing.assert_allclose(sinkhorn_plan(cost, 0.05).mass, plain, rtol=0, atol=1e-4 / 8)


def test_unequal_marginals() -> None:
    rng = np.random.default_rng(0)
    mu, nu = rng.dirichlet(np.full(7, 5.0)), rng.dirichlet(np.full(5, 5.0))
    mass = sinkhorn_plan(rng.uniform(size=(7, 5)), 0.02, mu, nu).mass
    np.testing.assert_allclose(mass.sum(axis=1), mu, atol=1e-5 / 7)
    np.testing.assert_allclose(mass.sum(axis=0), nu, atol=1e-5 / 7)


def test_newton_steps_never_raise_the_error_and_square_it_near_the_solution() -> None:
    rng = np.random.default_rng(0)
    cost, mu, nu = rng.uniform(size=(9, 6)) / 0.05, np.full(9, 1 / 9), np.full(6, 1 / 6)

    def plan_and_error(log_v: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        log_u = np.log(mu) - logsumexp(log_v - cost, axis=1)
        mass = np.exp(log_u[:, None] + log_v - cost)
        return mass, log_u, float(np.linalg.norm(mass.sum(axis=0) - nu))

    solution = sinkhorn_plan(cost * 0.05, 0.05).potentials[1]
    for distance in (0.003, 0.1, 1.0, 5.0, 30.0, 200.0):
        log_v = solution + distance * rng.standard_normal(6)
        mass, log_u, before = plan_and_error(log_v)
        stepped_u, stepped_v = _newton_step(cost, mu, nu, mass, (log_u, log_v))
        _, expected_u, after = plan_and_error(stepped_v)
        np.testing.assert_allclose(stepped_u, expected_u, rtol=1e-9)
        assert after <= before
        if distance < 0.01:
            assert after < 0.05 * before


def test_costs_of_heads_are_squared_distances() -> None:
    rng = np.random.default_rng(0)
    heads, experts = rng.normal(size=(5, 2, 3)).astype(np.float32), rng.normal(size=(4, 2, 3)).astype(np.float32)
    expected = ((heads[:, None].astype(np.float64) - experts[None]) ** 2).sum(axis=(2, 3))
    np.testing.assert_allclose(head_costs(heads, experts), expected, rtol=1e-14)


def test_aggregation_needs_memory_for_heads_and_costs_but_not_for_their_product() -> None:
    rng = np.random.default_rng(0)
    n, m, shape = 2000, 32, (3, 65)
    centres = rng.normal(size=(m, *shape))
    heads = (centres[rng.integers(m, size=n)] + 0.5 * rng.normal(size=(n, *shape))).astype(np.float32)
    server = OTMoE(m, cost="param")
    uploads = {client: {HEAD: head} for client, head in enumerate(heads)}
    server.aggregate(0, uploads)
    tracemalloc.start()
    broadcasts = server.aggregate(1, uploads)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 12 * heads.astype(np.float64).nbytes  # all pairs of a head and an expert would be 32 times the heads
    # What goes down is one array for everybody, which nobody can change for the others or for the server.
    assert broadcasts[0][EXPERTS] is broadcasts[1][EXPERTS]
    with pytest.raises(ValueError, match="read-only"):
        broadcasts[0][EXPERTS][0] = 0.0
    assert not np.shares_memory(broadcasts[0][EXPERTS], server.experts)
