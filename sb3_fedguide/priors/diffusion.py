"""Diffusion prior: a shared, frozen trunk of features and one linear head per client."""

from __future__ import annotations

import math

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_fedguide.priors.base import HeadStatistics, Prior
from sb3_fedguide.priors.density import THETA_MAX, ddim_sample, noise_angle, ode_log_density

OBS_CLIP = 10.0
CHUNK_ROWS = 2048


class DiffusionTrunk(nn.Module):
    """Features ``phi(s, a_k, k)``: a residual network over the observation, the noisy action and the noise level.

    ``h_0 = W_0 [s, a_k, embedding(k)]``, ``h_{j+1} = h_j + W_j silu(h_j)``, ``phi = silu(h_n)``. Without normalisation layers, so that the
    derivative with respect to the action is a few exact lines (:meth:`features_and_tangents`).

    :param width: number of features
    :param n_blocks: residual blocks
    :param n_frequencies: sines and cosines in the embedding of the noise level
    """

    def __init__(self, obs_dim: int, action_dim: int, width: int, n_blocks: int, n_frequencies: int) -> None:
        super().__init__()
        self.obs_dim, self.action_dim, self.n_frequencies = obs_dim, action_dim, n_frequencies
        self.input: nn.Module = nn.Linear(obs_dim + action_dim + 2 * n_frequencies, width)
        self.blocks = nn.ModuleList(nn.Linear(width, width) for _ in range(n_blocks))

    def embed(self, theta: th.Tensor) -> th.Tensor:
        """Embedding of noise angles ``(...)`` -> ``(..., 2 n_frequencies)``."""
        # Slow waves in sqrt(theta), the variable in which the flow is integrated: few RK4 steps need a smooth right-hand side.
        phase = theta.sqrt().unsqueeze(-1) * (math.pi / math.sqrt(THETA_MAX))
        waves = phase * th.arange(1, self.n_frequencies + 1, dtype=theta.dtype)
        return th.cat([waves.cos(), waves.sin()], dim=-1)

    def forward(self, obs: th.Tensor, noisy: th.Tensor, theta: th.Tensor) -> th.Tensor:
        """Features of standardised observations, noisy actions and noise angles ``(...)``, all with the same leading dimensions."""
        return self._body(self.input(th.cat([obs, noisy, self.embed(theta)], dim=-1)))

    def _body(self, h: th.Tensor) -> th.Tensor:
        for block in self.blocks:
            h = h + block(F.silu(h))
        return F.silu(h)

    # The input layer in parts: along one trajectory only the action and the (common) noise level change.

    def obs_part(self, obs: th.Tensor) -> th.Tensor:
        return F.linear(obs, self.input.weight[:, : self.obs_dim])

    def input_at(self, obs_part: th.Tensor, noisy: th.Tensor, theta: float) -> th.Tensor:
        weight = self.input.weight
        level = F.linear(
            self.embed(th.tensor(theta, dtype=weight.dtype)), weight[:, self.obs_dim + self.action_dim :], self.input.bias
        )
        return obs_part + (F.linear(noisy, weight[:, self.obs_dim : self.obs_dim + self.action_dim]) + level)

    def features_rows(self, obs_part, noisy, theta):
        weight = self.input.weight
        return self._body(obs_part + F.linear(th.cat([noisy, self.embed(theta)], -1), weight[:, self.obs_dim:], self.input.bias))

    def features_at(self, obs_part: th.Tensor, noisy: th.Tensor, theta: float) -> th.Tensor:
        """Features at one noise angle for all rows."""
        return self._body(self.input_at(obs_part, noisy, theta))

    def features_and_tangents(self, obs_part: th.Tensor, noisy: th.Tensor, theta: float) -> tuple[th.Tensor, th.Tensor]:
        """Features ``(batch, p)`` and their exact derivatives ``(d, batch, p)`` with respect to each action coordinate."""
        h = self.input_at(obs_part, noisy, theta)
        weight = self.input.weight[:, self.obs_dim : self.obs_dim + self.action_dim]
        tangent = weight.t().unsqueeze(1)
        for block in self.blocks:
            activation, slope = _silu_and_slope(h)
            h = h + block(activation)
            tangent = tangent + F.linear(slope * tangent, block.weight)
        activation, slope = _silu_and_slope(h)
        return activation, slope * tangent


def _silu_and_slope(h: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    gate = th.sigmoid(h)
    activation = h * gate
    return activation, gate + activation * (1.0 - gate)


class DiffusionPrior(Prior):
    """State-conditioned diffusion over single actions, noise prediction, K = 1000 steps with linear beta from 1e-4 to 2e-2.

    ``eps_hat = sigma a_k + alpha W [phi; 1]``, that is: the head predicts the velocity. The score ``-eps_hat / sigma`` is affine in ``W``
    with a part that no client owns, so averaging heads (with weights that sum to one) is averaging scores. For ``W = 0`` the prior is
    the standard normal; it is towards this that the ridge shrinks, and what the flow ends in at ``t = 1`` whatever ``W`` is.

    :param obs_dim: length of an observation
    :param action_dim: length of an action
    :param width: number of features ``p``
    :param n_blocks: residual blocks of the trunk
    :param n_frequencies: frequencies in the embedding of the noise level
    :param ridge: penalty of the head fit, relative to the mean diagonal of the normal equations
    :param n_draws: noise draws per row when a head is fitted
    :param max_rows: cap on rows times draws of one fit
    :param n_ode_steps: default RK4 steps of :meth:`log_prob`
    :param n_sample_steps: default DDIM steps of :meth:`sample`
    :param rng: initialises the trunk; default a fixed stream, so that every site starts from the same network
    """

    obs_mean: th.Tensor
    obs_std: th.Tensor

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        width: int = 64,
        n_blocks: int = 2,
        n_frequencies: int = 4,
        ridge: float = 1e-3,
        n_draws: int = 20,
        max_rows: int = 400_000,
        n_ode_steps: int = 8,
        n_sample_steps: int = 10,
        rng: np.random.Generator | None = None,
    ) -> None:
        super().__init__(obs_dim, action_dim, n_features=width)
        for name, value in {"width": width, "n_blocks": n_blocks, "n_frequencies": n_frequencies, "n_draws": n_draws}.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}.")
        self.ridge, self.n_draws, self.max_rows = float(ridge), int(n_draws), int(max_rows)
        self.n_ode_steps, self.n_sample_steps = int(n_ode_steps), int(n_sample_steps)
        self.trunk = DiffusionTrunk(obs_dim, action_dim, width, n_blocks, n_frequencies)
        _initialise(self.trunk, rng if rng is not None else np.random.default_rng(0))
        self.register_buffer("obs_mean", th.zeros(obs_dim))
        self.register_buffer("obs_std", th.ones(obs_dim))

    def set_observation_moments(self, mean: np.ndarray, std: np.ndarray) -> None:
        """Standardise observations with these (common to all clients, since the trunk is); constant coordinates pass centred."""
        mean, std = np.asarray(mean, dtype=np.float64), np.asarray(std, dtype=np.float64)
        if mean.shape != (self.obs_dim,) or std.shape != (self.obs_dim,) or not (np.isfinite(mean).all() and (std >= 0).all()):
            raise ValueError(f"Observation moments need finite shape ({self.obs_dim},) and std >= 0, got {mean.shape}, {std.shape}.")
        self.obs_mean.copy_(th.as_tensor(mean))
        self.obs_std.copy_(th.as_tensor(np.where(std > 1e-6, std, 1.0)))

    def standardise(self, obs: th.Tensor) -> th.Tensor:
        return ((obs - self.obs_mean) / self.obs_std).clamp(-OBS_CLIP, OBS_CLIP)

    # Head

    def head_statistics(
        self,
        obs: np.ndarray,
        actions: np.ndarray,
        rng: np.random.Generator,
        weights: np.ndarray | None = None,
        n_draws: int | None = None,
    ) -> HeadStatistics:
        """Normal equations of ``E |eps - eps_hat|^2``, with ``n_draws`` (default the constructor's) noise levels per row, stratified."""
        obs, actions, weights = self._check_data(obs, actions, weights)
        draws = self.n_draws if n_draws is None else int(n_draws)
        if draws < 1:
            raise ValueError(f"n_draws must be at least 1, got {draws}.")
        size = self.n_features + 1
        gram, cross = np.zeros((size, size)), np.zeros((size, self.action_dim))
        drawn = 0.0
        for rows, theta, noisy, target, features in self._noised(obs, actions, rng, draws):
            loss_weight = (weights[rows] * level_weight(theta))[:, None]
            weighted = features * loss_weight
            gram += weighted.T @ features
            cross += weighted.T @ target
            drawn += weights[rows].sum()
        # Per row, not per draw: statistics with different numbers of draws then add up in the right proportion.
        total = float(weights.sum())
        return HeadStatistics(gram * (total / drawn), cross * (total / drawn), total)

    def solve_head(self, statistics: HeadStatistics) -> np.ndarray:
        self._check_statistics(statistics)
        penalty = self.ridge * np.trace(statistics.gram) / len(statistics.gram)
        return np.linalg.solve(statistics.gram + penalty * np.eye(len(statistics.gram)), statistics.cross).T.astype(np.float32)

    def feature_moment(self, obs: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """``E_k[alpha_k^2 / sigma_k^2 f f^T]``: the score is ``-(a_k + alpha / sigma W f)``."""
        obs, actions, _ = self._check_data(obs, actions, None)
        moment = np.zeros((self.n_features + 1, self.n_features + 1))
        count = 0
        for _, theta, _, _, features in self._noised(obs, actions, rng, self.n_draws):
            moment += (features * (level_weight(theta) / np.tan(theta) ** 2)[:, None]).T @ features
            count += len(features)
        return moment / count

    @th.no_grad()
    def _noised(self, obs, actions, rng, n_draws):
        n = len(obs)
        chosen = np.arange(n) if n <= self.max_rows else np.sort(rng.choice(n, self.max_rows, replace=False))
        draws = max(1, min(n_draws, self.max_rows // len(chosen)))
        obs_part = self.trunk.obs_part(self.standardise(th.from_numpy(obs[chosen])))
        for j in range(draws):
            # Stratified twice: over the draws of each row, and within a draw over the rows.
            quantile = (j + (rng.permutation(len(chosen)) + rng.random(len(chosen))) / len(chosen)) / draws
            theta = level_quantile(quantile)
            noise = rng.standard_normal((len(chosen), self.action_dim), dtype=np.float32)
            for start in range(0, len(chosen), CHUNK_ROWS):
                part = slice(start, start + CHUNK_ROWS)
                rows = chosen[part]
                alpha, sigma = np.cos(theta[part])[:, None], np.sin(theta[part])[:, None]
                noisy = alpha * actions[rows] + sigma * noise[part]
                velocity = alpha * noise[part] - sigma * actions[rows]
                features = self.trunk.features_rows(obs_part[part], th.from_numpy(noisy.astype(np.float32)), th.from_numpy(theta[part].astype(np.float32)))
                features = np.column_stack([features.double().numpy(), np.ones(len(rows))])
                yield rows, theta[part], noisy, velocity, features

    @th.no_grad()
    def log_prob(self, head, obs, actions, n_steps=None):
        heads, single = self._check_heads(head)
        obs, actions = self._check_batch(obs, actions)
        steps = self.n_ode_steps if n_steps is None else n_steps
        weight, bias = heads[:, :, :-1], heads[:, :, -1]
        obs_part = self.trunk.obs_part(self.standardise(obs))
        out = []
        for m in range(len(heads)):
            def velocity(x, theta, w=weight[m], b=bias[m]):
                phi, tangents = self.trunk.features_and_tangents(part, x, theta)
                return F.linear(phi, w, b), (tangents * w.unsqueeze(1)).sum(dim=(0, 2))
            pieces = []
            for start in range(0, len(obs), CHUNK_ROWS):
                part = obs_part[start:start + CHUNK_ROWS]
                pieces.append(ode_log_density(velocity, actions[start:start + CHUNK_ROWS], steps))
            out.append(th.cat(pieces))
        return out[0] if single else th.stack(out)

    @th.no_grad()
    def sample(self, head, obs, rng, assignment=None, n_steps=None):
        heads, _ = self._check_heads(head)
        obs = th.as_tensor(obs, dtype=th.float32)
        assignment = self._check_assignment(assignment, len(heads), len(obs))
        noise = th.from_numpy(rng.standard_normal((len(obs), self.action_dim), dtype=np.float32))
        obs_part = self.trunk.obs_part(self.standardise(obs))
        flat = heads[:, :, :-1].reshape(-1, self.n_features)
        bias = heads[:, :, -1].reshape(-1)
        index = th.from_numpy(assignment)
        rows = th.arange(len(obs))
        def velocity(x, theta):
            phi = self.trunk.features_at(obs_part, x, theta)
            every = F.linear(phi, flat, bias).view(len(phi), len(heads), self.action_dim)
            return every[rows, index]
        return ddim_sample(velocity, noise, self.n_sample_steps if n_steps is None else n_steps)


def _initialise(trunk, rng):
    for layer in trunk.modules():
        if isinstance(layer, nn.Linear):
            bound = 1/math.sqrt(layer.in_features)
            with th.no_grad():
                layer.weight.copy_(th.from_numpy(rng.uniform(-bound, bound, layer.weight.shape)))
                layer.bias.zero_()

LEVELS="t"; LOSS="eps"
def level_quantile(q):
    if LEVELS=="t":
        return noise_angle(1/1000+(1-1/1000)*q)
    if LEVELS=="u":
        from sb3_fedguide.priors.density import THETA_MIN
        return (math.sqrt(THETA_MIN)+(math.sqrt(THETA_MAX)-math.sqrt(THETA_MIN))*q)**2
    if LEVELS=="logs":
        from sb3_fedguide.priors.density import THETA_MIN
        return np.arctan(np.exp(np.log(np.tan(THETA_MIN))+(np.log(np.tan(THETA_MAX))-np.log(np.tan(THETA_MIN)))*q))
def level_weight(theta):
    return np.cos(theta)**2 if LOSS=="eps" else np.ones_like(theta)
