"""Federations small enough for a test, made and trained as the command line does."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import torch as th

from sb3_fedguide.cli.recorder import CostCallback, DeployedCallback, RunEvalCallback
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.checkpoint import CheckpointCallback
from sb3_fedguide.registry import algorithm

ROUNDS, STOP = 4, 2
OFFLINE = {"bc_updates": 2, "dice_updates": 2, "prior_updates": 2, "dataset_size": 200, "prior_width": 8, "dice_width": 8}
COMMON = {
    "rollout_size": 32, "batch_size": 16, "seed": 3, "policy_kwargs": {"net_arch": [8]}, "normalize": True, "bc_weight": 0.3,
    "n_envs_per_client": 2, "pretraining": OFFLINE,
}  # fmt: skip
#: What makes each algorithm keep as much as it can from round to round.
OWN = {
    "fedkl": {"average_every": 2},
    "fedsvrpgm": {"reference_every": 2},
    "fedrl": {"learning_starts": 20, "buffer_size": 90, "train_freq": 8},  # the ring is full in the third round
    "fedguide": {"adapt": "advantage", "calibrate": True, "beta": "auto", "prior_states": 32},
    "fedguide-p": {"prior_loss": "sample", "cost": "param"},
    "fedguide-a": {"average_every": 2, "n_experts": 2, "server_momentum": 0.5},
    "fedguide-r": {"normalize": "shared", "screening": 0.5, "mix": 0.7},
}  # fmt: skip


def make(algo: str, env: str, **more):
    epochs = {} if algo == "fedrl" else {"n_epochs": 2}
    return algorithm(algo)("MlpPolicy", env, **copy.deepcopy({**COMMON, **epochs, **OWN.get(algo, {}), **more}))


class Log(RoundCallback):
    """What each round leaves in the log, without seconds."""

    def __init__(self):
        super().__init__()
        self.rounds = {}

    def _on_round_end(self) -> None:
        values = {name: value for name, value in self.logger.name_to_value.items() if not name.startswith("time/")}
        self.rounds[self.model.round] = {**values, "return": self.model.mean_episode_return()}


def train(model, rounds: int, csv_path: Path, folder: Path | None = None) -> tuple[Log, RunEvalCallback]:
    """Train until ``rounds`` rounds are done, as the command line does."""
    log, evaluation = Log(), RunEvalCallback(ROUNDS, 2, 1, csv_path)
    callbacks = [evaluation, CostCallback(), DeployedCallback(), log]
    if folder is not None:
        callbacks.append(CheckpointCallback(folder, STOP))
    total = rounds * model.rollout_size * model.n_participants
    model.learn(total - model.num_timesteps, callbacks, reset_num_timesteps=model.round == 0)
    return log, evaluation


#: Constructor arguments of a DDPG federation small enough for a test.
SMALL = {
    "rollout_size": 64,
    "batch_size": 16,
    "learning_starts": 32,
    "seed": 3,
    "tau": 0.01,
    "learning_rate": 1e-3,
    "policy_kwargs": {"net_arch": [16, 16]},
}


def minibatch(model, size=16):
    """One minibatch of the model's last rollout."""
    return next(model.rollout_buffer.get(size, enumerate(np.random.default_rng(k) for k in range(model.n_clients))))


def perturb(model, scale, seed=0):
    generator = th.Generator().manual_seed(seed)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(scale * th.randn(parameter.shape, generator=generator))
