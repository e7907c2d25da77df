"""Federated pretraining of the trunk."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch as th

from sb3_fedguide.offline.trunk import (
    TrunkTraining,
    federated_trunk,
    merge_moments,
    observation_moments,
    upload_size,
)
from sb3_fedguide.priors import DiffusionPrior
from sb3_fedguide.server.averaging import weighted_average

RNG = np.random.default_rng


def dataset(client, n=400, action_dim=2):
    rng = RNG(client)
    obs = rng.normal(client, 1 + client, (n, 3)).astype(np.float32)
    actions = np.tanh(obs[:, :action_dim] + 0.2 * rng.standard_normal((n, action_dim))).astype(np.float32)
    return SimpleNamespace(observations=obs, actions=actions)


def small_prior(action_dim=2):
    return DiffusionPrior(3, action_dim, width=16, encoder_width=16)


def rngs(*clients):
    return [RNG([7, client]) for client in clients]


def test_merged_moments_are_those_of_the_union():
    parts = [RNG(k).normal(5 * k, 1 + k, (50 + 100 * k, 3)) for k in range(4)]
    mean, std = merge_moments([observation_moments(part) for part in parts])
    np.testing.assert_allclose(mean, np.concatenate(parts).mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(std, np.concatenate(parts).std(axis=0), rtol=1e-12)
    with pytest.raises(ValueError, match="at least one"):
        merge_moments([])


def test_uploads_are_averaged_by_samples():
    uploads = [{"w": np.float32([1.0, 2.0])}, {"w": np.float32([5.0, 4.0])}]
    average = weighted_average(uploads, [300, 100], ["w"])
    np.testing.assert_allclose(average["w"], [2.0, 2.5])
    assert average["w"].dtype == np.float32


@pytest.mark.parametrize("action_dim", [1, 2])
def test_lockstep_is_separate_sites_that_exchange_uploads(action_dim):
    """Three clients in one process and three sites with one client each end with the same trunk, bit for bit."""
    data = [dataset(k, 200 + 100 * k, action_dim) for k in range(3)]
    together = federated_trunk(
        small_prior(action_dim), data, rngs(0, 1, 2), n_updates=12, average_every=5, batch_size=32
    ).prior

    prior = small_prior(action_dim)
    prior.set_observation_moments(*merge_moments([observation_moments(part.observations) for part in data]))
    sites = [TrunkTraining(prior, [data[k]], rngs(k), 12, batch_size=32) for k in range(3)]
    while sites[0].n_done < 12:
        for site in sites:
            site.run(5)
        sent = [site.uploads()[0] for site in sites]
        average = weighted_average(sent, [len(part.actions) for part in data], sent[0])
        for site in sites:
            site.receive(average)
    for name, value in together.trunk.state_dict().items():
        np.testing.assert_array_equal(value.numpy(), average[name], err_msg=name)


def test_a_client_that_exchanges_nothing_does_not_see_the_others():
    prior = small_prior()
    group = TrunkTraining(prior, [dataset(0), dataset(1), dataset(2)], rngs(0, 1, 2), 10, batch_size=32)
    alone = TrunkTraining(prior, [dataset(1)], rngs(1), 10, batch_size=32)
    assert group.run(10)[1] == alone.run(10)[0]
    for name, value in group.uploads()[1].items():
        np.testing.assert_array_equal(value, alone.uploads()[0][name])
        assert not np.array_equal(value, group.uploads()[0][name])


def test_heads_stay_local_and_trunks_become_one():
    training = TrunkTraining(small_prior(), [dataset(0), dataset(1)], rngs(0, 1), 10, batch_size=32)
    training.run(10)
    heads = training.head.weight.detach().clone()
    training.receive(weighted_average(sent := training.uploads(), [1, 1], sent[0]))
    first, second = training.uploads()
    assert all(np.array_equal(first[name], second[name]) for name in first)
    assert th.equal(training.head.weight, heads) and not th.equal(heads[0], heads[1])


def test_result_of_pretraining():
    data = [dataset(0), dataset(1)]
    prior = small_prior()
    before = {name: value.clone() for name, value in prior.state_dict().items()}
    calls = []
    result = federated_trunk(
        prior, data, rngs(0, 1), 400, average_every=90, batch_size=64, progress=lambda done, total: calls.append((done, total))
    )
    assert calls == [(90, 400), (180, 400), (270, 400), (360, 400), (400, 400)]
    assert result.losses.shape == (5, 2)
    assert (result.losses[-1] < 0.7 * result.losses[0]).all()
    assert all(th.equal(value, before[name]) for name, value in prior.state_dict().items())
    assert not any(parameter.requires_grad for parameter in result.prior.parameters())
    union = np.concatenate([part.observations for part in data])
    np.testing.assert_allclose(result.prior.obs_mean, union.mean(axis=0), rtol=1e-4)
    np.testing.assert_allclose(result.prior.obs_std, union.std(axis=0), rtol=1e-4)
    n_parameters = sum(parameter.numel() for parameter in prior.trunk.parameters())
    assert result.upload_bytes == 4 * (1 + 3 + 3) + 5 * 4 * n_parameters
    assert result.download_bytes == 4 * (3 + 3) + 5 * 4 * n_parameters
    assert upload_size({"w": np.zeros((3, 5))}) == 60


def test_pretraining_is_deterministic_and_leaves_global_randomness_alone():
    state = th.get_rng_state()
    runs = [federated_trunk(small_prior(), [dataset(0), dataset(1)], rngs(0, 1), 20, batch_size=16).prior for _ in range(2)]
    assert th.equal(th.get_rng_state(), state)
    for name, value in runs[0].state_dict().items():
        assert th.equal(value, runs[1].state_dict()[name])


def test_a_pretrained_trunk_beats_a_random_one():
    data = [dataset(0, 2000), dataset(1, 2000)]
    random = small_prior()
    random.set_observation_moments(*merge_moments([observation_moments(part.observations) for part in data]))
    pretrained = federated_trunk(random, data, rngs(0, 1), 500, batch_size=64).prior
    held_out = dataset(1, 2500)
    obs, actions = (th.tensor(array[2000:]) for array in (held_out.observations, held_out.actions))
    means = [
        float(prior.log_prob(prior.fit_head(data[1].observations, data[1].actions, RNG(0)), obs, actions).mean())
        for prior in (random, pretrained)
    ]
    assert means[1] > means[0] + 0.5


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match="generator per dataset"):
        TrunkTraining(small_prior(), [dataset(0)], rngs(0, 1), 10)
    with pytest.raises(ValueError, match="n_updates"):
        TrunkTraining(small_prior(), [dataset(0)], rngs(0), 0)
    with pytest.raises(ValueError, match="average_every"):
        federated_trunk(small_prior(), [dataset(0)], rngs(0), 10, average_every=0)
    with pytest.raises(ValueError, match="observations"):
        federated_trunk(DiffusionPrior(4, 2, width=8), [dataset(0)], rngs(0), 10)
