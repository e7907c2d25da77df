"""Estimated cost of a run, in seconds of one idle core, from measured rounds.

The figures are those of ``docs/performance.md`` (networks 64-64, eight clients, a quiet machine). A busy machine takes two or
three times as long; so does another processor.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fed_envs import Family
from sb3_fedguide.offline.collect import default_size
from sb3_fedguide.registry import algorithm
from sb3_fedguide.server.averaging import policy_is_due
from sb3_fedguide.settings.evaluation import broadcast_is_due, deployed_is_due
from sb3_fedguide.settings.participants import n_participants
from sb3_fedguide.settings.pretraining import Piece, PretrainingConfig, prior_is_gaussian

#: Microseconds of one client's environment step with its policy, by backbone; and steps of an evaluation episode, at most.
STEPS: dict[str, tuple[float, int]] = {
    "Bandit2D": (40, 1), "Reacher-v5": (25, 50), "Hopper-v5": (61, 700), "Walker2d-v5": (90, 1000),
    "HalfCheetah-v5": (32, 1000), "MetaWorld-v3": (410, 500), "PointMaze-v3": (33, 300),
}  # fmt: skip
#: For backbones without a measurement.
OTHER_STEPS = (60, 1000)
#: How much longer a step takes for each width of 64 more.
STEP_WIDTH = 0.2
#: Microseconds of a row of the rollout in an epoch, for layers of 64; the cost grows with their width.
ROW, ROW_WIDTH = 4.9, 64
#: Microseconds of a client's gradient step of DDPG, 64-64.
DDPG_STEP = 360.0
#: Factor of a method's own terms on training time; and on a whole round, for each estimator of the prior's term.
TRAINING = {"fedprox": 1.3, "fedkl": 1.4, "fedsvrpgm": 1.9}
PRIOR_ROUND = {"sample": 1.2, "snis": 1.75}
#: Milliseconds of an update of eight clients of behaviour cloning, trunk and DICE with so many rows in a batch.
OFFLINE_UPDATE: dict[Piece, tuple[float, int]] = {"bc": (6.5, 512), "prior": (10.8, 128), "dice": (33.0, 128)}
#: Seconds for the data of eight clients, and for the heads on the trunk, of so many rows each.
OFFLINE_ROWS = {"bc": 12.0, "prior": 11.0, "dice": 0.0}
ROWS, CLIENTS = 20_000, 8


@dataclass(frozen=True)
class Cost:
    """Of one run, in seconds.

    :param rounds: rollouts, training and tests
    :param evaluation: of the deployed policies
    :param offline: piece of the offline stage to its seconds; runs with the same piece share it
    """

    rounds: float
    evaluation: float
    offline: Mapping[str, float]


def estimate(
    algo: str,
    values: Mapping[str, Any],
    family: Family,
    seed: int,
    eval_freq: int,
    n_episodes: int,
    eval_average: bool = False,
) -> Cost:
    """The cost of a run.

    :param values: its complete hyperparameters
    :param seed: the offline stage is kept for each seed
    :param eval_freq: rounds between evaluations
    :param n_episodes: episodes per client of one
    :param eval_average: whether the average of the policies is evaluated where the method sends none
    """
    n_rounds, present = values["n_rounds"], n_participants(values["client_fraction"], family.n_clients)
    step, length = STEPS.get(family.backbone, OTHER_STEPS)
    width = _width(values["policy_kwargs"])
    step *= 1 + STEP_WIDTH * max(0.0, width / ROW_WIDTH - 1)
    rows = values["rollout_size"] * present
    if "n_epochs" in values:
        training = ROW * width / ROW_WIDTH * values["n_epochs"] * TRAINING.get(algo, 1.0)
    else:
        training = DDPG_STEP * width / ROW_WIDTH
    round = rows * (step * (1 + values.get("screening", 0.0)) + training) / 1e6
    guided = (
        min(values.get("prior_horizon", 0), n_rounds) / n_rounds * (PRIOR_ROUND.get(values.get("prior_loss", ""), 1.0) - 1)
    )
    evaluations = _evaluations(values, eval_freq, eval_average)
    return Cost(
        rounds=n_rounds * round * (1 + guided),
        evaluation=evaluations * n_episodes * family.n_clients * length * step / 1e6,
        offline=_offline(algo, values, family, seed),
    )


def _evaluations(values: Mapping[str, Any], eval_freq: int, eval_average: bool) -> int:
    """Of the deployed policies, of broadcast policies, and of averages; a ``mix`` that ends counts as one that stays."""
    found, n_rounds = 0, values["n_rounds"]
    for round in range(1, n_rounds + 1):
        due = deployed_is_due(round, n_rounds, eval_freq)
        if "average" in values and policy_is_due(round, values["average"], values["average_every"], values["average_until"]):
            found += due + broadcast_is_due(round, n_rounds, eval_freq)
        else:
            found += due + (due and eval_average)
    return found


def _width(policy_kwargs: Mapping[str, Any]) -> int:
    layers = policy_kwargs["net_arch"] or [ROW_WIDTH]
    layers = [*layers["pi"], *next(layers[name] for name in layers if name != "pi")] if isinstance(layers, dict) else layers
    return max(layers, default=ROW_WIDTH)


def _offline(algo: str, values: Mapping[str, Any], family: Family, seed: int) -> dict[str, float]:
    config = PretrainingConfig(**values["pretraining"])
    gaussian = prior_is_gaussian(config.prior, family.world)
    pieces: list[Piece] = ["bc"] if values["bc_weight"] > 0 else []
    pieces += ["prior"] if getattr(algorithm(algo), "uses_prior", False) and not gaussian else []
    pieces += ["dice"] if getattr(algorithm(algo), "uses_dice", False) else []
    n_rows = config.dataset_size or default_size(family)
    found = {}
    for piece in pieces:
        milliseconds, batch = OFFLINE_UPDATE[piece]
        n_updates, share = config.n_updates(piece, n_rows), getattr(config, f"{piece}_batch_size") / batch
        seconds = milliseconds * n_updates * max(share, math.sqrt(share)) / 1e3  # small batches gain less
        own = {name: value for name, value in config.model_dump(mode="json").items() if name.startswith((piece, "dataset"))}
        network = values["policy_kwargs"]["net_arch"] if piece == "bc" else None
        key = json.dumps([piece, seed, own, network], sort_keys=True)
        found[key] = (seconds + OFFLINE_ROWS[piece] * n_rows / ROWS) * family.n_clients / CLIENTS
    return found
