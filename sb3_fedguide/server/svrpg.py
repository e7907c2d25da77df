"""The server of FedSVRPG-M: averages parameters and the clients' directions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sb3_fedguide.server.averaging import Averaging
from sb3_fedguide.server.strategy import N_SAMPLES, Payload

#: Prefix of a direction's arrays; the rest is the name of the parameter that it belongs to.
DIRECTION = "direction."


class SVRPG(Averaging):
    """``theta += mean_i Delta_i``, which is averaging, and ``u_{r+1} = mean_i u_i``, after the same rounds.

    Parameters are those of :class:`Averaging`.
    """

    @property
    def norm_groups(self) -> tuple[str, ...]:
        return (DIRECTION,)

    def aggregate(self, round: int, uploads: Mapping[int, Payload]) -> dict[int, Payload]:
        broadcasts = super().aggregate(round, uploads)
        taking_part = {client: payload for client, payload in uploads.items() if payload.get(N_SAMPLES, 1) > 0}
        names = [name for name in next(iter(taking_part.values()), {}) if name.startswith(DIRECTION)]
        if not self.is_due(round) or not names:
            return broadcasts
        direction = self._combine(taking_part, names)
        norm, norms = _norm(direction, names), [_norm(payload, names) for payload in taking_part.values()]
        # 1 where all clients agree on the direction, near 0 where they cancel
        self.metrics.update(direction_norm=norm, direction_agreement=norm / max(float(np.mean(norms)), 1e-30))
        self._latest = {**self._latest, **direction}
        for broadcast in broadcasts.values():
            broadcast.update({name: array.copy() for name, array in direction.items()})
        return broadcasts


def _norm(payload: Payload, names: list[str]) -> float:
    return float(np.sqrt(sum(float(np.sum(payload[name] ** 2, dtype=np.float64)) for name in names)))
