"""An optimiser's state as plain arrays."""

from __future__ import annotations

import torch as th

from fed_envs.plain_data import State
from sb3_fedguide.state.stacked import to_arrays, to_tensors


def optimizer_state(optimizer: th.optim.Optimizer) -> State:
    """Moments and step counts of each parameter in the optimiser's order, and the groups' learning rates."""
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    return {
        "parameters": [to_arrays(optimizer.state.get(parameter, {})) for parameter in parameters],
        "learning_rates": [float(group["lr"]) for group in optimizer.param_groups],
    }


def load_optimizer(optimizer: th.optim.Optimizer, saved: State) -> None:
    """Restore the state from :func:`optimizer_state`, for parameters of the same shapes."""
    state = optimizer.state_dict()
    state["state"] = {index: to_tensors(arrays) for index, arrays in enumerate(saved["parameters"]) if arrays}
    for group, learning_rate in zip(state["param_groups"], saved["learning_rates"], strict=True):
        group["lr"] = learning_rate
    optimizer.load_state_dict(state)
