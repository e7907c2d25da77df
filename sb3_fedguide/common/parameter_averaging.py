"""The client's side of parameter averaging, for learners of any kind."""

from __future__ import annotations

from typing import Literal

import numpy as np

from sb3_fedguide.common.federation import Federation
from sb3_fedguide.server.averaging import (
    Aggregator,
    averaged_prefixes,
    averaging_is_due,
    check_aggregator,
    check_averaging,
)
from sb3_fedguide.server.strategy import N_SAMPLES, Payload


class ParameterAveraging(Federation):
    """Mixin for methods that average policy parameters; optimiser state and normalisation stay with their client."""

    def _init_averaging(
        self,
        average: Literal["all", "actor", "critic"],
        average_every: int,
        average_until: int | None,
        aggregator: Aggregator,
        trim_fraction: float,
    ) -> None:
        """Called by a subclass's constructor, before its base's."""
        check_averaging(average, average_every)
        check_aggregator(aggregator, trim_fraction)
        self.aggregator = aggregator
        self.trim_fraction = trim_fraction
        self.average: Literal["all", "actor", "critic"] = average
        self.average_every = average_every
        self.average_until = average_until

    @property
    def averaged_prefixes(self) -> tuple[str, ...]:
        """How the names of the parameters begin that are averaged."""
        return averaged_prefixes(self.average, self.policy.actor_prefixes, self.policy.critic_prefixes)

    def sends_policy(self, round: int) -> bool:
        return self.average != "critic" and averaging_is_due(round, self.average_every, self.average_until)

    def upload(self, index: int) -> Payload:
        return policy_upload(self, index, self.averaged_prefixes)

    def receive(self, index: int, broadcast: Payload) -> None:
        self.policy.load_client(index, broadcast)


def policy_upload(model: Federation, index: int, prefixes: tuple[str, ...]) -> Payload:
    """Copies of a client's parameters under SB3's names, and the number of samples behind them."""
    payload: Payload = {
        name: parameter[index].detach().cpu().numpy().copy()
        for name, parameter in model.policy.named_parameters()
        if name.startswith(prefixes)
    }
    payload[N_SAMPLES] = np.array(model.rollout_size, dtype=np.float32)
    return payload
