"""OT-MoE: the server's mixture of prior experts, routed by optimal transport (FedGuide, Algorithm 1)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from sb3_fedguide.server.strategy import Payload, Strategy
from sb3_fedguide.server.validation import FEWEST_NORMS
from sb3_fedguide.settings.arguments import CostScaling, FedGuideArguments, TransportCost
from sb3_fedguide.settings.ranges import check_values
from sb3_fedguide.settings.signatures import types_of

HEAD = "prior.head"
COST_ROW = "prior.cost_row"
EXPERTS = "prior.experts"
MIXTURE_ROW = "prior.mixture_row"

# POT checks the marginals in its first and every tenth iteration after it.
_ITERATIONS, _MAX_RUNS = 11, 900
_DAMPING = 0.01

#: A head looks wrong if its agreement with the others is lower than the clients' median by more than this. Honest heads were
#: at most 0.35 below it; random and negated ones at least 0.5 from the first round on, and mostly before (docs/robustness.md).
LEAST_AGREEMENT = 0.5

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
    """Entropic optimal transport plan (paper, Eq. 8) by POT's log-domain Sinkhorn.

    Near a permutation the iterations converge like ``1 / k``: thousands of them. So POT iterates in short runs. Each run
    starts from the last one's potentials after a Newton step (:func:`_newton_step`), which replaces many iterations. The
    returned plan comes from POT, and its marginals are checked here.

    :param cost: ``(n_clients, n_experts)``, finite, nonnegative, already scaled
    :param eta: entropic regularisation
    :param row_marginal: mu, uniform by default; ``column_marginal``, nu, alike
    :param start: potentials of a similar problem, from which few iterations are left
    :raises ValueError: for costs that are not finite
    :raises RuntimeError: if the marginal error stays above ``1e-4 / n_clients``
    """
    import ot

    cost = np.asarray(cost, dtype=np.float64)
    if not np.isfinite(cost).all():
        raise ValueError("transport costs must be finite: a client's prior head or cost row is broken")
    n, m = cost.shape
    mu = np.full(n, 1 / n) if row_marginal is None else np.asarray(row_marginal, dtype=np.float64)
    nu = np.full(m, 1 / m) if column_marginal is None else np.asarray(column_marginal, dtype=np.float64)
    scaled = cost / eta
    for _ in range(_MAX_RUNS):
        with np.errstate(over="ignore"):  # POT also returns exp(potentials), which may be beyond what a float holds
            mass, log = ot.sinkhorn(
                mu,
                nu,
                cost,
                reg=eta,
                method="sinkhorn_log",
                numItermax=_ITERATIONS,
                stopThr=1e-5 / n,
                log=True,
                warn=False,
                warmstart=start,
            )
        potentials = log["log_u"], log["log_v"]
        if log["err"][-1] < 1e-5 / n:
            break
        start = _newton_step(scaled, mu, nu, mass, potentials)
    error = float(max(np.abs(mass.sum(1) - mu).max(), np.abs(mass.sum(0) - nu).max()))
    if not error <= 1e-4 / n:
        raise RuntimeError(f"Sinkhorn left a marginal error of {error:.1e} at eta={eta}; use a larger eta")
    return TransportPlan(mass, error, potentials)


def _newton_step(
    scaled_cost: np.ndarray, mu: np.ndarray, nu: np.ndarray, mass: np.ndarray, potentials: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Potentials after a Newton step on the dual of the columns, with exact rows; unchanged if the step does not help.

    With the row potentials eliminated, the dual is concave in the M column potentials. Its gradient is the columns' marginal
    error, its Hessian is ``-(diag(q) - P^T diag(1 / mu) P)`` with ``q = P^T 1``. The damping vanishes with the error, so that
    the step converges quadratically, and it keeps a step finite where the plan is a permutation and the Hessian vanishes.

    :param scaled_cost: the costs over eta
    :param mass: the plan of ``potentials``, whose rows sum to ``mu``
    """
    columns = mass.sum(axis=0)
    missing = nu - columns
    error = np.linalg.norm(missing)
    hessian = np.diag(columns) - mass.T @ (mass / mu[:, None])
    step = np.linalg.solve(hessian + _DAMPING * error * np.eye(len(nu)), missing)
    for length in (1.0, 0.25, 0.0625):
        log_v = potentials[1] + length * step
        log_kernel = log_v - scaled_cost
        peak = log_kernel.max(axis=1, keepdims=True)
        kernel = np.exp(log_kernel - peak)
        total = kernel.sum(axis=1)
        if np.linalg.norm(nu - (mu / total) @ kernel) < error:
            return np.log(mu / total) - peak[:, 0], log_v
    return potentials


def head_costs(heads: np.ndarray, experts: np.ndarray) -> np.ndarray:
    """Squared distances between heads ``(n_clients, ...)`` and experts ``(n_experts, ...)``, ``(n_clients, n_experts)``."""
    flat = heads.reshape(len(heads), -1).astype(np.float64)
    # One expert after the other: all differences at once are n_clients * n_experts heads.
    return np.stack([((flat - expert.reshape(-1)) ** 2).sum(axis=1) for expert in experts], axis=1)


def head_oddity(heads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cosine of each head and the heads' median, taken coordinate by coordinate, and its distance from that median.

    :param heads: ``(n_clients, ...)``
    :return: ``(n_clients,)`` in [-1, 1], and ``(n_clients,)``
    """
    flat = heads.reshape(len(heads), -1)
    median = np.median(flat, axis=0).astype(np.float64)
    agreement, distance = np.empty(len(flat)), np.empty(len(flat))
    for i, head in enumerate(flat):  # not all differences at once, see head_costs
        length = np.linalg.norm(head) * np.linalg.norm(median)
        agreement[i] = head @ median / length if length > 0 else 0.0
        distance[i] = np.linalg.norm(head - median)
    return agreement, distance


def given_heads(plan: np.ndarray) -> np.ndarray:
    """The share of every client's head in each client's mixture.

    Client j's mixture weighs expert m with ``P_jm / sum_m P_jm``, and that expert weighs client i's head with
    ``P_im / sum_i P_im`` (paper, Eq. 9 and 10).

    :param plan: ``(n_clients, n_experts)``
    :return: the share of head i in client j's mixture at [j, i], ``(n_clients, n_clients)``; rows sum to one
    """
    rows = plan / plan.sum(axis=1, keepdims=True)
    columns = plan / np.maximum(plan.sum(axis=0), np.finfo(float).tiny)
    return rows @ columns.T


def head_shares(plan: np.ndarray) -> np.ndarray:
    """The mean share of each client's head in the other clients' mixtures: ``1 / n_clients`` if all share equally.

    :param plan: ``(n_clients, n_experts)``, see :func:`given_heads`
    :return: ``(n_clients,)``
    """
    given = given_heads(plan)
    return (given.sum(axis=0) - np.diag(given)) / (len(plan) - 1)


def scale_cost(cost: np.ndarray, scaling: CostScaling) -> np.ndarray:
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

    Before the first round it needs two exchanges: clients upload heads and receive the first experts, then they upload cost
    rows and receive the first mixture rows. After every round the experts become column-weighted averages of the
    clients' heads (paper, Eq. 9) and client i's mixture weights its normalised row (Eq. 10).
    A client that is absent keeps its row.

    :param n_experts: M
    :param eta: entropic regularisation of the scaled costs
    :param cost: ``"score"``, rows of expected squared score distances, computed at the client (Eq. 7), or ``"param"``,
        squared distances between heads, computed at the server
    :param cost_scaling: divide costs by their ``"max"`` or by the ``"median"`` of the positive ones, which is robust to
        one outlier
    :param seed: of the server's own stream, used for jitter where M > N
    """

    def __init__(
        self,
        n_experts: int,
        eta: float = FedGuideArguments.eta,
        cost: TransportCost = FedGuideArguments.cost,
        cost_scaling: CostScaling = FedGuideArguments.cost_scaling,
        seed: np.random.SeedSequence | int = 0,
    ) -> None:
        super().__init__()
        check_values(types_of(FedGuideArguments), locals())
        self.n_experts, self.eta, self.cost, self.cost_scaling = n_experts, eta, cost, cost_scaling
        self.rng = np.random.default_rng(seed)
        self.experts: np.ndarray | None = None
        self.plan: np.ndarray | None = None
        #: clients of the plan's rows
        self.routed: list[int] = []
        self.rows: dict[int, np.ndarray] = {}
        self._potentials: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def needs_setup(self) -> bool:
        return self.plan is None

    @property
    def norm_groups(self) -> tuple[str, ...]:
        return (HEAD, COST_ROW)

    def aggregate(self, round: int, uploads: Mapping[int, Payload]) -> dict[int, Payload]:
        clients = sorted(uploads)
        heads = np.stack([uploads[client][HEAD] for client in clients])
        if self.experts is None:
            self.experts = farthest_points(heads, self.n_experts, self.rng)
            if self.cost == "score":  # rows need the experts first
                experts = self._broadcast_experts()
                return {client: {EXPERTS: experts} for client in clients}
        raw = self._costs(heads, uploads, clients)
        cost = scale_cost(raw, self.cost_scaling)
        start = self._potentials if self._potentials is not None and len(self._potentials[0]) == len(clients) else None
        self.plan, error, self._potentials = sinkhorn_plan(cost, self.eta, start=start)  # Eq. 8, the transport plan
        self.routed = clients
        rows = self.plan / self.plan.sum(axis=1, keepdims=True)  # Eq. 10, weights of the personal prior
        self.rows.update(zip(clients, rows.astype(np.float32), strict=True))
        self._look_at_heads(clients, heads)
        if round > 0:  # the first plan routes to the seeded experts as they are
            self._update_experts(heads)
        self._measure(cost, rows, error)
        experts = self._broadcast_experts()
        return {client: {EXPERTS: experts, MIXTURE_ROW: self.rows[client]} for client in clients}

    def latest(self, client: int) -> Payload:
        if self.experts is None:
            return {}
        # A client that is new to the server has no experts yet.
        row = self.rows.get(client, np.full(self.n_experts, 1 / self.n_experts, dtype=np.float32))
        return {EXPERTS: self.experts.copy(), MIXTURE_ROW: row}

    def _broadcast_experts(self) -> np.ndarray:
        """The current experts, one read-only array for all clients."""
        assert self.experts is not None
        experts = self.experts.copy()
        experts.flags.writeable = False
        return experts

    def _costs(self, heads: np.ndarray, uploads: Mapping[int, Payload], clients: list[int]) -> np.ndarray:
        if self.cost == "score":
            return np.stack([uploads[client][COST_ROW] for client in clients]).astype(np.float64)
        assert self.experts is not None
        return head_costs(heads, self.experts)

    def _update_experts(self, heads: np.ndarray) -> None:
        assert self.plan is not None and self.experts is not None
        load = self.plan.sum(axis=0)
        weights = self.plan / np.maximum(load, np.finfo(float).tiny)
        # Eq. 9, expert update
        updated = np.tensordot(weights, heads.astype(np.float64), axes=(0, 0)).astype(np.float32)
        served = load > 1e-12  # an expert that nobody is routed to stays as it is
        self.experts = np.where(served.reshape(-1, *([1] * (heads.ndim - 1))), updated, self.experts)

    def _look_at_heads(self, clients: list[int], heads: np.ndarray) -> None:
        """Warn of heads unlike the others, with their share in the other mixtures; the check of norms does not find them."""
        assert self.plan is not None
        if len(clients) < FEWEST_NORMS:
            return
        (agreement, distance), shares = head_oddity(heads), head_shares(self.plan)
        measured = {"head_agreement": agreement, "head_distance": distance, "head_share": shares}
        for name, values in measured.items():
            self.client_metrics[name] = dict(zip(clients, values.tolist(), strict=True))
        usual = float(np.median(agreement))
        for client, own, share in zip(clients, agreement, shares, strict=True):
            if own < usual - LEAST_AGREEMENT:
                self.doubts[client] = (
                    f"the cosine of its prior head and the median head is {own:.2f}, for the median client {usual:.2f}; "
                    f"the others' priors take {share:.1%} from it (an even share is {1 / len(clients):.1%})"
                )

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
