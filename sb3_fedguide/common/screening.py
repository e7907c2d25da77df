"""Tests of the broadcast in the client's own environments: each client accepts it, or goes on alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from sb3_fedguide.common.evaluation import evaluate_federation, evaluation_env
from sb3_fedguide.seeding import Role, stream
from sb3_fedguide.server.strategy import Payload

if TYPE_CHECKING:
    from fed_envs import FederatedVecEnv
    from sb3_fedguide.common.parameter_averaging import ParameterAveraging

#: Episodes of either policy in a test, if there are enough steps left.
EPISODES = 5
#: Margin by which a policy must be better in a test, relative to the scale of the client's returns.
MARGIN = 0.1
#: Round of the first test; largest number of rounds between two tests.
FIRST_ROUND, LONGEST_WAIT = 1, 16
#: Largest share of the remaining test steps for one test.
PART = 0.25


class Screening:
    """Each client's tests, and its decisions from them.

    A client takes the broadcast until a test shows that it is clearly worse than the policy that the client has just trained.
    Then the client goes on alone: its uploads have no weight, and it does not take the broadcast, until a test shows that the
    broadcast is clearly better than its own policy. A test is some episodes of both policies, deterministic and with the same
    seeds, in copies of the client's environments. A test that changes nothing doubles the rounds until the next one.

    Tests cost environment steps: ``Federation.test_steps`` counts them.

    The idea is that of POET's transfer (Wang et al. 2019) and of screening in CAESAR (Mak et al. 2024).
    """

    def __init__(self, model: ParameterAveraging) -> None:
        self.model = model
        self._env: FederatedVecEnv | None = None

    def begin(self) -> None:
        """Make ``screening_state``, unless it was loaded.

        Per client, ``(n_clients,)``: whether it is alone, the steps of its tests (and those not yet in simulated time),
        the round of its next test, and the rounds to wait after that."""
        state, n_clients = self.model.screening_state, self.model.n_clients
        if self.model.screening and not state:
            state["alone"] = np.zeros(n_clients, dtype=bool)
            state["steps"] = np.zeros(n_clients, dtype=int)
            state["untimed"] = np.zeros(n_clients, dtype=int)
            state["next_round"] = np.full(n_clients, FIRST_ROUND)
            state["wait"] = np.ones(n_clients, dtype=int)

    def is_alone(self, index: int) -> bool:
        """Whether the client at position ``index`` has left the average."""
        return bool(self.model.screening > 0 and self.model.screening_state["alone"][index])

    def refused(self, candidates: Mapping[int, Payload]) -> set[int]:
        """The clients that refuse the broadcast, after the tests that are due.

        :param candidates: by position, a client's parameters if it accepts
        """
        model, state = self.model, self.model.screening_state
        episodes = {index: self._affordable(index) for index in candidates}
        episodes = {index: n for index, n in episodes.items() if n > 0 and model.round >= state["next_round"][index]}
        for index, (own, other) in self._test(candidates, episodes).items():
            scale = self._scale(index, own)
            alone = bool(state["alone"][index])
            better, worse = (other, own) if alone else (own, other)
            changes = clearly_better(better, worse, MARGIN * scale)
            state["alone"][index] = alone != changes
            state["wait"][index] = 1 if changes else min(2 * state["wait"][index], LONGEST_WAIT)
            state["next_round"][index] = model.round + state["wait"][index]
            model.record_client(model.client_ids[index], "screening_own", float(own.mean()))
            model.record_client(model.client_ids[index], "screening_sent", float(other.mean()))
        model.logger.record("screening/alone", float(state["alone"].sum()))
        model.logger.record("screening/test_steps", model.test_steps)
        return {index for index in candidates if state["alone"][index]}

    def _affordable(self, index: int) -> int:
        """Episodes of either policy that the client can afford with its remaining steps; 0 for none."""
        model, state = self.model, self.model.screening_state
        lengths = [info["l"] for info in model.episode_infos[index]]
        if not lengths or not model.has_trained[index]:
            return 0
        planned = model.screening * model._total_timesteps / model.n_participants
        left, pair = planned - state["steps"][index], 2 * float(np.mean(lengths))
        return 0 if left < pair else max(1, min(EPISODES, int(PART * left / pair)))

    def _scale(self, index: int, own: np.ndarray) -> float:
        """The unit of differences between returns: the level of the client's own returns, or the spread of its training
        returns if that is larger."""
        returns = [info["r"] for info in self.model.episode_infos[index]]
        return max(abs(float(own.mean())), float(np.std(returns)))

    def _test(
        self, candidates: Mapping[int, Payload], episodes: Mapping[int, int]
    ) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Returns of the clients' own policies and of the candidates, ``(episodes,)`` each; the policies stay as they were."""
        if not episodes:
            return {}
        model = self.model
        if self._env is None:
            self._env = evaluation_env(model, EPISODES)
        active = np.zeros((model.n_clients, EPISODES), dtype=bool)
        for index, n in episodes.items():
            active[index, :n] = True
        assert model.seed is not None
        seed = int(stream(model.seed, Role.SCREENING, model.round).integers(2**31))
        results = []
        for policies in ({}, {index: candidates[index] for index in episodes}):
            own = {index: model.averaged_parameters(index) for index in policies}
            for index, parameters in policies.items():
                model.policy.load_client(index, parameters)
            tested = evaluate_federation(lambda obs: model.predict(obs, deterministic=True)[0], self._env, seed, active)
            for index, parameters in own.items():
                model.policy.load_client(index, parameters)
            steps = np.where(active, tested.lengths, 0).sum(axis=1)
            for name in ("steps", "untimed"):
                model.screening_state[name][:] += steps
            model.test_steps += int(steps.sum())
            results.append(tested.returns)
        return {index: (results[0][index, :n], results[1][index, :n]) for index, n in episodes.items()}


def clearly_better(returns: np.ndarray, others: np.ndarray, margin: float) -> bool:
    """Whether paired returns are above the others' by more than two standard errors of the difference and by ``margin``."""
    difference = returns - others
    n = len(difference)
    error = float(difference.std(ddof=1)) / math.sqrt(n) if n > 1 else 0.0
    return float(difference.mean()) > max(2 * error, margin)


def check_screening(screening: float, average: str) -> None:
    """:raises ValueError: if the server sends no policy to test"""
    if screening > 0 and average == "critic":
        raise ValueError("screening tests policies, and average='critic' sends none; use 'all' or 'actor', or screening=0")
