"""What a federation on Bandit2D has learned, as densities over its two-dimensional actions."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch as th

from fed_envs.bandit2d import ACTION_LIMIT, PEAKS, reward
from sb3_fedguide.algorithms.fedguide import FedGuide
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.federated_ppo import FederatedPPO
from sb3_fedguide.priors.mixture import mixture_log_prob

#: A peak counts as kept where the deterministic action of some client earns at least this share of it.
KEPT = 0.5


@dataclass(frozen=True)
class Policies:
    """The clients' Gaussian policies at Bandit2D's only observation.

    :param mean: ``(n_clients, 2)``
    :param std: ``(n_clients, 2)``
    """

    mean: np.ndarray
    std: np.ndarray

    def density(self, points: np.ndarray) -> np.ndarray:
        """``(n_clients, n_points)`` for points ``(n_points, 2)``; of the action before it is clipped."""
        z = (points[None] - self.mean[:, None]) / self.std[:, None]
        return np.exp(-0.5 * (z**2).sum(-1)) / (2 * np.pi * self.std.prod(-1))[:, None]

    def expected_reward(self, n: int = 401) -> np.ndarray:
        """``E_pi[r]`` of every client, ``(n_clients,)``, summed over a grid; actions are clipped as in the environment."""
        limit = ACTION_LIMIT + 5 * float(self.std.max())
        axis = np.linspace(-limit, limit, n)
        points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        mass = self.density(points)
        mass /= mass.sum(axis=1, keepdims=True)
        rewards = reward(np.clip(points, -ACTION_LIMIT, ACTION_LIMIT))
        return mass @ rewards

    def peaks_kept(self) -> int:
        """Of the four peaks, those that some client's deterministic action reaches."""
        distance = np.linalg.norm(self.mean[:, None] - PEAKS, axis=-1)
        reached = reward(np.clip(self.mean, -ACTION_LIMIT, ACTION_LIMIT)) >= KEPT
        return len(set(distance[reached].argmin(axis=1)))


def policies(model: FederatedPPO) -> Policies:
    """The current policies of a federation on Bandit2D."""
    zeros = np.zeros((model.n_clients, 1, model.observation_space.shape[0]), dtype=np.float32)  # type: ignore[index]
    with th.no_grad():
        mean = model.policy.actor_mean(th.as_tensor(model.normalizer.normalize_obs(zeros), device=model.device))
        std = model.policy.log_std.exp()
    return Policies(mean[:, 0].double().cpu().numpy(), std.double().cpu().numpy())


class PolicySnapshot(RoundCallback):
    """Keeps the deployed policies of the last round, which an exchange may replace afterwards."""

    model: FederatedPPO
    deployed: Policies

    def _on_local_training_end(self) -> None:
        self.deployed = policies(self.model)


@dataclass(frozen=True)
class Priors:
    """Prior densities of a FedGuide federation over points.

    :param clients: each client's own, fitted on its own data, ``(n_clients, n_points)``
    :param personal: each client's mixture of experts, ``(n_clients, n_points)``
    :param server: the mixture of all experts by their load, ``(n_points,)``
    """

    clients: np.ndarray
    personal: np.ndarray
    server: np.ndarray


def priors(model: FedGuide, points: np.ndarray) -> Priors:
    """The priors of a trained federation at points ``(n_points, 2)``."""
    obs = th.zeros(len(points), model.observation_space.shape[0])  # type: ignore[index]
    actions = th.as_tensor(points, dtype=th.float32)
    own = [model.prior.log_prob(head, obs, actions).exp().numpy() for head in model.heads]
    rows = [*model.mixture_rows, model.mixture_rows.mean(axis=0)]
    mixtures = [mixture_log_prob(model.prior, model.experts[0], row, obs, actions).exp().numpy() for row in rows]
    return Priors(np.stack(own), np.stack(mixtures[:-1]), mixtures[-1])


@dataclass
class MethodResult:
    """One method's run for the figure.

    :param name: as printed
    :param deployed: the clients' policies after local training in the last round
    :param final_return: F, the client-average return of the last evaluation
    :param curve: ``(round, client-average return)``
    :param shared: the policy that the server broadcast, where there is one
    """

    name: str
    deployed: Policies
    final_return: float
    curve: list[tuple[int, float]] = field(default_factory=list)
    shared: Policies | None = None

    def measures(self) -> dict[str, float | int]:
        """F, the peaks kept and the expected reward of the stochastic policies."""
        return {
            "F": self.final_return,
            "peaks_kept": self.deployed.peaks_kept(),
            "expected_reward": float(self.deployed.expected_reward().mean()),
        }
