"""FedAvg: clients' parameters are averaged after every round."""

from __future__ import annotations

from sb3_fedguide.common.federated_ppo import FederatedPPO
from sb3_fedguide.common.parameter_averaging import ParameterAveraging
from sb3_fedguide.settings.arguments import FedAvgArguments
from sb3_fedguide.settings.signatures import takes


class FedAvg(ParameterAveraging, FederatedPPO):
    """PPO with federated averaging of actor and critic; optimiser state stays with its client.

    Paper: https://arxiv.org/abs/1602.05629

    Parameters are those of :class:`~sb3_fedguide.common.parameter_averaging.ParameterAveraging` and of :class:`FederatedPPO`.
    """

    @takes(FedAvgArguments)
    def __init__(self, given: FedAvgArguments) -> None:
        super().__init__(**vars(given))
