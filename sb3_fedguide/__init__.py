"""Federated reinforcement learning for Stable-Baselines3: FedGuide, its baselines, and a Local control.

A whole federation is one algorithm::

    from sb3_fedguide import FedAvg

    model = FedAvg("MlpPolicy", "Bandit2D", rollout_size=200, seed=0)
    model.learn(total_timesteps=2 * 4 * 200)  # two rounds of four clients
    model.client(3)  # client 3 as an ordinary stable_baselines3.PPO
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_fedguide.algorithms.fedavg import FedAvg
    from sb3_fedguide.algorithms.fedguide import FedGuide, FedGuideA, FedGuideP
    from sb3_fedguide.algorithms.fedguide_r import FedGuideR
    from sb3_fedguide.algorithms.fedkl import FedKL
    from sb3_fedguide.algorithms.fedprox import FedProx
    from sb3_fedguide.algorithms.fedrl import FedRL
    from sb3_fedguide.algorithms.fedsvrpgm import FedSVRPGM
    from sb3_fedguide.algorithms.local import Local
    from sb3_fedguide.algorithms.pooled import Pooled
    from sb3_fedguide.common.evaluation import FederatedEvalCallback, evaluate_federation
    from sb3_fedguide.common.federated_ddpg import FederatedDDPG
    from sb3_fedguide.common.federated_ppo import FederatedPPO
    from sb3_fedguide.monitoring.callbacks import TensorBoardCallback
    from sb3_fedguide.monitoring.diagnostics import DiagnosticsCallback
    from sb3_fedguide.registry import register_algorithm

_LAZY = {
    "register_algorithm": "sb3_fedguide.registry",
    "DiagnosticsCallback": "sb3_fedguide.monitoring.diagnostics",
    "FedAvg": "sb3_fedguide.algorithms.fedavg",
    "FedGuide": "sb3_fedguide.algorithms.fedguide",
    "FedGuideA": "sb3_fedguide.algorithms.fedguide",
    "FedGuideP": "sb3_fedguide.algorithms.fedguide",
    "FedGuideR": "sb3_fedguide.algorithms.fedguide_r",
    "FedKL": "sb3_fedguide.algorithms.fedkl",
    "FedProx": "sb3_fedguide.algorithms.fedprox",
    "FedRL": "sb3_fedguide.algorithms.fedrl",
    "FedSVRPGM": "sb3_fedguide.algorithms.fedsvrpgm",
    "Local": "sb3_fedguide.algorithms.local",
    "Pooled": "sb3_fedguide.algorithms.pooled",
    "TensorBoardCallback": "sb3_fedguide.monitoring.callbacks",
    "FederatedDDPG": "sb3_fedguide.common.federated_ddpg",
    "FederatedEvalCallback": "sb3_fedguide.common.evaluation",
    "FederatedPPO": "sb3_fedguide.common.federated_ppo",
    "evaluate_federation": "sb3_fedguide.common.evaluation",
}

__version__ = "0.1.0"
__all__ = [
    "DiagnosticsCallback",
    "FedAvg",
    "FedGuide",
    "FedGuideA",
    "FedGuideP",
    "FedGuideR",
    "FedKL",
    "FedProx",
    "FedRL",
    "FedSVRPGM",
    "FederatedDDPG",
    "FederatedEvalCallback",
    "FederatedPPO",
    "Local",
    "Pooled",
    "TensorBoardCallback",
    "__version__",
    "evaluate_federation",
    "register_algorithm",
]


def __getattr__(name: str) -> Any:  # torch and SB3 are imported when one of them is first used
    if name in _LAZY:
        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
