"""Checkpoints of a run: one npz file each, plain arrays and a JSON text, written complete or not at all.

Nothing in them is pickled, and a file whose content does not have the checksum that was written with it is not used.
"""

from __future__ import annotations

import json
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from fed_envs.state import State
from sb3_fedguide.common.array_files import read_arrays, write_arrays
from sb3_fedguide.common.callbacks import RoundCallback

#: How many checkpoints stay: the newest may turn out to be damaged.
KEPT = 2
#: Raised whenever what a checkpoint holds changes, so that another version's is refused.
FORMAT = 1
_JSON = "state.json"
_TAG = "__type__"  # as in fed_envs.state, which keeps it out of the states' own keys
_NAME = re.compile(r"round_(\d+)\.npz")


class CheckpointError(ValueError):
    """A run cannot be saved, or cannot go on from its checkpoint."""


def write_checkpoint(folder: str | Path, round: int, state: State) -> Path:
    """Write ``round_<number>.npz``, and remove all but the newest :data:`KEPT`.

    :param state: dicts with text for keys, lists, arrays and JSON values
    :raises OSError: where it cannot be written; what was there before stays
    """
    arrays: dict[str, np.ndarray] = {}
    text = json.dumps({"format": FORMAT, "state": _without_arrays(state, "", arrays)}, allow_nan=False)
    path = Path(folder) / f"round_{round:06d}.npz"
    write_arrays(path, {**arrays, _JSON: np.frombuffer(text.encode(), dtype=np.uint8)})
    _remove_old(folder)
    return path


def read_checkpoint(path: str | Path) -> State:
    """What :func:`write_checkpoint` wrote.

    :raises ValueError: for a file that is damaged, of another version or something else
    :raises FileNotFoundError: if there is none
    """
    arrays = read_arrays(Path(path))
    try:
        content = json.loads(arrays[_JSON].tobytes())
        if content["format"] != FORMAT:
            raise ValueError(
                f"{path} has format {content['format']!r} and this version reads {FORMAT}: go on with the version of the "
                "package that wrote it"
            )
        return _with_arrays(content["state"], arrays)
    except (KeyError, TypeError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is no checkpoint: {error!r}") from None


def checkpoints(folder: str | Path) -> list[Path]:
    """The checkpoints in a folder, oldest first."""
    if not Path(folder).is_dir():
        return []
    found = [(int(match[1]), path) for path in Path(folder).iterdir() if (match := _NAME.fullmatch(path.name))]
    return [path for _, path in sorted(found)]


def _remove_old(folder: str | Path) -> None:
    for old in checkpoints(folder)[:-KEPT]:
        old.unlink(missing_ok=True)


def newest_checkpoint(folder: str | Path) -> tuple[Path, State] | None:
    """The newest intact checkpoint; ``None`` where there is none at all. Damaged ones are named in a warning.

    :raises ValueError: if none of those that are there can be read
    """
    problems = []
    for path in reversed(checkpoints(folder)):
        try:
            state = read_checkpoint(path)
        except ValueError as error:
            problems.append(str(error))
            continue
        for problem in problems:
            warnings.warn(f"{problem}; going on from the one before it, {path.name}", stacklevel=2)
        return path, state
    if problems:
        raise ValueError(f"no checkpoint can be read: {'; '.join(problems)}")
    return None


class CheckpointCallback(RoundCallback):
    """Writes a checkpoint every ``save_freq`` rounds, from which :meth:`Federation.resume` goes on.

    :param folder: where to write them; the last two stay
    :param save_freq: rounds between them
    :raises ValueError: for ``save_freq`` below one
    :raises CheckpointError: at the start of training, where the run cannot be saved
    """

    def __init__(self, folder: str | Path, save_freq: int = 10) -> None:
        super().__init__()
        if save_freq < 1:
            raise ValueError(f"save_freq={save_freq} must be at least 1 round; without checkpoints, leave the callback out")
        self.folder, self.save_freq = Path(folder), save_freq
        #: round of the last checkpoint that was written
        self.saved_round: int | None = None

    def _on_training_start(self) -> None:
        for leftover in self.folder.glob(".round_*.part"):  # of a process that was killed while it wrote
            leftover.unlink()
        _remove_old(self.folder)
        try:
            self._state()  # what cannot be saved is said now and not after `save_freq` rounds
        except ValueError as error:
            raise CheckpointError(f"{error} (or train without checkpoints: --save-freq 0 on the command line)") from error

    def _on_round_logged(self) -> bool:
        if self.model.round % self.save_freq == 0:
            self.save()
        return True

    def save(self) -> bool:
        """Write a checkpoint of the round that has just ended, unless there is one.

        :return: false where it could not be written, after a warning: training goes on, and so may the next checkpoint
        """
        if self.saved_round == self.model.round:
            return True
        try:
            write_checkpoint(self.folder, self.model.round, self._state())
        except (OSError, ValueError) as error:
            warnings.warn(f"no checkpoint after round {self.model.round}: {error}", stacklevel=2)
            return False
        self.saved_round = self.model.round
        return True

    def _state(self) -> State:
        saved = [(type(callback).__name__, callback.save_state()) for callback in self.locals["rounds"]]
        callbacks = [{"class": name, "state": state} for name, state in saved if state]
        return {"round": self.model.round, "model": self.model.save_state(), "callbacks": callbacks}


def _without_arrays(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    """``value`` with each array replaced by its name in ``arrays``, where it is put."""
    if isinstance(value, dict):
        return {key: _without_arrays(item, f"{path}/{key}", arrays) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_arrays(item, f"{path}/{index}", arrays) for index, item in enumerate(value)]
    if not isinstance(value, np.ndarray):
        return value
    name = path.removeprefix("/")
    while name in arrays:  # keys may contain slashes
        name += "_"
    arrays[name] = value
    return {_TAG: "array", "name": name}


def _with_arrays(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(value, dict):
        if value.get(_TAG) == "array":
            return arrays[value["name"]]
        return {key: _with_arrays(item, arrays) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_arrays(item, arrays) for item in value]
    return value
