"""Arguments of Stable-Baselines3's constructors that a federation does not support, each with its reason."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_fedguide.common.stacked_policy import StackedPolicy
from sb3_fedguide.settings.ranges import check_values
from sb3_fedguide.settings.signatures import CompleteSignature, parameters, types_of

_NO_SDE = "exploration noise is drawn by each client's own random stream, independently in every step"
_NO_FEATURES = "lockstep policies see flat observations directly; extract features in a wrapper around the environments"
_NO_BUFFER = "the clients' experience has a client axis, and its buffer is the federation's own"

#: keyword of an SB3 constructor, or of its ``policy_kwargs``, to the reason and the remedy
UNSUPPORTED = {
    "use_sde": _NO_SDE,
    "sde_sample_freq": _NO_SDE,
    "use_sde_at_warmup": _NO_SDE,
    "full_std": _NO_SDE,
    "use_expln": _NO_SDE,
    "squash_output": "actions are drawn from a Gaussian and clipped to the action space, as SB3 does without gSDE",
    "target_kl": "clients in lockstep take the same number of gradient steps; use fewer n_epochs or a smaller clip_range",
    "n_steps": "a round's steps are given per client: rollout_size (n_steps * n_envs_per_client)",
    "rollout_buffer_class": _NO_BUFFER,
    "rollout_buffer_kwargs": _NO_BUFFER,
    "replay_buffer_class": _NO_BUFFER,
    "replay_buffer_kwargs": _NO_BUFFER,
    "optimize_memory_usage": "each client's buffer keeps next observations, since its environments are reset in turn",
    "action_noise": "each client has its own Ornstein-Uhlenbeck noise; set it with noise_theta, noise_sigma and noise_dt",
    "features_extractor_class": _NO_FEATURES,
    "features_extractor_kwargs": _NO_FEATURES,
    "share_features_extractor": _NO_FEATURES,
    "normalize_images": _NO_FEATURES,
    "policy_delay": "DDPG updates its actor in every gradient step",
    "target_policy_noise": "DDPG does not smooth its targets",
    "target_noise_clip": "DDPG does not smooth its targets",
    "policy_base": "the policies are given by policy alone",
    "create_eval_env": "evaluate with FederatedEvalCallback",
    "monitor_wrapper": "episodes are recorded by FederatedVecEnv, without a wrapper",
    "support_multi_env": "a federation always has several environments",
}  # fmt: skip
#: reasons for off-policy algorithms, if they are different
_OFF_POLICY = {"n_steps": "the critics' targets are one-step returns, as in DDPG's paper"}


#: remedies for SB3's other policies
_INSTEAD = {
    "MultiInputPolicy": "observations that are a Dict are flattened for it",
    "CnnPolicy": "images are flattened for it, and there are no convolutions",
}


def check_keywords(cls: type, given: Iterable[str]) -> None:
    """:raises ValueError: for a keyword of SB3's constructor that ``cls`` does not take
    :raises TypeError: for any other unknown name
    """
    known = set(parameters(cls))
    for name in given:
        if name not in known:
            reasons = {**UNSUPPORTED, **_OFF_POLICY} if issubclass(cls, OffPolicyAlgorithm) else UNSUPPORTED
            _refuse(name, known, f"{cls.__name__}()", reasons)


def check_policy(policy: Any, aliases: Mapping[str, type[BasePolicy]], cls: type) -> None:
    """:raises ValueError: for a policy that holds a single agent, or whose name is unknown"""
    stacked = " or ".join(kind.__name__ for kind in aliases.values())
    if isinstance(policy, str):
        if policy not in aliases:
            instead = _INSTEAD.get(policy, "other networks are policy_kwargs (net_arch, activation_fn)")
            raise ValueError(
                f"policy={policy!r} must be {' or '.join(map(repr, aliases))} for {cls.__name__}, "
                f"or a subclass of {stacked}; {instead}"
            )
    elif not isinstance(policy, type) or not issubclass(policy, StackedPolicy):
        shown = policy.__name__ if isinstance(policy, type) else repr(policy)
        raise ValueError(
            f"policy={shown} holds one agent, and {cls.__name__} needs all clients' networks in one policy: give "
            f"{' or '.join(map(repr, aliases))}, or a subclass of {stacked}"
        )


def check_policy_keywords(policy_class: type, given: Mapping[str, Any]) -> None:
    """:raises ValueError: for ``policy_kwargs`` that SB3's policies take and ``policy_class`` does not
    :raises TypeError: for any other unknown name
    """
    known = set(parameters(policy_class)) - {"observation_space", "action_space", "lr_schedule", "n_clients", "init_seed"}
    for name in given:
        if name not in known:
            _refuse(name, known, "policy_kwargs")


def _refuse(name: str, known: set[str], where: str, reasons: Mapping[str, str] = UNSUPPORTED) -> None:
    if name in reasons:
        raise ValueError(f"{name} is not supported: {reasons[name]}")
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.75)
    hint = f"; did you mean {near[0]!r}?" if near else f"; it takes {', '.join(sorted(known))}"
    raise TypeError(f"{where} has no argument {name!r}{hint}")


class CheckedKeywords(BaseAlgorithm):
    """Mixin: names and values are checked before any constructor runs, and the signature shows all names."""

    __signature__ = CompleteSignature()

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        check_keywords(cls, kwargs)
        types = types_of(cls)
        by_position = [name for name, known in parameters(cls).items() if known.kind is known.POSITIONAL_OR_KEYWORD]
        check_values(types, {**dict(zip(by_position, args, strict=False)), **kwargs})
        return super().__new__(cls)
