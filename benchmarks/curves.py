"""The learning curve that a benchmark with a loop of its own records."""

from __future__ import annotations

from sb3_fedguide.common.evaluation import Evaluation, FederatedEvalCallback


class Curve(FederatedEvalCallback):
    """Each client's return after every ``eval_freq`` rounds and the last one, of the deployed policies.

    :param n_rounds: rounds of the run
    :param start: whether there is an evaluation before the first round, too
    """

    def __init__(self, n_rounds: int, eval_freq: int = 5, n_episodes: int = 5, start: bool = False) -> None:
        super().__init__(n_rounds, eval_freq, n_episodes)
        self.start = start
        #: round and the clients' returns
        self.points: list[tuple[int, list[float]]] = []

    def is_due(self, round: int) -> bool:
        return round % self.eval_freq == 0 or round == self.n_rounds

    def _on_training_start(self) -> None:
        super()._on_training_start()
        if self.start:
            self._evaluate("deployed", 0)

    def _evaluate(self, policy: str, round: int) -> Evaluation:
        evaluation = super()._evaluate(policy, round)
        if policy == "deployed":
            self.points.append((round, evaluation.client_returns.round(4).tolist()))
        return evaluation
