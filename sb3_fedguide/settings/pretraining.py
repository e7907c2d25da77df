"""Settings of the offline stage."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["DEFAULTS", "Count", "Piece", "PretrainingConfig", "prior_is_gaussian"]

Count = Annotated[int, Field(ge=1, lt=2**31)]
Size = Annotated[int, Field(ge=1, le=10_000_000)]  # far above useful sizes, and below those that exceed any memory
Width = Annotated[int, Field(ge=1, le=8192)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Piece = Literal["bc", "prior", "dice"]


def prior_is_gaussian(prior: str, world: str | None) -> bool:
    """Whether a prior is the Gaussian one: by default on Bandit2D.

    :param prior: as in :class:`PretrainingConfig`
    :param world: of the family; ``None`` for a user's own environments
    """
    return prior == "gaussian" or (prior == "auto" and world == "bandit2d")


class PretrainingConfig(BaseModel):
    """Settings of the offline stage; :class:`sb3_fedguide.offline.pretraining.Pretraining` takes them.

    Lengths are in updates. ``*_epochs`` is the number of passes over the data if that is longer; the updates are then a
    minimum (40 epochs of 5,000 rows are only 400 updates and leave a network untrained).

    :param dataset: a Minari dataset (id or path, ``{client}`` stands for the client's number) instead of a collected one
    :param dataset_size: rows per client; default 20,000, or 1,000 for Bandit2D; a given dataset is used whole
    :param gamma: discount factor of the DICE value
    :param prior: ``"gaussian"`` (state-independent), ``"diffusion"``, or ``"auto"``: Gaussian for Bandit2D
    :param prior_average_every: updates between two averages of the trunk over the clients
    :param dice_tau: weight of the new parameters in the moving average of Q's targets
    :param dice_v_coef: coefficient of V in its loss: a number, or ``"1-gamma"`` as printed in the paper
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    dataset: str | None = None
    dataset_size: Size | None = None
    gamma: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.99

    bc_updates: Count = 2000
    bc_epochs: Count | None = None
    bc_batch_size: Size = 512
    bc_learning_rate: Positive = 3e-4

    prior: Literal["auto", "gaussian", "diffusion"] = "auto"
    prior_updates: Count = 5000
    prior_epochs: Count | None = None
    prior_batch_size: Size = 128
    prior_learning_rate: Positive = 5e-3
    prior_width: Width = 64
    prior_average_every: Count = 50

    dice_updates: Count = 5000
    dice_epochs: Count | None = None
    dice_batch_size: Size = 128
    dice_learning_rate: Positive = 1e-4
    dice_width: Width = 256
    dice_omega: Positive = 0.5
    dice_tau: Annotated[float, Field(gt=0.0, le=1.0)] = 0.005
    dice_f: Literal["soft_chi", "kl", "chi2"] = "soft_chi"
    dice_v_coef: Annotated[float, Field(allow_inf_nan=False)] | Literal["1-gamma"] = 1.0

    def n_updates(self, piece: Piece, n_rows: int) -> int:
        """Updates of a piece on ``n_rows`` rows: its minimum, or its epochs if these are more."""
        floor, epochs = getattr(self, f"{piece}_updates"), getattr(self, f"{piece}_epochs")
        return max(floor, (epochs or 0) * math.ceil(n_rows / getattr(self, f"{piece}_batch_size")))

    def settings(self, *pieces: str) -> dict[str, Any]:
        """The fields that begin with one of ``pieces``, without lengths, for a cache key."""
        return {
            name: value
            for name, value in self.model_dump(mode="json").items()
            if name.split("_")[0] in pieces and not name.endswith(("_updates", "_epochs"))
        }


#: The default settings: the functions of the offline stage take their defaults from it.
DEFAULTS = PretrainingConfig()
