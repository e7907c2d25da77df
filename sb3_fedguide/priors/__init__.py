"""Action priors with linear heads, and their mixture."""

from sb3_fedguide.priors.base import HeadStatistics, Prior, score_cost
from sb3_fedguide.priors.diffusion import DiffusionPrior
from sb3_fedguide.priors.gaussian import GaussianPrior
from sb3_fedguide.priors.mixture import active_experts, mixture_log_prob, mixture_sample

__all__ = [
    "DiffusionPrior",
    "GaussianPrior",
    "HeadStatistics",
    "Prior",
    "active_experts",
    "mixture_log_prob",
    "mixture_sample",
    "score_cost",
]
