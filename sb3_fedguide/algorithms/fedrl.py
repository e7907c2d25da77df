"""FedRL: DDPG whose actors and critics are averaged after every round (DDPGAvg)."""

from __future__ import annotations

from typing import Literal, Unpack

from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.td3.policies import TD3Policy

from sb3_fedguide.common.arguments import FederatedDDPGArguments
from sb3_fedguide.common.federated_ddpg import FederatedDDPG
from sb3_fedguide.common.federation import FederationLike
from sb3_fedguide.common.parameter_averaging import ParameterAveraging
from sb3_fedguide.server.averaging import Aggregator
from sb3_fedguide.server.strategy import Payload


class FedRL(ParameterAveraging, FederatedDDPG):
    """DDPG with averaging of actor and critic; the target networks are set to the average.

    Replay buffers, optimiser state and normalisation stay with their client.

    Paper: https://arxiv.org/abs/2204.02634

    ``average``, ``average_every``, ``average_until``, ``aggregator``, ``trim_fraction``, ``server_step``, ``server_momentum``,
    ``mix`` and ``screening`` are those of :class:`~sb3_fedguide.common.parameter_averaging.ParameterAveraging`, all other
    parameters those of :class:`FederatedDDPG`.
    """

    server_method = "fedrl"

    def __init__(
        self,
        policy: str | type[TD3Policy],
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
        **ddpg: Unpack[FederatedDDPGArguments],
    ) -> None:
        self._init_averaging(
            average, average_every, average_until, aggregator, trim_fraction, server_step, server_momentum, mix, screening
        )
        super().__init__(policy, env, **ddpg)

    def receive(self, index: int, broadcast: Payload) -> None:
        super().receive(index, broadcast)
        if broadcast:
            self.policy.copy_to_targets(index, self.averaged_prefixes)
