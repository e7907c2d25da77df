"""Stacked networks: the short way through them is the long way, bit for bit."""

from __future__ import annotations

import pytest
import torch as th
from torch import nn

from sb3_fedguide.state.stacked import fixed_forward, stack_module


def perturbed(*layers: nn.Module, n_clients: int = 3) -> nn.Sequential:
    stacked = stack_module(nn.Sequential(*layers), n_clients)
    with th.no_grad():
        for parameter in stacked.parameters():
            parameter.add_(0.1 * th.randn_like(parameter))
    return stacked


@pytest.mark.parametrize("activation", [nn.Tanh, nn.ReLU, nn.ELU])
@pytest.mark.parametrize("outputs", [1, 3])
@pytest.mark.parametrize("rows", [1, 7])
def test_fixed_forward_equals_the_modules_bit_for_bit(activation, outputs, rows):
    th.manual_seed(0)
    body = perturbed(nn.Linear(5, 16), activation(), nn.Sequential(nn.Linear(16, 8), activation()))
    head = perturbed(nn.Linear(8, outputs))[0]
    x = th.randn(3, rows, 5)
    given = x.clone()
    result = fixed_forward([body, head])(x)
    assert th.equal(result, head(body(x))) and not result.requires_grad
    assert th.equal(x, given)  # nothing is overwritten


def test_fixed_forward_sees_weights_that_change_in_place():
    th.manual_seed(0)
    net = perturbed(nn.Linear(5, 4))
    forward = fixed_forward([net])
    x = th.randn(3, 2, 5)
    before = forward(x)
    with th.no_grad():
        net[0].bias.add_(1.0)
    assert th.allclose(forward(x), before + 1.0)
