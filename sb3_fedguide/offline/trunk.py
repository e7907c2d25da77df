"""Federated pretraining of the diffusion trunk: FedAvg on the trunk with local heads, after which the trunk is frozen.

Nothing but observation moments (once) and trunk parameters (every ``average_every`` updates) leaves a client.
:func:`federated_trunk` runs all clients in one process; a deployment runs the same :class:`TrunkTraining` on each site with
its clients, exchanges the payloads of ``uploads()`` and ``receive()``, and gets the same trunk.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch as th
from torch import nn

from fed_envs.plain_data import State, freeze, thaw
from sb3_fedguide.offline.groups import client_groups, train_together
from sb3_fedguide.offline.progress import StepProgress
from sb3_fedguide.priors.density import training_angle
from sb3_fedguide.priors.diffusion import DiffusionPrior
from sb3_fedguide.priors.trunk_network import DiffusionTrunk
from sb3_fedguide.server.averaging import weighted_average
from sb3_fedguide.server.trunk import merge_moments
from sb3_fedguide.settings.pretraining import DEFAULTS
from sb3_fedguide.state.optimizer_state import load_optimizer, optimizer_state
from sb3_fedguide.state.stacked import StackedLinear, client_state, stack_module, to_arrays, to_tensors

__all__ = [
    "TrunkResult",
    "TrunkTraining",
    "federated_trunk",
    "merge_moments",
    "observation_moments",
    "upload_size",
]

Upload = dict[str, np.ndarray]


class ActionData(Protocol):
    """The part of a client's dataset that the trunk needs: ``observations (n, obs_dim)`` and ``actions (n, action_dim)``."""

    @property
    def observations(self) -> np.ndarray: ...

    @property
    def actions(self) -> np.ndarray: ...


@dataclass(frozen=True)
class TrunkResult:
    """A pretrained trunk, with losses and bytes.

    :param prior: with the averaged, frozen trunk and the merged observation moments
    :param losses: mean velocity loss of each client between two averages, ``(n_averages, n_clients)``
    :param upload_bytes: bytes that each client sent (moments and trunks), as float32
    :param download_bytes: bytes that each client received
    """

    prior: DiffusionPrior
    losses: np.ndarray
    upload_bytes: int
    download_bytes: int


def observation_moments(observations: np.ndarray) -> Upload:
    """The moments of a client's observations: ``n_samples`` and, per coordinate, ``mean`` and ``var`` (population)."""
    observations = np.asarray(observations, dtype=np.float64)
    return {
        "n_samples": np.array(len(observations), dtype=np.float64),
        "mean": observations.mean(axis=0),
        "var": observations.var(axis=0),
    }


def upload_size(upload: Mapping[str, np.ndarray]) -> int:
    """Bytes of an upload, sent as float32."""
    return sum(4 * int(np.size(value)) for value in upload.values())


class TrunkTraining:
    """The clients of one process in lockstep: stacked trunks and heads, each with its own data, stream and Adam moments.

    :param prior: the network to start from, with the federation's observation moments; not changed
    :param datasets: one per client
    :param rngs: one generator per client, the only source of randomness in its updates
    :param n_updates: length of the cosine schedule
    :param batch_size: rows per client and update
    :param learning_rate: of Adam at the start; it falls to zero
    :raises ValueError: for data of the wrong shape or a number of generators other than that of datasets
    """

    def __init__(
        self,
        prior: DiffusionPrior,
        datasets: Sequence[ActionData],
        rngs: Sequence[np.random.Generator],
        n_updates: int,
        batch_size: int = DEFAULTS.prior_batch_size,
        learning_rate: float = DEFAULTS.prior_learning_rate,
    ) -> None:
        if len(datasets) == 0 or len(rngs) != len(datasets):
            raise ValueError(f"Trunk training needs one random generator per dataset, got {len(rngs)} for {len(datasets)}.")
        if n_updates < 1 or batch_size < 1:
            raise ValueError(f"n_updates and batch_size must be at least 1, got {n_updates} and {batch_size}.")
        self.n_clients = len(datasets)
        self.rngs = list(rngs)
        self.observations, self.actions = [], []
        for dataset in datasets:
            observations, actions, _ = prior.check_data(dataset.observations, dataset.actions, None)
            self.observations.append(prior.standardise(th.from_numpy(observations)).numpy())
            self.actions.append(actions)
        self.n_samples = [len(actions) for actions in self.actions]
        self.trunk = _stack_trunk(prior.trunk, self.n_clients)
        # Heads start at zero, the standard normal prior.
        self.head = StackedLinear(
            th.zeros(self.n_clients, prior.action_dim, prior.n_features), th.zeros(self.n_clients, prior.action_dim)
        )
        self.batch_size, self.n_updates, self.n_done = batch_size, n_updates, 0
        self.learning_rate = learning_rate
        self.optimizer = th.optim.Adam([*self.trunk.parameters(), *self.head.parameters()], lr=learning_rate, foreach=True)

    def run(self, n_updates: int) -> np.ndarray:
        """Train every client for ``n_updates`` updates (no further than the schedule); mean losses ``(n_clients,)``."""
        n_updates = min(n_updates, self.n_updates - self.n_done)
        total = th.zeros(self.n_clients)
        for _ in range(n_updates):
            for group in self.optimizer.param_groups:
                group["lr"] = 0.5 * self.learning_rate * (1.0 + math.cos(math.pi * self.n_done / self.n_updates))
            obs, noisy, theta, velocity = self._batch()
            predicted = self.head(self.trunk(self.trunk.encoder(obs), noisy, theta))
            losses = (predicted - velocity).square().sum(dim=-1).mean(dim=-1)
            self.optimizer.zero_grad()
            losses.sum().backward()  # every client has its own parameters, so this is each one's own gradient
            self.optimizer.step()
            total += losses.detach()
            self.n_done += 1
        return (total / max(n_updates, 1)).numpy()

    def uploads(self) -> list[Upload]:
        """Each client's trunk, float32, keyed like the trunk's state dict."""
        state = self.trunk.state_dict()
        return [{name: value.numpy() for name, value in client_state(state, k).items()} for k in range(self.n_clients)]

    def receive(self, trunk: Mapping[str, np.ndarray]) -> None:
        """Continue every client from the averaged trunk; heads and optimiser moments stay."""
        with th.no_grad():
            for name, parameter in self.trunk.named_parameters():
                parameter.copy_(th.from_numpy(trunk[name]).expand_as(parameter))

    def save_state(self) -> State:
        """Everything that changes while it trains, as plain data for a checkpoint."""
        return {
            "n_done": self.n_done,
            "trunk": to_arrays(self.trunk.state_dict()),
            "head": to_arrays(self.head.state_dict()),
            "optimizer": optimizer_state(self.optimizer),
            "rngs": freeze(self.rngs),
        }

    def load_state(self, state: State) -> None:
        """Go on from what :meth:`save_state` returned, on a training with the same data and settings."""
        self.n_done = state["n_done"]
        self.trunk.load_state_dict(to_tensors(state["trunk"]))
        self.head.load_state_dict(to_tensors(state["head"]))
        load_optimizer(self.optimizer, state["optimizer"])
        self.rngs = thaw(state["rngs"])

    def _batch(self) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
        """Standardised observations, noisy actions, noise angles and velocities, ``(n_clients, batch, ...)``."""
        size = self.batch_size
        parts = []
        for observations, actions, rng in zip(self.observations, self.actions, self.rngs, strict=True):
            rows = rng.integers(len(actions), size=size)
            theta = training_angle((np.arange(size) + rng.random(size)) / size)  # stratified over the batch
            eps = rng.standard_normal((size, actions.shape[1]), dtype=np.float32)
            alpha, sigma = np.cos(theta, dtype=np.float32)[:, None], np.sin(theta, dtype=np.float32)[:, None]
            clean = actions[rows]
            parts.append(
                (observations[rows], alpha * clean + sigma * eps, theta.astype(np.float32), alpha * eps - sigma * clean)
            )
        obs, noisy, angles, velocity = (th.from_numpy(np.stack(part)) for part in zip(*parts, strict=True))
        return obs, noisy, angles, velocity


def federated_trunk(
    prior: DiffusionPrior,
    datasets: Sequence[ActionData],
    rngs: Sequence[np.random.Generator],
    n_updates: int = DEFAULTS.prior_updates,
    average_every: int = DEFAULTS.prior_average_every,
    batch_size: int = DEFAULTS.prior_batch_size,
    learning_rate: float = DEFAULTS.prior_learning_rate,
    progress: StepProgress | None = None,
) -> TrunkResult:
    """Pretrain the trunk of ``prior`` by FedAvg over the clients, all in this process.

    :param prior: architecture and initial weights; not changed
    :param datasets: one per client
    :param rngs: one generator per client
    :param n_updates: updates of each client
    :param average_every: updates between two averages
    :param batch_size: rows per client and update
    :param learning_rate: of Adam, falling to zero on a cosine
    :param progress: called with (updates done, updates in all) after every average
    :raises ValueError: see :class:`TrunkTraining`; also for ``average_every`` below 1
    """
    if average_every < 1:
        raise ValueError(f"average_every must be at least 1, got {average_every}.")
    prior = copy.deepcopy(prior)
    for dataset in datasets:
        prior.check_data(dataset.observations, dataset.actions, None)
    moments = [observation_moments(dataset.observations) for dataset in datasets]
    mean, std = merge_moments(moments)
    prior.set_observation_moments(mean, std)
    upload_bytes, download_bytes = upload_size(moments[0]), upload_size({"mean": mean, "std": std})
    trainings = [
        TrunkTraining(prior, [datasets[k] for k in group], [rngs[k] for k in group], n_updates, batch_size, learning_rate)
        for group in client_groups(len(datasets))
    ]
    n_samples = [n for training in trainings for n in training.n_samples]

    def job(training: TrunkTraining) -> Callable[[StepProgress | None], np.ndarray]:
        return lambda _: training.run(average_every)

    losses = []
    while trainings[0].n_done < n_updates:
        parts = train_together([job(training) for training in trainings])
        losses.append(np.concatenate(parts))
        uploads = [upload for training in trainings for upload in training.uploads()]
        trunk = weighted_average(uploads, n_samples, uploads[0])
        for training in trainings:
            training.receive(trunk)
        upload_bytes += upload_size(uploads[0])
        download_bytes += upload_size(trunk)
        if progress is not None:
            progress(trainings[0].n_done, n_updates)
    prior.trunk.load_state_dict({name: th.from_numpy(value) for name, value in trunk.items()})
    return TrunkResult(prior, np.stack(losses), upload_bytes, download_bytes)


def _stack_trunk(trunk: DiffusionTrunk, n_clients: int) -> DiffusionTrunk:
    """``n_clients`` trainable copies as one module, with the same parameter names and a leading client dimension."""
    stacked = copy.deepcopy(trunk)
    for name in ("encoder", "level", "action"):
        setattr(stacked, name, stack_module(getattr(trunk, name), n_clients))
    stacked.blocks = nn.ModuleList(stack_module(block, n_clients) for block in trunk.blocks)
    return stacked.requires_grad_(True)
