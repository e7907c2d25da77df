"""Fills TensorBoard's Custom Scalars, HParams and Images tabs, in the run's own event file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.logger import Image, TensorBoardOutputFormat

from sb3_fedguide.algorithms.fedguide import FedGuide
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.federated_ppo import FederatedPPO
from sb3_fedguide.monitoring import charts
from sb3_fedguide.priors.gaussian import GaussianPrior

if TYPE_CHECKING:
    from sb3_fedguide.benchmark.bandit2d import Policies

#: Outputs of SB3's logger that cannot take a picture.
NO_PICTURES = ("stdout", "log", "json", "csv")


class TensorBoardCallback(RoundCallback):
    """Charts, hyperparameters and pictures of a run, beside its scalars.

    * Custom Scalars: related keys in one chart, see :func:`~sb3_fedguide.monitoring.charts.chart_layout`.
    * HParams: the hyperparameters, with returns at the end as metrics.
    * Images: how the clients differ, at the start; the transport plan and, on Bandit2D, the densities of policies and priors.

    Without a TensorBoard output in the model's logger it does nothing.

    :param n_rounds: rounds of the whole run; the last one is always drawn
    :param picture_freq: rounds between pictures; 0 for none
    :param hyperparameters: for the HParams tab; nested ones get dotted names
    :param other_hyperparameters: names of other runs' hyperparameters, so that runs of several algorithms share a table
    :raises ValueError: for a negative ``picture_freq``
    """

    def __init__(
        self,
        n_rounds: int,
        picture_freq: int = 20,
        hyperparameters: Mapping[str, Any] | None = None,
        other_hyperparameters: Iterable[str] = (),
    ) -> None:
        super().__init__()
        if picture_freq < 0:
            raise ValueError(f"picture_freq={picture_freq} must not be negative; 0 draws no pictures")
        self.n_rounds, self.picture_freq = n_rounds, picture_freq
        self.hyperparameters = charts.flatten(hyperparameters or {})
        self.other_hyperparameters = tuple(other_hyperparameters)
        self._deployed: Policies | None = None

    def _on_training_start(self) -> None:
        outputs = self.logger.output_formats
        self._writer = next((output.writer for output in outputs if isinstance(output, TensorBoardOutputFormat)), None)
        if self._writer is None:
            return
        self._write(charts.layout_summary(charts.chart_layout(self.model)))
        if self.hyperparameters:
            for summary in charts.session_start(self.hyperparameters, others=self.other_hyperparameters):
                self._write(summary)
        if self.picture_freq > 0 and self.model.round == 0:
            self._draw_family()

    def _on_local_training_end(self) -> None:
        if self._draws(self.model.round + 1) and self._is_bandit:
            from sb3_fedguide.benchmark.bandit2d import policies

            self._deployed = policies(self.model)  # type: ignore[arg-type]

    def _on_round_end(self) -> None:
        if not self._draws(self.model.round):
            return
        if isinstance(self.model, FedGuide):
            from sb3_fedguide.monitoring.pictures import transport_plan

            self._record("transport_plan", transport_plan(self.model.mixture_rows, self.model.client_ids))
        if self._deployed is not None:
            self._draw_densities(self._deployed)

    def _on_training_end(self) -> None:
        if self._writer is not None and self.hyperparameters:
            self._write(charts.session_end())
            self._writer.flush()

    @property
    def _is_bandit(self) -> bool:
        family = self.model.family
        return isinstance(self.model, FederatedPPO) and family is not None and family.world == "bandit2d"

    def _draws(self, round: int) -> bool:
        """Whether this round has pictures: the first, every ``picture_freq``-th and the last."""
        if self._writer is None or self.picture_freq == 0:
            return False
        return round in (1, self.n_rounds) or round % self.picture_freq == 0

    def _draw_family(self) -> None:
        from sb3_fedguide.monitoring.pictures import heterogeneity

        picture = None if self.model.family is None else heterogeneity(self.model.family, self.model.client_ids)
        if picture is not None:
            self._record("heterogeneity", picture)

    def _draw_densities(self, deployed: Policies) -> None:
        from sb3_fedguide.benchmark.bandit2d import policies, priors
        from sb3_fedguide.benchmark.figures.bandit2d import grid
        from sb3_fedguide.monitoring.pictures import bandit_densities

        model = self.model
        # The density of any other prior takes longer than the round.
        guided = isinstance(model, FedGuide) and isinstance(model.prior, GaussianPrior)
        drawn = priors(model, grid()) if guided else None  # type: ignore[arg-type]
        broadcast = policies(model) if model.sends_policy(model.round) else None  # type: ignore[arg-type]
        self._record("densities", bandit_densities(deployed, model.client_ids, drawn, broadcast))

    def _record(self, name: str, picture: np.ndarray) -> None:
        self.logger.record(f"pictures/{name}", Image(picture, "HWC"), exclude=NO_PICTURES)

    def _write(self, summary: Any) -> None:
        assert self._writer is not None and self._writer.file_writer is not None
        self._writer.file_writer.add_summary(summary)
