"""OT-MoE: the server's mixture of prior experts, routed by optimal transport (FedGuide, Algorithm 1)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np

from sb3_fedguide.server.strategy import Payload, Strategy

HEAD = "prior.head"
COST_ROW = "prior.cost_row"
EXPERTS = "prior.experts"
MIXTURE_ROW = "prior.mixture_row"

for _backend in ("PYTORCH", "JAX", "CUPY", "TENSORFLOW"):  # importing POT with all its backends takes seconds
    os.environ.setdefault(f"POT_BACKEND_DISABLE_{_backend}", "1")


class TransportPlan(NamedTuple):
    """An entropic transport plan.

    :param mass: ``(n_clients, n_experts)``
    :param marginal_error: the largest deviation of a row or column sum from its marginal
    :param potentials: the logarithms of the scaling vectors, from which the next solve can start
    """

    mass: np.ndarray
    marginal_error: float
    potentials: tuple[np.ndarray, np.ndarray]


def sinkhorn_plan(
    cost: np.ndarray,
    eta: float,
    row_marginal: np.ndarray | None = None,
    column_marginal: np.ndarray | None = None,
    start: tuple[np.ndarray, np.ndarray] | None = None,
) -> TransportPlan:
    """Entropic optimal transport plan (paper, Eq. ot-plan) by POT's log-domain Sinkhorn.

    :param cost: ``(n_clients, n_experts)``, finite, nonnegative, already scaled
    :param eta: entropic regularisation
    :param row_marginal: mu, uniform by default; ``column_marginal``, nu, alike
    :param start: potentials of a similar problem, from which few iterations are left
    :raises ValueError: for costs that are not finite
    :raises RuntimeError: where the marginal error stays above ``1e-4 / n_clients``
    """
    import ot

    cost = np.asarray(cost, dtype=np.float64)
    if not np.isfinite(cost).all():
        raise ValueError("transport costs must be finite: a client's prior head or cost row is broken")
    n, m = cost.shape
    mu = np.full(n, 1 / n) if row_marginal is None else np.asarray(row_marginal, dtype=np.float64)
    nu = np.full(m, 1 / m) if column_marginal is None else np.asarray(column_marginal, dtype=np.float64)
    mass, log = ot.sinkhorn(
        mu,
        nu,
        cost,
        reg=eta,
        method="sinkhorn_log",
        numItermax=10_000,
        stopThr=1e-5 / n,
        log=True,
        warn=False,
        warmstart=start,
    )
    error = float(max(np.abs(mass.sum(1) - mu).max(), np.abs(mass.sum(0) - nu).max()))
    if not error <= 1e-4 / n:
        raise RuntimeError(f"Sinkhorn left a marginal error of {error:.1e} at eta={eta}; use a larger eta")
    return TransportPlan(mass, error, (log["log_u"], log["log_v"]))


def scale_cost(cost: np.ndarray, scaling: Literal["max", "median"]) -> np.ndarray:
    """Costs over their maximum, or over the median of the positive ones; all-zero costs stay zero."""
    positive = cost[cost > 0]
    if not len(positive):
        return np.zeros_like(cost, dtype=np.float64)
    return cost / (positive.max() if scaling == "max" else np.median(positive))


def farthest_points(heads: np.ndarray, n_experts: int, rng: np.random.Generator) -> np.ndarray:
    """First experts: heads chosen one by one, each farthest from those chosen; jittered copies beyond their number.

    The first is the head nearest to the average, so that the choice does not depend on the clients' order.

    :param heads: ``(n_clients, ...)``
    :return: ``(n_experts, ...)``
    """
    flat = heads.reshape(len(heads), -1).astype(np.float64)
    chosen = [int(np.argmin(((flat - flat.mean(0)) ** 2).sum(1)))]
    distance = ((flat - flat[chosen[0]]) ** 2).sum(1)
    while len(chosen) < min(n_experts, len(heads)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, ((flat - flat[chosen[-1]]) ** 2).sum(1))
    experts = heads[chosen].astype(np.float64)
    if n_experts > len(heads):
        copies = experts[np.arange(n_experts - len(heads)) % len(heads)]
        jitter = 1e-2 * heads.std() * rng.standard_normal(copies.shape)
        experts = np.concatenate([experts, copies + jitter])
    return experts.astype(np.float32)


class OTMoE(Strategy):
    """Keeps M expert heads and routes clients to them by an entropic transport plan.

    Before the first round it takes two exchanges: heads come up and the first experts go down, then the clients' cost
    rows come up and the first mixture rows go down. After every round the experts become column-weighted averages of the
    clients' heads (paper, Eq. expert-update) and client i's mixture weights its normalised row (Eq. personalized-prior).
    A client that is absent keeps its row.

    :param n_experts: M
    :param eta: entropic regularisation of the scaled costs
    :param cost: ``"score"``, rows of expected squared score distances that clients compute at home (Eq. ot-cost), or
        ``"param"``, squared distances between heads that the server computes
    :param cost_scaling: divide costs by their ``"max"`` or by the ``"median"`` of the positive ones, which one outlier
        cannot flatten
    :param seed: of the server's own stream, used for jitter where M > N
    """

    def __init__(
        self,
        n_experts: int,
        eta: float = 0.05,
        cost: Literal["score", "param"] = "score",
        cost_scaling: Literal["max", "median"] = "max",
        seed: np.random.SeedSequence | int = 0,
    ) -> None:
        super().__init__()
        if n_experts < 1:
            raise ValueError(f"n_experts={n_experts} must be positive")
        if eta <= 0:
            raise ValueError(f"eta={eta} must be positive: it is the entropic regularisation of the transport plan")
        if cost not in ("score", "param") or cost_scaling not in ("max", "median"):
            raise ValueError(f"cost={cost!r} must be 'score' or 'param', and cost_scaling={cost_scaling!r} 'max' or 'median'")
        self.n_experts, self.eta, self.cost, self.cost_scaling = n_experts, eta, cost, cost_scaling
        self.rng = np.random.default_rng(seed)
        self.experts: np.ndarray | None = None
        self.plan: np.ndarray | None = None
        self.rows: dict[int, np.ndarray] = {}
        self._potentials: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def needs_setup(self) -> bool:
        return self.plan is None

    def aggregate(self, round: int, uploads: Mapping[int, Payload]) -> dict[int, Payload]:
        clients = sorted(uploads)
        heads = np.stack([uploads[client][HEAD] for client in clients])
        if self.experts is None:
            self.experts = farthest_points(heads, self.n_experts, self.rng)
            if self.cost == "score":  # rows need the experts first
                return {client: {EXPERTS: self.experts.copy()} for client in clients}
        raw = self._costs(heads, uploads, clients)
        cost = scale_cost(raw, self.cost_scaling)
        start = self._potentials if self._potentials is not None and len(self._potentials[0]) == len(clients) else None
        self.plan, error, self._potentials = sinkhorn_plan(cost, self.eta, start=start)
        rows = self.plan / self.plan.sum(axis=1, keepdims=True)
        self.rows.update(zip(clients, rows.astype(np.float32), strict=True))
        if round > 0:  # the first plan routes to the seeded experts as they are
            self._update_experts(heads)
        self._measure(cost, rows, error)
        return {client: {EXPERTS: self.experts.copy(), MIXTURE_ROW: self.rows[client]} for client in clients}

    def latest(self, client: int) -> Payload:
        if self.experts is None:
            return {}
        row = {MIXTURE_ROW: self.rows[client]} if client in self.rows else {}
        return {EXPERTS: self.experts.copy(), **row}

    def _costs(self, heads: np.ndarray, uploads: Mapping[int, Payload], clients: list[int]) -> np.ndarray:
        if self.cost == "score":
            return np.stack([uploads[client][COST_ROW] for client in clients]).astype(np.float64)
        assert self.experts is not None
        difference = heads[:, None].astype(np.float64) - self.experts[None]
        return (difference**2).reshape(len(clients), self.n_experts, -1).sum(axis=2)

    def _update_experts(self, heads: np.ndarray) -> None:
        assert self.plan is not None and self.experts is not None
        load = self.plan.sum(axis=0)
        weights = self.plan / np.maximum(load, np.finfo(float).tiny)
        updated = np.einsum("im,i...->m...", weights, heads.astype(np.float64)).astype(np.float32)
        served = load > 1e-12  # an expert that nobody is routed to stays as it is
        self.experts = np.where(served.reshape(-1, *([1] * (heads.ndim - 1))), updated, self.experts)

    def _measure(self, cost: np.ndarray, rows: np.ndarray, error: float) -> None:
        assert self.plan is not None
        entropy = -(rows * np.log(np.maximum(rows, 1e-300))).sum(axis=1)
        load = self.plan.sum(axis=0)
        self.metrics = {
            "effective_experts": float(np.exp(entropy).mean()),
            "expert_load_max": float(load.max() / load.sum()),
            "marginal_error": error,
            "transport_cost": float((self.plan * cost).sum()),
        }
