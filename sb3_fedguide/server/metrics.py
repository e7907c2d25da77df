"""The clients' reports of a round: their logs as one log, and their evaluations as one table."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_fedguide.server.payload import EPSILON

#: Columns of the table of evaluations, the same in process and over a network.
EVALUATION_COLUMNS = (
    "round", "timesteps", "policy", "client", "mean_return", "std_return", "mean_length", "success_rate",
)  # fmt: skip

POLICIES = ("deployed", "broadcast")


@dataclass(frozen=True)
class ClientEvaluation:
    """One client's episodes with one policy.

    :param policy: ``"deployed"``, after local training, or ``"broadcast"``, what the server sent after it
    :param successes: whether each episode succeeded; ``None`` if the environment does not say
    """

    client: int
    round: int
    policy: str
    returns: list[float]
    lengths: list[int]
    successes: list[bool] | None = None

    def facts(self) -> dict[str, Any]:
        """As plain data; the client is known by who sends it."""
        return {name: value for name, value in vars(self).items() if name != "client"}

    def row(self, timesteps: int) -> tuple[Any, ...]:
        """Of the table, see :func:`evaluation_row`."""
        rate = None if self.successes is None else float(np.mean(self.successes))
        return evaluation_row(self.round, timesteps, self.policy, self.client, self.returns, self.lengths, rate)


def evaluation_row(
    round: int,
    timesteps: int,
    policy: str,
    client: int,
    returns: Sequence[float] | np.ndarray,
    lengths: Sequence[int] | np.ndarray,
    success_rate: float | None,
) -> tuple[Any, ...]:
    """A row under :data:`EVALUATION_COLUMNS`.

    :param timesteps: environment steps of all clients together
    :param returns: of the client's episodes, ``(n_episodes,)``, like ``lengths``
    :param success_rate: ``None`` if the environment does not say
    """
    rate = "" if success_rate is None else f"{success_rate:.6g}"
    mean, std, length = np.mean(returns), np.std(returns), np.mean(lengths)
    return (round, timesteps, policy, client, f"{mean:.6g}", f"{std:.6g}", f"{length:.6g}", rate)


def read_evaluations(client: int, facts: Mapping[str, Any]) -> list[ClientEvaluation]:
    """The evaluations in a client's reply; what is no evaluation is left out."""
    found = []
    given = facts.get("evaluations")
    for item in given if isinstance(given, list) else []:
        try:
            returns, lengths, successes = [float(value) for value in item["returns"]], item["lengths"], item["successes"]
            evaluation = ClientEvaluation(
                client,
                int(item["round"]),
                item["policy"],
                returns,
                [int(value) for value in lengths],
                None if successes is None else [bool(value) for value in successes],
            )
        except (TypeError, KeyError, ValueError, OverflowError):
            continue
        whole = bool(returns) and all(map(math.isfinite, returns)) and evaluation.policy in POLICIES
        whole = whole and all(0 <= length < 2**53 for length in evaluation.lengths)
        if whole and all(len(values) == len(returns) for values in (lengths, successes or lengths)):
            found.append(evaluation)
    return found


def count_tests(facts: Mapping[int, Mapping[str, Any]], counted: dict[int, int]) -> int:
    """The number of reported test steps that were not in ``counted``; adds them to it.

    :param facts: each client's report, with its ``test_steps`` since the start; invalid numbers are ignored
    :param counted: test steps by client
    """
    new = 0
    for client, own in facts.items():
        steps = own.get("test_steps")
        if type(steps) is int and counted.get(client, 0) < steps < 2**53:
            new += steps - counted.get(client, 0)
            counted[client] = steps
    return new


def merge_metrics(facts: Mapping[int, Mapping[str, Any]]) -> dict[str, float]:
    """All clients' logs as one: ``client_<k>/...`` is taken from client k, every other key is averaged over the clients that
    report it. Of :data:`~sb3_fedguide.server.payload.EPSILON` the largest value is taken.

    Keys of evaluations are left out: :func:`evaluation_metrics` computes them from the episodes.
    """
    merged: dict[str, float] = {}
    shared: dict[str, list[float]] = {}
    for client, own in sorted(facts.items()):
        given = own.get("figures")
        for key, value in given.items() if isinstance(given, dict) else ():
            if not isinstance(key, str) or isinstance(value, bool) or not isinstance(value, int | float):
                continue
            try:
                number = float(value)
            except OverflowError:  # an integer of any length
                continue
            if not math.isfinite(number):
                continue
            if key.startswith(f"client_{client}/"):
                merged[key] = number
            elif not key.startswith(("client_", "federated/", "eval/")):
                shared.setdefault(key, []).append(number)
    return {**{key: float(np.max(values) if key == EPSILON else np.mean(values)) for key, values in shared.items()}, **merged}


def evaluation_metrics(evaluations: Iterable[ClientEvaluation]) -> dict[str, float]:
    """The clients' average and the worst client, under the keys that a federation in process logs."""
    figures: dict[str, float] = {}
    by_policy: dict[str, list[ClientEvaluation]] = {}
    for evaluation in evaluations:
        by_policy.setdefault(evaluation.policy, []).append(evaluation)
    if deployed := by_policy.get("deployed"):
        means = [float(np.mean(evaluation.returns)) for evaluation in deployed]
        figures["eval/mean_reward"], figures["eval/worst_client"] = float(np.mean(means)), min(means)
        figures["eval/mean_ep_length"] = float(np.mean([np.mean(evaluation.lengths) for evaluation in deployed]))
        rates = [float(np.mean(evaluation.successes)) for evaluation in deployed if evaluation.successes is not None]
        if rates:
            figures["eval/success_rate"] = float(np.mean(rates))
    if broadcast := by_policy.get("broadcast"):
        figures["eval/broadcast_mean_reward"] = float(np.mean([np.mean(evaluation.returns) for evaluation in broadcast]))
    return figures
