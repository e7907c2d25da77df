"""Offline data as Minari datasets, read and written by path so that Minari's environment variable stays untouched."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
from minari.data_collector.episode_buffer import EpisodeBuffer
from minari.dataset._storages import get_minari_storage
from minari.dataset.minari_storage import MinariStorage
from minari.serialization import deserialize_space

from sb3_fedguide.offline.data import OfflineData

#: How far an action may lie outside its bounds, relative to them: the rounding of a conversion between float types.
ROUNDING = 1e-5

__all__ = ["check_spaces", "find_dataset", "local_root", "read_minari", "write_minari"]


def write_minari(
    folder: Path,
    dataset_id: str,
    data: OfflineData,
    observation_space: gym.spaces.Box,
    action_space: gym.spaces.Box,
    metadata: dict[str, Any],
) -> None:
    """Write ``data`` as the Minari dataset ``dataset_id`` into ``folder`` (its ``data`` subfolder), one episode each."""
    ends = np.flatnonzero(data.episode_ends)
    starts = np.concatenate([[0], ends[:-1] + 1])
    episodes = []
    for start, end in zip(starts, ends, strict=True):
        rows = slice(int(start), int(end) + 1)
        truncations = np.zeros(end + 1 - start, dtype=bool)
        truncations[-1] = not data.terminations[end]
        episodes.append(
            EpisodeBuffer(
                observations=np.concatenate([data.observations[rows], data.next_observations[end : end + 1]]),
                actions=data.actions[rows],
                rewards=data.rewards[rows],
                terminations=data.terminations[rows],
                truncations=truncations,
            )
        )
    folder.mkdir(parents=True, exist_ok=True)
    storage = MinariStorage.new(folder / "data", _as_float32(observation_space), _as_float32(action_space), data_format="hdf5")
    storage.update_metadata({"dataset_id": dataset_id, "minari_version": minari.__version__, **metadata})
    # HDF5 may crash the process when it cannot finish a file, as on a full disk, so it writes to memory.
    content, path = io.BytesIO(), storage._file_path  # type: ignore[attr-defined]
    storage._file_path = content  # type: ignore[attr-defined]
    storage.update_episodes(episodes)
    storage._file_path = path  # type: ignore[attr-defined]
    path.write_bytes(content.getbuffer())
    storage.update_metadata({"dataset_size": storage.get_size()})


def read_minari(data_path: Path, max_rows: int | None = None, rng: np.random.Generator | None = None) -> OfflineData:
    """Read a Minari dataset's ``data`` folder.

    :param max_rows: stop after so many rows; default all
    :param rng: draws the order of the episodes; default as recorded
    :raises ValueError: if there is no readable dataset with Box observations and actions
    """
    storage = _open(data_path)
    try:
        order = np.arange(storage.total_episodes)
        if rng is not None:
            rng.shuffle(order)
        names = ("observations", "actions", "rewards", "next_observations", "terminations", "truncations")
        columns: dict[str, list[np.ndarray]] = {name: [] for name in names}
        missing = max_rows if max_rows is not None else storage.total_steps
        for episode in storage.get_episodes(order):
            rows = min(len(episode["rewards"]), missing)
            observations = episode["observations"]
            columns["observations"].append(observations[:rows])
            columns["next_observations"].append(observations[1 : rows + 1])
            for name in ("actions", "rewards", "terminations"):
                columns[name].append(episode[name][:rows])
            columns["truncations"].append(np.arange(rows) == rows - 1)  # whatever its flags say, the record ends there
            missing -= rows
            if missing <= 0:
                break
        data = OfflineData(**{name: np.concatenate(parts) for name, parts in columns.items()})
    except Exception as error:  # h5py, json, Gymnasium and NumPy each have their own for a file that is not what it should be
        raise ValueError(f"{data_path} is not a readable Minari dataset of Box spaces: {error}") from error
    _check_actions(data_path, data.actions, storage.action_space)
    return data


def _check_actions(data_path: Path, actions: np.ndarray, space: gym.Space) -> None:
    """:raises ValueError: for actions outside the space that the dataset declares"""
    assert isinstance(space, gym.spaces.Box)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    beyond = np.maximum(low - actions, actions - high).max(axis=1)
    wrong = beyond > ROUNDING * np.maximum(1.0, np.abs(np.where(np.isfinite(high), high, 1.0)).max())
    if wrong.any():
        raise ValueError(
            f"the dataset at {data_path} has actions outside its own action space {space} in {wrong.sum()} of {len(actions)} "
            f"rows, by up to {beyond.max():.3g}: clients would imitate actions that no environment executes. Record the "
            "executed actions (clipped to the space), or leave these episodes out"
        )


def find_dataset(dataset: str) -> Path:
    """The ``data`` folder of a local Minari dataset, by id or by path.

    :raises ValueError: if there is none; the message lists the local ones
    """
    root = local_root()
    try:
        path = Path(dataset).expanduser()
        for candidate in (path, path / "data", root / dataset / "data"):
            if (candidate / "metadata.json").is_file():
                return candidate
    except (OSError, RuntimeError) as error:  # a name that is too long, or the home of a user who does not exist
        raise ValueError(f"{dataset!r} is no Minari dataset: {error}") from None
    local = ", ".join(sorted(_local_datasets(root))) or "none"
    raise ValueError(
        f"no Minari dataset {dataset!r} on this machine (a path was tried, too). Local datasets: {local}. "
        f"Fetch a public one with `minari download {dataset}`"
    )


def local_root() -> Path:
    """Where Minari keeps its datasets. Its own functions would make the folder, and import the environment of a dataset."""
    return Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets")


def _local_datasets(root: Path) -> Iterator[str]:
    for metadata in root.rglob("data/metadata.json"):
        name = metadata.parent.parent.relative_to(root)
        if not any(part.startswith(".") for part in name.parts):
            yield name.as_posix()


def _open(data_path: Path) -> MinariStorage:
    """A dataset whose metadata contain its spaces.

    Without them Minari would make the environment in the metadata, which can name any function to call.

    :raises ValueError: for invalid metadata, or metadata without both spaces
    """
    try:
        metadata = MinariStorage.read_raw_metadata(data_path)
        spaces = [deserialize_space(metadata[f"{kind}_space"]) for kind in ("observation", "action")]
        storage = get_minari_storage(metadata["data_format"])
        return storage(data_path, *spaces, jpeg_encoding=bool(metadata.get("jpeg_encoding", True)))
    except Exception as error:  # the metadata may hold anything
        raise ValueError(f"{data_path} is not a readable Minari dataset with its own spaces: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    return f"its metadata have no {error}" if isinstance(error, KeyError) else str(error) or type(error).__name__


def check_spaces(data_path: Path, observation_space: gym.Space, action_space: gym.Space) -> None:
    """Refuse a dataset whose spaces are not those of the client.

    :raises ValueError: naming the spaces of both; observation bounds may differ, action bounds may not
    """
    storage = _open(data_path)
    theirs = (storage.observation_space, storage.action_space)
    for kind, given, needed in zip(("observation", "action"), theirs, (observation_space, action_space), strict=True):
        matches = isinstance(given, gym.spaces.Box) and isinstance(needed, gym.spaces.Box) and given.shape == needed.shape
        if isinstance(given, gym.spaces.Box) and isinstance(needed, gym.spaces.Box) and matches and kind == "action":
            matches = np.allclose(given.low, needed.low) and np.allclose(given.high, needed.high)
        if not matches:
            raise ValueError(f"the dataset at {data_path} does not fit: its {kind} space is {given}, the client's is {needed}")


def _as_float32(space: gym.spaces.Box) -> gym.spaces.Box:
    return gym.spaces.Box(space.low.astype(np.float32), space.high.astype(np.float32), dtype=np.float32)
