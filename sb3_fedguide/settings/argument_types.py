"""Types of arguments that need PyTorch, pydantic or environments.

:mod:`~sb3_fedguide.settings.arguments` names them in strings, which signatures look up here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th
from stable_baselines3.common.policies import BasePolicy

from fed_envs import Family, FederatedVecEnv
from sb3_fedguide.settings.pretraining import PretrainingConfig

PolicyLike = str | type[BasePolicy]
#: What a federation's environments can be made of: a family or its name, a metadata file, or one function per client.
FederationLike = str | Path | Family | FederatedVecEnv | Sequence[Callable[[], gym.Env]]
MaybeFederation = FederationLike | None
MaybePretraining = PretrainingConfig | dict[str, Any] | None
DeviceLike = th.device | str
