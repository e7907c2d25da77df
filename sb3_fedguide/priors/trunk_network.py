"""The network that all clients of a diffusion prior share: features of an observation, a noisy action and a noise level."""

from __future__ import annotations

import math

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_fedguide.priors.density import THETA_MAX


class DiffusionTrunk(nn.Module):
    """Features ``phi(s, a_k, k)`` in ``R^width``.

    ``[shift, gate_0, ..., gate_n] = encoder(s) + level(k)``, ``h_0 = W a_k + shift``,
    ``h_{j+1} = h_j + W_j ((1 + gate_j) silu(h_j))``, ``phi = (1 + gate_n) silu(h_n)``.

    The observation and the noise level are multiplied, because the velocity of a sharp prior is a product: a gain that
    depends on ``k`` times a distance from a mean that depends on ``s``. The encoder is evaluated once per observation, not
    once per integration step, so its width is almost free. There are no normalisation layers, so that the derivative with
    respect to the action is a few exact lines (:meth:`with_tangents`).

    :param obs_dim: length of a (standardised) observation
    :param action_dim: length of an action
    :param width: number of features
    :param encoder_width: hidden units of the encoder
    :param n_blocks: residual blocks
    :param n_frequencies: sines and cosines in the embedding of the noise level
    :param rng: draws the initial weights (PyTorch's global generator is left alone)
    """

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        width: int,
        encoder_width: int,
        n_blocks: int,
        n_frequencies: int,
        rng: np.random.Generator,
    ) -> None:
        super().__init__()
        self.width, self.n_blocks, self.n_frequencies = width, n_blocks, n_frequencies
        context = width * (n_blocks + 2)
        self.encoder = nn.Sequential(_linear(obs_dim, encoder_width, rng), nn.SiLU(), _linear(encoder_width, context, rng))
        self.level = _linear(2 * n_frequencies, context, rng)
        self.action = _linear(action_dim, width, rng)
        self.blocks = nn.ModuleList(_linear(width, width, rng) for _ in range(n_blocks))

    def embed(self, theta: th.Tensor) -> th.Tensor:
        """Embedding of noise angles, ``(...)`` -> ``(..., 2 n_frequencies)``."""
        # Slow waves in sqrt(theta), the variable in which the flow is solved: few RK4 steps need a smooth right-hand side.
        phase = theta.sqrt().unsqueeze(-1) * (math.pi / math.sqrt(THETA_MAX))
        waves = phase * th.arange(1, self.n_frequencies + 1, dtype=theta.dtype)
        return th.cat([waves.cos(), waves.sin()], dim=-1)

    def forward(self, encoded: th.Tensor, noisy: th.Tensor, theta: th.Tensor) -> th.Tensor:
        """Features ``(..., width)``.

        :param encoded: ``encoder(obs)``, ``(..., width * (n_blocks + 2))``
        :param noisy: noisy actions, ``(..., action_dim)``
        :param theta: noise angles, ``(...)``, or one angle ``()`` for all rows
        """
        shift, *gates = (encoded + self.level(self.embed(theta))).split(self.width, dim=-1)
        h = self.action(noisy) + shift
        for block, gate in zip(self.blocks, gates[:-1], strict=True):
            activation = F.silu(h)
            h = h + block(th.addcmul(activation, activation, gate))
        activation = F.silu(h)
        return th.addcmul(activation, activation, gates[-1])

    def with_tangents(self, encoded: th.Tensor, noisy: th.Tensor, theta: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Features ``(batch, width)`` and their exact derivatives ``(action_dim, batch, width)`` by each action coordinate.

        Forward mode by hand, all coordinates at once; for one (not a stacked) network.
        """
        shift, *gates = (encoded + self.level(self.embed(theta))).split(self.width, dim=-1)
        h = self.action(noisy) + shift
        tangents = self.action.weight.t().unsqueeze(1)
        for block, gate in zip(self.blocks, gates[:-1], strict=True):
            assert isinstance(block, nn.Linear)  # for the type checker
            activation, slope = _silu_and_slope(h)
            h = h + block(th.addcmul(activation, activation, gate))
            tangents = tangents + F.linear(th.addcmul(slope, slope, gate) * tangents, block.weight)
        activation, slope = _silu_and_slope(h)
        return th.addcmul(activation, activation, gates[-1]), th.addcmul(slope, slope, gates[-1]) * tangents


def _silu_and_slope(h: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    gate = th.sigmoid(h)
    activation = h * gate
    return activation, th.addcmul(gate, activation, 1.0 - gate)  # gate + activation (1 - gate)


def _linear(in_features: int, out_features: int, rng: np.random.Generator) -> nn.Linear:
    layer = nn.utils.skip_init(nn.Linear, in_features, out_features)
    bound = 1.0 / math.sqrt(in_features)
    with th.no_grad():
        layer.weight.copy_(th.from_numpy(rng.uniform(-bound, bound, (out_features, in_features))))
        layer.bias.zero_()
    return layer
