"""The clients' actor-critic networks, stacked along a leading client dimension."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_fedguide.common.distributions import action_distribution
from sb3_fedguide.common.stacked_policy import StackedPolicy, check_observations
from sb3_fedguide.server.payload import PPO_ACTOR, PPO_CRITIC
from sb3_fedguide.state.stacked import fixed_forward, stack_tensor

ACTOR_PREFIXES, CRITIC_PREFIXES = PPO_ACTOR, PPO_CRITIC


class StackedActor(nn.Module):
    """The clients' actors alone: ``(n_clients, batch, obs_dim)`` to means or logits, ``(n_clients, batch, n_outputs)``."""

    def __init__(self, policy_net: nn.Module, action_net: nn.Module) -> None:
        super().__init__()
        self.policy_net = policy_net
        self.action_net = action_net

    def forward(self, obs: th.Tensor) -> th.Tensor:
        return self.action_net(self.policy_net(obs))


class StackedMlpPolicy(StackedPolicy, ActorCriticPolicy):
    """SB3's ``MlpPolicy`` for ``n_clients`` clients at once.

    Parameters keep SB3's names and gain a leading client dimension, so client k's slice of the state dict is the state
    dict of an ordinary ``MlpPolicy``. Observations and actions are client-major: ``(n_clients, batch, dim)`` inside,
    ``(n_clients * batch, dim)`` in :meth:`predict`. Every client starts from the same network, drawn from ``init_seed``.

    :param n_clients: number of networks
    :param init_seed: seed of the initial network, one for the whole federation
    :param net_arch: as in SB3; actor and critic may differ, ``dict(pi=[64, 64], vf=[64, 64])``
    :param activation_fn: activation module class
    :param log_std_init: initial value of the state-independent log standard deviation, of continuous actions
    :raises ValueError: for observations that are not a flat ``Box``, and actions that
        :func:`~sb3_fedguide.common.distributions.action_distribution` refuses
    """

    actor_prefixes = ACTOR_PREFIXES
    critic_prefixes = CRITIC_PREFIXES

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        n_clients: int = 1,
        init_seed: int = 0,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.Tanh,
        ortho_init: bool = True,
        use_sde: bool = False,
        log_std_init: float = 0.0,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        check_observations(observation_space)
        if use_sde:
            raise ValueError("use_sde=True is not supported by lockstep policies; use the default Gaussian exploration")
        self.distribution = action_distribution(action_space)
        self.n_clients = n_clients
        self.init_seed = init_seed
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=net_arch,
            activation_fn=activation_fn,
            ortho_init=ortho_init,
            log_std_init=log_std_init,
            features_extractor_class=FlattenExtractor,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        with th.random.fork_rng(devices=[]):
            th.manual_seed(self.init_seed)
            super()._build(lr_schedule)  # one ordinary network ...
        self.mlp_extractor.policy_net = self._stacked(self.mlp_extractor.policy_net)  # ... copied for each
        self.mlp_extractor.value_net = self._stacked(self.mlp_extractor.value_net)
        self.action_net = self._stacked(self.action_net)
        self.value_net = self._stacked(self.value_net)
        std = nn.Parameter(stack_tensor(self.log_std, self.n_clients)) if self.distribution.has_log_std else None
        self.register_parameter("log_std", std)
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def _build_mlp_extractor(self) -> None:
        # On the CPU first, so that one seed gives the same initial network on every device.
        self.mlp_extractor = MlpExtractor(
            self.features_dim, net_arch=self.net_arch, activation_fn=self.activation_fn, device="cpu"
        )

    def actor_mean(self, obs: th.Tensor) -> th.Tensor:
        """Parameters of the distribution of actions, for observations ``(n_clients, batch, obs_dim)``.

        :return: a Gaussian's mean, or logits, ``(n_clients, batch, n_outputs)``
        """
        return self.action_net(self.mlp_extractor.policy_net(obs))

    def fixed_actor_mean(self) -> Callable[[th.Tensor], th.Tensor]:
        """:meth:`actor_mean` with the current weights, without gradients: for a rollout, which calls it at every step."""
        return fixed_forward([self.mlp_extractor.policy_net, self.action_net])

    def values(self, obs: th.Tensor) -> th.Tensor:
        """The critics' values, ``(n_clients, batch)``."""
        return self.value_net(self.mlp_extractor.value_net(obs)).squeeze(-1)

    def actor(self) -> StackedActor:
        """A copy of the actors alone, for behaviour cloning."""
        return StackedActor(copy.deepcopy(self.mlp_extractor.policy_net), copy.deepcopy(self.action_net))

    def actor_parameter(self, name: str) -> nn.Parameter:
        """This policy's parameter that a :class:`StackedActor` calls ``name``."""
        return self.get_parameter(name if name.startswith("action_net.") else f"mlp_extractor.{name}")

    def forward(self, obs: th.Tensor, deterministic: bool = False) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Actions, values and log-probabilities, client-major and flat as SB3 returns them."""
        obs = self.split_clients(obs)
        mean = self.actor_mean(obs)
        perturbed = mean
        if not deterministic:
            noise = self.distribution.noise_like(mean)
            perturbed = mean + (noise if self.log_std is None else noise * self.log_std.exp().unsqueeze(1))
        actions = self.distribution.decide(perturbed)
        log_prob = self.distribution.log_prob(mean, self.log_std, actions)
        return actions.flatten(0, 1), self.values(obs).reshape(-1, 1), log_prob.flatten()

    def evaluate_actions(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """Values and log-probabilities of stored actions, and each client's mean entropy, client-major and flat as in SB3."""
        assert isinstance(obs, th.Tensor)
        obs = self.split_clients(obs)
        mean = self.actor_mean(obs)
        actions = actions.reshape(*mean.shape[:2], self.distribution.action_dim)
        log_prob = self.distribution.log_prob(mean, self.log_std, actions)
        entropy = self.distribution.entropy(mean, self.log_std).unsqueeze(1).expand_as(log_prob)
        return self.values(obs).reshape(-1, 1), log_prob.flatten(), entropy.flatten()

    def predict_values(self, obs: PyTorchObs) -> th.Tensor:
        assert isinstance(obs, th.Tensor)
        return self.values(self.split_clients(obs)).reshape(-1, 1)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self.forward(observation, deterministic)[0]  # type: ignore[arg-type]

    def get_distribution(self, obs: PyTorchObs) -> Any:
        raise ValueError("a stacked policy has no single distribution; take one client's policy with client(k).policy")

    def _get_constructor_parameters(self) -> dict[str, Any]:
        keys = ["n_clients", "init_seed", "net_arch", "activation_fn", "ortho_init", "log_std_init"]
        keys += ["optimizer_class", "optimizer_kwargs"]
        data: dict[str, Any] = {key: getattr(self, key) for key in keys}
        data.update(observation_space=self.observation_space, action_space=self.action_space, lr_schedule=self._dummy_schedule)
        return data
