"""FedProx: federated averaging with a proximal term around the last broadcast."""

from __future__ import annotations

import torch as th

from sb3_fedguide.algorithms.fedavg import FedAvg
from sb3_fedguide.common.anchors import Parameters, snapshot
from sb3_fedguide.common.rollout_buffer import FederatedSamples
from sb3_fedguide.server.strategy import Payload
from sb3_fedguide.settings.arguments import FedAvgArguments, FedProxArguments
from sb3_fedguide.settings.signatures import takes


class AnchoredFedAvg(FedAvg):
    """FedAvg whose clients remember the last broadcast; the base class of methods that stay near it.

    Before the first broadcast a client's anchor is its parameters at the start of its first round. Parameters are those of
    :class:`FedAvg`.
    """

    state_attributes = ("anchor",)

    @takes(FedAvgArguments)
    def __init__(self, given: FedAvgArguments) -> None:
        self.anchor: Parameters = {}  # theta_bar as each client last received it
        super().__init__(**vars(given))

    def _begin_learning(self, environments_were_reset: bool) -> None:
        super()._begin_learning(environments_were_reset)
        self._begin_anchor()

    def _begin_anchor(self) -> None:
        if not self.anchor:
            self.anchor = snapshot(self.policy, self.averaged_prefixes)

    def receive(self, index: int, broadcast: Payload) -> None:
        self._begin_anchor()
        super().receive(index, broadcast)
        for name, array in broadcast.items():
            self.anchor[name][index] = array


class FedProx(AnchoredFedAvg):
    """FedAvg whose clients minimise ``L_PPO + mu / 2 * ||theta - theta_bar||^2``.

    ``theta_bar`` is the last broadcast. The term covers the averaged parameters: by default actor (with ``log_std``) and
    critic.
    ``mu = 0`` is FedAvg.

    Paper: https://arxiv.org/abs/1812.06127 (Eq. 2)

    :param mu: weight of the proximal term
    :raises ValueError: for a negative ``mu``

    All other parameters are those of :class:`FedAvg`.
    """

    @takes(FedProxArguments)
    def __init__(self, given: FedProxArguments) -> None:
        self.mu = given.mu
        self._anchor_tensors: dict[str, th.Tensor] = {}
        super().__init__(**given.of(FedAvgArguments))

    def _prepare_training(self) -> None:
        self._anchor_tensors = {name: th.as_tensor(array, device=self.device) for name, array in self.anchor.items()}

    def _extra_losses(self, data: FederatedSamples, mean: th.Tensor, log_prob: th.Tensor) -> dict[str, th.Tensor]:
        if self.mu == 0:
            return {}
        distance = th.zeros(self.n_clients, device=self.device)
        for name, anchor in self._anchor_tensors.items():
            difference = self.policy.get_parameter(name) - anchor
            distance = distance + (difference**2).flatten(1).sum(dim=1)
        return {"proximal_loss": 0.5 * self.mu * distance}

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_anchor_tensors"]
