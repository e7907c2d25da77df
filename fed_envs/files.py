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
    """A file beside ``path`` that takes its place when the block ends without an error, and leaves nothing otherwise.

    It is on the disk before it takes the place, so that neither a full disk nor a crash leaves half a file there.

    :raises OSError: where it cannot be written; what was at ``path`` before stays
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
    """The permissions that new files and folders go without."""
    umask = os.umask(0)
    os.umask(umask)
    return umask


class GrowingTable:
    """A CSV to which a run adds rows, and which is as long as the run's checkpoint says when the run goes on.

    :param path: of the file; there is none before the header is written
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    @property
    def size(self) -> int | None:
        """Bytes that are written; ``None`` where there is no file."""
        return self.path.stat().st_size if self.path.exists() else None

    def begin(self, columns: Sequence[str]) -> None:
        """Write the header, unless there is one."""
        if not self.size:
            with self.path.open("w", newline="", encoding="utf-8") as file:
                csv.writer(file).writerow(columns)

    def add(self, rows: Iterable[Sequence[Any]]) -> None:
        """Append rows; they are on the disk when this returns."""
        with self.path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(rows)
            file.flush()
            os.fsync(file.fileno())

    def cut(self, size: int | None) -> None:
        """Forget the rows that were written after the table had ``size`` bytes: they will be written again.

        :param size: ``None`` where there was no table yet
        :raises ValueError: where rows are missing that were there
        """
        if size is None:
            self.path.unlink(missing_ok=True)
            return
        if (found := self.size or 0) < size:
            raise ValueError(f"{self.path} has {found} bytes and had {size} when the checkpoint was written: rows are missing")
        os.truncate(self.path, size)
