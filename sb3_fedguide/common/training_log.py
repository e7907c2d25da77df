"""The log of one round's ``train()``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch as th
from stable_baselines3.common.utils import explained_variance

if TYPE_CHECKING:
    from stable_baselines3.common.type_aliases import Schedule

    from sb3_fedguide.common.federated_ppo import FederatedPPO


class RoundStatistics:
    """Means over all minibatches of a round, per client."""

    def __init__(self) -> None:
        self._sums: dict[str, th.Tensor] = {}
        self._count = 0

    def add(self, **values: th.Tensor) -> None:
        """One minibatch's statistics, each ``(n_clients,)``."""
        self._count += 1
        for name, value in values.items():
            value = value.detach()
            self._sums[name] = self._sums[name] + value if name in self._sums else value.clone()

    def means(self) -> dict[str, np.ndarray]:
        """``(n_clients,)`` each."""
        return {name: (total / self._count).cpu().numpy() for name, total in self._sums.items()}


def record_training(model: FederatedPPO, statistics: RoundStatistics, schedules: dict[str, Schedule | None]) -> None:
    """SB3's ``train/`` keys as averages over clients, and the most informative ones for each client."""
    buffer = model.rollout_buffer
    means = statistics.means()
    values, returns = buffer.rows(buffer.values), buffer.rows(buffer.returns)
    means["explained_variance"] = np.array([explained_variance(v, r) for v, r in zip(values, returns, strict=True)])
    names = ["approx_kl", "explained_variance", "grad_norm"]
    if model.policy.log_std is not None:
        means["std"] = model.policy.log_std.detach().exp().mean(dim=1).cpu().numpy()
        names.append("std")
    for name, per_client in means.items():
        model.logger.record(f"train/{name}", float(np.mean(per_client[model.present])))
    for name in names:
        for index in np.flatnonzero(model.present):
            model.record_client(model.client_ids[index], name, float(means[name][index]))
    model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")
    for name, schedule in schedules.items():
        if schedule is not None:
            model.logger.record(f"train/{name}", schedule(model._current_progress_remaining))
