"""The offline stage of a federation before its first round, for any learner."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from sb3_fedguide.common.ddpg_policy import StackedDDPGPolicy
from sb3_fedguide.common.normalization import FederatedNormalizer, Normalize
from sb3_fedguide.common.ppo_policy import StackedMlpPolicy
from sb3_fedguide.offline.pretraining import Pretraining, PretrainingConfig
from sb3_fedguide.offline.progress import Progress
from sb3_fedguide.server.payload import Payload

if TYPE_CHECKING:
    from fed_envs import Family


class WarmStart(BaseAlgorithm):
    """Mixin of a federation: behaviour cloning, and a method's own part in :meth:`_pretrain`."""

    #: whether the offline stage has priors, whose trunk all clients train together
    uses_prior: ClassVar[bool] = False
    policy: StackedMlpPolicy | StackedDDPGPolicy  # type: ignore[assignment]
    family: Family | None
    client_ids: list[int]
    pretraining_config: PretrainingConfig
    cache_dir: str | Path | None
    gamma: float
    bc_weight: float
    normalize: Normalize
    normalizer: FederatedNormalizer
    pretrained: bool

    def _pretrain(self, stage: Pretraining) -> None:
        """A method's own part of the offline stage."""

    def offline_stage(
        self, progress_bar: bool = False, trunk: Payload | None = None, progress: Progress | None = None
    ) -> Pretraining:
        """The offline stage of the clients that live here; nothing is computed yet. Parameters as in :meth:`pretrain`."""
        assert self.seed is not None
        return Pretraining(
            self.family,
            self.client_ids,
            self.pretraining_config.model_copy(update={"gamma": self.gamma}),
            seed=self.seed,
            cache_dir=self.cache_dir,
            progress_bar=progress_bar,
            progress=progress,
            env_spaces=(self.observation_space, self.action_space),
            trunk=trunk,
        )

    def check_offline_data(self) -> None:
        """:raises ValueError: if the offline stage needs data that are not available, before anything is computed"""
        if self.pretrained or not (self.uses_prior or self.bc_weight > 0):
            return
        try:
            self.offline_stage().check_data()
        except ValueError as error:
            remedy = "" if self.uses_prior else "; or leave behaviour cloning out with bc_weight=0 (-params bc_weight:0)"
            raise ValueError(f"{type(self).__name__} begins with an offline stage: {error}{remedy}") from None

    def pretrain(self, progress_bar: bool = False, trunk: Payload | None = None, progress: Progress | None = None) -> None:
        """The offline stage: behaviour cloning and the method's own part; results are cached. Runs at most once.

        :param trunk: the priors' trunk if a server has trained it
            (:meth:`sb3_fedguide.server.trunk.TrunkAverages.payload`); otherwise it is trained here, on all clients' data
        :param progress: called during the stage, instead of a bar for each piece
        :raises ValueError: if the method needs offline data that are not available
        """
        if self.pretrained:
            return
        self.check_offline_data()
        stage = self.offline_stage(progress_bar, trunk, progress)
        if self.bc_weight > 0:
            self._initialize_from_behavior_cloning(stage)
        self._pretrain(stage)
        self.pretrained = True

    def _actors(self) -> nn.Module:
        """A copy of the stacked actors alone: observations to actions in the action space's own units."""
        assert isinstance(self.policy, StackedMlpPolicy)
        return self.policy.actor()

    def _initialize_from_behavior_cloning(self, stage: Pretraining) -> None:
        """theta_0 = (1 - alpha) theta_rand + alpha theta_BC, both from the same initial actor.

        With running normalisation, each client's observation statistics start from its own offline data, because the actor
        was cloned in their scale.
        """
        if self.normalize:
            for index, data in enumerate(stage.datasets()):
                obs = data.observations.astype(np.float64)
                self.normalizer.warm_start(index, obs.mean(axis=0), obs.var(axis=0), len(obs))
        cloned = stage.behavior_cloning(self._actors(), normalize=bool(self.normalize))
        with th.no_grad():
            for name, tensor in cloned.items():
                self.policy.actor_parameter(name).lerp_(tensor.to(self.device), self.bc_weight)
