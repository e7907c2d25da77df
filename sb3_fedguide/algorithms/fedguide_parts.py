"""FedGuide's offline stage as plain arrays: priors, experts, DICE values, and what their use needs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sb3_fedguide.offline.dice import DiceValue
from sb3_fedguide.offline.pretraining import untrained_prior
from sb3_fedguide.priors.adaptation import HeadAdaptation
from sb3_fedguide.priors.base import HeadStatistics
from sb3_fedguide.state.array_files import take_prefix
from sb3_fedguide.state.stacked import to_arrays, to_tensors

if TYPE_CHECKING:
    from sb3_fedguide.algorithms.fedguide import FedGuide

#: Parts that come with training and not with the offline stage.
OPTIONAL = {"experts", "calibration"}


def offline_parts(model: FedGuide) -> list[str]:
    """Which parts there are at the moment."""
    held = {
        "prior": model.prior is not None,
        "adaptation": model.adaptation is not None,
        "dice": model.dice is not None,
        "experts": model.experts is not None and bool(np.isfinite(model.mixture_rows).all()),
        "calibration": model.dice_scale is not None,
    }
    return [part for part, is_held in held.items() if is_held]


def begin_parts(model: FedGuide, parts: Sequence[str], pretrained: bool) -> None:
    """Set the parts up in their shapes, with zeros for what is learned.

    :raises ValueError: for parts that this model does not take or lacks
    """
    needed = {"prior": True, "dice": model.uses_dice, "adaptation": model.adapt == "advantage"} if pretrained else {}
    required = {part for part, is_needed in needed.items() if is_needed}
    possible = required | (OPTIONAL if pretrained else set())
    if not model.calibrate:
        possible -= {"calibration"}
    if unknown := sorted(set(parts) - possible):
        raise ValueError(f"the file holds {', '.join(unknown)}, which this model with its settings has not")
    if missing := sorted(required - set(parts)):
        raise ValueError(f"the file holds no {', '.join(missing)}, which this model with its settings needs")
    obs_dim, action_dim = model.observation_space.shape[0], model.action_space.shape[0]  # type: ignore[index]
    n, seed = model.n_clients, model.seed
    assert seed is not None
    model.prior = model.dice = model.dice_scale = model.experts = model.adaptation = None
    if "prior" in parts:
        model.prior = untrained_prior(model.family, model.pretraining_config, obs_dim, action_dim, seed).requires_grad_(False)
        size = model.prior.n_features + 1
        model.heads = np.zeros((n, action_dim, size), dtype=np.float32)
        model.score_moments = np.zeros((n, size, size))
        if "adaptation" in parts:
            blank = HeadStatistics(np.zeros((size, size)), np.zeros((size, action_dim)), 1.0)
            model.adaptation = HeadAdaptation([blank] * n, model.adapt_weight, model.adapt_temperature)
        if "experts" in parts:
            n_experts = model.n_experts or n
            model.experts = np.zeros((n, n_experts, action_dim, size), dtype=np.float32)
            model.mixture_rows = np.zeros((n, n_experts), dtype=np.float32)
    if "dice" in parts:
        model.dice = DiceValue(n, obs_dim, model.pretraining_config.dice_width).requires_grad_(False)
    if "calibration" in parts:
        model.dice_scale, model.calibrated = np.zeros((n, 2)), np.zeros(n, dtype=bool)


def part_arrays(model: FedGuide) -> dict[str, np.ndarray]:
    """Every part's arrays by name."""
    arrays: dict[str, np.ndarray] = {}
    parts = offline_parts(model)
    if model.prior is not None:
        arrays |= to_arrays(model.prior.state_dict(), "prior/trunk/")
        arrays |= {"prior/heads": model.heads.copy(), "prior/moments": model.score_moments.copy()}
    if model.adaptation is not None:
        arrays["prior/gram"] = np.stack([statistics.gram for statistics in model.adaptation.offline])
        arrays["prior/cross"] = np.stack([statistics.cross for statistics in model.adaptation.offline])
    if model.experts is not None and "experts" in parts:
        arrays |= {"prior/experts": model.experts.copy(), "prior/mixture_rows": model.mixture_rows.copy()}
    if model.dice is not None:
        arrays |= to_arrays(model.dice.state_dict(), "dice/")
    if model.dice_scale is not None:
        arrays |= {"dice_scale": model.dice_scale.copy(), "dice_calibrated": model.calibrated.copy()}
    return arrays


def set_part_arrays(model: FedGuide, arrays: dict[str, np.ndarray]) -> None:
    """Fill parts that :func:`begin_parts` has set up."""
    if model.prior is not None:
        model.prior.load_state_dict(to_tensors(take_prefix(arrays, "prior/trunk/")))
        model.heads, model.score_moments = arrays["prior/heads"], arrays["prior/moments"]
    if model.adaptation is not None:  # per unit of weight already
        statistics = zip(arrays["prior/gram"], arrays["prior/cross"], strict=True)
        offline = [HeadStatistics(gram, cross, 1.0) for gram, cross in statistics]
        model.adaptation = HeadAdaptation(offline, model.adapt_weight, model.adapt_temperature)
    if model.experts is not None:
        model.experts, model.mixture_rows = arrays["prior/experts"], arrays["prior/mixture_rows"]
    if model.dice is not None:
        model.dice.load_state_dict(to_tensors(take_prefix(arrays, "dice/")))
    if model.dice_scale is not None:
        model.dice_scale, model.calibrated = arrays["dice_scale"], arrays["dice_calibrated"]
