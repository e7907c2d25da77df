"""Evaluation of every client's policy in its own environment, all episodes of all clients batched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fed_envs import FederatedVecEnv
from fed_envs.faults import ClientError
from fed_envs.files import GrowingTable
from fed_envs.plain_data import State, freeze, thaw
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.episodes import truth
from sb3_fedguide.seeding import EVALUATION_SEED, Role
from sb3_fedguide.server.metrics import EVALUATION_COLUMNS, evaluation_row
from sb3_fedguide.settings.evaluation import EVAL_EPISODES, EVAL_FREQ, broadcast_is_due, deployed_is_due

if TYPE_CHECKING:
    from sb3_fedguide.common.federation import Federation

#: Steps after which an evaluation episode counts as endless.
MAX_STEPS = 100_000


@dataclass(frozen=True)
class Evaluation:
    """Episodes of every client.

    :param returns: undiscounted raw returns, ``(n_clients, n_episodes)``
    :param lengths: steps, ``(n_clients, n_episodes)``
    :param successes: whether each episode succeeded, ``(n_clients, n_episodes)`` bool; ``None`` if no environment reports it.
        If only some clients' environments do, it is float with NaN for the others
    """

    returns: np.ndarray
    lengths: np.ndarray
    successes: np.ndarray | None = None

    @property
    def client_returns(self) -> np.ndarray:
        """Mean return of each client, ``(n_clients,)``."""
        return self.returns.mean(axis=1)

    @property
    def average(self) -> float:
        """The client-average return: in the last round, the measure F."""
        return float(self.client_returns.mean())

    @property
    def success_rates(self) -> np.ndarray | None:
        """Share of each client's episodes that succeeded, ``(n_clients,)``; ``None`` if no environment reports success, NaN
        for clients whose environment does not."""
        return None if self.successes is None else self.successes.mean(axis=1)

    @property
    def success_list(self) -> list[float | None] | None:
        """:attr:`success_rates` for JSON, with ``None`` for clients whose environment does not report success."""
        rates = self.success_rates
        return None if rates is None else [None if np.isnan(rate) else float(rate) for rate in rates]

    @property
    def worst_client(self) -> float:
        return float(self.client_returns.min())


def evaluation_env(federation: Federation, n_episodes: int) -> FederatedVecEnv:
    """Environments for ``n_episodes`` parallel episodes of each of the federation's clients."""
    env = federation.get_env()
    assert isinstance(env, FederatedVecEnv)
    return env.copies(n_episodes, role=Role.EVAL_ENV)


def evaluate_federation(
    predict: Callable[[np.ndarray], np.ndarray],
    env: FederatedVecEnv,
    seed: int = EVALUATION_SEED,
    active: np.ndarray | None = None,
    max_steps: int = MAX_STEPS,
) -> Evaluation:
    """Run one seeded episode in every copy of every client's environment.

    :param predict: actions for observations ``(num_envs, obs_dim)``, client-major
    :param env: one copy per client and episode
    :param seed: of the episodes
    :param active: ``(n_clients, n_episodes)`` bool, episodes to run; all if ``None``. Results of the others are undefined
    :param max_steps: of an episode
    :raises ClientError: for clients with an episode that does not end before
    """
    env.seed(seed)
    env.active[:] = True if active is None else active.reshape(-1)
    obs: Any = env.reset()
    returns, lengths = np.zeros(env.num_envs), np.zeros(env.num_envs, dtype=int)
    shape = (env.n_clients, env.n_envs_per_client)
    successes, say = np.zeros(env.num_envs, dtype=bool), np.zeros(env.num_envs, dtype=bool)
    for _ in range(max_steps):
        obs, _, dones, infos = env.step(predict(obs))
        for index in np.flatnonzero(dones):
            returns[index], lengths[index] = infos[index]["episode"]["r"], infos[index]["episode"]["l"]
            success = infos[index].get("is_success")
            if success is not None:
                say[index], successes[index] = True, truth(success, env.client_ids[index // env.n_envs_per_client])
        env.active[dones] = False
        if not env.active.any():
            break
    else:
        waiting = [env.client_ids[position] for position in np.flatnonzero(env.active.reshape(shape).any(axis=1))]
        raise ClientError(
            waiting,
            f"an episode of the evaluation has not ended after {max_steps} steps: end it yourself, or with "
            "gymnasium.wrappers.TimeLimit, or train without evaluation",
        )
    return Evaluation(returns.reshape(shape), lengths.reshape(shape), _successes(successes.reshape(shape), say.reshape(shape)))


def _successes(successes: np.ndarray, say: np.ndarray) -> np.ndarray | None:
    """As in :class:`Evaluation`. If a client reports success for some episodes, the others had none."""
    if not say.any():
        return None
    silent = np.flatnonzero(say.sum(axis=1) == 0)
    if not len(silent):
        return successes
    successes = successes.astype(float)
    successes[silent] = np.nan
    return successes


class FederatedEvalCallback(RoundCallback):
    """Evaluates the deployed policies every ``eval_freq`` rounds and in each of the last twenty, and writes a CSV.

    The deployed policy is a client's own after local training. If the exchange of an evaluated round replaces the
    policies, the broadcast policy is evaluated as well, every ``eval_freq`` rounds and after the last.

    :param n_rounds: rounds of the whole run
    :param eval_freq: rounds between evaluations
    :param n_episodes: episodes per client
    :param csv_path: file to write, one row per round, client and policy; ``None`` for none
    :param deterministic: evaluate the mean action
    :param max_steps: of an episode, as in :func:`evaluate_federation`
    """

    def __init__(
        self,
        n_rounds: int,
        eval_freq: int = EVAL_FREQ,
        n_episodes: int = EVAL_EPISODES,
        csv_path: str | Path | None = None,
        deterministic: bool = True,
        max_steps: int = MAX_STEPS,
    ) -> None:
        super().__init__()
        if eval_freq < 1 or n_episodes < 1:
            raise ValueError(f"eval_freq={eval_freq} and n_episodes={n_episodes} must be at least 1")
        self.n_rounds, self.eval_freq, self.n_episodes, self.deterministic = n_rounds, eval_freq, n_episodes, deterministic
        self.table, self.max_steps = None if csv_path is None else GrowingTable(csv_path), max_steps
        #: the last evaluation of the deployed and of the broadcast policy
        self.last: dict[str, Evaluation] = {}

    def save_state(self) -> State:
        evaluations = {policy: freeze(vars(evaluation)) for policy, evaluation in self.last.items()}
        size = None if self.table is None else self.table.size
        return {**super().save_state(), "evaluations": evaluations, "csv_size": size}

    def load_state(self, state: State) -> None:
        """Remove rows that were written after the state was saved: they will be written again.

        :raises ValueError: if rows are missing that were written before
        """
        super().load_state({name: state[name] for name in state.keys() - {"evaluations", "csv_size"}})
        self.last = {policy: Evaluation(**thaw(values)) for policy, values in state["evaluations"].items()}
        if self.table is not None:
            self.table.cut(state["csv_size"])

    def _on_training_start(self) -> None:
        self.env = evaluation_env(self.model, self.n_episodes)
        if self.table is not None:
            self.table.begin(EVALUATION_COLUMNS)

    def is_due(self, round: int) -> bool:
        """Whether the deployed policies are evaluated after the local training of round ``round``, counted from 1."""
        return deployed_is_due(round, self.n_rounds, self.eval_freq)

    def _on_local_training_end(self) -> None:
        round = self.model.round + 1
        if self.is_due(round):
            evaluation = self._evaluate("deployed", round)
            self.logger.record("eval/mean_reward", evaluation.average)
            self.logger.record("eval/worst_client", evaluation.worst_client)
            self.logger.record("eval/mean_ep_length", float(evaluation.lengths.mean()))
            for client, value in zip(self.model.client_ids, evaluation.client_returns, strict=True):
                self.model.record_client(client, "eval_mean_reward", float(value))
            if evaluation.success_rates is not None:
                self.logger.record("eval/success_rate", float(np.nanmean(evaluation.success_rates)))
                for client, value in zip(self.model.client_ids, evaluation.success_rates, strict=True):
                    if not np.isnan(value):
                        self.model.record_client(client, "eval_success_rate", float(value))

    def _on_round_end(self) -> None:
        round = self.model.round
        if not self.model.sends_policy(round):
            self.last.pop("broadcast", None)  # no client has that policy now
        elif broadcast_is_due(round, self.n_rounds, self.eval_freq):
            evaluation = self._evaluate("broadcast", round)
            self.logger.record("eval/broadcast_mean_reward", evaluation.average)
            self.logger.record("eval/averaging_change", evaluation.average - self.last["deployed"].average)

    def _on_training_end(self) -> None:
        self.env.close()

    def run(self) -> Evaluation:
        """The model's current policies in this callback's episodes; nothing is logged or written."""
        return evaluate_federation(
            lambda obs: self.model.predict(obs, deterministic=self.deterministic)[0], self.env, max_steps=self.max_steps
        )

    def _evaluate(self, policy: str, round: int) -> Evaluation:
        evaluation = self.run()
        self.last[policy] = evaluation
        if self.table is not None:
            self.table.add(self._rows(policy, round, evaluation))
        return evaluation

    def _rows(self, policy: str, round: int, evaluation: Evaluation) -> list[tuple[Any, ...]]:
        rates = evaluation.success_list or [None] * len(evaluation.returns)
        return [
            evaluation_row(round, self.model.environment_steps, policy, *client)
            for client in zip(self.model.client_ids, evaluation.returns, evaluation.lengths, rates, strict=True)
        ]
