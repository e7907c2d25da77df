"""FedRL: DDPG whose actors and critics are averaged after every round (DDPGAvg)."""

from __future__ import annotations

from typing import ClassVar, Literal, Unpack

import numpy as np
from stable_baselines3.td3.policies import TD3Policy

from sb3_fedguide.common.ddpg_policy import ACTOR_PREFIXES, CRITIC_PREFIXES
from sb3_fedguide.common.ddpg_settings import FederatedDDPGArguments
from sb3_fedguide.common.federated_ddpg import FederatedDDPG
from sb3_fedguide.common.federation import FederationLike
from sb3_fedguide.server.averaging import Averaging
from sb3_fedguide.server.strategy import N_SAMPLES, Payload, Strategy

AVERAGED_PREFIXES = {"all": ACTOR_PREFIXES + CRITIC_PREFIXES, "actor": ACTOR_PREFIXES, "critic": CRITIC_PREFIXES}


class FedRL(FederatedDDPG):
    """DDPG with averaging of actor and critic; the target networks are set to the average.

    Replay buffers, optimiser state and normalisation stay with their client.

    Paper: https://arxiv.org/abs/2204.02634

    :param average: ``"all"``, only the ``"actor"``, or only the ``"critic"``
    :param average_every: average after every so many rounds
    :param average_until: last round after which to average; ``None`` for no end

    All other parameters are those of :class:`FederatedDDPG`.
    """

    shares_policy: ClassVar[bool] = True

    def __init__(
        self,
        policy: str | type[TD3Policy],
        env: FederationLike | None,
        average: Literal["all", "actor", "critic"] = "all",
        average_every: int = 1,
        average_until: int | None = None,
        **ddpg: Unpack[FederatedDDPGArguments],
    ) -> None:
        if average not in AVERAGED_PREFIXES:
            raise ValueError(f"average={average!r} must be one of {', '.join(AVERAGED_PREFIXES)}")
        if average_every < 1:
            raise ValueError(f"average_every={average_every} must be at least 1 round")
        self.average = average
        self.average_every = average_every
        self.average_until = average_until
        super().__init__(policy, env, **ddpg)

    def _make_strategy(self) -> Strategy:
        return Averaging(AVERAGED_PREFIXES[self.average], self.average_every, self.average_until)

    def upload(self, index: int) -> Payload:
        payload: Payload = {
            name: parameter[index].detach().cpu().numpy().copy()
            for name, parameter in self.policy.named_parameters()
            if name.startswith(AVERAGED_PREFIXES[self.average])
        }
        payload[N_SAMPLES] = np.array(self.rollout_size, dtype=np.float32)
        return payload

    def receive(self, index: int, broadcast: Payload) -> None:
        self.policy.load_client(index, broadcast)
        if broadcast:
            self.policy.copy_to_targets(index, AVERAGED_PREFIXES[self.average])
