"""Small federations as sites that answer a server, and the same clients in one process."""

from __future__ import annotations

import copy
import functools
import json
from pathlib import Path
from typing import Any

import numpy as np

import fed_envs
from fed_envs.metadata import Family, parse_family
from sb3_fedguide.common.federation import Federation
from sb3_fedguide.deployment.serve import ServerConfig
from sb3_fedguide.deployment.site import Site
from sb3_fedguide.registry import algorithm
from tests.conftest import assert_same_parameters
from tests.loop_transport import LoopTransport

CLIENTS, N_ROUNDS = [0, 1, 2], 3
COMMON = {
    "rollout_size": 32, "batch_size": 16, "n_envs_per_client": 4, "seed": 3, "normalize": True, "bc_weight": 0.3,
    "policy_kwargs": {"net_arch": [16]},
    "pretraining": {
        "dataset_size": 60, "bc_updates": 4, "dice_updates": 4, "dice_width": 8,
        "prior_updates": 7, "prior_average_every": 3, "prior_width": 8,
    },
}  # fmt: skip
OWN: dict[str, dict[str, Any]] = {
    "fedrl": {"learning_starts": 8, "buffer_size": 100, "train_freq": 4},
    "fedsvrpgm": {"reference_every": 2},
    "fedguide-a": {"average_every": 2, "adapt": "advantage", "beta": "auto", "calibrate": True},
    "fedguide-p": {"prior_loss": "sample"},
    "fedguide-r": {"normalize": "shared", "screening": 0.5, "mix": lambda remaining: 2 * remaining},
}


@functools.cache
def family(name: str) -> Family:
    """Its first three clients."""
    content = json.loads(fed_envs.FAMILIES[name].read_text())
    return parse_family({**content, "clients": content["clients"][: len(CLIENTS)]}, name)


def make(algo: str, env: str, clients: list[int] | None = None, **more: Any) -> Federation:
    settings = copy.deepcopy({**COMMON, **OWN.get(algo, {}), **more})  # SB3 writes into policy_kwargs
    if algorithm(algo).uses_prior:
        settings = {"prior_states": 16, **settings}
    return algorithm(algo)("MlpPolicy", family(env), clients=clients, **settings)


def federation(algo: str, env: str, folder: Path, fresh: bool = False, **more: Any) -> tuple[ServerConfig, LoopTransport]:
    """The server's configuration and the sites of the same federation."""
    settings = make(algo, env, **more).server_settings()
    config = ServerConfig(algo, len(CLIENTS), N_ROUNDS, COMMON["rollout_size"], COMMON["seed"], settings, wait=0.0, poll=0.0)

    def site(client: int) -> Site:
        return Site(make(algo, env, [client], **more), N_ROUNDS, folder / f"site_{client}", eval_freq=2, n_episodes=2)

    return config, LoopTransport(site, CLIENTS, fresh)


@functools.cache
def in_process(algo: str, env: str, **more: Any) -> Federation:
    """The same clients in one process; who was absent at the end has received what it missed, as at a server's end."""
    model = make(algo, env, **more)
    model.learn(N_ROUNDS * model.rollout_size * model.n_participants)
    for index in np.flatnonzero(model.outdated):
        model.take_broadcasts({index: model.strategy.catch_up(model.client_ids[index])})
    return model


def assert_equal(transport: LoopTransport, model: Federation) -> None:
    for client in CLIENTS:
        site = transport.site(client).model
        assert_same_parameters(site.policy.client_state_dict(0), model.policy.client_state_dict(client))
        for name, array in site.normalizer.state_dict().items():
            np.testing.assert_array_equal(array[0], model.normalizer.state_dict()[name][client], err_msg=name)
        if getattr(model, "experts", None) is not None:
            np.testing.assert_array_equal(site.experts[0], model.experts[client])
            np.testing.assert_array_equal(site.heads[0], model.heads[client])
