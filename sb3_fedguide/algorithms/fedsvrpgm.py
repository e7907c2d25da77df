"""FedSVRPG-M: variance-reduced policy gradients whose momentum is a direction that all clients share."""

from __future__ import annotations

import numpy as np
import torch as th

from sb3_fedguide.algorithms.fedavg import FedAvg
from sb3_fedguide.common.anchors import Parameters, actor_at, snapshot
from sb3_fedguide.common.ppo_policy import ACTOR_PREFIXES, StackedActor
from sb3_fedguide.common.rollout_buffer import FederatedSamples
from sb3_fedguide.server.strategy import Payload
from sb3_fedguide.server.svrpg import DIRECTION
from sb3_fedguide.settings.arguments import FedAvgArguments, FedSVRPGMArguments
from sb3_fedguide.settings.signatures import takes


class FedSVRPGM(FedAvg):
    """FedAvg whose actors follow ``u = beta * g + (1 - beta) * (u_r + g - g_ref)`` instead of their gradient ``g``.

    ``g`` is the ascent gradient of PPO's surrogate at the current policy. ``g_ref`` is that of the same surrogate on the
    same minibatch at the reference policy, with the ratio ``pi_ref / pi_old`` inside the clip. Their difference has less
    noise than ``g``. ``u_r`` is the average of all clients' directions in the round before, zero at first: each client
    uploads the mean of its ``u`` over the round's minibatches, before the norm is clipped. The critic keeps its own gradient,
    and ``max_grad_norm`` bounds both together. ``beta = 1`` is FedAvg; a reference equal to the current policy leaves
    ``beta * g + (1 - beta) * u_r``.

    This is the practical form for PPO: the original takes one SGD step per trajectory, weights ``g_ref`` by the importance
    of the whole trajectory, and its reference is the broadcast before the last.

    Paper: https://arxiv.org/abs/2405.19499

    :param beta: weight of the plain gradient, in [0, 1]
    :param reference_every: rounds between two reference policies; a new one is the client's policy at the start of the
        round: the broadcast, or in the first round the initial policy
    :raises ValueError: for values out of range, and if no policy is averaged

    All other parameters are those of :class:`FedAvg`.
    """

    state_attributes = ("reference", "reference_period", "momentum", "directions")
    reference: Parameters  # theta_ref of each client
    reference_period: np.ndarray  # when each client took it, counted in periods of `reference_every` rounds
    momentum: Parameters  # u_r as each client last received it
    directions: Parameters  # each client's mean u of the last round

    @takes(FedSVRPGMArguments)
    def __init__(self, given: FedSVRPGMArguments) -> None:
        if given.average == "critic":
            raise ValueError(
                "FedSVRPG-M shares the actors' directions, and average='critic' shares no actor; use 'all' or 'actor'"
            )
        self.beta = given.beta
        self.reference_every = given.reference_every
        self._reference_actor: StackedActor | None = None
        self._reference_tensors: dict[str, th.Tensor] = {}
        self._momentum_tensors: dict[str, th.Tensor] = {}
        self._direction_sums: dict[str, th.Tensor] = {}
        self._n_directions = 0
        super().__init__(**given.of(FedAvgArguments))

    def _setup_state(self) -> None:
        super()._setup_state()
        self.hold(
            reference=lambda: snapshot(self.policy, ACTOR_PREFIXES),
            reference_period=lambda: np.full(self.n_clients, -1),
            momentum=self._no_directions,
            directions=self._no_directions,
        )

    def _no_directions(self) -> Parameters:
        return {name: np.zeros_like(array) for name, array in snapshot(self.policy, ACTOR_PREFIXES).items()}

    def upload(self, index: int) -> Payload:
        """Parameters and number of samples as in FedAvg, and ``direction.<actor parameter>``."""
        payload = super().upload(index)
        payload.update({DIRECTION + name: array[index].copy() for name, array in self.directions.items()})
        return payload

    def public_parameters(self) -> Parameters:
        directions = {DIRECTION + name: array for name, array in self._no_directions().items()}
        return {**super().public_parameters(), **directions}

    def receive(self, index: int, broadcast: Payload) -> None:
        super().receive(index, {name: array for name, array in broadcast.items() if not name.startswith(DIRECTION)})
        for name, array in broadcast.items():
            if name.startswith(DIRECTION):
                self.momentum[name.removeprefix(DIRECTION)][index] = array

    def _prepare_training(self) -> None:
        self._refresh_references()
        self._reference_actor, self._reference_tensors = actor_at(self.policy, self.reference)
        self._momentum_tensors = {name: th.as_tensor(array, device=self.device) for name, array in self.momentum.items()}
        self._direction_sums = {name: th.zeros_like(tensor) for name, tensor in self._momentum_tensors.items()}
        self._n_directions = 0
        self._record_ratios()

    def _refresh_references(self) -> None:
        """Renew the references; a client that was absent when the others renewed theirs does so when it is back."""
        current = snapshot(self.policy, ACTOR_PREFIXES)
        period = self.round // self.reference_every
        due = (self.reference_period != period) | (self.round % self.reference_every == 0)
        for index in np.flatnonzero(due & self.present):
            for name, array in current.items():
                self.reference[name][index] = array[index]
            self.reference_period[index] = period

    @th.no_grad()
    def _record_ratios(self) -> None:
        """Staleness of the reference: ``pi_ref / pi_old`` has mean one, but few samples may dominate it."""
        buffer = self.rollout_buffer
        rows = [th.as_tensor(buffer.rows(array), device=self.device) for array in (buffer.observations, buffer.actions)]
        ratio = th.exp(self._at_reference(*rows)[0] - th.as_tensor(buffer.rows(buffer.log_probs), device=self.device))
        effective = ratio.sum(dim=1) ** 2 / (ratio**2).sum(dim=1) / buffer.n_rows
        present = th.as_tensor(self.present, device=self.device)
        self.logger.record("svrpg/effective_sample_share", float(effective[present].mean()))
        self.logger.record("svrpg/reference_ratio_max", float(ratio[present].max()))

    def _at_reference(self, observations: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Log-probabilities of the actions, ``(n_clients, batch)``, and entropies, ``(n_clients,)``, at theta_ref."""
        assert self._reference_actor is not None
        distribution, log_std = self.policy.distribution, self._reference_tensors.get("log_std")
        mean = self._reference_actor(observations)
        return distribution.log_prob(mean, log_std, actions), distribution.entropy(mean, log_std)

    def _reference_gradients(self, data: FederatedSamples) -> dict[str, th.Tensor]:
        """g_ref by parameter: the ascent gradient of :meth:`train`'s objective, at theta_ref."""
        advantages = data.advantages
        if self.normalize_advantage and advantages.shape[1] > 1:
            centred = advantages - advantages.mean(dim=1, keepdim=True)
            advantages = centred / (advantages.std(dim=1, keepdim=True) + 1e-8)
        # Actions come from pi_old, so E[ratio] = 1 for any age of the reference: no cap beyond the surrogate's own.
        log_prob, entropy = self._at_reference(data.observations, data.actions)
        ratio = th.exp(log_prob - data.old_log_prob)
        clip_range = self.clip_range(self._current_progress_remaining)
        clipped = th.clamp(ratio, 1 - clip_range, 1 + clip_range)
        objective = th.min(advantages * ratio, advantages * clipped).mean(dim=1)
        objective = objective + self.ent_coef * entropy
        gradients = th.autograd.grad(objective.sum(), list(self._reference_tensors.values()))
        return dict(zip(self._reference_tensors, gradients, strict=True))

    def _transform_gradients(self, data: FederatedSamples) -> None:
        for name, reference_gradient in self._reference_gradients(data).items():
            descent = self.policy.get_parameter(name).grad
            assert descent is not None
            direction = variance_reduced(-descent, reference_gradient, self._momentum_tensors[name], self.beta)
            self._direction_sums[name] += direction
            descent.copy_(-direction)
        self._n_directions += 1

    def _finish_training(self) -> None:
        for name, total in self._direction_sums.items():
            means = (total / self._n_directions).cpu().numpy()
            self.directions[name][self.present] = means[self.present]

    def _excluded_save_params(self) -> list[str]:
        of_one_round = ["_reference_actor", "_reference_tensors", "_momentum_tensors", "_direction_sums"]
        return [*super()._excluded_save_params(), *of_one_round]


def variance_reduced(gradient: th.Tensor, reference_gradient: th.Tensor, momentum: th.Tensor, beta: float) -> th.Tensor:
    """``u = beta * g + (1 - beta) * (u_r + g - g_ref)``; all of one shape, in the ascent convention."""
    return beta * gradient + (1 - beta) * (momentum + (gradient - reference_gradient))
