"""Quantities of the paper's theory that training does not need; Lemma 2's are in ``common.value_blend``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch as th

from sb3_fedguide.algorithms.fedguide import FedGuide
from sb3_fedguide.common.anchors import Parameters, actor_at, snapshot
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.evaluation import FederatedEvalCallback
from sb3_fedguide.common.federated_ppo import FederatedPPO
from sb3_fedguide.common.ppo_policy import ACTOR_PREFIXES
from sb3_fedguide.priors.base import score_cost
from sb3_fedguide.server.ot_moe import head_costs, scale_cost

#: States per client at which policies are compared.
N_STATES = 256


@th.no_grad()
def policy_divergences(model: FederatedPPO, n_states: int = N_STATES) -> np.ndarray:
    """``E_s KL(pi_i || pi_bar)`` of each client that takes part in the round (paper, Theorem 3, Eq. policy-dispersion).

    ``pi_bar`` has the average of their actors' parameters, each client with its own normalisation of states; the
    expectation is over evenly spaced states of the client's last rollout. The dispersion ``Gamma_pi`` is the mean of the
    returned values, since every client has equally many samples.

    :return: ``(n_present,)``
    """
    buffer = model.rollout_buffer
    chosen = np.linspace(0, buffer.n_rows - 1, min(n_states, buffer.n_rows)).astype(int)
    states = th.as_tensor(buffer.rows(buffer.observations)[:, chosen], device=model.device)
    actor, tensors = actor_at(model.policy, average_actor(model))
    own = model.policy.actor_mean(states), model.policy.log_std
    divergence = model.policy.distribution.kl_divergence(*own, actor(states), tensors.get("log_std"))
    return divergence.mean(dim=1).cpu().numpy()[model.present]


def average_actor(model: FederatedPPO) -> Parameters:
    """The average of the present clients' actor parameters, repeated for every client, ``(n_clients, ...)`` each."""
    parameters = snapshot(model.policy, ACTOR_PREFIXES)
    means = {
        name: array[model.present].mean(axis=0, dtype=np.float64).astype(np.float32) for name, array in parameters.items()
    }
    return {name: np.stack([mean] * model.n_clients) for name, mean in means.items()}


@contextmanager
def averaged(model: FederatedPPO) -> Iterator[None]:
    """Inside this context all clients have the average of the actors; afterwards each has its own again."""
    own = snapshot(model.policy, ACTOR_PREFIXES)
    try:
        _put(model, average_actor(model))
        yield
    finally:
        _put(model, own)


@th.no_grad()
def _put(model: FederatedPPO, parameters: Parameters) -> None:
    for name, array in parameters.items():
        model.policy.get_parameter(name).copy_(th.from_numpy(array))


class CostProxy(NamedTuple):
    """How well distances between heads approximate distances between scores (paper, assumption A5).

    :param error: epsilon_C, the largest difference of the two costs, both scaled as the server does
    :param correlation: over all pairs of a client and an expert; NaN where one of the costs is constant
    """

    error: float
    correlation: float


def compare_costs(param: np.ndarray, score: np.ndarray, scaling: str = "max") -> CostProxy:
    """Of two matrices of transport costs, ``(n_clients, n_experts)`` each.

    :param scaling: as for :func:`~sb3_fedguide.server.ot_moe.scale_cost`
    """
    first, second = (scale_cost(cost.astype(np.float64), scaling) for cost in (param, score))  # type: ignore[arg-type]
    varies = np.ptp(first) > 0 and np.ptp(second) > 0
    correlation = float(np.corrcoef(first.ravel(), second.ravel())[0, 1]) if varies else float("nan")
    return CostProxy(float(np.abs(first - second).max()), correlation)


def cost_proxy(model: FedGuide) -> CostProxy:
    """Costs of ``cost: param`` against those of ``cost: score``, between the clients' heads and their last experts."""
    clients = np.flatnonzero(model.present)
    param = np.concatenate([head_costs(model.heads[i, None], model.experts[i]) for i in clients])
    score = np.stack([score_cost(model.heads[i], model.experts[i], model.score_moments[i]) for i in clients])
    return compare_costs(param, score, model.cost_scaling)


class DiagnosticsCallback(RoundCallback):
    """Logs the policies' dispersion after local training and how the two transport costs compare after the exchange.

    It uses no random stream of training and changes no parameter, so training is the same as without it.

    :param evaluation: this run's evaluation, which comes before this callback; with it, the average of the policies is
        evaluated in the same rounds if the method itself sends no policy (Theorem 3's other side)
    """

    def __init__(self, evaluation: FederatedEvalCallback | None = None) -> None:
        super().__init__()
        self.evaluation = evaluation

    def _on_local_training_end(self) -> None:
        if not isinstance(self.model, FederatedPPO):
            return
        self.logger.record("federated/policy_dispersion", float(policy_divergences(self.model).mean()))
        round = self.model.round + 1
        if self.evaluation is not None and self.evaluation.is_due(round) and not self.model.sends_policy(round):
            with averaged(self.model):
                average = self.evaluation.run().average
            self.logger.record("eval/averaging_change", average - self.evaluation.last["deployed"].average)

    def _on_round_end(self) -> None:
        if isinstance(self.model, FedGuide):
            proxy = cost_proxy(self.model)
            self.logger.record("federated/cost_proxy_error", proxy.error)
            self.logger.record("federated/cost_proxy_correlation", proxy.correlation)
