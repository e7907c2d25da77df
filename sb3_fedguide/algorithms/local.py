"""Local: every client trains alone, the control of every federated method."""

from __future__ import annotations

from sb3_fedguide.common.federated_ppo import FederatedPPO


class Local(FederatedPPO):
    """PPO on every client without any exchange.

    It shows whether federation helps at all, under the same budget, hyperparameters and warm start.
    Parameters are those of :class:`FederatedPPO`.
    """
