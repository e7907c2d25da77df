"""Arguments of the algorithms' constructors: name, type with its range, and default of each, only here.

The constructors take these classes (:func:`~sb3_fedguide.settings.signatures.takes`); the command line, servers and the
documentation read them, without PyTorch and pydantic. Types that need these are strings, each a name in
:mod:`sb3_fedguide.settings.argument_types`. The docstring of its algorithm describes an argument.
"""

# Without `from __future__ import annotations`: types are objects, with their ranges.
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from sb3_fedguide.settings.ranges import OPEN, Range

if TYPE_CHECKING:
    from sb3_fedguide.settings.argument_types import DeviceLike, MaybeFederation, MaybePretraining, PolicyLike

#: A function of the remaining progress, from 1 down to 0, as in SB3.
Schedule = Callable[[float], float]
#: Parameters that the server averages: all, the actor with ``log_std``, or the critic.
Average = Literal["all", "actor", "critic"]
#: Ways to combine uploads, see :func:`sb3_fedguide.server.averaging.combine`.
Aggregator = Literal["mean", "median", "trimmed_mean"]
#: No normalisation, statistics per client, or observation statistics that all clients share.
Normalize = bool | Literal["shared"]
TransportCost = Literal["score", "param"]
CostScaling = Literal["max", "median"]

#: Default bound on norms: at 10 an honest client of FedAvg on Bandit2D was rejected (six times the median of four).
UPLOAD_BOUND = 30.0

# Upper bounds of sizes are far above useful values and below those that exceed any memory.
Count = Annotated[int, Range(1)]
Size = Annotated[int, Range(1, 1e7)]
Copies = Annotated[int, Range(1, 1000)]
Positive = Annotated[float, Range(OPEN)]
NotNegative = Annotated[float, Range(0)]
Share = Annotated[float, Range(0, 1)]
ServerStep = Annotated[float | Literal["exp"], Range(OPEN, why="1 is the average itself, and 'exp' FedExP's step")]
Mix = Annotated[float, Range(0, 1, "it is the share of the broadcast that a client takes", start=100)]
Tested = Annotated[float, Range(0, 0.5)]
Rounds = Annotated[int, Range(1, 1e7)]


@dataclass(frozen=True)
class FederationArguments:
    """Arguments of every federation."""

    #: names of the policies; :mod:`sb3_fedguide.settings.networks` has their ``policy_kwargs``
    policies: ClassVar[tuple[str, ...]] = ("MlpPolicy",)
    network_config: ClassVar[str]

    policy: "PolicyLike"
    env: "MaybeFederation"
    _: KW_ONLY
    rollout_size: Annotated[int, Range(2, 1e7)] = 4096
    batch_size: Size = 64
    gamma: Share = 0.99
    n_envs_per_client: Copies = 1
    clients: Sequence[int] | None = None
    num_threads: Copies = 1
    normalize: Normalize = False
    bc_weight: Share = 0.0
    client_fraction: Annotated[float, Range(OPEN, 1)] = 1.0
    upload_bound: Positive | None = UPLOAD_BOUND
    pretraining: "MaybePretraining" = None
    cache_dir: str | Path | None = None
    stats_window_size: Count = 100
    tensorboard_log: str | None = None
    policy_kwargs: dict[str, Any] | None = None
    verbose: int = 0
    seed: int | None = None
    device: "DeviceLike" = "cpu"
    _init_setup_model: bool = True

    def of(self, base: type) -> dict[str, Any]:
        """The arguments that the class ``base`` has too, as keywords."""
        return {field.name: getattr(self, field.name) for field in fields(base)}


@dataclass(frozen=True, kw_only=True)
class FederatedPPOArguments(FederationArguments):
    """Those of :class:`~sb3_fedguide.common.federated_ppo.FederatedPPO`, ``Local`` and ``Pooled``."""

    network_config = "StochasticNetworkConfig"

    learning_rate: Positive | Schedule = 3e-4
    n_epochs: Count = 4
    gae_lambda: Share = 0.95
    clip_range: Positive | Schedule = 0.2
    clip_range_vf: Positive | Schedule | None = None
    normalize_advantage: bool = True
    ent_coef: NotNegative = 0.0
    vf_coef: NotNegative = 0.5
    max_grad_norm: Positive = 0.5


@dataclass(frozen=True, kw_only=True)
class FederatedDDPGArguments(FederationArguments):
    """Those of :class:`~sb3_fedguide.common.federated_ddpg.FederatedDDPG`."""

    network_config = "DeterministicNetworkConfig"

    learning_rate: Positive | Schedule = 1e-4
    buffer_size: Annotated[int, Range(1, 1e8)] = 100_000
    learning_starts: Annotated[int, Range(0)] = 1000
    tau: Annotated[float, Range(OPEN, 1)] = 1e-3
    train_freq: Count = 1
    gradient_steps: int = 1
    noise_theta: NotNegative = 0.15
    noise_sigma: NotNegative = 0.2
    noise_dt: Positive = 1.0


@dataclass(frozen=True, kw_only=True)
class AveragingArguments:
    """Those of :class:`~sb3_fedguide.common.parameter_averaging.ParameterAveraging` beside its learner's."""

    average: Average = "all"
    average_every: Count = 1
    average_until: Count | None = None
    aggregator: Aggregator = "mean"
    trim_fraction: Annotated[float, Range(0, 0.5, "it is the share left out on either side", without_high=True)] = 0.25
    server_step: ServerStep = 1.0
    server_momentum: Annotated[float, Range(0, 1, "it is the share of the last update that is added", without_high=True)] = 0.0
    mix: Mix | Schedule = 1.0
    screening: Tested = 0.0
    noise_multiplier: Annotated[float, Range(0, 1e6)] = 0.0
    clipping_norm: Positive | None = None
    delta: Annotated[float, Range(OPEN, 0.1)] = 1e-5


@dataclass(frozen=True, kw_only=True)
class FedAvgArguments(AveragingArguments, FederatedPPOArguments):
    """Those of :class:`~sb3_fedguide.algorithms.fedavg.FedAvg`."""


@dataclass(frozen=True, kw_only=True)
class FedRLArguments(AveragingArguments, FederatedDDPGArguments):
    """Those of :class:`~sb3_fedguide.algorithms.fedrl.FedRL`."""


@dataclass(frozen=True, kw_only=True)
class FedProxArguments(FedAvgArguments):
    """Those of :class:`~sb3_fedguide.algorithms.fedprox.FedProx`."""

    mu: Annotated[float, Range(0, why="it is the weight of the proximal term; 0 is FedAvg")] = 0.01


#: Weight of a divergence from another policy.
Divergence = Annotated[float, Range(0, why="it weighs a divergence; 0 leaves it out")]


@dataclass(frozen=True, kw_only=True)
class FedKLArguments(FedAvgArguments):
    """Those of :class:`~sb3_fedguide.algorithms.fedkl.FedKL`."""

    lambda_global: Divergence = 0.1
    lambda_local: Divergence = 0.05


@dataclass(frozen=True, kw_only=True)
class FedSVRPGMArguments(FedAvgArguments):
    """Those of :class:`~sb3_fedguide.algorithms.fedsvrpgm.FedSVRPGM`."""

    beta: Annotated[float, Range(0, 1, "it is the weight of the plain gradient; 1 is FedAvg")] = 0.2
    reference_every: Count = 5


@dataclass(frozen=True, kw_only=True)
class FedGuideRArguments(FedAvgArguments):
    """Those of :class:`~sb3_fedguide.algorithms.fedguide_r.FedGuideR`."""

    server_step: ServerStep = 2.0
    screening: Tested = 0.05


@dataclass(frozen=True, kw_only=True)
class FedGuideArguments(FederatedPPOArguments):
    """Those of :class:`~sb3_fedguide.algorithms.fedguide.FedGuide`."""

    lambda_trust: NotNegative = 0.05
    lambda_prior: NotNegative = 0.5
    prior_horizon: Count = 50
    prior_loss: Literal["snis", "sample"] = "snis"
    prior_states: Size | None = 512
    density_steps: Count = 6
    sampling_steps: Count = 10
    beta: Annotated[float, Range(0, 1, "it is the online critic's weight in the baseline")] | Schedule | Literal["auto"] = 0.5
    critic_target: Literal["online", "blend"] = "online"
    calibrate: bool = False
    n_experts: Annotated[int, Range(1, 1e4)] | None = None
    eta: Annotated[float, Range(OPEN, why="it is the entropic regularisation of the transport plan")] = 0.05
    cost: TransportCost = "score"
    cost_scaling: CostScaling = "max"
    adapt: Literal["none", "advantage"] = "none"
    adapt_temperature: Positive = 1.0
    adapt_weight: Share = 0.5


@dataclass(frozen=True, kw_only=True)
class FedGuideAArguments(AveragingArguments, FedGuideArguments):
    """Those of :class:`~sb3_fedguide.algorithms.fedguide.FedGuideA`."""

    average: Average = "actor"
    average_every: Count = 5
