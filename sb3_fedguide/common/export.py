"""One client's policy outside of the federation: an ordinary Stable-Baselines3 model, TorchScript, ``torch.export``, ONNX."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import DDPG, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import fx, nn

from fed_envs.files import atomic_file
from sb3_fedguide.common.ddpg_policy import BoundedActor
from sb3_fedguide.common.distributions import Gaussian, action_distribution
from sb3_fedguide.common.normalization import FederatedNormalizer
from sb3_fedguide.common.participation import ParticipationAdam
from sb3_fedguide.common.spaces import is_plain

logger = logging.getLogger(__name__)

#: settings of the federation that further training keeps, by SB3's names
SETTINGS: dict[str, tuple[str, ...]] = {
    "PPO": (
        "learning_rate", "n_steps", "batch_size", "n_epochs", "gamma", "gae_lambda", "clip_range", "clip_range_vf",
        "normalize_advantage", "ent_coef", "vf_coef", "max_grad_norm",
    ),
    "DDPG": (
        "learning_rate", "buffer_size", "learning_starts", "batch_size", "tau", "gamma", "train_freq", "gradient_steps",
        "noise_sigma", "noise_theta", "noise_dt",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Normalization:
    """``clip((obs - mean) / std, -clip, clip)`` of flattened observations, in float64.

    :param mean: ``(obs_dim,)``, like ``std``
    """

    mean: np.ndarray
    std: np.ndarray
    clip: float

    @classmethod
    def of(cls, mean: np.ndarray, var: np.ndarray) -> Normalization:
        """Made from a client's running moments, as in :meth:`FederatedNormalizer.normalize_obs`."""
        return cls(mean, np.sqrt(var + FederatedNormalizer.EPSILON), FederatedNormalizer.CLIP)


@dataclass(frozen=True)
class ClientPolicy:
    """Everything that is needed to build one client's policy anywhere.

    :param learner: ``"PPO"`` or ``"DDPG"``
    :param observation_space: of the client's own environment
    :param state: the ordinary policy's state dict, by SB3's names
    :param normalization: of observations; ``None`` for none
    :param settings: hyperparameters for further training, by the names in :data:`SETTINGS`; SB3's defaults for the others
    """

    learner: str
    observation_space: spaces.Space
    action_space: spaces.Space
    activation_fn: type[nn.Module]
    state: dict[str, th.Tensor]
    normalization: Normalization | None
    settings: dict[str, Any] = field(default_factory=dict)
    seed: int | None = None
    #: of the policy, only for further training
    network: dict[str, Any] = field(default_factory=dict)

    def to_sb3(self) -> PPO | DDPG:
        """An ordinary model that takes the environment's own observations; ``set_env`` gives it one to train in.

        Networks and normalisation are copied; Adam's moments are not, so further training starts without them. Once saved,
        the model loads wherever Stable-Baselines3 is installed.
        """
        settings = dict(self.settings)
        if noise := {name: settings.pop(f"noise_{name}") for name in ("sigma", "theta", "dt") if f"noise_{name}" in settings}:
            zeros = np.zeros(self.action_space.shape or ())
            settings["action_noise"] = OrnsteinUhlenbeckActionNoise(zeros, zeros + noise["sigma"], noise["theta"], noise["dt"])
        kind = "MultiInputPolicy" if isinstance(self.observation_space, spaces.Dict) else "MlpPolicy"
        model = (PPO if self.learner == "PPO" else DDPG)(
            kind,
            None,  # type: ignore[arg-type]
            policy_kwargs=self._policy_kwargs(),
            seed=self.seed,
            device="cpu",
            _init_setup_model=False,
            **settings,
        )
        model.observation_space, model.action_space = self.observation_space, self.action_space
        model.n_envs = 1
        model._setup_model()
        model.policy.load_state_dict(self.state)
        return model

    def _policy_kwargs(self) -> dict[str, Any]:
        actor, critic = ("pi", "vf") if self.learner == "PPO" else ("pi", "qf")
        kwargs: dict[str, Any] = {
            "net_arch": {actor: self._hidden_sizes(critic=False), critic: self._hidden_sizes(critic=True)},
            "activation_fn": self.activation_fn,
            **self.network,
        }
        is_flat = isinstance(self.observation_space, spaces.Box) and len(self.observation_space.shape) == 1
        if self.normalization is not None or not is_flat:
            kwargs["features_extractor_class"] = features_extractor(self.observation_space, self.normalization)
            kwargs["normalize_images"] = False
        return kwargs

    def _hidden_sizes(self, critic: bool) -> list[int]:
        if self.learner == "PPO":
            return self._layer_sizes("mlp_extractor.value_net." if critic else "mlp_extractor.policy_net.")
        return self._layer_sizes("critic.qf0." if critic else "actor.mu.")[:-1]  # the last one is the output

    def _layer_sizes(self, prefix: str) -> list[int]:
        names = [name for name in self.state if name.startswith(prefix) and name.endswith(".weight")]
        return [len(self.state[name]) for name in sorted(names, key=lambda name: int(name.removeprefix(prefix).split(".")[0]))]

    def module(self) -> DeployedPolicy:
        """Its deterministic policy as a plain module."""
        return DeployedPolicy(self).eval().requires_grad_(False)

    @property
    def obs_dim(self) -> int:
        """Entries of a flattened observation."""
        return spaces.flatdim(self.observation_space)


def features_extractor(space: spaces.Space, normalization: Normalization | None) -> type[FlattenExtractor]:
    """A features extractor class that flattens observations and normalises them, and unpickles without this package.

    SB3's archive holds the class itself. Pickle writes a class by its module's name; cloudpickle writes a class of
    ``__main__`` with its functions' bytecode, which no other version of Python runs. So this class has no function of its
    own: ``self.flatten``, which ``FlattenExtractor`` calls, is an ``fx.GraphModule``, which pickles as source code.
    """
    graph = fx.Graph()
    observations = graph.placeholder("observations")
    parts = [observations]
    if isinstance(space, spaces.Dict):
        parts = [graph.call_method("__getitem__", (observations, name)) for name in space.spaces]
    features = graph.call_function(th.cat, ([graph.call_function(th.flatten, (part, 1)) for part in parts], 1))
    root = nn.Module()
    if normalization is not None:
        # As attributes of the class, not of its instances, the constants stay on the CPU, and so load everywhere.
        root.register_buffer("mean", th.as_tensor(normalization.mean))
        root.register_buffer("std", th.as_tensor(normalization.std))
        device = graph.call_function(getattr, (features, "device"))
        mean, std = (graph.call_method("to", (graph.get_attr(name), device)) for name in ("mean", "std"))
        scaled = graph.call_function(th.div, (graph.call_function(th.sub, (features, mean)), std))
        clipped = graph.call_function(th.clamp, (scaled, -normalization.clip, normalization.clip))
        features = graph.call_method("to", (clipped, th.float32))
    graph.output(features)
    module = fx.GraphModule(root, graph, class_name="Features")
    return type("ClientFeatures", (FlattenExtractor,), {"flatten": module, "__module__": "__main__"})


class DeployedPolicy(nn.Module):
    """A client's deterministic policy from raw observations to executed actions; needs neither SB3 nor this package.

    It maps ``(batch, obs_dim)`` float32, flattened as by ``gymnasium.spaces.flatten``, to actions for the environment, row by
    row: ``(batch, action_dim)`` float32 within the bounds, or integers, ``(batch,)`` for a Discrete space.
    """

    mean: th.Tensor
    std: th.Tensor
    low: th.Tensor
    high: th.Tensor

    def __init__(self, policy: ClientPolicy) -> None:
        super().__init__()
        model: Any = policy.to_sb3()
        network: list[nn.Module]
        if policy.learner == "DDPG":
            network = [BoundedActor(model.policy.actor.mu, policy.action_space)]  # type: ignore[arg-type]
        else:
            network = [model.policy.mlp_extractor.policy_net, model.policy.action_net]
        self.network = nn.Sequential(*network)
        self.distribution = action_distribution(policy.action_space)
        self.is_discrete = isinstance(policy.action_space, spaces.Discrete)
        if isinstance(self.distribution, Gaussian):
            self.register_buffer("low", th.as_tensor(self.distribution.low))
            self.register_buffer("high", th.as_tensor(self.distribution.high))
        self.clip = None if policy.normalization is None else policy.normalization.clip
        if policy.normalization is not None:
            self.register_buffer("mean", th.as_tensor(policy.normalization.mean))
            self.register_buffer("std", th.as_tensor(policy.normalization.std))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        if self.clip is not None:
            scaled = (observations - self.mean) / self.std
            observations = th.clamp(scaled, -self.clip, self.clip).to(th.float32)
        actions = self.distribution.decide(self.network(observations))
        if isinstance(self.distribution, Gaussian):
            actions = th.minimum(th.maximum(actions, self.low), self.high)
        return actions.squeeze(-1) if self.is_discrete else actions


def write_policy(policy: ClientPolicy, path: str | Path) -> None:
    """Write a policy in the format of ``path``'s suffix, complete or not at all.

    :raises ValueError: for another suffix, or if a package is missing
    """
    path = Path(path)
    if path.suffix not in FORMATS:
        raise ValueError(f"{path}: the suffix selects the format, and must be one of {', '.join(FORMATS)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path, "wb") as file:
        FORMATS[path.suffix](policy, file)


def _write_sb3(policy: ClientPolicy, file: Any) -> None:
    policy.to_sb3().save(file)


def _write_program(policy: ClientPolicy, file: Any) -> None:
    module, example = _traceable(policy)
    th.export.save(th.export.export(module, (example,), dynamic_shapes=({0: th.export.Dim("batch")},)), file)


def _write_torchscript(policy: ClientPolicy, file: Any) -> None:
    module, example = _traceable(policy)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of TorchScript itself, which LibTorch still reads
        th.jit.save(th.jit.trace(module, example), file)


def _write_onnx(policy: ClientPolicy, file: Any) -> None:
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ModuleNotFoundError as error:
        raise ValueError(f"{error.name} is not installed: pip install 'sb3-fedguide[onnx]'") from None
    module, example = _traceable(policy)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyTorch's exporter warns of its own parts
        program = th.onnx.export(
            module,
            (example,),
            input_names=["observations"],
            output_names=["actions"],
            dynamic_shapes=({0: th.export.Dim("batch")},),
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    file.write(program.model_proto.SerializeToString())


def _traceable(policy: ClientPolicy) -> tuple[DeployedPolicy, th.Tensor]:
    return policy.module(), th.zeros(2, policy.obs_dim)


#: Writers of a policy, by the suffix of the file: SB3's archive, a ``torch.export`` program, TorchScript, ONNX.
FORMATS: dict[str, Callable[[ClientPolicy, Any], None]] = {
    ".zip": _write_sb3,
    ".pt2": _write_program,
    ".pt": _write_torchscript,
    ".onnx": _write_onnx,
}


def client_settings(model: Any) -> dict[str, Any]:
    """The federation's hyperparameters that a client's own model keeps; it has one environment."""
    settings = {name: getattr(model, name) for name in SETTINGS[model.learner]}
    return {**settings, "n_steps": model.rollout_size} if "n_steps" in settings else settings


class ClientPolicies(BaseAlgorithm):
    """Mixin of a federation that exports its clients' policies."""

    policy: Any
    normalizer: FederatedNormalizer
    client_ids: list[int]
    #: of the clients' own environments, before they were flattened
    raw_observation_space: spaces.Space | None = None

    def client(self, client_id: int) -> PPO | DDPG:
        """Client ``client_id``'s policy as an ordinary ``stable_baselines3`` model that takes raw observations.

        Networks and normalisation are copied; Adam's moments and replay are not. Once saved, it loads without this package.

        :raises ValueError: for a client that does not live here
        """
        model = self.client_policy(client_id).to_sb3()
        model._stats_window_size, model.verbose = self._stats_window_size, self.verbose
        return model

    def export(self, client_id: int, path: str | Path) -> None:
        """Write client ``client_id``'s policy in the format of the suffix; no format needs this package.

        ``.zip`` is :meth:`client` in SB3's archive. The others map raw observations, flattened, to executed actions:
        ``.pt2`` for ``torch.export.load(path).module()``, ``.pt`` for ``torch.jit.load``, ``.onnx`` for ONNX.

        :raises ValueError: for a client that does not live here, or another suffix
        """
        write_policy(self.client_policy(client_id), path)

    def client_policy(self, client_id: int) -> ClientPolicy:
        """Client ``client_id``'s policy, copied.

        :raises ValueError: for a client that does not live here
        """
        if client_id not in self.client_ids:
            raise ValueError(f"no client {client_id} here; this federation holds the clients {self.client_ids}")
        if self.raw_observation_space not in (None, self.client_observation_space):
            logger.warning(
                "client %d's policy takes gymnasium.spaces.flatten(space, observation), since Stable-Baselines3 has no policy "
                "for the space %s", client_id, self.raw_observation_space,
            )  # fmt: skip
        index, moments = self.client_ids.index(client_id), self.normalizer.obs
        return ClientPolicy(
            self.learner,
            self.client_observation_space,
            self.action_space,
            self.policy.activation_fn,
            self.policy.client_state_dict(index),
            Normalization.of(moments.mean[index], moments.var[index]) if self.normalizer.norm_obs else None,
            client_settings(self),
            self.seed,
            self._network_settings(),
        )

    def _network_settings(self) -> dict[str, Any]:
        names = ("optimizer_class", "optimizer_kwargs", "ortho_init", "log_std_init")
        found = {name: getattr(self.policy, name) for name in names if hasattr(self.policy, name)}
        if found["optimizer_class"] is ParticipationAdam:  # Adam, for partial participation
            found["optimizer_class"] = th.optim.Adam
        return found

    @property
    def learner(self) -> str:
        """The SB3 class of a client's policy."""
        return "DDPG" if isinstance(self, DDPG) else "PPO"

    @property
    def client_observation_space(self) -> spaces.Space:
        """A client's policy takes the environments' own observations, or flattened ones if SB3 does not support them."""
        raw = self.raw_observation_space
        return raw if raw is not None and is_plain(raw) else self.observation_space
