"""Keyword arguments that algorithms hand on to their base classes, whose constructors state the defaults."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypedDict

import torch as th
from stable_baselines3.common.type_aliases import Schedule

from sb3_fedguide.common.normalization import Normalize
from sb3_fedguide.server.averaging import Aggregator
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


class _WhatIsAveraged(TypedDict, total=False):
    average: Literal["all", "actor", "critic"]
    average_every: int


class _HowFarAndTested(TypedDict, total=False):
    server_step: float | Literal["exp"]
    screening: float


class _HowItIsAveraged(TypedDict, total=False):
    average_until: int | None
    aggregator: Aggregator
    trim_fraction: float
    server_momentum: float
    mix: float | Schedule
    noise_multiplier: float
    clipping_norm: float | None
    delta: float


class AveragingArguments(_WhatIsAveraged, _HowFarAndTested, _HowItIsAveraged, total=False):
    """Those of :class:`~sb3_fedguide.common.parameter_averaging.ParameterAveraging`."""


class FedAvgArguments(AveragingArguments, FederatedPPOArguments, total=False):
    """Those of :class:`~sb3_fedguide.algorithms.fedavg.FedAvg`."""


class FedGuideRArguments(_WhatIsAveraged, _HowItIsAveraged, FederatedPPOArguments, total=False):
    """Those of FedAvg for which :class:`~sb3_fedguide.algorithms.fedguide_r.FedGuideR` has no default of its own."""


class FedGuideArguments(FederatedPPOArguments, total=False):
    """Those of :class:`~sb3_fedguide.algorithms.fedguide.FedGuide`."""

    lambda_trust: float
    lambda_prior: float
    prior_horizon: int
    prior_loss: Literal["snis", "sample"]
    prior_states: int | None
    density_steps: int
    sampling_steps: int
    beta: float | Schedule | Literal["auto"]
    critic_target: Literal["online", "blend"]
    calibrate: bool
    n_experts: int | None
    eta: float
    cost: Literal["score", "param"]
    cost_scaling: Literal["max", "median"]
    adapt: Literal["none", "advantage"]
    adapt_temperature: float
    adapt_weight: float


class FedGuideAArguments(_HowFarAndTested, _HowItIsAveraged, FedGuideArguments, total=False):
    """Those of its bases for which :class:`~sb3_fedguide.algorithms.fedguide.FedGuideA` has no default of its own."""
