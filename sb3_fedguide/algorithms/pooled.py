"""Pooled: one PPO on the data of all clients, the upper bound for every method that shares. It is not federated."""

from __future__ import annotations

from typing import ClassVar

import torch as th

from sb3_fedguide.common.federated_ppo import FederatedPPO
from sb3_fedguide.common.rollout_buffer import FederatedSamples
from sb3_fedguide.offline.pretraining import Pretraining
from sb3_fedguide.settings.arguments import FederatedPPOArguments
from sb3_fedguide.settings.signatures import takes

#: A one-hot client vector as an additional input of both networks: it equals a first-layer bias for each client.
CLIENT_INPUT = ("mlp_extractor.policy_net.0.bias", "mlp_extractor.value_net.0.bias")


class Pooled(FederatedPPO):
    """PPO on the rollouts of all clients together, with one policy whose input includes the client.

    All clients' trajectories are in one place, which no federation allows: as a control, it shows the loss from keeping them
    separate. A minibatch is ``batch_size`` rows of every client. The client vector is one-hot, and its weights are the
    clients' own first-layer biases; all other parameters are shared, so each client takes the mean of the clients' gradients.

    Parameters are those of :class:`FederatedPPO`.

    :raises ValueError: for ``client_fraction`` below 1
    """

    is_federated: ClassVar[bool] = False

    @takes(FederatedPPOArguments)
    def __init__(self, given: FederatedPPOArguments) -> None:
        if given.client_fraction != 1.0:
            raise ValueError("Pooled has all clients' data in every minibatch; leave client_fraction at 1")
        super().__init__(**vars(given))

    @th.no_grad()
    def _pretrain(self, stage: Pretraining) -> None:
        for parameter in self.policy.parameters():  # one network, from the mean of the cloned ones
            parameter.copy_(parameter.mean(dim=0, keepdim=True).expand_as(parameter))

    def _transform_gradients(self, data: FederatedSamples) -> None:
        """The gradient of the mean loss, its norm clipped as a whole."""
        square = th.zeros((), device=self.device)
        gradients = []
        for name, parameter in self.policy.named_parameters():
            gradient = parameter.grad
            assert gradient is not None
            if name in CLIENT_INPUT:
                gradient.div_(self.n_clients)
                square = square + (gradient**2).sum()
            else:
                gradient.copy_(gradient.mean(dim=0, keepdim=True).expand_as(gradient))
                square = square + (gradient[0] ** 2).sum()
            gradients.append(gradient)
        scale = th.clamp(self.max_grad_norm / (square.sqrt() + 1e-6), max=1.0)
        for gradient in gradients:
            gradient.mul_(scale)
