"""Minari datasets from arrays or from the user's own logs, without Minari's data collector."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_fedguide.offline.cache import publish_folder
from sb3_fedguide.offline.data import OfflineData
from sb3_fedguide.offline.minari_io import local_root, write_minari

__all__ = ["COLUMNS", "make_dataset", "read_log"]

#: Entries of a log, and their names in files; further words of a CSV file's columns follow an underscore.
COLUMNS: dict[str, tuple[str, ...]] = {
    "observations": ("observations", "observation", "obs"),
    "actions": ("actions", "action", "act"),
    "rewards": ("rewards", "reward"),
    "next_observations": ("next_observations", "next_observation", "next_obs"),
    "terminations": ("terminations", "terminated", "terminals"),
    "truncations": ("truncations", "truncated", "timeouts"),
    "episodes": ("episodes", "episode"),
}
_NEEDED, _ROWS_OF_VECTORS = ("observations", "actions", "rewards"), ("observations", "actions", "next_observations")
_ID = re.compile(r"^([\w.-]+/)*[\w.-]+-v\d+$")


def make_dataset(
    dataset: str | Path,
    observations: Any,
    actions: Any,
    rewards: Any,
    action_space: gym.Space,
    terminations: Any = None,
    truncations: Any = None,
    next_observations: Any = None,
    episodes: Any = None,
    overwrite: bool = False,
) -> Path:
    """Write transitions, in the order in which they happened, as a Minari dataset.

    Without ``next_observations``, a row's next observation is that of the next row. The last row of a truncated episode then
    has none: it is left out, and its observation ends the episode.

    :param dataset: an id such as ``"robots/arm0-v0"``, stored in Minari's own folder, or a :class:`~pathlib.Path`
    :param observations: ``(n, obs_dim)``
    :param actions: as executed, ``(n, action_dim)``
    :param rewards: ``(n,)``
    :param action_space: the client's; actions outside are refused
    :param terminations: ``(n,)`` bool: the episode ends there by itself; nowhere by default
    :param truncations: ``(n,)`` bool: the episode is cut off there; the last row always ends one
    :param next_observations: ``(n, obs_dim)``
    :param episodes: ``(n,)``: a row with another value than the row before begins an episode
    :param overwrite: replace a dataset that is there
    :return: the dataset's folder, which ``dataset=`` takes as well
    :raises ValueError: for arrays that do not fit together or are not finite, and a dataset that is there already
    """
    folder, name = _target(dataset)
    if folder.exists() and not overwrite:
        raise ValueError(f"there is a dataset {name} already, in {folder}; give another name, or overwrite it")
    columns = {
        "observations": _rows("observations", observations), "actions": _rows("actions", actions),
        "rewards": np.asarray(rewards, dtype=np.float32).reshape(len(rewards), -1),
    }  # fmt: skip
    n = len(columns["observations"])
    if columns["rewards"].shape[1:] != (1,):
        raise ValueError(f"rewards must be one number a row, but have the shape {np.shape(rewards)}")
    columns["rewards"] = columns["rewards"][:, 0]
    ended, cut = (np.zeros(n, dtype=bool) if flags is None else _flags(flags, n) for flags in (terminations, truncations))
    if episodes is not None:
        cut = cut.copy()
        cut[:-1] |= np.asarray(episodes)[:-1] != np.asarray(episodes)[1:]
    cut[-1:] = True
    if next_observations is None:
        following = np.concatenate([columns["observations"][1:], columns["observations"][-1:]])
        keep = ended | ~cut
        following[ended] = columns["observations"][ended]  # the state after the end has no value
    else:
        following, keep = _rows("next_observations", next_observations), np.ones(n, dtype=bool)
    if not all(len(array) == n for array in (*columns.values(), following)):
        shapes = {key: array.shape for key, array in {**columns, "next_observations": following}.items()}
        raise ValueError(f"every array needs the same number of rows: {shapes}")
    if not keep.any():
        raise ValueError("there are no transitions: without next_observations an episode needs two rows at least")
    data = OfflineData(
        **{key: array[keep] for key, array in columns.items()}, next_observations=following[keep], terminations=ended[keep]
    )
    space = _checked_actions(data.actions, action_space)
    bounds = np.full(data.observations.shape[1], np.inf, dtype=np.float32)
    with publish_folder(folder, lambda path: False) as temporary:
        description = {"description": "made by sb3_fedguide from arrays"}
        write_minari(temporary, name, data, gym.spaces.Box(-bounds, bounds), space, description)
    return folder


def read_log(paths: Sequence[str | Path], names: Mapping[str, Sequence[str]] | None = None) -> dict[str, np.ndarray]:
    """Read the arguments of :func:`make_dataset` from CSV or NPZ files; each file ends an episode.

    :param paths: CSV files with a header, or NPZ files, with the same columns
    :param names: the columns (CSV) or the array (NPZ) of an entry of :data:`COLUMNS` with other names
    :raises ValueError: for a file that cannot be read, or lacks the columns
    """
    parts: dict[str, list[np.ndarray]] = {}
    for path in map(Path, paths):
        columns = _npz(path, names or {}) if path.suffix == ".npz" else _csv(path, names or {})
        if parts and columns.keys() | {"truncations"} != parts.keys():
            raise ValueError(f"{path} has {', '.join(columns)}, but the files before it have {', '.join(parts)}")
        n = len(columns["rewards"])
        if n == 0 or any(len(array) != n for array in columns.values()):
            raise ValueError(f"{path}: every column needs the same number of rows, at least one")
        cut = columns.get("truncations", np.zeros(n)).astype(bool)
        cut[-1] = True
        for name, array in {**columns, "truncations": cut}.items():
            parts.setdefault(name, []).append(array)
    try:
        return {name: np.concatenate(arrays) for name, arrays in parts.items()}
    except ValueError as error:
        raise ValueError(f"the files do not fit together: {error}") from None


def _target(dataset: str | Path) -> tuple[Path, str]:
    if isinstance(dataset, Path):
        return dataset.absolute(), f"{dataset.name}" if _ID.match(dataset.name) else f"{dataset.name}-v0"
    if not _ID.match(dataset):
        raise ValueError(f"{dataset!r} is no id of a Minari dataset such as 'robots/arm0-v0'; give a Path for another place")
    return local_root() / dataset, dataset


def _rows(name: str, values: Any) -> np.ndarray:
    array = np.asarray(values, dtype=np.float32)
    if array.ndim not in (1, 2) or len(array) == 0:
        raise ValueError(f"{name} must have one row for each transition, (n, dim), but have the shape {array.shape}")
    return array.reshape(len(array), -1)


def _flags(values: Any, n: int) -> np.ndarray:
    array = np.asarray(values).reshape(-1)
    if len(array) != n or not np.isin(array, (0, 1)).all():
        raise ValueError(f"terminations and truncations are {n} values true or false, but got {len(array)}: {array[:5]} ...")
    return array.astype(bool)


def _checked_actions(actions: np.ndarray, space: gym.Space) -> gym.spaces.Box:
    if not isinstance(space, gym.spaces.Box) or space.shape != actions.shape[1:]:
        raise ValueError(f"actions of shape {actions.shape} do not fit the client's action space {space}")
    outside = (actions < space.low - 1e-6) | (actions > space.high + 1e-6)
    if outside.any():
        row = int(np.argwhere(outside.any(axis=1))[0, 0])
        raise ValueError(
            f"{int(outside.any(axis=1).sum())} actions lie outside the client's action space {space}, the first in row {row}: "
            f"{actions[row]}; record the executed actions"
        )
    return space


def _npz(path: Path, names: Mapping[str, Sequence[str]]) -> dict[str, np.ndarray]:
    from sb3_fedguide.state.array_files import load_arrays

    try:
        arrays = load_arrays(path)
    except FileNotFoundError:
        raise ValueError(f"there is no file {path}") from None
    found = {}
    for entry, known in COLUMNS.items():
        match = next((name for name in names.get(entry) or known if name in arrays), None)
        if match is not None:
            found[entry] = arrays[match]
    return _complete(found, path, arrays, names)


def _csv(path: Path, names: Mapping[str, Sequence[str]]) -> dict[str, np.ndarray]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *lines = [line for line in csv.reader(file) if line and not line[0].startswith("#")]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from None
    except ValueError:
        raise ValueError(f"{path} is empty: a CSV file begins with the names of its columns") from None
    header = [name.strip() for name in header]
    found = {}
    for entry in COLUMNS:
        columns = list(names.get(entry) or [name for name in header if _belongs(name, entry)])
        if missing := [name for name in columns if name not in header]:
            raise ValueError(f"{path} has no column {missing[0]!r}; it has {', '.join(header)}")
        if columns:
            values = np.array([_numbers(path, number, line, header, columns) for number, line in enumerate(lines, 1)])
            found[entry] = values if entry in _ROWS_OF_VECTORS else values.reshape(-1)
    return _complete(found, path, header, names)


def _belongs(column: str, entry: str) -> bool:
    """Whether a column is one of an entry's: of vectors, ``obs0``, ``obs_0`` and ``obs_angle`` are."""
    more = r"(_?\d+|_.+)?" if entry in _ROWS_OF_VECTORS else ""
    return any(re.fullmatch(name + more, column) for name in COLUMNS[entry])


def _numbers(path: Path, number: int, line: list[str], header: list[str], columns: list[str]) -> list[float]:
    if len(line) != len(header):
        raise ValueError(f"{path}: row {number} has {len(line)} values for {len(header)} columns")
    truths = {"true": 1.0, "false": 0.0}
    values = []
    for name in columns:
        text = line[header.index(name)].strip()
        try:
            values.append(truths[text.lower()] if text.lower() in truths else float(text))
        except ValueError:
            raise ValueError(f"{path}: row {number}, column {name!r}: {text!r} is no number") from None
    return values


def _complete(
    found: dict[str, np.ndarray], path: Path, there: Any, names: Mapping[str, Sequence[str]]
) -> dict[str, np.ndarray]:
    for entry in _NEEDED:
        if entry not in found:
            wanted = " or ".join(names.get(entry) or COLUMNS[entry])
            raise ValueError(f"{path} has no {entry} ({wanted}); it has {', '.join(there)}: name them with --{entry}")
    return found
