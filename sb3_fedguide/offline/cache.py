"""The cache of the offline stage: entries are found by content hash, written atomically and read without pickle."""

from __future__ import annotations

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

__all__ = ["arrays_hash", "cache_folder", "cached_arrays", "content_key", "publish_folder", "read_arrays", "write_arrays"]

logger = logging.getLogger(__name__)

CACHE_VARIABLE = "FEDGUIDE_CACHE"
_CHECKSUM = "__sha256__"


def cache_folder(path: str | Path | None = None) -> Path:
    """``path``, or ``$FEDGUIDE_CACHE``, or ``~/.cache/fedguide``."""
    return Path(path or os.environ.get(CACHE_VARIABLE) or Path.home() / ".cache" / "fedguide").expanduser()


def content_key(**parts: Any) -> str:
    """SHA-256 of the canonical JSON of ``parts`` (numbers, strings, booleans, None, lists and dicts of these)."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, allow_nan=False).encode()).hexdigest()


def arrays_hash(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of named arrays: names, dtypes, shapes and bytes."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}:{array.dtype.str}:{array.shape};".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays and their checksum as one npz file that appears complete or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, **{**arrays, _CHECKSUM: np.array(arrays_hash(arrays))})  # type: ignore[arg-type]
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read what :func:`write_arrays` wrote.

    :raises ValueError: if the file is damaged, pickled or does not have the checksum of its content
    :raises FileNotFoundError: if there is none
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except FileNotFoundError:
        raise
    except Exception as error:  # zipfile, zlib, NumPy and the OS each have their own for the same thing
        raise ValueError(f"{path} is damaged: {error}") from error
    checksum = arrays.pop(_CHECKSUM, None)
    if checksum is None or str(checksum) != arrays_hash(arrays):
        raise ValueError(f"{path} is damaged: its content does not have the checksum that was written with it")
    return arrays


def cached_arrays(path: Path, build: Callable[[], Mapping[str, np.ndarray]] | None = None) -> dict[str, np.ndarray] | None:
    """The entry at ``path``; built and written first if it is absent or damaged.

    :param build: makes the entry; without it an absent or damaged entry gives ``None``
    """
    try:
        return read_arrays(path)
    except FileNotFoundError:
        pass
    except ValueError as error:
        logger.warning("rebuilding a cache entry: %s", error)
    if build is None:
        return None
    arrays = dict(build())
    write_arrays(path, arrays)
    return arrays


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
