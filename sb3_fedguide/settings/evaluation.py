"""The rounds in which a run evaluates its policies. Imports nothing heavy."""

from __future__ import annotations

#: Rounds between evaluations, by default.
EVAL_FREQ = 5
#: Episodes per client of an evaluation, by default.
EVAL_EPISODES = 10
#: Number of rounds at the end of a run that are all evaluated; CV is computed over them.
LAST_ROUNDS = 20


def deployed_is_due(round: int, n_rounds: int, eval_freq: int) -> bool:
    """Whether the deployed policies are evaluated after the local training of round ``round``, counted from 1."""
    return round % eval_freq == 0 or round > n_rounds - LAST_ROUNDS


def broadcast_is_due(round: int, n_rounds: int, eval_freq: int) -> bool:
    """Whether a policy that the server sends after round ``round`` is evaluated."""
    return round % eval_freq == 0 or round == n_rounds
