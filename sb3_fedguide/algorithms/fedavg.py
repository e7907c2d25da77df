"""FedAvg: clients' parameters are averaged after every round."""

from __future__ import annotations

from typing import Literal, Unpack

from sb3_fedguide.common.arguments import FederatedPPOArguments
from sb3_fedguide.common.federated_ppo import FederatedPPO
from sb3_fedguide.common.federation import FederationLike, PolicyLike
from sb3_fedguide.common.parameter_averaging import ParameterAveraging
from sb3_fedguide.server.averaging import Aggregator


class FedAvg(ParameterAveraging, FederatedPPO):
    """PPO with federated averaging of actor and critic; optimiser state and normalisation stay with their client.

    Paper: https://arxiv.org/abs/1602.05629

    :param average: ``"all"``, only the ``"actor"`` (with ``log_std``), or only the ``"critic"``
    :param average_every: average after every so many rounds
    :param average_until: last round after which to average; ``None`` for no end
    :param aggregator: ``"mean"``, or coordinate by coordinate the ``"median"`` or a ``"trimmed_mean"``, which a minority of
        wrong uploads cannot move far; both ignore numbers of samples
    :param trim_fraction: share of the clients that ``"trimmed_mean"`` leaves out at either end

    All other parameters are those of :class:`FederatedPPO`.
    """

    server_method = "fedavg"

    def __init__(
        self,
        policy: PolicyLike,
        env: FederationLike | None,
        average: Literal["all", "actor", "critic"] = "all",
        average_every: int = 1,
        average_until: int | None = None,
        aggregator: Aggregator = "mean",
        trim_fraction: float = 0.25,
        **ppo: Unpack[FederatedPPOArguments],
    ) -> None:
        self._init_averaging(average, average_every, average_until, aggregator, trim_fraction)
        super().__init__(policy, env, **ppo)
