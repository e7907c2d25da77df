"""Checkpoints of a run: written while it trains, files of :mod:`sb3_fedguide.state.checkpoint_files`."""

from __future__ import annotations

import warnings
from pathlib import Path

from fed_envs.plain_data import State
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.state.checkpoint_files import (
    KEPT,
    checkpoints,
    newest_checkpoint,
    read_checkpoint,
    remove_leftovers,
    remove_old,
    write_checkpoint,
)

__all__ = [
    "KEPT", "CheckpointCallback", "CheckpointError", "checkpoints", "newest_checkpoint", "read_checkpoint", "write_checkpoint",
]  # fmt: skip


class CheckpointError(ValueError):
    """A run cannot be saved, or cannot be resumed from its checkpoint."""


class CheckpointCallback(RoundCallback):
    """Writes a checkpoint every ``save_freq`` rounds, for :meth:`Federation.resume`.

    :param folder: folder of the checkpoints; the last two stay
    :param save_freq: rounds between them
    :raises ValueError: for ``save_freq`` below one
    :raises CheckpointError: at the start of training, if the run cannot be saved
    """

    def __init__(self, folder: str | Path, save_freq: int = 10) -> None:
        super().__init__()
        if save_freq < 1:
            raise ValueError(f"save_freq={save_freq} must be at least 1 round; without checkpoints, leave the callback out")
        self.folder, self.save_freq = Path(folder), save_freq
        #: round of the last checkpoint that was written
        self.saved_round: int | None = None

    def _on_training_start(self) -> None:
        remove_leftovers(self.folder)
        remove_old(self.folder)
        try:
            self._state()  # an error of saving is raised now, not after `save_freq` rounds
        except ValueError as error:
            raise CheckpointError(f"{error} (or train without checkpoints: --save-freq 0 on the command line)") from error

    def _on_round_logged(self) -> bool:
        if self.model.round % self.save_freq == 0:
            self.save()
        return True

    def save(self) -> bool:
        """Write a checkpoint of the round that has just ended, unless there is one.

        :return: false if it could not be written, after a warning: training goes on, and the next checkpoint may succeed
        """
        if self.saved_round == self.model.round:
            return True
        try:
            write_checkpoint(self.folder, self.model.round, self._state())
        except (OSError, ValueError) as error:
            warnings.warn(f"no checkpoint after round {self.model.round}: {error}", stacklevel=2)
            return False
        self.saved_round = self.model.round
        return True

    def _state(self) -> State:
        saved = [(type(callback).__name__, callback.save_state()) for callback in self.locals["rounds"]]
        callbacks = [{"class": name, "state": state} for name, state in saved if state]
        return {"round": self.model.round, "model": self.model.save_state(), "callbacks": callbacks}
