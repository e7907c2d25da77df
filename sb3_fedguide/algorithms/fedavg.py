"""FedAvg: clients' parameters are averaged after every round."""

from __future__ import annotations

from typing import Literal, Unpack

from stable_baselines3.common.type_aliases import Schedule

from sb3_fedguide.common.arguments import FederatedPPOArguments
from sb3_fedguide.common.federated_ppo import FederatedPPO
from sb3_fedguide.common.federation import FederationLike, PolicyLike
from sb3_fedguide.common.parameter_averaging import ParameterAveraging
from sb3_fedguide.server.averaging import Aggregator


class FedAvg(ParameterAveraging, FederatedPPO):
    """PPO with federated averaging of actor and critic; optimiser state stays with its client.

    Paper: https://arxiv.org/abs/1602.05629

    ``average``, ``average_every``, ``average_until``, ``aggregator``, ``trim_fraction``, ``server_step``, ``server_momentum``,
    ``mix`` and ``screening`` are those of :class:`~sb3_fedguide.common.parameter_averaging.ParameterAveraging`, all other
    parameters those of :class:`FederatedPPO`.
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
        server_step: float | Literal["exp"] = 1.0,
        server_momentum: float = 0.0,
        mix: float | Schedule = 1.0,
        screening: float = 0.0,
        **ppo: Unpack[FederatedPPOArguments],
    ) -> None:
        self._init_averaging(
            average, average_every, average_until, aggregator, trim_fraction, server_step, server_momentum, mix, screening
        )
        super().__init__(policy, env, **ppo)
