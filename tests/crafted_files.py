"""Files that execute something where they are unpickled."""

from __future__ import annotations

from pathlib import Path

import numpy as np


class Payload:
    """Executed when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self) -> tuple:
        return Path.touch, (Path(self.path),)


def crafted_npz(path: Path, executed: Path, **arrays: np.ndarray) -> None:
    np.savez(path, **{**arrays, "payload": np.array([Payload(executed)], dtype=object)})
