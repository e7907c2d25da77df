"""``--track``: also log a run to Weights & Biases or trackio, with TensorBoard's keys and environment steps as x axis."""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.logger import KVWriter


class TrackerOutputFormat(KVWriter):
    """An output of SB3's logger that sends every number to a tracking library.

    :param name: of the library: ``trackio`` or ``wandb``
    :param project: of the run in the library
    :param folder: of the run; a run that is resumed in its folder is resumed in the library too
    :param config: settings that the library shows
    :param resumed: whether the run is resumed
    """

    def __init__(self, name: str, project: str, folder: Path, config: Mapping[str, Any], resumed: bool) -> None:
        self._tracker: Any = importlib.import_module(name)
        place = str(folder.absolute())
        run_name = f"{folder.parent.name}-{folder.name}-{hashlib.sha256(place.encode()).hexdigest()[:8]}"
        shown: dict[str, Any] = {"project": project, "config": dict(config)}
        if name == "wandb":
            shown.update(
                id=run_name, name=f"{folder.parent.name}/{folder.name}", dir=place, resume="allow" if resumed else None
            )
        else:
            shown.update(name=run_name, resume="allow" if resumed else "never")
        try:
            self._run = self._tracker.init(**shown)
        except Exception as error:  # any error of the library without a key, a network or a writable folder
            reason = " ".join(str(error).split()) or type(error).__name__
            raise OSError(f"--track {name}: {reason}") from error

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        numbers = {
            key: float(value)
            for key, value in key_values.items()
            if isinstance(value, int | float | np.number) and "tensorboard" not in (key_excluded.get(key) or ())
        }
        self._run.log(numbers, step=step)

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Send the run's summary, as ``summary/`` keys, and end the run in the library."""
        numbers = {
            f"summary/{name}": value
            for name, value in _flat(summary).items()
            if isinstance(value, bool | int | float) and name != "seed"
        }
        if self._tracker.__name__ == "wandb":
            self._run.summary.update(numbers)
        else:
            self._run.log(numbers, step=summary["timesteps"])
        self._run.finish()

    def close(self) -> None:
        """Do nothing: the logger is closed before the summary is known. A run without a summary ends with Python."""


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat.update(_flat(value, f"{prefix}{name}/") if isinstance(value, Mapping) else {f"{prefix}{name}": value})
    return flat
