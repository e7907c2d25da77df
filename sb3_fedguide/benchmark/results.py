"""Result files of runs, and the measures of a method over its seeds.

A run's result file is ``<folder>/<family>-<label>/<method>-seed<seed>.json``: its ``summary.json``, and in files of
``fedguide benchmark`` its complete hyperparameters (``config``) and ``versions`` as well.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_fedguide.benchmark.bootstrap import mean_interval
from sb3_fedguide.benchmark.paper import PAPER_F
from sb3_fedguide.settings.evaluation import LAST_ROUNDS
from sb3_fedguide.settings.pretraining import prior_is_gaussian

#: A client is stuck if its return is below this share of its best known return.
STUCK = 0.6


@dataclass(frozen=True)
class Result:
    """One finished run.

    :param n_episodes: episodes per client in an evaluation
    :param final: client-average return of the deployed policies after the last round; if clients tested broadcast policies,
        in the last evaluation within the environment steps of a run without tests
    :param worst_client: the lowest client's return there
    :param success: share of the episodes there that succeeded; ``None`` if the environments do not report it
    :param broadcast: client-average return of the last broadcast policy; ``None`` if there is none
    :param curve: evaluated round to client-average return of the deployed policies
    :param spent: evaluated round to the environment steps until then, in rounds without tests
    :param bytes_up: uploaded per round by all clients together; ``None`` if an older file does not separate it from the
        uploads before the first round. ``bytes_down`` likewise, sent to all clients together
    :param offline_bytes_up: once, before the first round; ``offline_bytes_down`` likewise
    :param median_seconds: of the median round
    :param config: hyperparameters; ``None`` if the file does not say
    :param clients: their numbers; empty where the file does not say
    :param client_finals: each client's return in the evaluation of ``final``; empty where the file does not say
    :param client_curve: evaluated round to each client's return; empty in files of earlier versions
    :param steps_per_round: environment steps of all clients in a round without tests; ``None`` if the file does not say
    :param round_seconds: of all rounds together: rollout, training and exchange; ``None`` if the file does not say
    :param delays: the delays that were simulated; ``None`` without
    :param total_bytes: up and down, of all clients together, with the exchanges before the first round
    """

    path: Path
    method: str
    family: str
    seed: int
    n_rounds: int
    conf_file: str
    metadata_hash: str
    n_episodes: int
    final: float
    worst_client: float
    success: float | None
    broadcast: float | None
    curve: Mapping[int, float]
    spent: Mapping[int, float]
    bytes_up: float | None
    bytes_down: float | None
    offline_bytes_up: float | None
    offline_bytes_down: float | None
    median_seconds: float
    config: Mapping[str, Any] | None
    clients: Sequence[int]
    client_finals: Sequence[float]
    client_curve: Mapping[int, Sequence[float]]
    steps_per_round: float | None
    round_seconds: float | None
    total_bytes: float
    delays: str | None = None


@dataclass(frozen=True)
class Measures:
    """One method on one family, over its seeds.

    :param F: client-average return after the last round, mean over seeds; ``F_std`` its population standard deviation
    :param W: its worst seed
    :param CV: standard deviation over absolute mean of the last twenty rounds, averaged over seeds; ``None`` if undefined
    :param worst_client: the lowest client's return, averaged over seeds
    :param speed_up: rounds of a run over the first evaluated round in which the curve is at the target; ``None`` without a
        target, or where it is never reached
    :param area: mean of the curve from the first to the last evaluated round, by environment steps, averaged over seeds
    :param difference: F minus the baseline's F over their common seeds, and the 95 % bootstrap interval of the paired
        differences, if there are two such seeds; ``None`` without a baseline
    :param stuck: clients per run whose return is below :data:`STUCK` of their best known return; ``None`` if that is not
        known, or not positive
    :param curve: asked-for round to client-average return, averaged over seeds; without those that were not evaluated
    :param seconds_per_round: the fastest seed's median: other work on the machine only adds
    :param paper_F: of the paper
    """

    method: str
    seeds: tuple[int, ...]
    F: float
    F_std: float
    W: float
    CV: float | None
    worst_client: float
    success: float | None
    broadcast: float | None
    curve: Mapping[int, float]
    bytes_up_per_round: float | None
    bytes_down_per_round: float | None
    offline_bytes_up: float | None
    offline_bytes_down: float | None
    seconds_per_round: float
    paper_F: float | None
    speed_up: float | None = None
    area: float | None = None
    difference: float | None = None
    difference_interval: tuple[float, float] | None = None
    stuck: float | None = None


def result_folder(folder: Path, family: str, label: str) -> Path:
    """Where the result files of a family under a label are."""
    return folder / f"{family}-{label}"


def result_path(folder: Path, family: str, label: str, method: str, seed: int) -> Path:
    """The result file of a run."""
    return result_folder(folder, family, label) / f"{method}-seed{seed}.json"


def read_result(path: Path) -> Result:
    """:raises ValueError: if the file is damaged, or of a run that was not finished"""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        result = parse_result(path, content)
    except (OSError, ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path} is not the result of a run ({reason}); delete it to repeat the run") from None
    if path.name != f"{result.method}-seed{result.seed}.json":
        raise ValueError(
            f"{path} holds the result of {result.method} with seed {result.seed}; give it that name, or delete it"
        )
    return result


def parse_result(path: Path, content: Mapping[str, Any]) -> Result:
    """The content of a result file, or the ``summary.json`` of a run's folder.

    :raises ValueError: of a run that was not finished
    :raises KeyError, TypeError, AttributeError: if something is missing or no number
    """
    if content["finished"] is not True:
        raise ValueError(f"it ended after {content['rounds_done']} of {content['n_rounds']} rounds")
    deployed, rates = content["deployed"], content["deployed"].get("success_rates")
    broadcast, rounds = content.get("broadcast"), int(content["rounds_done"])
    config = content.get("config")
    final = _final_returns(content)
    offline = _offline_bytes(content)
    each = [
        None if before is None else (float(content[name]) - before) / rounds
        for name, before in zip(("bytes_up", "bytes_down"), offline, strict=True)
    ]
    return Result(
        path=path,
        method=str(content["algo"]),
        family=str(content["env"]),
        seed=int(content["seed"]),
        n_rounds=int(content["n_rounds"]),
        conf_file=str(content["conf_file"]),
        metadata_hash=str(content["metadata_hash"]),
        n_episodes=int(deployed["n_episodes"]),
        final=float(np.mean(final) if final else deployed["average"]),
        worst_client=float(np.min(final) if final else deployed["worst_client"]),
        success=None if rates is None else float(np.mean([rate for rate in rates if rate is not None])),
        broadcast=None if broadcast is None else float(broadcast["average"]),
        curve={int(round): float(value) for round, value in deployed["curve"]},
        spent=_spent(content),
        bytes_up=each[0],
        bytes_down=each[1],
        offline_bytes_up=offline[0],
        offline_bytes_down=offline[1],
        median_seconds=float(content["seconds"]["median_round"]),
        config=None if config is None else dict(config),
        clients=[int(client) for client in content.get("clients", ())],
        client_finals=final or [float(value) for value in deployed.get("client_returns", ())],
        client_curve={
            int(round): [float(value) for value in returns] for round, _, returns in deployed.get("client_curve", ())
        },
        steps_per_round=_steps_per_round(content) if "timesteps" in content else None,
        round_seconds=_round_seconds(content["seconds"]),
        total_bytes=float(content["bytes_up"]) + float(content["bytes_down"]),
        delays=content.get("delays"),
    )


def _final_returns(content: Mapping[str, Any]) -> list[float]:
    """For runs with tests: each client's return in the last evaluation within the steps of a run without tests."""
    if not (tests := content.get("test_timesteps", 0)):
        return []
    budget = content["timesteps"] - tests
    within = [returns for _, steps, returns in content["deployed"]["client_curve"] if steps <= budget]
    return [float(value) for value in within[-1]] if within else []


def _spent(content: Mapping[str, Any]) -> dict[int, float]:
    deployed, tests = content["deployed"], content.get("test_timesteps", 0)
    if not tests:
        return {int(round): float(round) for round, _ in deployed["curve"]}
    per_round = _steps_per_round(content)
    return {int(round): steps / per_round for round, steps, _ in deployed["client_curve"]}


def _steps_per_round(content: Mapping[str, Any]) -> float:
    return (content["timesteps"] - content.get("test_timesteps", 0)) / content["rounds_done"]


def _round_seconds(seconds: Mapping[str, Any]) -> float | None:
    parts = ("rollout", "train", "exchange")
    return sum(float(seconds[part]) for part in parts) if all(part in seconds for part in parts) else None


#: Methods whose clients train a prior's trunk together.
_WITH_PRIOR = ("fedguide", "fedguide-p", "fedguide-a")


def _offline_bytes(content: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """Bytes up and down before the first round; ``None`` if they are not zero and the file does not give them.

    Files of earlier versions have one sum. Their methods with a prior trained its trunk together, except the Gaussian prior
    of Bandit2D, which has no trunk.
    """
    if "offline_bytes_up" in content:
        return float(content["offline_bytes_up"]), float(content["offline_bytes_down"])
    prior = ((content.get("config") or {}).get("pretraining") or {}).get("prior", "auto")
    gaussian = prior_is_gaussian(prior, "bandit2d" if content["env"] == "Bandit2D" else None)
    return (0.0, 0.0) if gaussian or content["algo"] not in _WITH_PRIOR else (None, None)


def read_results(
    folder: Path, family: str, label: str, methods: Sequence[str], seeds: Sequence[int] | None = None
) -> dict[str, list[Result]]:
    """The results that there are, by method in the given order, seeds ascending.

    :param seeds: those to read; all by default
    :raises ValueError: for a damaged file, and for runs of one folder with other clients or another number of rounds
    """
    found: dict[str, list[Result]] = {}
    for method in methods:
        pattern = re.compile(rf"{re.escape(method)}-seed(\d+)\.json")
        place = result_folder(folder, family, label)
        names = sorted(path.name for path in place.iterdir()) if place.is_dir() else []
        numbers = sorted(int(match[1]) for name in names if (match := pattern.fullmatch(name)))
        wanted = [seed for seed in numbers if seeds is None or seed in seeds]
        if wanted:
            found[method] = [read_result(result_path(folder, family, label, method, seed)) for seed in wanted]
    check_comparable([result for results in found.values() for result in results])
    return found


def check_comparable(results: Sequence[Result]) -> None:
    """:raises ValueError: for runs on one family with other clients, or another number of rounds or of episodes"""
    for result in results:
        first = results[0]
        for name, what in (("n_rounds", "rounds"), ("metadata_hash", "clients"), ("n_episodes", "episodes")):
            if getattr(result, name) != getattr(first, name):
                raise ValueError(
                    f"{result.path} and {first.path} cannot stand in one table: their {what} differ ({getattr(result, name)} "
                    f"and {getattr(first, name)}); move one of them to the folder of another label"
                )


def measure(
    results: Sequence[Result],
    at_rounds: Sequence[int] = (),
    baseline: Sequence[Result] | None = None,
    best_known: np.ndarray | None = None,
) -> Measures:
    """The measures of one method on one family.

    :param results: one per seed
    :param at_rounds: rounds of the curve to report as well
    :param baseline: results of the method whose F counts for the speed-up, and from which differences are taken
    :param best_known: the best return known of each client, ``(n_clients,)``
    """
    paired = [] if baseline is None or baseline is results else paired_differences(results, baseline)
    final = np.array([result.final for result in results])
    success = [result.success for result in results if result.success is not None]
    broadcast = [result.broadcast for result in results if result.broadcast is not None]
    volatilities = [volatility(result) for result in results]
    known = [value for value in volatilities if value is not None]
    curves = [result.curve for result in results]
    return Measures(
        method=results[0].method,
        seeds=tuple(result.seed for result in results),
        F=float(final.mean()),
        F_std=float(final.std()),
        W=float(final.min()),
        CV=float(np.mean(known)) if len(known) == len(results) else None,
        worst_client=float(np.mean([result.worst_client for result in results])),
        success=float(np.mean(success)) if len(success) == len(results) else None,
        broadcast=float(np.mean(broadcast)) if len(broadcast) == len(results) else None,
        curve={
            round: float(np.mean([curve[round] for curve in curves]))
            for round in at_rounds
            if all(round in curve for curve in curves)
        },
        bytes_up_per_round=_known_mean([result.bytes_up for result in results]),
        bytes_down_per_round=_known_mean([result.bytes_down for result in results]),
        offline_bytes_up=_known_mean([result.offline_bytes_up for result in results]),
        offline_bytes_down=_known_mean([result.offline_bytes_down for result in results]),
        seconds_per_round=min(result.median_seconds for result in results),
        paper_F=PAPER_F.get(results[0].family, {}).get(results[0].method),
        speed_up=None if baseline is None else speed_up(results, float(np.mean([result.final for result in baseline]))),
        area=float(np.mean([area(result) for result in results])),
        difference=float(np.mean(paired)) if len(paired) else None,
        difference_interval=_floats(mean_interval(np.array(paired))) if len(paired) > 1 else None,
        stuck=None if best_known is None else stuck_clients(results, best_known),
    )


def speed_up(results: Sequence[Result], target: float) -> float | None:
    """Environment steps of a run over those at which the seeds' mean curve reaches ``target``; ``None`` if it never does.

    :param results: one per seed; only rounds that all seeds evaluated count
    """
    everywhere = set.intersection(*(set(result.curve) for result in results))
    for round in sorted(everywhere):
        if np.mean([result.curve[round] for result in results]) >= target:
            return results[0].n_rounds / float(np.mean([result.spent[round] for result in results]))
    return None


def area(result: Result) -> float:
    """The mean of a run's curve over environment steps, from the first to the last evaluation, by the trapezoidal rule."""
    rounds = sorted(result.curve)
    values, spent = [result.curve[round] for round in rounds], [result.spent[round] for round in rounds]
    return float(np.trapezoid(values, spent) / (spent[-1] - spent[0])) if len(rounds) > 1 else values[0]


def paired_differences(results: Sequence[Result], baseline: Sequence[Result]) -> list[float]:
    """F of each seed minus the baseline's with the same seed."""
    theirs = {result.seed: result.final for result in baseline}
    return [result.final - theirs[result.seed] for result in results if result.seed in theirs]


def best_known(results: Iterable[Result]) -> np.ndarray | None:
    """The best return of each client in any of the runs, ``(n_clients,)``; ``None`` if a file does not say."""
    best = [np.max([result.client_finals, *result.client_curve.values()], axis=0) for result in results]
    return np.max(best, axis=0) if all(len(returns) for returns in best) else None


def stuck_clients(results: Sequence[Result], best: np.ndarray) -> float | None:
    """Clients per run whose return is below :data:`STUCK` of the best known; ``None`` unless all of those are positive."""
    if not (best > 0).all():
        return None
    return float(np.mean([(np.array(result.client_finals) < STUCK * best).sum() for result in results]))


def _floats(interval: tuple[np.ndarray, np.ndarray]) -> tuple[float, float]:
    return float(interval[0]), float(interval[1])


def _known_mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def volatility(result: Result) -> float | None:
    """CV of one run: standard deviation over absolute mean of the last twenty rounds; ``None`` for one round or mean 0."""
    last = [value for round, value in result.curve.items() if round > result.n_rounds - LAST_ROUNDS]
    mean = abs(float(np.mean(last))) if len(last) > 1 else 0.0
    return float(np.std(last)) / mean if mean > 0 else None
