"""Progress of the offline stage: a callable ``progress(stage, done, total)``, and the tqdm bars used by default."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Protocol

from tqdm.auto import tqdm

__all__ = ["Progress", "StepProgress", "TqdmProgress", "stage_progress"]

StepProgress = Callable[[int, int], None]
"""Called with the steps done so far and their total."""


class Progress(Protocol):
    """Called with the stage's name, the steps done so far and their total; the last call has ``done == total``."""

    def __call__(self, stage: str, done: int, total: int) -> None: ...


class TqdmProgress:
    """One terminal bar per stage, drawn from the stage's first report to its last."""

    def __init__(self) -> None:
        self._bars: dict[str, tqdm] = {}

    def __call__(self, stage: str, done: int, total: int) -> None:
        bar = self._bars.get(stage)
        if bar is None:
            bar = self._bars[stage] = tqdm(total=total, desc=stage, dynamic_ncols=True)
        bar.update(done - bar.n)
        if done >= total:
            bar.close()
            del self._bars[stage]

    def close(self) -> None:
        """Close the bars of stages that ended early."""
        for bar in self._bars.values():
            bar.close()
        self._bars.clear()


def stage_progress(progress: Progress | None, stage: str) -> StepProgress | None:
    """The part of ``progress`` that belongs to one stage."""
    return None if progress is None else partial(progress, stage)
