"""Federated pretraining of the diffusion trunk: FedAvg on the trunk, heads local, then the trunk is frozen."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch as th
from torch import nn

from sb3_fedguide.common.stacked import StackedLinear, stack_module
from sb3_fedguide.priors.diffusion import DiffusionPrior, level_quantile, level_weight

Upload = dict[str, np.ndarray]


def observation_moments(observations: np.ndarray) -> Upload:
    """What a client tells of its observations: their number, means and variances (population), per coordinate."""
    observations = np.asarray(observations, dtype=np.float64)
    return {"count": np.array(float(len(observations))), "mean": observations.mean(axis=0), "var": observations.var(axis=0)}


def merge_moments(uploads: Sequence[Mapping[str, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the union of the clients' data (Chan et al. 1979), from their moments alone."""
    count, mean, squares = 0.0, 0.0, 0.0
    for upload in uploads:
        n, client_mean, client_var = float(upload["count"]), upload["mean"], upload["var"]
        delta = client_mean - mean
        total = count + n
        squares = squares + client_var * n + delta**2 * count * n / total
        mean = mean + delta * n / total
        count = total
    return np.asarray(mean), np.sqrt(squares / count)


class TrunkTraining:
    def __init__(self, prior, observations, actions, rngs, n_updates, batch_size=256, learning_rate=1e-3):
        self.prior = prior
        self.rngs = list(rngs)
        self.n = len(observations)
        self.trunk = stack_trunk(prior, self.n)
        p, d = prior.n_features, prior.action_dim
        self.head = StackedLinear(th.zeros(self.n, d, p), th.zeros(self.n, d))
        self.obs = [prior.standardise(th.as_tensor(o, dtype=th.float32)).numpy() for o in observations]
        self.actions = [np.asarray(a, dtype=np.float32) for a in actions]
        self.batch_size = batch_size
        self.params = [*self.trunk.parameters(), *self.head.parameters()]
        self.optimizer = th.optim.Adam(self.params, lr=learning_rate, foreach=True)
        self.lr, self.n_updates, self.done = learning_rate, n_updates, 0

    def batch(self):
        obs, noisy, target, theta = [], [], [], []
        for o, a, rng in zip(self.obs, self.actions, self.rngs, strict=True):
            b = self.batch_size
            rows = rng.integers(len(o), size=b)
            q = (np.arange(b) + rng.random(b)) / b
            th_ = level_quantile(q)
            eps = rng.standard_normal((b, a.shape[1]), dtype=np.float32)
            al, si = np.cos(th_)[:, None].astype(np.float32), np.sin(th_)[:, None].astype(np.float32)
            x = a[rows]
            obs.append(o[rows]); noisy.append(al * x + si * eps); target.append(al * eps - si * x); theta.append(th_)
        theta = np.stack(theta)
        f = lambda v: th.from_numpy(np.stack(v))
        return f(obs), f(noisy), f(target), th.from_numpy(theta.astype(np.float32)), th.from_numpy(level_weight(theta).astype(np.float32))

    def run(self, n):
        for _ in range(n):
            for g in self.optimizer.param_groups:
                g["lr"] = self.lr * 0.5 * (1 + math.cos(math.pi * self.done / self.n_updates))
            obs, noisy, target, theta, w = self.batch()
            v = self.head(self.trunk(obs, noisy, theta))
            loss = ((v - target).square().sum(-1) * w).mean(1).sum()
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
            self.done += 1
        return float(loss) / self.n

    def average(self):
        with th.no_grad():
            for p in self.trunk.parameters():
                p.copy_(p.double().mean(0, keepdim=True).expand_as(p))


def stack_trunk(prior, n):
    trunk = copy.deepcopy(prior.trunk)
    trunk.input = stack_module(trunk.input, n)
    trunk.blocks = nn.ModuleList(stack_module(b, n) for b in trunk.blocks)
    return trunk
