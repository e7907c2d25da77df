"""One client's policy as an ordinary Stable-Baselines3 model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import DDPG, PPO
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_fedguide.common.normalization import FederatedNormalizer
from sb3_fedguide.common.participation import ParticipationAdam
from sb3_fedguide.common.ppo_policy import StackedMlpPolicy

if TYPE_CHECKING:
    from sb3_fedguide.common.federated_ddpg import FederatedDDPG
    from sb3_fedguide.common.federation import Federation


PPO_SETTINGS = (
    "learning_rate", "batch_size", "n_epochs", "gamma", "gae_lambda", "clip_range", "clip_range_vf", "normalize_advantage",
    "ent_coef", "vf_coef", "max_grad_norm", "verbose", "seed",
)  # fmt: skip
DDPG_SETTINGS = (
    "learning_rate", "buffer_size", "learning_starts", "batch_size", "tau", "gamma", "train_freq", "gradient_steps",
    "verbose", "seed",
)  # fmt: skip


class NormalizedObservation(BaseFeaturesExtractor):
    """Features extractor that applies a client's observation normalisation, so that its model takes raw observations.

    :param mean: ``(obs_dim,)``; ``var`` alike
    :param clip: bound on the normalised values
    """

    mean: th.Tensor
    deviation: th.Tensor

    def __init__(
        self, observation_space: spaces.Box, mean: list[float], var: list[float], epsilon: float, clip: float
    ) -> None:
        super().__init__(observation_space, features_dim=observation_space.shape[0])
        self.clip = clip
        self.register_buffer("mean", th.tensor(mean, dtype=th.float64))
        self.register_buffer("deviation", th.sqrt(th.tensor(var, dtype=th.float64) + epsilon))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        scaled = (observations - self.mean) / self.deviation
        return th.clamp(scaled, -self.clip, self.clip).to(th.float32)


class DeployedPolicy(nn.Module):
    """A client's deterministic policy from raw observations to executed actions, free of SB3 and of this package.

    ``(batch, obs_dim)`` float32 to ``(batch, action_dim)`` float32, clipped to the action space.
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(self, model: PPO) -> None:
        super().__init__()
        self.features = model.policy.features_extractor
        self.policy_net = model.policy.mlp_extractor.policy_net
        self.action_net = model.policy.action_net
        self.register_buffer("low", th.as_tensor(model.action_space.low))  # type: ignore[attr-defined]
        self.register_buffer("high", th.as_tensor(model.action_space.high))  # type: ignore[attr-defined]

    def forward(self, observations: th.Tensor) -> th.Tensor:
        actions = self.action_net(self.policy_net(self.features(observations)))
        return th.minimum(th.maximum(actions, self.low), self.high)


def export_client(federation: Federation, index: int, path: str | Path) -> None:
    """Write the policy of the client at position ``index`` as a ``torch.export`` program."""
    export_program(DeployedPolicy(client_model(federation, index)), federation.observation_space.shape[0], path)  # type: ignore[index]


def export_program(policy: nn.Module, obs_dim: int, path: str | Path) -> None:
    """Write ``policy``, which maps ``(batch, obs_dim)`` to actions, as a ``torch.export`` program for any batch size."""
    example = th.zeros(2, obs_dim)
    batch = {0: th.export.Dim("batch")}
    th.export.save(th.export.export(policy.eval().requires_grad_(False), (example,), dynamic_shapes=(batch,)), path)


def normalized_features(normalizer: FederatedNormalizer, index: int) -> dict[str, Any]:
    """What builds the normalisation of the client at position ``index`` into its policy; nothing where there is none."""
    if not normalizer.norm_obs:
        return {}
    kwargs = {
        "mean": normalizer.obs.mean[index].tolist(),
        "var": normalizer.obs.var[index].tolist(),
        "epsilon": normalizer.EPSILON,
        "clip": normalizer.CLIP,
    }
    return {"features_extractor_class": NormalizedObservation, "features_extractor_kwargs": kwargs}


def _network(federation: Federation, index: int) -> dict[str, Any]:
    """``policy_kwargs`` of the client at position ``index`` that every kind of policy has."""
    policy: Any = federation.policy
    given = {name: getattr(policy, name) for name in ("net_arch", "activation_fn", "optimizer_class", "optimizer_kwargs")}
    if given["optimizer_class"] is ParticipationAdam:  # Adam, for clients that come and go
        given["optimizer_class"] = th.optim.Adam
    return {**given, **normalized_features(federation.normalizer, index)}


def _set_up(model: PPO | DDPG, federation: Federation) -> None:
    """Make the networks and buffers of a model without environments."""
    model.observation_space, model.action_space = federation.observation_space, federation.action_space
    model.n_envs = 1
    model._setup_model()


def client_model(federation: Federation, index: int) -> PPO:
    """The client at position ``index`` as a ``stable_baselines3.PPO``; ``set_env`` gives it an environment to train in.

    Policy, critic and normalisation are copied; Adam's moments are not, so that further training starts fresh.
    """
    policy = federation.policy
    assert isinstance(policy, StackedMlpPolicy)
    policy_kwargs = {name: getattr(policy, name) for name in ("log_std_init", "ortho_init")}
    settings: dict[str, Any] = {name: getattr(federation, name) for name in PPO_SETTINGS}
    model = PPO(
        "MlpPolicy",
        None,  # type: ignore[arg-type]
        n_steps=federation.rollout_size,  # in one environment
        policy_kwargs={**policy_kwargs, **_network(federation, index)},
        stats_window_size=federation._stats_window_size,
        device="cpu",
        _init_setup_model=False,
        **settings,
    )
    _set_up(model, federation)
    state = policy.client_state_dict(index)
    model.policy.load_state_dict({**model.policy.state_dict(), **state})
    return model


def client_ddpg(federation: FederatedDDPG, index: int) -> DDPG:
    """As :func:`client_model`, of a federation of deterministic policies: the networks and their targets are copied."""
    policy = federation.policy
    zeros = np.zeros(federation.action_space.shape or ())
    settings: dict[str, Any] = {name: getattr(federation, name) for name in DDPG_SETTINGS}
    noise = federation.noise
    model = DDPG(
        "MlpPolicy",
        None,  # type: ignore[arg-type]
        action_noise=OrnsteinUhlenbeckActionNoise(zeros, np.full_like(zeros, noise.sigma), noise.theta, noise.dt),
        policy_kwargs=_network(federation, index),
        device="cpu",
        _init_setup_model=False,
        **settings,
    )
    model._stats_window_size = federation._stats_window_size
    _set_up(model, federation)
    model.policy.load_state_dict({**model.policy.state_dict(), **policy.client_state_dict(index)})
    return model
