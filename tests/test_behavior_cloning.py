"""Behaviour cloning: the least-squares solution is found, and no client sees another."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_fedguide.offline.behavior_cloning import clone
from sb3_fedguide.offline.data import normalize_observations
from sb3_fedguide.state.stacked import stack_module


def rngs(which: list[int]) -> list[np.random.Generator]:
    return [np.random.default_rng(k) for k in which]


def test_recovers_each_clients_linear_policy() -> None:
    rng = np.random.default_rng(0)
    matrices = [rng.uniform(-0.5, 0.5, (2, 4)) for _ in range(3)]
    offsets = [rng.uniform(-0.3, 0.3, 2) for _ in range(3)]
    observations = [rng.standard_normal((400, 4)).astype(np.float32) for _ in range(3)]
    actions = [obs @ matrix.T + offset for obs, matrix, offset in zip(observations, matrices, offsets, strict=True)]
    actor = stack_module(nn.Linear(4, 2), 3)
    reports: list[tuple[int, int]] = []
    errors = clone(
        actor,
        observations,
        actions,
        rngs([0, 1, 2]),
        n_updates=600,
        batch_size=64,
        learning_rate=1e-2,
        progress=lambda done, total: reports.append((done, total)),
    )
    np.testing.assert_allclose(actor.weight.detach().numpy(), np.stack(matrices), atol=1e-3)  # type: ignore[union-attr, operator]
    np.testing.assert_allclose(actor.bias.detach().numpy(), np.stack(offsets), atol=1e-3)  # type: ignore[union-attr, operator]
    assert errors.shape == (3,)
    assert (errors < 1e-2).all()
    assert reports == [(250, 600), (500, 600), (600, 600)]


def test_a_client_learns_the_same_bits_with_and_without_neighbours() -> None:
    rng = np.random.default_rng(0)
    sizes = [200, 300, 150]
    observations = [rng.standard_normal((n, 5)).astype(np.float32) for n in sizes]
    actions = [rng.uniform(-1, 1, (n, 1)).astype(np.float32) for n in sizes]  # one column: the delicate case
    initial = nn.Sequential(nn.Linear(5, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1))

    def train(which: list[int]) -> dict[str, th.Tensor]:
        actor = stack_module(copy.deepcopy(initial), len(which))
        clone(actor, [observations[k] for k in which], [actions[k] for k in which], rngs(which), 50, batch_size=37)
        return actor.state_dict()

    together = train([0, 1, 2])
    for k in range(3):
        for name, tensor in train([k]).items():
            assert th.equal(tensor[0], together[name][k]), (k, name)


def test_normalisation_is_that_of_vec_normalize() -> None:
    from stable_baselines3.common.running_mean_std import RunningMeanStd
    from stable_baselines3.common.vec_env import VecNormalize

    rng = np.random.default_rng(0)
    obs = (3.0 + 0.01 * rng.standard_normal((50, 4))).astype(np.float32)
    obs[0, 0] = 100.0  # beyond the clip
    mean, var = obs.astype(np.float64).mean(axis=0), obs.astype(np.float64).var(axis=0) * np.array([1e-6, 1, 1, 0])
    normalizer = VecNormalize.__new__(VecNormalize)
    normalizer.clip_obs, normalizer.epsilon = 10.0, 1e-8
    moments = RunningMeanStd(shape=(4,))
    moments.mean, moments.var = mean, var
    np.testing.assert_allclose(
        normalize_observations(obs, mean, var), normalizer._normalize_obs(obs, moments), rtol=1e-6, atol=1e-6
    )


def test_refuses_lists_that_do_not_fit() -> None:
    actor = stack_module(nn.Linear(2, 1), 2)
    rows = [np.zeros((3, 2))] * 2
    with pytest.raises(ValueError, match="as many actions as observations"):
        clone(actor, rows, [np.zeros((3, 1)), np.zeros((2, 1))], rngs([0, 1]))
    with pytest.raises(ValueError, match="per client"):
        clone(actor, rows, [np.zeros((3, 1))] * 2, rngs([0]))
    with pytest.raises(ValueError, match="at least 1"):
        clone(actor, rows, [np.zeros((3, 1))] * 2, rngs([0, 1]), n_updates=0)
