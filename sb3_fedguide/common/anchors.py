"""Earlier policies that a method keeps: stored as arrays, restored as tensors or as actors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch as th

from sb3_fedguide.common.ppo_policy import StackedActor, StackedMlpPolicy

#: Parameters of all clients by SB3's name, ``(n_clients, ...)`` each; arrays, so that a saved model loads on any device.
Parameters = dict[str, np.ndarray]


def snapshot(policy: th.nn.Module, prefixes: tuple[str, ...]) -> Parameters:
    """Copies of the parameters whose names begin with one of ``prefixes``."""
    named = policy.named_parameters()
    return {name: parameter.detach().cpu().numpy().copy() for name, parameter in named if name.startswith(prefixes)}


def actor_at(policy: StackedMlpPolicy, parameters: Mapping[str, np.ndarray]) -> tuple[StackedActor, dict[str, th.Tensor]]:
    """An actor of this policy's architecture with other parameters, on this policy's device.

    :param parameters: at least every actor parameter, as :func:`snapshot` names them
    :return: the actor, and its trainable tensors under the policy's names, with ``log_std`` if there is one
    """
    actor = policy.actor()
    tensors: dict[str, th.Tensor] = {}
    if policy.log_std is not None:
        tensors["log_std"] = th.as_tensor(parameters["log_std"]).to(policy.log_std, copy=True).requires_grad_()
    with th.no_grad():
        for name, tensor in actor.named_parameters():
            full_name = name if name.startswith("action_net.") else f"mlp_extractor.{name}"
            tensor.copy_(th.as_tensor(parameters[full_name]))
            tensors[full_name] = tensor
    return actor, tensors
