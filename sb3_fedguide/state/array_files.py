"""Named arrays in one npz file: written complete or not at all, read without pickle."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fed_envs.files import atomic_file

__all__ = ["array_mismatches", "arrays_hash", "load_arrays", "read_arrays", "write_arrays"]

_CHECKSUM = "__sha256__"


def arrays_hash(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of named arrays: names, dtypes, shapes and bytes."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}:{array.dtype.str}:{array.shape};".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays and their checksum as one npz file that appears complete or not at all.

    :raises OSError: if it cannot be written
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path, "wb") as file:
        np.savez(file, **{**arrays, _CHECKSUM: np.array(arrays_hash(arrays))})  # type: ignore[arg-type]


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an npz file from any source; nothing is unpickled, and a checksum is compared if there is one.

    :raises ValueError: if the file is damaged, not an npz file, or holds pickled objects
    :raises FileNotFoundError: if there is none
    """
    return _load(path, needs_checksum=False)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read a file of :func:`write_arrays`.

    :raises ValueError: if the file is damaged, pickled or does not have the checksum of its content
    :raises FileNotFoundError: if there is none
    """
    _refuse_compression(path)
    return _load(path, needs_checksum=True)


def _load(path: Path, needs_checksum: bool) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except Exception as error:  # zipfile, zlib, NumPy and the OS each have their own error for it
        raise _unreadable(path, error) from error
    checksum = arrays.pop(_CHECKSUM, None)
    if needs_checksum if checksum is None else str(checksum) != arrays_hash(arrays):
        raise ValueError(f"{path} is damaged: its content does not match its checksum")
    return arrays


def array_mismatches(arrays: Mapping[str, np.ndarray], expected: Mapping[str, np.ndarray]) -> list[str]:
    """Differences of arrays from the expected ones in names, dtypes and shapes: one line each, none if they fit."""
    lines = [f"{name} is missing" for name in sorted(expected.keys() - arrays.keys())]
    lines += [f"{name} is not known" for name in sorted(arrays.keys() - expected.keys())]
    for name in sorted(arrays.keys() & expected.keys()):
        given, needed = arrays[name], expected[name]
        if (given.dtype, given.shape) != (needed.dtype, needed.shape):
            lines.append(f"{name} is {given.dtype} {given.shape} instead of {needed.dtype} {needed.shape}")
    return lines


def _refuse_compression(path: Path) -> None:
    """Refuse compressed arrays: we write none, so that a file never takes more memory than disk space."""
    try:
        with zipfile.ZipFile(path) as archive:
            compressed = [entry.filename for entry in archive.infolist() if entry.compress_type != zipfile.ZIP_STORED]
    except Exception as error:  # as above
        raise _unreadable(path, error) from error
    if compressed:
        raise ValueError(f"{path} is damaged: {compressed[0]!r} in it is compressed")


def _unreadable(path: Path, error: Exception) -> Exception:
    if isinstance(error, FileNotFoundError):
        return error
    if isinstance(error, OSError) and error.strerror:
        return ValueError(f"{path} cannot be read: {error.strerror}")
    return ValueError(f"{path} is damaged: {error}")


def take_prefix(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays whose names begin with ``prefix``, without it."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
