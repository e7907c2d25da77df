"""Clients that join late start from the mean policy of another federation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sb3_fedguide.common.parameters import HEADER
from sb3_fedguide.server.moments import Moments, merge
from sb3_fedguide.state.array_files import read_arrays, take_prefix

if TYPE_CHECKING:
    from sb3_fedguide.common.federation import Federation


def start_from(model: Federation, path: str | Path) -> None:
    """Let every client of ``model`` start from the mean policy and the pooled observation statistics of another federation.

    The other federation may have other clients, and any number of them. Its networks must be near each other: export
    them while it averages them. The offline stage of ``model`` comes first, for priors and values of the method.
    A deployment does not need this function: a client that joins late receives the others' policy.

    :param model: not yet trained
    :param path: file of the other federation's ``export_parameters``, such as a run's ``parameters.npz``
    :raises ValueError: for a model that has trained, or a file that does not fit
    """
    if model.round > 0:
        raise ValueError("clients start from another federation before they train; make a new model")
    try:
        arrays = read_arrays(Path(path))
    except FileNotFoundError:
        raise ValueError(f"there is no parameter file {path}") from None
    policies, statistics = take_prefix(arrays, "policy/"), take_prefix(arrays, "normalizer/")
    own = model.policy.state_dict()
    wrong = [
        name
        for name in own.keys() | policies.keys()
        if name not in policies or own[name].shape[1:] != policies[name].shape[1:]
    ]
    normalized = json.loads(str(arrays[HEADER])).get("normalize") if HEADER in arrays else None
    if wrong or not statistics or normalized != bool(model.normalize):
        what = f"its parameter {wrong[0]} is different" if wrong else f"its normalize is {normalized}, here {model.normalize}"
        raise ValueError(f"{path} does not fit this {type(model).__name__}: {what}; give both the same settings")
    model.pretrain()
    for index in range(model.n_clients):
        model.policy.load_client(index, {name: array.mean(axis=0).astype(np.float32) for name, array in policies.items()})
    known = zip(statistics["obs.count"].ravel(), statistics["obs.mean"], statistics["obs.var"], strict=True)
    distinct = {(mean.tobytes(), var.tobytes()): Moments(float(count), mean, var) for count, mean, var in known}
    pooled = merge(list(distinct.values()))  # shared statistics are the same for all clients, and count once
    for index in range(model.n_clients):
        model.normalizer.warm_start(index, pooled.mean, pooled.var, int(pooled.count))
