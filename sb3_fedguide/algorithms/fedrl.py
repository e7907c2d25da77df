"""FedRL: DDPG whose actors and critics are averaged after every round (DDPGAvg)."""

from __future__ import annotations

from sb3_fedguide.common.federated_ddpg import FederatedDDPG
from sb3_fedguide.common.parameter_averaging import ParameterAveraging
from sb3_fedguide.server.strategy import Payload
from sb3_fedguide.settings.arguments import FedRLArguments
from sb3_fedguide.settings.signatures import takes


class FedRL(ParameterAveraging, FederatedDDPG):
    """DDPG with averaging of actor and critic; the target networks are set to the average.

    Replay buffers, optimiser state and normalisation stay with their client.

    Paper: https://arxiv.org/abs/2204.02634

    Parameters are those of :class:`~sb3_fedguide.common.parameter_averaging.ParameterAveraging` and of
    :class:`FederatedDDPG`.
    """

    @takes(FedRLArguments)
    def __init__(self, given: FedRLArguments) -> None:
        super().__init__(**vars(given))

    def receive(self, index: int, broadcast: Payload) -> None:
        super().receive(index, broadcast)
        if broadcast:
            self.policy.copy_to_targets(index, self.averaged_prefixes)
