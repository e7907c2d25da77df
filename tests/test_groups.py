"""Groups of clients that train at the same time: the same bits as all in one, and one voice to the outside."""

from __future__ import annotations

import threading
from types import ModuleType

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_fedguide.offline import behavior_cloning, dice, groups, trunk
from sb3_fedguide.offline.data import OfflineData
from sb3_fedguide.offline.groups import client_groups, train_together
from sb3_fedguide.priors import DiffusionPrior
from sb3_fedguide.state.stacked import stack_module

N_CLIENTS = 9


def dataset(client: int) -> OfflineData:
    rng = np.random.default_rng(client)
    n = 60 + 10 * client
    obs = rng.standard_normal((n + 1, 3)).astype(np.float32)
    return OfflineData(obs[:-1], rng.uniform(-1, 1, (n, 2)), rng.standard_normal(n), obs[1:], rng.random(n) < 0.05)


DATASETS = [dataset(client) for client in range(N_CLIENTS)]


def rngs() -> list[np.random.Generator]:
    return [np.random.default_rng(client) for client in range(N_CLIENTS)]


@pytest.fixture
def on_cores(monkeypatch: pytest.MonkeyPatch):
    """Pretend that the machine has so many cores; ``on_cores.jobs`` are the numbers of groups that then trained."""
    jobs_run: list[int] = []

    def use(module: ModuleType, n_cores: int) -> None:
        def counting(jobs, progress=None):
            jobs_run.append(len(jobs))
            return train_together(jobs, progress)

        monkeypatch.setattr(module, "client_groups", lambda n_clients: client_groups(n_clients, n_cores))
        monkeypatch.setattr(module, "train_together", counting)

    use.jobs = jobs_run  # type: ignore[attr-defined]
    return use


@pytest.mark.parametrize("n_clients", [1, 3, 7, 8, 9, 40])
@pytest.mark.parametrize("n_cores", [1, 2, 5])
def test_groups_are_all_clients_in_order(n_clients: int, n_cores: int) -> None:
    found = client_groups(n_clients, n_cores)
    assert [client for group in found for client in group] == list(range(n_clients))
    assert len(found) == max(1, min(n_cores, n_clients // 4))
    assert max(map(len, found)) - min(map(len, found)) <= 1


def test_cores_that_torch_uses_itself_are_not_used_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(groups.th, "get_num_threads", lambda: 4)
    assert [len(client_groups(64, n_cores)) for n_cores in (1, 4, 7, 8, 16)] == [1, 1, 1, 2, 4]


def test_dice_does_not_depend_on_the_groups(on_cores) -> None:
    states, reports = [], []
    for n_cores in (1, 2):
        on_cores(dice, n_cores)
        told: list[tuple[int, int]] = []
        value = dice.train_dice(
            DATASETS, rngs(), n_updates=251, batch_size=8, width=16, progress=lambda *steps, told=told: told.append(steps)
        )
        states.append(value.state_dict())
        reports.append(told)
        assert not any(parameter.requires_grad for parameter in value.parameters())
    assert on_cores.jobs == [1, 2]
    for name, tensor in states[0].items():
        assert th.equal(tensor, states[1][name]), name
    assert reports[0] == reports[1] == [(250, 251), (251, 251)]


def test_behavior_cloning_does_not_depend_on_the_groups(on_cores) -> None:
    initial = nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, 2))
    actors, errors = [], []
    for n_cores in (1, 2):
        on_cores(behavior_cloning, n_cores)
        actors.append(stack_module(initial, N_CLIENTS))
        observations, actions = [data.observations for data in DATASETS], [data.actions for data in DATASETS]
        errors.append(behavior_cloning.clone(actors[-1], observations, actions, rngs(), n_updates=40, batch_size=16))
    assert on_cores.jobs == [1, 2]
    np.testing.assert_array_equal(errors[0], errors[1])
    for one, two in zip(actors[0].parameters(), actors[1].parameters(), strict=True):
        assert th.equal(one, two)
        assert not th.equal(one[0], one[-1])  # trained in place, each on its own data


def test_trunk_does_not_depend_on_the_groups(on_cores) -> None:
    results = []
    for n_cores in (1, 2):
        on_cores(trunk, n_cores)
        prior = DiffusionPrior(3, 2, width=16, encoder_width=16)
        results.append(trunk.federated_trunk(prior, DATASETS, rngs(), n_updates=25, average_every=10, batch_size=16))
    assert on_cores.jobs == [1, 1, 1, 2, 2, 2]
    np.testing.assert_array_equal(results[0].losses, results[1].losses)
    for name, tensor in results[0].prior.state_dict().items():
        assert th.equal(tensor, results[1].prior.state_dict()[name]), name
    assert results[0].upload_bytes == results[1].upload_bytes


def test_progress_is_that_of_the_slowest() -> None:
    turns = [threading.Event() for _ in range(4)]

    def fast(report):
        report(1, 3)
        report(2, 3)
        turns[0].set()
        turns[1].wait(10)
        report(3, 3)
        turns[2].set()
        return "fast"

    def slow(report):
        turns[0].wait(10)
        report(1, 3)
        turns[1].set()
        turns[2].wait(10)
        report(3, 3)
        return "slow"

    told: list[tuple[int, int]] = []
    assert train_together([fast, slow], lambda *steps: told.append(steps)) == ["fast", "slow"]
    assert told == [(1, 3), (3, 3)]


@pytest.mark.parametrize("position", [0, 1])
def test_an_error_ends_the_other_groups_at_their_next_report(position: int) -> None:
    failed = threading.Event()

    def failing(report):
        failed.set()
        raise ValueError("broken data")

    def endless(report):
        failed.wait(10)
        while True:
            report(0, 1)

    with pytest.raises(ValueError, match="broken data"):
        train_together([failing, endless] if position == 0 else [endless, failing])
    assert not any(thread.name.startswith("offline") for thread in threading.enumerate())
