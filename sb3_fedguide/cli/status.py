"""The current stage of a run, in a file of its folder that other processes can read."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any, NamedTuple

from sb3_fedguide.cli.run_folder import STATUS, write_json
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.offline.progress import Progress

#: Seconds between two writes of the file.
INTERVAL = 1.0


class Stage(NamedTuple):
    """A stage of a run.

    :param name: a piece of the offline stage, such as ``"prior"``, or ``"round"``
    :param done: finished steps or rounds
    :param total: all steps or rounds
    :param seconds: since the stage began, or was resumed
    :param left: estimated seconds until its end; ``None`` if nothing is done yet
    """

    name: str
    done: int
    total: int
    seconds: float
    left: float | None

    def __str__(self) -> str:
        left = "" if self.left is None else f", about {duration(self.left)} left"
        return f"{self.name} {self.done} of {self.total}, {duration(self.seconds)}{left}"


class Status(RoundCallback):
    """Writes the stage of a run into its folder; also used as the offline stage's progress.

    :param n_rounds: of the whole run
    :param bar: progress bar of the offline stage, to show too
    """

    def __init__(self, folder: Path, n_rounds: int, bar: Progress | None = None) -> None:
        super().__init__()
        self.path, self.n_rounds, self.bar = folder / STATUS, n_rounds, bar
        self._name, self._first, self._began, self._written = "", 0, 0.0, 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report the progress of a piece of the offline stage."""
        if self.bar is not None:
            self.bar(stage, done, total)
        self._report(stage, done, total)

    def _on_training_start(self) -> None:
        self._report("round", self.model.round, self.n_rounds)

    def _on_round_end(self) -> None:
        self._report("round", self.model.round, self.n_rounds)

    def _report(self, name: str, done: int, total: int) -> None:
        now = time.monotonic()
        if name != self._name:
            self._name, self._first, self._began, self._written = name, done, now, 0.0
        if now - self._written < INTERVAL:
            return
        seconds, new = now - self._began, done - self._first
        left = seconds * (total - done) / new if new > 0 else None
        write_json(self.path, Stage(name, done, total, seconds, left)._asdict())
        self._written = now

    def remove(self) -> None:
        """Remove the file at the end of the run: its summary has the results."""
        self.path.unlink(missing_ok=True)


def read_status(folder: Path) -> Stage | None:
    """The last stage of the run in ``folder``; ``None`` if there is no readable file."""
    try:
        content: dict[str, Any] = json.loads((folder / STATUS).read_text(encoding="utf-8"))
        left = content["left"]
        return Stage(str(content["name"]), int(content["done"]), int(content["total"]), float(content["seconds"]),
                     None if left is None else float(left))  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError):
        return None


def duration(seconds: float) -> str:
    """A duration such as ``40 s``, ``12 min`` or ``3 h 05 min``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
