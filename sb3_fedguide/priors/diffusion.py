"""Diffusion prior: a shared, frozen trunk of features and one linear head per client."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch as th
from torch.nn import functional as F

from sb3_fedguide.priors.base import HeadStatistics, Prior
from sb3_fedguide.priors.density import flow_sample, ode_log_density, training_angle, uniform_step_angle
from sb3_fedguide.priors.trunk_network import DiffusionTrunk
from sb3_fedguide.settings.pretraining import DEFAULTS

OBS_CLIP = 10.0  # bound on standardised observations
CHUNK_ROWS = 1024  # keeps the activations of one pass in the processor's cache


class DiffusionPrior(Prior):
    """State-conditioned diffusion over single actions: K = 1000 steps, linear beta from 1e-4 to 2e-2, noise prediction.

    ``eps_hat = sigma a_k + alpha W [phi; 1]``: the head predicts the velocity ``(eps - sigma a_k) / alpha``. The score
    ``-eps_hat / sigma`` is affine in ``W`` with the same constant part for all clients. So averaging heads with weights that
    sum to one equals averaging scores, and two scores differ by ``-alpha / sigma (W - W') [phi; 1]``.
    For ``W = 0`` the prior is the standard normal, towards which the ridge shrinks; at ``t = 1`` the flow ends in the
    standard normal for any ``W``.

    :param obs_dim: length of an observation
    :param action_dim: length of an action; actions are expected on the scale of [-1, 1]
    :param width: number of features ``p``
    :param encoder_width: hidden units of the observation encoder
    :param n_blocks: residual blocks of the trunk
    :param n_frequencies: frequencies in the embedding of the noise level
    :param ridge: penalty of the head fit, relative to the mean diagonal of the normal equations
    :param n_draws: noise draws per row when a head is fitted
    :param max_rows: cap on rows times draws of one fit; beyond it there are fewer draws, then fewer rows
    :param n_ode_steps: default RK4 steps of :meth:`log_prob`
    :param n_sample_steps: default denoising steps of :meth:`sample`
    :param rng: initialises the trunk; default a fixed stream, so that every site starts from the same network
    """

    obs_mean: th.Tensor
    obs_std: th.Tensor

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        width: int = DEFAULTS.prior_width,
        encoder_width: int = 128,
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
        self.arguments: dict[str, int | float] = {
            "obs_dim": obs_dim,
            "action_dim": action_dim,
            "width": width,
            "encoder_width": encoder_width,
            "n_blocks": n_blocks,
            "n_frequencies": n_frequencies,
            "ridge": ridge,
            "n_draws": n_draws,
            "max_rows": max_rows,
            "n_ode_steps": n_ode_steps,
            "n_sample_steps": n_sample_steps,
        }
        """``DiffusionPrior(**prior.arguments)`` and ``load_state_dict`` rebuild a prior."""
        for name, value in self.arguments.items():
            if name != "ridge" and (value != int(value) or value < 1):
                raise ValueError(f"{name} must be an integer of at least 1, got {value}.")
        if not ridge > 0.0:
            raise ValueError(f"ridge must be positive, got {ridge}.")
        self.ridge, self.n_draws, self.max_rows = float(ridge), int(n_draws), int(max_rows)
        self.n_ode_steps, self.n_sample_steps = int(n_ode_steps), int(n_sample_steps)
        rng = rng if rng is not None else np.random.default_rng(0)
        self.trunk = DiffusionTrunk(obs_dim, action_dim, width, encoder_width, n_blocks, n_frequencies, rng)
        self.trunk.requires_grad_(False)
        self.register_buffer("obs_mean", th.zeros(obs_dim))
        self.register_buffer("obs_std", th.ones(obs_dim))

    def set_observation_moments(self, mean: np.ndarray, std: np.ndarray) -> None:
        """Standardise observations with these, the same for all clients since they share the trunk.

        :param mean: ``(obs_dim,)``
        :param std: ``(obs_dim,)``; a constant coordinate (0) is only centred
        """
        mean, std = np.asarray(mean, dtype=np.float64), np.asarray(std, dtype=np.float64)
        if mean.shape != (self.obs_dim,) or std.shape != (self.obs_dim,):
            raise ValueError(f"Observation moments need shape ({self.obs_dim},), got {mean.shape} and {std.shape}.")
        if not (np.isfinite(mean).all() and np.isfinite(std).all() and (std >= 0.0).all()):
            raise ValueError("Observation moments must be finite, and standard deviations >= 0.")
        self.obs_mean.copy_(th.from_numpy(mean))
        self.obs_std.copy_(th.from_numpy(np.where(std > 1e-6, std, 1.0)))

    def standardise(self, obs: th.Tensor) -> th.Tensor:
        """The trunk's inputs for raw observations."""
        return ((obs - self.obs_mean) / self.obs_std).clamp(-OBS_CLIP, OBS_CLIP)

    @th.no_grad()
    def predict_noise(
        self, head: np.ndarray | th.Tensor, obs: th.Tensor, noisy_actions: th.Tensor, theta: th.Tensor
    ) -> th.Tensor:
        """``eps_hat(s, a_k, k)``; the score is ``-eps_hat / sin(theta)``.

        :param head: one head ``(action_dim, p + 1)``
        :param obs: ``(batch, obs_dim)``, raw
        :param noisy_actions: ``(batch, action_dim)``
        :param theta: noise angles ``(batch,)``: :func:`~sb3_fedguide.priors.density.noise_angle` of ``(k + 1) / K``
        :return: ``(batch, action_dim)``
        """
        heads, single = self._check_heads(head)
        if not single:
            raise ValueError("predict_noise takes one head; loop over several.")
        obs, noisy_actions = self._check_batch(obs, noisy_actions)
        theta = th.as_tensor(theta, dtype=th.float32)
        phi = self.trunk(self.trunk.encoder(self.standardise(obs)), noisy_actions, theta)
        velocity = F.linear(phi, heads[0, :, :-1], heads[0, :, -1])
        return theta.sin().unsqueeze(-1) * noisy_actions + theta.cos().unsqueeze(-1) * velocity

    def head_statistics(
        self,
        obs: np.ndarray,
        actions: np.ndarray,
        rng: np.random.Generator,
        weights: np.ndarray | None = None,
        n_draws: int | None = None,
    ) -> HeadStatistics:
        """Normal equations of ``E |v - W [phi; 1]|^2 = E |eps - eps_hat|^2 / alpha^2`` over stratified noise levels.

        :param n_draws: noise draws per row; default the prior's
        """
        obs, actions, weights = self.check_data(obs, actions, weights)
        draws = self.n_draws if n_draws is None else int(n_draws)
        if draws < 1:
            raise ValueError(f"n_draws must be at least 1, got {draws}.")
        size = self.n_features + 1
        gram, cross = np.zeros((size, size)), np.zeros((size, self.action_dim))
        drawn = 0.0
        for rows, _, features, velocity in self._noised(obs, actions, rng, draws, training_angle):
            weighted = features * weights[rows, None]
            gram += weighted.T @ features
            cross += weighted.T @ velocity
            drawn += float(weights[rows].sum())
        # Per row, not per draw: statistics with different numbers of draws then add up in the right proportion.
        total = float(weights.sum())
        return HeadStatistics(gram * (total / drawn), cross * (total / drawn), total)

    def solve_head(self, statistics: HeadStatistics) -> np.ndarray:
        """Ridge regression; the penalty is relative to the statistics, so their total weight does not matter."""
        self._check_statistics(statistics)
        size = len(statistics.gram)
        penalty = self.ridge * np.trace(statistics.gram) / size
        return np.linalg.solve(statistics.gram + penalty * np.eye(size), statistics.cross).T.astype(np.float32)

    def feature_moment(self, obs: np.ndarray, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """``E[alpha_k^2 / sigma_k^2 f f^T]`` over data and uniform ``k``: a head adds ``-alpha / sigma W f`` to the score."""
        obs, actions, _ = self.check_data(obs, actions, None)
        moment = np.zeros((self.n_features + 1, self.n_features + 1))
        count = 0
        for _, theta, features, _ in self._noised(obs, actions, rng, self.n_draws, uniform_step_angle):
            moment += (features / np.tan(theta)[:, None] ** 2).T @ features
            count += len(features)
        return moment / count

    @th.no_grad()
    def _noised(
        self,
        obs: np.ndarray,
        actions: np.ndarray,
        rng: np.random.Generator,
        n_draws: int,
        angle: Callable[[np.ndarray], np.ndarray],
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """Chunks of (row indices, noise angles, ``[phi; 1]``, velocity targets), in float64."""
        n = len(obs)
        chosen = np.arange(n) if n <= self.max_rows else np.sort(rng.choice(n, self.max_rows, replace=False))
        draws = max(1, min(n_draws, self.max_rows // len(chosen)))
        # Stratified twice: over the draws of a row, and within a draw over the rows.
        shuffled = np.stack([rng.permutation(len(chosen)) for _ in range(draws)]) + rng.random((draws, len(chosen)))
        theta = angle((np.arange(draws)[:, None] + shuffled / len(chosen)) / draws)
        noise = rng.standard_normal((draws, len(chosen), self.action_dim))
        for start in range(0, len(chosen), CHUNK_ROWS):
            part = slice(start, start + CHUNK_ROWS)
            rows = chosen[part]
            encoded = self.trunk.encoder(self.standardise(th.from_numpy(obs[rows])))
            for j in range(draws):
                angles, eps = theta[j, part], noise[j, part]
                alpha, sigma = np.cos(angles)[:, None], np.sin(angles)[:, None]
                noisy = th.from_numpy((alpha * actions[rows] + sigma * eps).astype(np.float32))
                phi = self.trunk(encoded, noisy, th.from_numpy(angles.astype(np.float32)))
                features = np.ones((len(rows), self.n_features + 1))
                features[:, :-1] = phi.numpy()
                yield rows, angles, features, alpha * eps - sigma * actions[rows]

    @th.no_grad()
    def log_prob(
        self, head: np.ndarray | th.Tensor, obs: th.Tensor, actions: th.Tensor, n_steps: int | None = None
    ) -> th.Tensor:
        """By the probability-flow ODE with exact divergence: see :func:`~sb3_fedguide.priors.density.ode_log_density`."""
        heads, single = self._check_heads(head)
        obs, actions = self._check_batch(obs, actions)
        steps = self.n_ode_steps if n_steps is None else n_steps
        chunks = []
        for start in range(0, len(obs), CHUNK_ROWS):
            encoded = self.trunk.encoder(self.standardise(obs[start : start + CHUNK_ROWS]))
            part = actions[start : start + CHUNK_ROWS]
            chunks.append(th.stack([ode_log_density(self._velocity(h, encoded), part, steps) for h in heads]))
        log_probs = th.cat(chunks, dim=1) if chunks else actions.new_zeros((len(heads), 0))
        return log_probs[0] if single else log_probs

    def _velocity(self, head: th.Tensor, encoded: th.Tensor) -> Callable[[th.Tensor, float], tuple[th.Tensor, th.Tensor]]:
        weight, bias = head[:, :-1], head[:, -1]

        def velocity(x: th.Tensor, theta: float) -> tuple[th.Tensor, th.Tensor]:
            phi, tangents = self.trunk.with_tangents(encoded, x, th.tensor(theta, dtype=th.float32))
            return F.linear(phi, weight, bias), th.einsum("jbp,jp->b", tangents, weight)

        return velocity

    @th.no_grad()
    def sample(
        self,
        head: np.ndarray | th.Tensor,
        obs: th.Tensor,
        rng: np.random.Generator,
        assignment: np.ndarray | None = None,
        n_steps: int | None = None,
    ) -> th.Tensor:
        """By the probability flow: one pass of the trunk for all rows, each row with its own head."""
        heads, _ = self._check_heads(head)
        obs = th.as_tensor(obs, dtype=th.float32)
        index = th.from_numpy(self._check_assignment(assignment, len(heads), len(obs)))
        noise = th.from_numpy(rng.standard_normal((len(obs), self.action_dim), dtype=np.float32))
        steps = self.n_sample_steps if n_steps is None else n_steps
        weight, bias = heads[:, :, :-1].flatten(0, 1), heads[:, :, -1].flatten()
        chunks = []
        for start in range(0, len(obs), CHUNK_ROWS):
            part = slice(start, start + CHUNK_ROWS)
            encoded = self.trunk.encoder(self.standardise(obs[part]))
            choice = index[part].view(-1, 1, 1).expand(-1, 1, self.action_dim)

            def velocity(x: th.Tensor, theta: float, encoded: th.Tensor = encoded, choice: th.Tensor = choice) -> th.Tensor:
                phi = self.trunk(encoded, x, th.tensor(theta, dtype=th.float32))
                # All heads on all rows, then each row's own: one matrix product is cheaper than gathering weights.
                every = F.linear(phi, weight, bias).view(len(phi), len(heads), self.action_dim)
                return every.gather(1, choice).squeeze(1)

            chunks.append(flow_sample(velocity, noise[part], steps))
        return th.cat(chunks) if chunks else noise
