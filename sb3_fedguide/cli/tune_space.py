"""The search space of ``fedguide tune``: hyperparameters and their values, from a YAML file or by default."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.registry import algorithm, registered_names

if TYPE_CHECKING:
    import optuna

#: Hyperparameters that every PPO method searches besides its own coefficients.
PPO: dict[str, list[Any]] = {"learning_rate": [1e-4, 3e-4, 1e-3], "n_epochs": [4, 8, 16]}
DDPG: dict[str, list[Any]] = {"learning_rate": [3e-5, 1e-4, 3e-4], "tau": [0.001, 0.005]}
#: At most three values of an algorithm's own coefficients, so that all are tuned with about equal effort.
OWN: dict[str, dict[str, list[Any]]] = {
    "fedavg": {"server_step": [0.5, 1.0, 2.0]},
    "fedprox": {"mu": [0.001, 0.01, 0.1]},
    "fedkl": {"lambda_global": [0.03, 0.1, 0.3], "lambda_local": [0.015, 0.05, 0.15]},
    "fedsvrpgm": {"beta": [0.1, 0.2, 0.4], "reference_every": [2, 5, 10]},
    "fedguide": {"lambda_trust": [0.01, 0.05, 0.2], "lambda_prior": [0.02, 0.1, 0.5], "beta": ["auto", 0.25, 0.5]},
    "fedguide-p": {"lambda_trust": [0.01, 0.05, 0.2], "lambda_prior": [0.02, 0.1, 0.5]},
    "fedguide-a": {"lambda_trust": [0.01, 0.05, 0.2], "lambda_prior": [0.02, 0.1, 0.5], "average_every": [1, 5, 10]},
    "fedguide-r": {"server_step": [1.0, 2.0, 3.0], "mix": ["until_0.3", "until_0.4", "until_0.5"]},
}
#: Hyperparameters that determine the environment steps of a trial.
BUDGET = ("n_rounds", "rollout_size", "client_fraction")


@dataclass(frozen=True)
class Interval:
    """Numbers from ``low`` to ``high``, integers if both are; proposed on a logarithmic scale if ``log``."""

    low: float
    high: float
    log: bool = False

    @property
    def whole(self) -> bool:
        return isinstance(self.low, int) and isinstance(self.high, int)


@dataclass(frozen=True)
class Space:
    """Name (dotted if nested) to a list of values or an interval."""

    entries: Mapping[str, list[Any] | Interval]

    def suggest(self, trial: optuna.Trial) -> dict[str, Any]:
        """One proposal of the study's sampler."""
        return {name: self._suggest(trial, name) for name in self.entries}

    def _suggest(self, trial: optuna.Trial, name: str) -> Any:
        entry = self.entries[name]
        if not isinstance(entry, Interval):
            return json.loads(trial.suggest_categorical(name, [json.dumps(value) for value in entry]))
        if entry.whole:
            return trial.suggest_int(name, int(entry.low), int(entry.high), log=entry.log)
        return trial.suggest_float(name, entry.low, entry.high, log=entry.log)

    def grid(self) -> Iterator[dict[str, str]]:
        """Every combination, as Optuna's parameters.

        :raises ValueError: if there is an interval
        """
        for name, entry in self.entries.items():
            if isinstance(entry, Interval):
                raise ValueError(f"--sampler grid needs lists of values, but {name} is an interval; list its values")
        texts = [[json.dumps(value) for value in entry] for entry in self.entries.values()]  # type: ignore[union-attr]
        return (dict(zip(self.entries, values, strict=True)) for values in itertools.product(*texts))

    def probes(self) -> Iterator[dict[str, Any]]:
        """Every value, or both ends of an interval, with the first values of the other parameters."""
        ends = {
            name: [entry.low, entry.high] if isinstance(entry, Interval) else entry for name, entry in self.entries.items()
        }
        first = {name: values[0] for name, values in ends.items()}
        yield first
        for name, values in ends.items():
            for value in values[1:]:
                yield {**first, name: value}

    def plain(self) -> dict[str, Any]:
        """The space as plain data, as in a file."""
        return {name: vars(entry) if isinstance(entry, Interval) else entry for name, entry in self.entries.items()}


def default_space(algo: str, fixed: Mapping[str, Any]) -> Space:
    """The space of an algorithm (of a user's own: that of its nearest known class), without ``fixed`` hyperparameters.

    :raises ValueError: if nothing is left
    """
    from sb3_fedguide.common.federated_ppo import FederatedPPO

    cls = algorithm(algo)
    own = OWN.get(next((name for name in registered_names(cls) if name in OWN), ""), {})
    entries = {**own, **(PPO if issubclass(cls, FederatedPPO) else DDPG)}
    left = {name: values for name, values in entries.items() if name not in fixed}
    if not left:
        raise ValueError(f"-params fixes the whole search space of {algo}: {', '.join(entries)}; give a space with --search")
    return Space(left)


def read_space(path: Path, fixed: Mapping[str, Any]) -> Space:
    """The space in a YAML file.

    :raises ValueError: for a file that cannot be read or is not a space, or if it has ``fixed`` hyperparameters
    """
    from sb3_fedguide.settings.config import read_yaml

    if not path.is_file():
        raise ValueError(f"--search: there is no file {path}")
    content = read_yaml(path)
    if not isinstance(content, dict) or not content:
        raise ValueError(f"{path}: a search space maps hyperparameters to values, e.g. 'learning_rate: [1e-4, 3e-4]'")
    for name in content:
        if name in BUDGET:
            raise ValueError(f"{path}: {name} cannot be searched: every trial has the same rounds and environment steps")
        if name in fixed:
            raise ValueError(f"{path} searches {name} and -params sets it; give one of them")
    return Space({str(name): _entry(path, str(name), value) for name, value in content.items()})


def _entry(path: Path, name: str, value: Any) -> list[Any] | Interval:
    if isinstance(value, list) and value:
        texts = [json.dumps(item, default=str) for item in value]
        if len(set(texts)) < len(texts):
            raise ValueError(f"{path}: {name} lists a value twice")
        return value
    if not isinstance(value, dict) or not {"low", "high"} <= value.keys() <= {"low", "high", "log"}:
        raise ValueError(f"{path}: {name} must be [values] or {{low: ..., high: ..., log: true}}, but it is {value!r}")
    low, high, log = value["low"], value["high"], value.get("log", False)
    if any(isinstance(end, bool) or not isinstance(end, int | float) or not math.isfinite(end) for end in (low, high)):
        raise ValueError(f"{path}: low and high of {name} must be numbers, but they are {low!r} and {high!r}")
    if not isinstance(log, bool):
        raise ValueError(f"{path}: log of {name} must be true or false, but it is {log!r}")
    if low >= high or (log and low <= 0):
        raise ValueError(f"{path}: {name} goes from {low} to {high}; low must be below high{', and positive' * log}")
    return Interval(low, high, log)
