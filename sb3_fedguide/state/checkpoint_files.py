"""Checkpoint files: one npz file each, plain arrays and a JSON text, written complete or not at all. Needs only NumPy.

Nothing in them is pickled, and a file whose content does not match its checksum is not used.
"""

from __future__ import annotations

import json
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from fed_envs.plain_data import TAG, State
from sb3_fedguide.state.array_files import read_arrays, write_arrays

#: Number of checkpoints to keep: the newest may be damaged.
KEPT = 2
#: Increased with every change of a checkpoint's content, so that another version's is refused.
FORMAT = 3
_JSON = "state.json"
_NAME = re.compile(r"round_(\d+)\.npz")


def write_checkpoint(folder: str | Path, round: int, state: State) -> Path:
    """Write ``round_<number>.npz``, and remove all but the newest :data:`KEPT`.

    :param state: dicts with text for keys, lists, arrays and JSON values
    :raises OSError: if it cannot be written; earlier checkpoints stay
    """
    arrays: dict[str, np.ndarray] = {}
    text = json.dumps({"format": FORMAT, "state": _without_arrays(state, "", arrays)}, allow_nan=False)
    path = Path(folder) / f"round_{round:06d}.npz"
    write_arrays(path, {**arrays, _JSON: np.frombuffer(text.encode(), dtype=np.uint8)})
    remove_old(folder)
    return path


def read_checkpoint(path: str | Path) -> State:
    """What :func:`write_checkpoint` wrote.

    :raises ValueError: for a file that is damaged, of another version or not a checkpoint
    :raises FileNotFoundError: if there is none
    """
    arrays = read_arrays(Path(path))
    try:
        content = json.loads(arrays[_JSON].tobytes())
        if content["format"] != FORMAT:
            raise ValueError(
                f"{path} has format {content['format']!r} and this version reads {FORMAT}: resume it with the version of the "
                "package that wrote it"
            )
        return _with_arrays(content["state"], arrays)
    except (KeyError, TypeError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is not a checkpoint: {error!r}") from None


def checkpoints(folder: str | Path) -> list[Path]:
    """The checkpoints in a folder, oldest first."""
    if not Path(folder).is_dir():
        return []
    found = [(int(match[1]), path) for path in Path(folder).iterdir() if (match := _NAME.fullmatch(path.name))]
    return [path for _, path in sorted(found)]


def remove_old(folder: str | Path) -> None:
    """Keep the newest :data:`KEPT` checkpoints of a folder only."""
    for old in checkpoints(folder)[:-KEPT]:
        old.unlink(missing_ok=True)


def remove_leftovers(folder: str | Path) -> None:
    """Remove half-written files of a killed process."""
    for leftover in Path(folder).glob(".round_*.part"):
        leftover.unlink()


def newest_checkpoint(folder: str | Path) -> tuple[Path, State] | None:
    """The newest intact checkpoint; ``None`` if the folder has no checkpoint. A warning names damaged ones.

    :raises ValueError: if there are checkpoints, but none can be read
    """
    problems = []
    for path in reversed(checkpoints(folder)):
        try:
            state = read_checkpoint(path)
        except ValueError as error:
            problems.append(str(error))
            continue
        for problem in problems:
            warnings.warn(f"{problem}; resuming from the one before it, {path.name}", stacklevel=2)
        return path, state
    if problems:
        raise ValueError(f"no checkpoint can be read: {'; '.join(problems)}")
    return None


def _without_arrays(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    """``value`` with each array moved to ``arrays`` and replaced by its name there."""
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
    return {TAG: "array", "name": name}


def _with_arrays(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(value, dict):
        if value.get(TAG) == "array":
            return arrays[value["name"]]
        return {key: _with_arrays(item, arrays) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_arrays(item, arrays) for item in value]
    return value
