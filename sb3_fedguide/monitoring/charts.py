"""Summaries that TensorBoard receives once per run: the keys of each chart, and the run's hyperparameters."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Any

from sb3_fedguide.algorithms.fedguide import FedGuide
from sb3_fedguide.algorithms.fedprox import AnchoredFedAvg
from sb3_fedguide.common.federated_ddpg import FederatedDDPG
from sb3_fedguide.common.federation import Federation
from sb3_fedguide.server.averaging import Averaging
from sb3_fedguide.server.strategy import Composite, Strategy
from sb3_fedguide.server.svrpg import SVRPG

#: Category to chart to keys.
Layout = dict[str, dict[str, list[str]]]

#: Metrics of the HParams tab, from the run's own time series; a metric that a run does not log stays empty.
METRICS = ("eval/mean_reward", "eval/worst_client", "eval/broadcast_mean_reward", "rollout/ep_rew_mean")

#: TensorBoard shows five columns at first: those marked as different between runs, then by name.
SHOWN_FIRST = ("algo", "family", "seed", "n_rounds", "learning_rate")

_RETURNS: Layout = {
    "Returns": {
        "evaluation, each client": [r"client_\d+/eval_mean_reward"],
        "evaluation, average and worst client": ["eval/mean_reward", "eval/worst_client"],
        "training episodes, each client": [r"client_\d+/ep_rew_mean"],
        "training episodes, average": ["rollout/ep_rew_mean"],
    }
}
_PPO: Layout = {
    "Losses": {
        "policy": ["train/policy_gradient_loss"],
        "critic": ["train/value_loss"],
        "entropy": ["train/entropy_loss"],
    },
    "Policy": {
        "KL from the rollout's policy, each client": [r"client_\d+/approx_kl"],
        "standard deviation, each client": [r"client_\d+/std"],
        "gradient norm, each client": [r"client_\d+/grad_norm"],
        "critic's explained variance, each client": [r"client_\d+/explained_variance"],
        "dispersion (Theorem 3)": ["federated/policy_dispersion"],
    },
}
_REGULARISERS: Layout = {"Losses": {"regularisers": [r"train/(trust|prior|proximal|global_kl|local_kl)_loss"]}}
_DDPG: Layout = {
    "Losses": {
        "DDPG's actor": ["train/actor_loss"],
        "DDPG's critic": ["train/critic_loss"],
        "DDPG's actor, each client": [r"client_\d+/actor_loss"],
        "DDPG's critic, each client": [r"client_\d+/critic_loss"],
    }
}
_PRIOR: Layout = {
    "Prior": {
        "weight of the prior": ["prior/lambda_prior"],
        "cross-entropy, weighted": ["train/prior_loss"],
    }
}
_SAMPLE_SIZE: Layout = {"Prior": {"effective sample share": [r"prior/effective_sample_share(_min)?"]}}
_ADAPTATION: Layout = {"Prior": {"change of the heads": ["prior/head_change"]}}
_DICE: Layout = {
    "DICE": {
        "weight of the online critic": ["dice/beta", "dice/beta_optimal"],
        "explained variance": [r"dice/explained_variance_(online|dice|blend)"],
        "variance of the advantage (Lemma 2)": [r"dice/advantage_variance_(online|blend|optimal)"],
        "residual correlation (Lemma 2)": ["dice/residual_correlation"],
    }
}
_TRANSPORT: Layout = {
    "OT-MoE": {
        "effective experts of a client": ["federated/effective_experts"],
        "largest load of an expert": ["federated/expert_load_max"],
        "transport cost": ["federated/transport_cost"],
        "cost: param against score": [r"federated/cost_proxy_(error|correlation)"],
    }
}
_AVERAGING: Layout = {
    "Returns": {"evaluation, average of the broadcast policy": ["eval/broadcast_mean_reward"]},
    "Averaging": {
        "distance from the average": ["federated/drift"],
        "change of the return (Theorem 3)": ["eval/averaging_change"],
    },
}
_SVRPG: Layout = {
    "Averaging": {
        "ratios of the reference policy": ["svrpg/effective_sample_share"],
        "common direction": [r"federated/direction_(norm|agreement)"],
    }
}
_TIME: Layout = {"Costs": {"seconds": [r"time/(rollout|train|exchange)"]}}
_BYTES: Layout = {"Costs": {"bytes in a round": [r"federated/bytes_(up|down)"]}}


def chart_layout(model: Federation) -> Layout:
    """The charts that a run of this model fills, as patterns of whole keys.

    A title always means the same patterns: TensorBoard shows the charts of several runs as one only where they are equal.
    """
    parts = [_RETURNS, _DDPG if isinstance(model, FederatedDDPG) else _PPO]
    if isinstance(model, (FedGuide, AnchoredFedAvg)):
        parts += [_REGULARISERS]
    if isinstance(model, FedGuide):
        parts += [_PRIOR]
        if model.prior_loss == "snis":
            parts += [_SAMPLE_SIZE]
        if model.adapt == "advantage":
            parts += [_ADAPTATION]
        if model.uses_dice:
            parts += [_DICE]
        parts += [_TRANSPORT]
    servers = list(flat(model.strategy))
    if any(isinstance(server, Averaging) for server in servers):
        parts += [_AVERAGING]
    if any(isinstance(server, SVRPG) for server in servers):
        parts += [_SVRPG]
    layout: Layout = {}
    parts += [_TIME] if model.strategy is None else [_TIME, _BYTES]
    for part in parts:
        for category, charts in part.items():
            layout.setdefault(category, {}).update(charts)
    return layout


def flat(strategy: Strategy | None) -> Iterable[Strategy]:
    """A strategy's parts, or itself."""
    if isinstance(strategy, Composite):
        for part in strategy.strategies:
            yield from flat(part)
    elif strategy is not None:
        yield strategy


def layout_summary(layout: Layout) -> Any:
    """The summary that TensorBoard's Custom Scalars tab reads; it matches patterns at a key's beginning only."""
    from torch.utils.tensorboard.summary import custom_scalars

    return custom_scalars(
        {
            category: {title: ["Multiline", [f"{key}$" for key in keys]] for title, keys in charts.items()}
            for category, charts in layout.items()
        }
    )


def flatten(hyperparameters: Mapping[str, Any], prefix: str = "") -> dict[str, bool | float | str]:
    """Nested hyperparameters under dotted names; lists and other types that HParams does not know become text.

    ``None`` is left out.
    """
    flat: dict[str, bool | float | str] = {}
    for name, value in hyperparameters.items():
        if isinstance(value, Mapping):
            flat.update(flatten(value, f"{prefix}{name}."))
        elif value is not None:
            flat[prefix + name] = value if isinstance(value, bool | int | float | str) else str(value)
    return flat


def session_start(
    hyperparameters: Mapping[str, bool | float | str], metrics: Iterable[str] = METRICS, others: Iterable[str] = ()
) -> list[Any]:
    """The summaries that TensorBoard's HParams tab reads; metrics are the last values of the run's own time series.

    TensorBoard takes the columns of all runs from the first run that it finds. So runs of different algorithms can be
    compared only if each also names the hyperparameters of the ``others``.
    """
    from tensorboard.plugins.hparams import api_pb2, metadata, plugin_data_pb2

    columns = dict.fromkeys([*hyperparameters, *others])
    experiment = api_pb2.Experiment(
        hparam_infos=[
            api_pb2.HParamInfo(name=name, type=_data_type(hyperparameters.get(name, "")), differs=name in SHOWN_FIRST)
            for name in columns
        ],
        metric_infos=[api_pb2.MetricInfo(name=api_pb2.MetricName(tag=key), display_name=key) for key in metrics],
    )
    session = plugin_data_pb2.SessionStartInfo(start_time_secs=time.time())
    for name, value in hyperparameters.items():
        field = {bool: "bool_value", str: "string_value"}.get(type(value), "number_value")
        setattr(session.hparams[name], field, value)
    return [
        _summary(metadata.EXPERIMENT_TAG, experiment=experiment),
        _summary(metadata.SESSION_START_INFO_TAG, session_start_info=session),
    ]


def session_end() -> Any:
    """The summary that marks a run in the HParams tab as finished."""
    from tensorboard.plugins.hparams import api_pb2, metadata, plugin_data_pb2

    end = plugin_data_pb2.SessionEndInfo(status=api_pb2.STATUS_SUCCESS, end_time_secs=time.time())
    return _summary(metadata.SESSION_END_INFO_TAG, session_end_info=end)


def _summary(tag: str, **content: Any) -> Any:
    from tensorboard.compat.proto.summary_pb2 import Summary
    from tensorboard.plugins.hparams import metadata, plugin_data_pb2

    described = metadata.create_summary_metadata(plugin_data_pb2.HParamsPluginData(**content))
    return Summary(value=[Summary.Value(tag=tag, metadata=described, tensor=metadata.NULL_TENSOR)])


def _data_type(value: bool | float | str) -> int:
    from tensorboard.plugins.hparams import api_pb2

    kinds = {bool: api_pb2.DATA_TYPE_BOOL, str: api_pb2.DATA_TYPE_STRING}
    return kinds.get(type(value), api_pb2.DATA_TYPE_FLOAT64)  # type: ignore[call-overload]
