"""The settings of lockstep DDPG: what subclasses hand on, and which values fit together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import torch as th
from stable_baselines3.common.type_aliases import Schedule

from sb3_fedguide.offline.config import PretrainingConfig

if TYPE_CHECKING:
    from sb3_fedguide.common.federated_ddpg import FederatedDDPG


class FederatedDDPGArguments(TypedDict, total=False):
    """Keyword arguments of :class:`FederatedDDPG` that its subclasses hand on; the constructor states their defaults."""

    learning_rate: float | Schedule
    rollout_size: int
    buffer_size: int
    learning_starts: int
    batch_size: int
    tau: float
    gamma: float
    train_freq: int
    gradient_steps: int
    noise_theta: float
    noise_sigma: float
    noise_dt: float
    n_envs_per_client: int
    clients: Sequence[int] | None
    normalize: bool
    bc_weight: float
    client_fraction: float
    pretraining: PretrainingConfig | dict[str, Any] | None
    cache_dir: str | Path | None
    stats_window_size: int
    tensorboard_log: str | None
    policy_kwargs: dict[str, Any] | None
    verbose: int
    seed: int | None
    device: th.device | str
    _init_setup_model: bool


def check_settings(model: FederatedDDPG) -> None:
    """:raises ValueError: for settings out of range or that do not fit together, with the remedy"""
    rollout_size, n_envs = model.rollout_size, model.n_envs_per_client
    if rollout_size < 1 or rollout_size % n_envs:
        raise ValueError(f"n_envs_per_client={n_envs} must divide rollout_size={rollout_size}, the steps per client and round")
    if model.train_freq < 1 or (rollout_size // n_envs) % model.train_freq:
        raise ValueError(
            f"train_freq={model.train_freq} must be at least 1 and divide the {rollout_size // n_envs} steps of every "
            "environment in a round (rollout_size / n_envs_per_client)"
        )
    if model.gradient_steps < 1 and model.gradient_steps != -1:
        raise ValueError(
            f"gradient_steps={model.gradient_steps} must be at least 1, or -1 for as many as there are new transitions"
        )
    if model.batch_size < 1 or model.learning_starts < 0:
        raise ValueError(
            f"batch_size={model.batch_size} must be at least 1 and learning_starts={model.learning_starts} at least 0"
        )
    if model.buffer_size <= model.learning_starts:
        raise ValueError(
            f"buffer_size={model.buffer_size} must be larger than learning_starts={model.learning_starts}; both are per client"
        )
    if not 0 < model.tau <= 1:
        raise ValueError(f"tau={model.tau} must lie in (0, 1]")
    if min(model.noise_theta, model.noise_sigma) < 0 or model.noise_dt <= 0:
        raise ValueError("noise_theta and noise_sigma must not be negative, and noise_dt must be positive")
