"""Refit of a client's prior head on its offline data and on recent actions with a high advantage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fed_envs.state import State, freeze, thaw
from sb3_fedguide.priors.base import HeadStatistics, Prior

#: Rows of a rollout that enter a refit, and noise draws of each: enough for a few hundred coefficients.
ROWS, DRAWS = 1024, 8
#: Bound on the weights exp(A / temperature), relative to their mean over the rollout.
MAX_WEIGHT = 20.0
#: Decay of the earlier rollouts' statistics from round to round.
MEMORY = 0.8


class HeadAdaptation:
    """Closed-form refit by weighted ridge regression; only its sufficient statistics are kept.

    :param offline: statistics of each client's offline data
    :param weight: share of the recent rollouts, in [0, 1]; 0 keeps the offline head
    :param temperature: of ``exp(A / temperature)``, in standard deviations of the advantage
    :raises ValueError: for a share or temperature out of range
    """

    def __init__(self, offline: Sequence[HeadStatistics], weight: float, temperature: float) -> None:
        if not 0.0 <= weight <= 1.0 or temperature <= 0:
            raise ValueError(f"adapt_weight={weight} must lie in [0, 1] and adapt_temperature={temperature} be positive")
        self.weight, self.temperature = weight, temperature
        self.offline = [statistics * (1.0 / statistics.weight) for statistics in offline]
        self.recent: list[HeadStatistics | None] = [None] * len(self.offline)

    def save_state(self) -> State:
        """Statistics of all clients, offline and recent, as plain data."""
        offline = [freeze(vars(part)) for part in self.offline]
        return {"offline": offline, "recent": [part and freeze(vars(part)) for part in self.recent]}

    def load_state(self, state: State) -> None:
        """Restore what :meth:`save_state` returned."""
        self.offline = [HeadStatistics(**thaw(part)) for part in state["offline"]]
        self.recent = [part and HeadStatistics(**thaw(part)) for part in state["recent"]]

    def refit(
        self,
        prior: Prior,
        index: int,
        obs: np.ndarray,
        actions: np.ndarray,
        advantages: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """The new head of the client at position ``index``.

        :param obs: the rollout's raw observations ``(n, obs_dim)``
        :param actions: executed actions ``(n, action_dim)``
        :param advantages: ``(n,)``, in any scale
        """
        weights = np.exp(np.clip((advantages - advantages.mean()) / (advantages.std() + 1e-8) / self.temperature, -20, 20))
        weights = np.minimum(weights / weights.mean(), MAX_WEIGHT)
        chosen = np.sort(rng.choice(len(obs), min(ROWS, len(obs)), replace=False))
        new = prior.head_statistics(obs[chosen], actions[chosen], rng, weights[chosen], n_draws=DRAWS)
        earlier = self.recent[index]
        recent = new if earlier is None else earlier * MEMORY + new
        self.recent[index] = recent
        mixed = self.offline[index] * (1 - self.weight) + recent * (self.weight / recent.weight)
        return prior.solve_head(mixed)
