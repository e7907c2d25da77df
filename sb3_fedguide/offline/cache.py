"""The cache of the offline stage: entries are found by content hash, written atomically and read without pickle."""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fed_envs.files import current_umask
from sb3_fedguide.state.array_files import array_mismatches, arrays_hash, read_arrays, write_arrays

__all__ = [
    "arrays_hash", "cache_folder", "cached_arrays", "check_cache_folder", "content_key", "keep_arrays", "publish_folder",
    "read_arrays", "warn_not_kept", "write_arrays",
]  # fmt: skip

logger = logging.getLogger(__name__)

CACHE_VARIABLE = "FEDGUIDE_CACHE"


def cache_folder(path: str | Path | None = None) -> Path:
    """``path``, or ``$FEDGUIDE_CACHE``, or ``~/.cache/fedguide``; absolute, whatever the working directory becomes.

    :raises ValueError: for the home folder of a user who does not exist
    """
    given = Path(path or os.environ.get(CACHE_VARIABLE) or Path.home() / ".cache" / "fedguide")
    try:
        return given.expanduser().absolute()
    except RuntimeError as error:
        raise ValueError(
            f"the cache folder {given}: {error}; give another one with --cache-dir or ${CACHE_VARIABLE}"
        ) from None


def content_key(**parts: Any) -> str:
    """SHA-256 of the canonical JSON of ``parts`` (numbers, strings, booleans, None, lists and dicts of these)."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, allow_nan=False).encode()).hexdigest()


def cached_arrays(
    path: Path,
    build: Callable[[], Mapping[str, np.ndarray]] | None = None,
    expected: Mapping[str, np.ndarray] | None = None,
) -> dict[str, np.ndarray] | None:
    """The entry at ``path``; built and stored first if it is missing, damaged or lacks the expected arrays.

    :param build: makes the entry; without it ``None`` is returned instead
    :param expected: arrays with the entry's names, dtypes and shapes
    """
    try:
        arrays = read_arrays(path)
        if expected is not None and (mismatches := array_mismatches(arrays, expected)):
            raise ValueError(f"{path} is an entry of another kind or version: {mismatches[0]}")
        return arrays
    except FileNotFoundError:
        pass
    except ValueError as error:
        logger.warning("making a cache entry again: %s", error)
    if build is None:
        return None
    arrays = dict(build())
    keep_arrays(path, arrays)
    return arrays


def keep_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write a cache entry; a failure only gives a warning, since the computed result is still valid."""
    try:
        write_arrays(path, arrays)
    except OSError as error:
        warn_not_kept(path, error)


def warn_not_kept(path: Path, error: Exception) -> None:
    """Say that a cache entry could not be written, and what to do."""
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    logger.warning(
        "%s could not be kept (%s) and will be made again by the next run; %schoose another cache folder with --cache-dir or "
        "$%s",
        path, getattr(error, "strerror", None) or error, "free some space there, or " if full else "", CACHE_VARIABLE,
    )  # fmt: skip


def check_cache_folder(folder: Path) -> None:
    """:raises ValueError: if there is no such cache and none can be made; nothing is created

    A folder without write permission is accepted: entries can be read from it.
    """
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise ValueError(
            f"the cache folder {folder} cannot be made: {existing} is a file; give another one with --cache-dir or "
            f"${CACHE_VARIABLE}"
        )
    if existing != folder.absolute() and not os.access(existing, os.W_OK):
        raise ValueError(
            f"the cache folder {folder} cannot be made in {existing}; give another one with --cache-dir or ${CACHE_VARIABLE}"
        )


@contextmanager
def publish_folder(target: Path, valid: Callable[[Path], bool]) -> Iterator[Path]:
    """Gives a temporary folder beside ``target`` that becomes ``target`` when the block ends without an error.

    If another process published a valid entry meanwhile, that one stays: entries of one key have one content.

    :param valid: says whether a folder holds a complete entry; anything else at ``target`` is replaced
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    # Hidden, so that a listing of the datasets in the cache does not see half-written ones.
    temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    try:
        yield temporary
        temporary.chmod(0o777 & ~current_umask())  # mkdtemp makes folders private
        _replace_folder(temporary, target, valid)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _replace_folder(temporary: Path, target: Path, valid: Callable[[Path], bool]) -> None:
    for _ in range(10):
        try:
            os.replace(temporary, target)  # a folder is replaced only if it is empty
            return
        except OSError:
            if valid(target):
                return
        # Moved aside first: another process that looks at the target sees all of it or nothing.
        aside = Path(tempfile.mkdtemp(prefix=f".{target.name}.old.", dir=target.parent))
        try:
            os.replace(target, aside)
        except OSError:
            logger.debug("%s was moved by another process", target)
        shutil.rmtree(aside, ignore_errors=True)
    raise OSError(f"could not write the cache entry {target}: something else keeps writing there")
