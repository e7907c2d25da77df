"""Keyword arguments that algorithms hand on to their base classes, whose constructors state the defaults."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypedDict

import torch as th
from stable_baselines3.common.type_aliases import Schedule

from sb3_fedguide.common.normalization import Normalize
from sb3_fedguide.settings.pretraining import PretrainingConfig


class FederationArguments(TypedDict, total=False):
    """Those of every federation."""

    learning_rate: float | Schedule
    rollout_size: int
    batch_size: int
    gamma: float
    n_envs_per_client: int
    clients: Sequence[int] | None
    num_threads: int
    normalize: Normalize
    bc_weight: float
    client_fraction: float
    upload_bound: float | None
    pretraining: PretrainingConfig | dict[str, Any] | None
    cache_dir: str | Path | None
    stats_window_size: int
    tensorboard_log: str | None
    policy_kwargs: dict[str, Any] | None
    verbose: int
    seed: int | None
    device: th.device | str
    _init_setup_model: bool


class FederatedPPOArguments(FederationArguments, total=False):
    """Those of :class:`~sb3_fedguide.common.federated_ppo.FederatedPPO`."""

    n_epochs: int
    gae_lambda: float
    clip_range: float | Schedule
    clip_range_vf: float | Schedule | None
    normalize_advantage: bool
    ent_coef: float
    vf_coef: float
    max_grad_norm: float


class FederatedDDPGArguments(FederationArguments, total=False):
    """Those of :class:`~sb3_fedguide.common.federated_ddpg.FederatedDDPG`."""

    buffer_size: int
    learning_starts: int
    tau: float
    train_freq: int
    gradient_steps: int
    noise_theta: float
    noise_sigma: float
    noise_dt: float


class LearnerArguments(FederatedPPOArguments, FederatedDDPGArguments, total=False):
    """Those of either learner, for methods that stand on both; the constructors refuse the other's."""
