"""FedAvg: clients' parameters are averaged after every round."""

from __future__ import annotations

from typing import ClassVar, Literal, Unpack

import numpy as np

from sb3_fedguide.common.federated_ppo import FederatedPPO, FederatedPPOArguments
from sb3_fedguide.common.federation import FederationLike, PolicyLike
from sb3_fedguide.common.policies import ACTOR_PREFIXES, CRITIC_PREFIXES
from sb3_fedguide.server.averaging import Averaging
from sb3_fedguide.server.strategy import N_SAMPLES, Payload, Strategy

AVERAGED_PREFIXES = {"all": ACTOR_PREFIXES + CRITIC_PREFIXES, "actor": ACTOR_PREFIXES, "critic": CRITIC_PREFIXES}


class FedAvg(FederatedPPO):
    """PPO with federated averaging of actor and critic; optimiser state and normalisation stay with their client.

    Paper: https://arxiv.org/abs/1602.05629

    :param average: ``"all"``, only the ``"actor"`` (with ``log_std``), or only the ``"critic"``
    :param average_every: average after every so many rounds
    :param average_until: last round after which to average; ``None`` for no end

    All other parameters are those of :class:`FederatedPPO`.
    """

    shares_policy: ClassVar[bool] = True

    def __init__(
        self,
        policy: PolicyLike,
        env: FederationLike | None,
        average: Literal["all", "actor", "critic"] = "all",
        average_every: int = 1,
        average_until: int | None = None,
        **ppo: Unpack[FederatedPPOArguments],
    ) -> None:
        if average not in AVERAGED_PREFIXES:
            raise ValueError(f"average={average!r} must be one of {', '.join(AVERAGED_PREFIXES)}")
        if average_every < 1:
            raise ValueError(f"average_every={average_every} must be at least 1 round")
        self.average = average
        self.average_every = average_every
        self.average_until = average_until
        super().__init__(policy, env, **ppo)

    def _make_strategy(self) -> Strategy:
        return Averaging(AVERAGED_PREFIXES[self.average], self.average_every, self.average_until)

    def upload(self, index: int) -> Payload:
        return policy_upload(self, index, AVERAGED_PREFIXES[self.average])

    def receive(self, index: int, broadcast: Payload) -> None:
        self.policy.load_client(index, broadcast)


def policy_upload(model: FederatedPPO, index: int, prefixes: tuple[str, ...]) -> Payload:
    """Copies of a client's parameters under SB3's names, and the number of samples behind them."""
    payload: Payload = {
        name: parameter[index].detach().cpu().numpy().copy()
        for name, parameter in model.policy.named_parameters()
        if name.startswith(prefixes)
    }
    payload[N_SAMPLES] = np.array(model.rollout_size, dtype=np.float32)
    return payload
