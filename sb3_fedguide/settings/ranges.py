"""The ranges of all hyperparameters, for constructors and the command line alike."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any, NamedTuple

_OPEN = 1e-12  # smallest value of what must be positive

#: Any integer stays below this.
MAX_INTEGER = 2**31


class Range(NamedTuple):
    """A closed range of numbers.

    :param whole: integers only
    :param words: values that are no numbers, such as ``None``
    """

    low: float
    high: float = math.inf
    whole: bool = False
    words: tuple[Any, ...] = ()


_COUNT = Range(1, whole=True)
_POSITIVE = Range(_OPEN)
_NOT_NEGATIVE = Range(0)
_SHARE = Range(0, 1)

#: Sizes end far above what is useful and below what no memory holds.
RANGES: dict[str, Range] = {
    "n_rounds": Range(1, 1e7, whole=True),
    "learning_rate": _POSITIVE,
    "n_epochs": _COUNT,
    "batch_size": Range(1, 1e7, whole=True),
    "gamma": _SHARE,
    "gae_lambda": _SHARE,
    "clip_range": _POSITIVE,
    "clip_range_vf": Range(_OPEN, words=(None,)),
    "ent_coef": _NOT_NEGATIVE,
    "vf_coef": _NOT_NEGATIVE,
    "max_grad_norm": _POSITIVE,
    "n_envs_per_client": Range(1, 1000, whole=True),
    "num_threads": Range(1, 1000, whole=True),
    "rollout_size": Range(2, 1e7, whole=True),
    "stats_window_size": _COUNT,
    "bc_weight": _SHARE,
    "client_fraction": Range(_OPEN, 1),
    "upload_bound": Range(_OPEN, words=(None,)),
    "trim_fraction": Range(0, 0.5),
    "lambda_trust": _NOT_NEGATIVE,
    "lambda_prior": _NOT_NEGATIVE,
    "prior_horizon": _COUNT,
    "beta": Range(0, 1, words=("auto",)),
    "n_experts": Range(1, 1e4, whole=True, words=(None,)),
    "eta": _POSITIVE,
    "prior_states": Range(1, 1e7, whole=True, words=(None,)),
    "density_steps": _COUNT,
    "sampling_steps": _COUNT,
    "adapt_temperature": _POSITIVE,
    "adapt_weight": _SHARE,
    "average_every": _COUNT,
    "average_until": Range(1, whole=True, words=(None,)),
    "server_step": Range(_OPEN, words=("exp",)),
    "server_momentum": Range(0, 1),
    "mix": Range(0, 100),
    "screening": Range(0, 0.5),
    "noise_multiplier": Range(0, 1e6),
    "clipping_norm": Range(_OPEN, words=(None,)),
    "delta": Range(_OPEN, 0.1),
    "buffer_size": Range(1, 1e8, whole=True),
    "learning_starts": Range(0, whole=True),
    "tau": Range(_OPEN, 1),
    "train_freq": _COUNT,
    "noise_theta": _NOT_NEGATIVE,
    "noise_sigma": _NOT_NEGATIVE,
    "noise_dt": _POSITIVE,
    "mu": _NOT_NEGATIVE,
    "lambda_global": _NOT_NEGATIVE,
    "lambda_local": _NOT_NEGATIVE,
    "reference_every": _COUNT,
}


def check_ranges(values: Mapping[str, Any]) -> None:
    """Check those of ``values`` that have a range; of a schedule of the remaining progress, what it begins with.

    :raises ValueError: for the first that is no number or out of its range
    """
    for name, limits in RANGES.items():
        if name not in values or any(values[name] is word or values[name] == word for word in limits.words):
            continue
        value = values[name](1.0) if callable(values[name]) else values[name]
        if not isinstance(value, Real) or isinstance(value, bool) or (limits.whole and not isinstance(value, Integral)):
            raise ValueError(f"{name} must be {'an integer' if limits.whole else 'a number'}, but it is {value!r}")
        check_range(name, value)


def check_range(name: str, number: Real | float) -> None:
    """:raises ValueError: for a number that is out of the range of the hyperparameter ``name``, or that is not finite"""
    if isinstance(number, Integral) and abs(int(number)) >= MAX_INTEGER:
        raise ValueError(f"{name} must be below 2^31, but it has {len(str(abs(int(number))))} digits")
    number = float(number)
    if not math.isfinite(number):
        raise ValueError(f"{name}={number} must be finite")
    limits = RANGES.get(name, Range(-math.inf))
    if not limits.low <= number <= limits.high:
        lower = "positive" if limits.low == _OPEN else f"at least {limits.low:g}"
        if limits.high <= 1:
            expected = f"in (0, {limits.high:g}]" if limits.low == _OPEN else f"between {limits.low:g} and {limits.high:g}"
        else:
            expected = lower if number < limits.low else f"at most {limits.high:.0f}"
        raise ValueError(f"{name}={number:g} must be {expected}")
