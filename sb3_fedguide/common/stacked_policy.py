"""The common part of the clients' stacked policies, for any SB3 policy."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from sb3_fedguide.state.stacked import client_state, stack_module


class StackedPolicy(BasePolicy):
    """Mixin for policies whose parameters have a leading client dimension and otherwise SB3's names."""

    #: prefixes of the names of the actor's and the critic's parameters
    actor_prefixes: ClassVar[tuple[str, ...]]
    critic_prefixes: ClassVar[tuple[str, ...]]
    n_clients: int

    def _stacked(self, module: nn.Module) -> Any:
        return stack_module(module, self.n_clients)

    def split_clients(self, obs: th.Tensor) -> th.Tensor:
        """``(n_clients * batch, obs_dim)``, client-major, to ``(n_clients, batch, obs_dim)``.

        :raises ValueError: if the rows cannot be divided among the clients
        """
        obs = obs.float()  # as SB3's policies, which take any numeric type
        if obs.dim() == 3 and obs.shape[0] == self.n_clients:
            return obs
        if obs.shape[0] % self.n_clients:
            raise ValueError(
                f"{obs.shape[0]} observation(s) cannot be divided among {self.n_clients} clients; pass the same number for "
                "each, client by client, or take one client's own model with client(k)"
            )
        return obs.reshape(self.n_clients, -1, obs.shape[-1])

    def client_state_dict(self, index: int) -> dict[str, th.Tensor]:
        """State dict of the ordinary policy of the client at position ``index``; copies, not aliases."""
        return client_state(self.state_dict(), index)

    @th.no_grad()
    def load_client(self, index: int, arrays: dict[str, np.ndarray]) -> None:
        """Copy parameters, named as in SB3 and unstacked, into the client at position ``index``.

        :raises ValueError: for an unknown name or a wrong shape
        """
        parameters = dict(self.named_parameters())
        for name, array in arrays.items():
            if name not in parameters or parameters[name].shape[1:] != array.shape:
                raise ValueError(f"parameter {name!r} of shape {array.shape} does not fit this policy")
            parameters[name][index].copy_(th.as_tensor(array))


def check_observations(space: spaces.Space) -> None:
    """:raises ValueError: for observations that are not a flat ``Box``"""
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ValueError(
            f"a federation's policy needs one-dimensional Box observations, but the observation space is {space}; flatten it "
            "(gymnasium.wrappers.FlattenObservation)"
        )
