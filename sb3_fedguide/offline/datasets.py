"""The clients' offline datasets: generated and cached Minari datasets, or any others with matching spaces."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np

from fed_envs import Family, load_family
from sb3_fedguide.offline.behavior import BehaviorPolicy
from sb3_fedguide.offline.cache import (
    cache_folder,
    content_key,
    publish_folder,
    read_arrays,
    warn_not_kept,
    write_arrays,
)
from sb3_fedguide.offline.collect import behavior_name, collect, default_size, source_key
from sb3_fedguide.offline.data import OfflineData, normalize_observations
from sb3_fedguide.offline.minari_io import check_spaces, find_dataset, read_minari, write_minari
from sb3_fedguide.offline.progress import StepProgress
from sb3_fedguide.seeding import Role, stream

__all__ = ["OfflineData", "client_datasets", "dataset_folder", "normalize_observations"]

logger = logging.getLogger(__name__)

ROWS = "rows.npz"
_FILES_HASH = "files_sha256"


def client_datasets(
    family: str | Path | Family | None,
    size: int | None = None,
    seed: int = 0,
    cache_dir: str | Path | None = None,
    dataset: str | None = None,
    clients: Sequence[int] | None = None,
    env_spaces: tuple[gym.Space, gym.Space] | None = None,
    policy: BehaviorPolicy | None = None,
    progress: StepProgress | None = None,
) -> list[OfflineData]:
    """Every client's offline data; a client's data do not depend on the other clients in ``clients``.

    :param family: a family's name, metadata file or object; ``None`` for the user's own environments (these need ``dataset``)
    :param size: rows per client; default 20,000, or 1,000 for Bandit2D. A given dataset is cut to ``size`` rows (whole
        episodes in an order drawn per client), and used entirely by default
    :param seed: the federation's seed
    :param cache_dir: default ``$FEDGUIDE_CACHE`` or ``~/.cache/fedguide``
    :param dataset: a Minari dataset instead, by id or path; ``{client}`` in it stands for the client's number
    :param clients: the requested clients; default all of the family
    :param env_spaces: observation and action space that a given dataset must fit; default those of each client
    :param policy: a behaviour policy instead of the shipped one
    :param progress: called with the clients done and their number
    :raises ValueError: for an unknown family, client or dataset, or a dataset whose spaces do not match
    """
    if size is not None and size < 1:
        raise ValueError(f"a dataset needs at least one row, got size={size}")
    known = None if family is None else load_family(family)
    if known is None and (dataset is None or clients is None or env_spaces is None):
        raise ValueError(
            "environments of one's own bring no offline data: client_datasets() needs dataset= (an id or a path, {client} in "
            "it stands for the client's number), clients= and env_spaces="
        )
    clients = range(known.n_clients) if clients is None and known is not None else clients or ()
    for client in clients if known is not None else ():
        known.client(client)  # type: ignore[union-attr]  # refuses clients that do not exist
    result = []
    for done, client in enumerate(clients):
        if progress is not None:
            progress(done, len(clients))
        try:
            if dataset is not None:
                result.append(_given(dataset, client, size, seed, env_spaces or _spaces(known, client)))
            elif known is not None:
                folder = dataset_folder(known, client, size, seed, cache_dir, policy)
                result.append(_made_on_the_spot(folder, known, client, size or default_size(known), seed, policy))
        except ValueError as error:
            raise ValueError(f"offline data of client {client}: {error}") from error
    if progress is not None:
        progress(len(clients), len(clients))
    return result


def dataset_folder(
    family: Family,
    client: int,
    size: int | None = None,
    seed: int = 0,
    cache_dir: str | Path | None = None,
    policy: BehaviorPolicy | None = None,
) -> Path:
    """Where a client's data are cached. ``<cache>/datasets`` is itself a Minari root, so Minari's own tools read them."""
    key = content_key(size=size or default_size(family), seed=seed, **source_key(family, client, policy))
    return cache_folder(cache_dir) / "datasets" / "fedguide" / family.name / f"client-{client}-{key[:16]}-v0"


def _made_on_the_spot(
    folder: Path, family: Family, client: int, size: int, seed: int, policy: BehaviorPolicy | None
) -> OfflineData:
    try:
        return _read_entry(folder)
    except FileNotFoundError:
        pass
    except (ValueError, OSError) as error:
        logger.warning("making the data of client %d again: %s", client, error)
    data, observation_space, action_space = collect(family, client, size, seed, policy)
    try:
        with publish_folder(folder, _is_valid) as temporary:
            write_minari(
                temporary,
                "/".join(folder.parts[-3:]),
                data,
                observation_space,
                action_space,
                {
                    "algorithm_name": behavior_name(family, client, policy),
                    "description": f"{family.name}, client {client}, made by sb3_fedguide with seed {seed}",
                },
            )
            write_arrays(temporary / ROWS, {**data.arrays(), _FILES_HASH: np.array(_files_hash(temporary))})
    except OSError as error:
        warn_not_kept(folder, error)
    return data


def _read_entry(folder: Path) -> OfflineData:
    """The data in a cache entry, from the flat copy of its rows: Minari reads a thousand short episodes in a second.

    :raises ValueError: if the Minari dataset or the copy is damaged or incomplete
    :raises FileNotFoundError: if there is no such entry
    """
    try:
        arrays = read_arrays(folder / ROWS)
        files_hash = _files_hash(folder)
    except FileNotFoundError as error:
        if not folder.exists():
            raise
        raise ValueError(f"{folder} is incomplete: {error}") from error
    if str(arrays.pop(_FILES_HASH, "")) != files_hash:
        raise ValueError(f"{folder} is damaged: its Minari files are not those that were written")
    try:
        return OfflineData(**arrays)
    except TypeError as error:
        raise ValueError(f"{folder} is an entry of another version: {error}") from error


def _files_hash(folder: Path) -> str:
    digest = hashlib.sha256()
    for name in ("main_data.hdf5", "metadata.json"):
        digest.update((folder / "data" / name).read_bytes())
    return digest.hexdigest()


def _is_valid(folder: Path) -> bool:
    try:
        _read_entry(folder)
    except (ValueError, OSError):
        return False
    return True


def _given(dataset: str, client: int, size: int | None, seed: int, env_spaces: tuple[gym.Space, gym.Space]) -> OfflineData:
    data_path = find_dataset(dataset.replace("{client}", str(client)))
    check_spaces(data_path, *env_spaces)
    # Each client has its own order: several clients of one dataset then do not get the same part of it.
    rng = stream(seed, Role.DATA, client) if size is not None else None
    return read_minari(data_path, size, rng)


def _spaces(family: Family | None, client: int) -> tuple[gym.Space, gym.Space]:
    if family is None:
        raise ValueError("without a family, env_spaces= must say what the data have to fit")
    env = family.make(client)
    try:
        return env.observation_space, env.action_space
    finally:
        env.close()
