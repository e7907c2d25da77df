"""Files that appear complete or not at all, and tables that grow with a run."""

from __future__ import annotations

import csv
import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal


@contextmanager
def atomic_file(path: str | os.PathLike[str], mode: Literal["w", "wb"] = "w") -> Iterator[IO[Any]]:
    """A temporary file that replaces ``path`` when the block ends without an error, and is removed otherwise.

    It is on disk before it replaces ``path``, so that neither a full disk nor a crash leaves half a file.

    :raises OSError: if it cannot be written; the old file at ``path`` stays
    """
    target = Path(path)
    descriptor, temporary = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".part", dir=target.parent)
    try:
        with os.fdopen(descriptor, mode, encoding=None if mode == "wb" else "utf-8") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~current_umask())  # mkstemp makes files private
        os.replace(temporary, target)
    except BaseException as error:
        Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = os.fspath(target)  # a write() does not know it
        raise


def current_umask() -> int:
    """The permissions that the umask removes from new files and folders."""
    umask = os.umask(0)
    os.umask(umask)
    return umask


class GrowingTable:
    """A CSV to which a run adds rows; a resumed run cuts it to its length in the checkpoint.

    :param path: of the file, which does not exist before the header is written
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    @property
    def size(self) -> int | None:
        """Size of the file in bytes; ``None`` if there is no file."""
        return self.path.stat().st_size if self.path.exists() else None

    def begin(self, columns: Sequence[str]) -> None:
        """Write the header, unless there is one."""
        if not self.size:
            with self.path.open("w", newline="", encoding="utf-8") as file:
                csv.writer(file).writerow(columns)

    def add(self, rows: Iterable[Sequence[Any]]) -> None:
        """Append rows; they are on disk when this returns."""
        with self.path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(rows)
            file.flush()
            os.fsync(file.fileno())

    def cut(self, size: int | None) -> None:
        """Remove the rows after the first ``size`` bytes: the resumed run writes them again.

        :param size: ``None`` if there was no table yet
        :raises ValueError: if the table is shorter than ``size``
        """
        if size is None:
            self.path.unlink(missing_ok=True)
            return
        if (found := self.size or 0) < size:
            raise ValueError(f"{self.path} has {found} bytes and had {size} when the checkpoint was written: rows are missing")
        os.truncate(self.path, size)
