"""Check that settings of DDPG fit together."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sb3_fedguide.common.environments import check_copies

if TYPE_CHECKING:
    from sb3_fedguide.common.federated_ddpg import FederatedDDPG


def check_settings(model: FederatedDDPG) -> None:
    """:raises ValueError: for settings out of range or that do not fit together, with the remedy"""
    rollout_size, n_envs = model.rollout_size, model.n_envs_per_client
    check_copies(rollout_size, n_envs)
    if model.train_freq < 1 or (rollout_size // n_envs) % model.train_freq:
        raise ValueError(
            f"train_freq={model.train_freq} must be at least 1 and divide the {rollout_size // n_envs} steps of every "
            "environment in a round (rollout_size / n_envs_per_client)"
        )
    if model.gradient_steps < 1 and model.gradient_steps != -1:
        raise ValueError(
            f"gradient_steps={model.gradient_steps} must be at least 1, or -1 for as many as there are new transitions"
        )
    if model.buffer_size <= model.learning_starts:
        raise ValueError(
            f"buffer_size={model.buffer_size} must be larger than learning_starts={model.learning_starts}; both are per client"
        )
