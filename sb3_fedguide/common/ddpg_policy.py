"""The clients' deterministic actors and their critics, stacked along a leading client dimension."""

from __future__ import annotations

import copy
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_fedguide.common.distributions import check_continuous
from sb3_fedguide.common.stacked_policy import StackedPolicy, check_observations
from sb3_fedguide.server.payload import DDPG_ACTOR, DDPG_CRITIC

ACTOR_PREFIXES, CRITIC_PREFIXES = DDPG_ACTOR, DDPG_CRITIC


def check_ddpg_actions(space: spaces.Space) -> None:
    """:raises ValueError: for actions without a deterministic policy gradient"""
    check_continuous(space, "DDPG", "use a method on PPO: FedAvg, FedProx, FedKL, FedSVRPGM or Local")


class BoundedActor(nn.Module):
    """Deterministic actors with actions in the action space's own bounds; one network or a stack of them.

    :param mu: observations to actions in [-1, 1]
    :param action_space: bounds
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(self, mu: nn.Module, action_space: spaces.Box) -> None:
        super().__init__()
        self.mu = mu
        self.register_buffer("low", th.as_tensor(action_space.low))
        self.register_buffer("high", th.as_tensor(action_space.high))

    def forward(self, obs: th.Tensor) -> th.Tensor:
        return self.low + 0.5 * (self.mu(obs) + 1.0) * (self.high - self.low)


class StackedDDPGPolicy(StackedPolicy, TD3Policy):
    """The ``MlpPolicy`` of SB3's ``DDPG`` for ``n_clients`` clients at once.

    Parameters keep SB3's names and gain a leading client dimension, so client k's slice of the state dict is the state
    dict of an ordinary policy with one critic. Inside, actions lie in [-1, 1]. Every client starts from the same network,
    drawn from ``init_seed``.

    :param n_clients: number of networks
    :param init_seed: seed of the initial network, one for the whole federation
    :param net_arch: as in SB3; actor and critic may differ, ``dict(pi=[64, 64], qf=[64, 64])``
    :param activation_fn: activation module class
    :param n_critics: must be 1, as in DDPG
    :raises ValueError: for spaces other than flat ``Box`` observations and ``Box`` actions, or several critics
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
        activation_fn: type[nn.Module] = nn.ReLU,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_critics: int = 1,
    ) -> None:
        check_observations(observation_space)
        check_ddpg_actions(action_space)
        if n_critics != 1:
            raise ValueError(f"n_critics={n_critics}: DDPG has one critic per client; leave n_critics out")
        self.n_clients = n_clients
        self.init_seed = init_seed
        super().__init__(
            observation_space,
            action_space,  # type: ignore[arg-type]
            lr_schedule,
            net_arch=[64, 64] if net_arch is None else net_arch,
            activation_fn=activation_fn,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            n_critics=1,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        with th.random.fork_rng(devices=[]):
            th.manual_seed(self.init_seed)
            super()._build(lr_schedule)  # one ordinary network ...
        for actor in (self.actor, self.actor_target):
            actor.mu = self._stacked(actor.mu)  # ... copied for each
        for critic in (self.critic, self.critic_target):
            critic.qf0 = self._stacked(critic.q_networks[0])
            critic.q_networks = [critic.qf0]  # type: ignore[list-item]
        for module in (self.actor, self.critic):
            module.optimizer = self.optimizer_class(module.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]
        for module in (self.actor_target, self.critic_target):
            module.requires_grad_(False)
        # Stored, because iterating over the modules takes as long as some of the computations with them.
        self.actor_parameters = list(self.actor.parameters())
        self._networks: list[th.Tensor] = [*self.actor.parameters(), *self.critic.parameters()]
        self._targets: list[th.Tensor] = [*self.actor_target.parameters(), *self.critic_target.parameters()]

    def actions(self, obs: th.Tensor) -> th.Tensor:
        """``(n_clients, batch, obs_dim)`` to actions in [-1, 1], ``(n_clients, batch, action_dim)``."""
        return self.actor.mu(obs)

    def target_actions(self, obs: th.Tensor) -> th.Tensor:
        """As :meth:`actions`, of the target actors."""
        return self.actor_target.mu(obs)

    def values(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """The critics' values Q(s, a), ``(n_clients, batch)``."""
        return self.critic.q_networks[0](th.cat([obs, actions], dim=-1)).squeeze(-1)

    def target_values(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """As :meth:`values`, of the target critics."""
        return self.critic_target.q_networks[0](th.cat([obs, actions], dim=-1)).squeeze(-1)

    @th.no_grad()
    def update_targets(self, tau: float, clients: th.Tensor | None = None) -> None:
        """Move the target networks towards the networks by the fraction ``tau``.

        :param clients: positions of the clients whose targets move; all if ``None``
        """
        if clients is None:
            th._foreach_mul_(self._targets, 1 - tau)  # SB3's polyak_update, bit for bit, in two calls
            th._foreach_add_(self._targets, self._networks, alpha=tau)
            return
        for network, target in zip(self._networks, self._targets, strict=True):
            target[clients] = (1 - tau) * target[clients] + tau * network[clients]

    @th.no_grad()
    def copy_to_targets(
        self, index: int | slice = slice(None), prefixes: tuple[str, ...] = ACTOR_PREFIXES + CRITIC_PREFIXES
    ) -> None:
        """Set the targets of the client at position ``index`` equal to its networks; of all clients by default."""
        for name, parameter in self.named_parameters():
            if name.startswith(prefixes):
                owner, rest = name.split(".", 1)
                self.get_parameter(f"{owner}_target.{rest}")[index] = parameter[index]

    def bounded_actors(self) -> BoundedActor:
        """A copy of the actors alone, in the action space's own units."""
        assert isinstance(self.action_space, spaces.Box)
        return BoundedActor(copy.deepcopy(self.actor.mu), self.action_space)

    def actor_parameter(self, name: str) -> nn.Parameter:
        """This policy's parameter that a :class:`BoundedActor` calls ``name``."""
        return self.get_parameter(f"actor.{name}")

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        return self.actions(self.split_clients(observation)).flatten(0, 1)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        keys = ["n_clients", "init_seed", "net_arch", "activation_fn", "optimizer_class", "optimizer_kwargs"]
        data: dict[str, Any] = {key: getattr(self, key) for key in keys}
        data.update(observation_space=self.observation_space, action_space=self.action_space, lr_schedule=self._dummy_schedule)
        return data
