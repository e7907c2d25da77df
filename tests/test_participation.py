"""Partial participation: the absent keep everything, the present learn as if they were alone, newcomers catch up."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th

from fed_envs import FederatedVecEnv
from sb3_fedguide import FedAvg, FedGuide, Local
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.participation import ParticipationAdam, draw_participants, n_participants

SMALL = {"rollout_size": 40, "batch_size": 20, "n_epochs": 2, "n_envs_per_client": 2, "seed": 3, "normalize": True}
TINY_OFFLINE = {"dataset_size": 200, "bc_updates": 5, "prior_updates": 5, "dice_updates": 5}


def steps(model, rounds: int) -> int:
    return rounds * model.rollout_size * model.n_participants


class Watch(RoundCallback):
    """The state of every client at each round's start and end, and who was present."""

    def __init__(self) -> None:
        super().__init__()
        self.present, self.before, self.trained, self.after = [], [], [], []

    def _on_round_start(self):
        self.present.append(self.model.present.copy())
        self.before.append(state_of(self.model))

    def _on_local_training_end(self):
        self.trained.append(state_of(self.model))

    def _on_round_end(self):
        self.after.append(state_of(self.model))


def state_of(model) -> list[list[np.ndarray]]:
    """For each client: parameters, optimiser, normaliser, streams, environment, and the mixture row where there is one."""
    states = []
    for index in range(model.n_clients):
        arrays = [parameter[index].detach().numpy().copy() for parameter in model.policy.parameters()]
        for entry in model.policy.optimizer.state.values():
            arrays += [entry[name][index].numpy().copy() for name in ("step", "exp_avg", "exp_avg_sq")]
        arrays += [tensor[index].numpy().copy() for tensor in model.normalizer.state_dict().values()]
        for role in sorted(model._streams):
            arrays.append(np.frombuffer(repr(model._streams[role][index].bit_generator.state).encode(), dtype=np.uint8))
        rows = slice(index * model.n_envs_per_client, (index + 1) * model.n_envs_per_client)
        arrays += [np.array(model._last_obs[rows]), np.array(model._last_episode_starts[rows])]
        if getattr(model, "experts", None) is not None:
            arrays += [model.mixture_rows[index].copy(), model.heads[index].copy()]
        states.append(arrays)
    return states


def equal(first, second) -> bool:
    return len(first) == len(second) and all(np.array_equal(a, b, equal_nan=True) for a, b in zip(first, second, strict=True))


def test_the_optimiser_equals_adam_where_all_are_present():
    rng = th.Generator().manual_seed(0)
    mine, theirs = (th.nn.Parameter(th.zeros(3, 4, 2)) for _ in range(2))
    optimizers = ParticipationAdam([mine], lr=0.1, eps=1e-5), th.optim.Adam([theirs], lr=0.1, eps=1e-5)
    for _ in range(20):
        grad = th.randn(3, 4, 2, generator=rng)
        for parameter, optimizer in zip((mine, theirs), optimizers, strict=True):
            parameter.grad = grad.clone()
            optimizer.step()
    th.testing.assert_close(mine, theirs, rtol=1e-6, atol=1e-7)


def test_the_optimiser_counts_each_clients_own_steps():
    rng = th.Generator().manual_seed(0)
    both, alone = th.nn.Parameter(th.zeros(2, 3)), th.nn.Parameter(th.zeros(1, 3))
    optimizer, reference = ParticipationAdam([both], lr=0.1), th.optim.Adam([alone], lr=0.1)
    for step in range(10):
        both.grad = th.randn(2, 3, generator=rng)
        optimizer.present = np.array([True, step % 3 == 0])
        optimizer.step()
        if step % 3 == 0:
            alone.grad = both.grad[1:].clone()
            reference.step()
    th.testing.assert_close(both[1:], alone, rtol=1e-6, atol=1e-7)


def test_the_draw_is_the_servers_own_and_fair():
    assert [n_participants(fraction, 8) for fraction in (0.01, 0.25, 0.5, 1.0)] == [1, 2, 4, 8]
    draws = np.array([draw_participants(0, round, 8, 3) for round in range(2000)])
    assert (draws.sum(axis=1) == 3).all()
    np.testing.assert_allclose(draws.mean(axis=0), 3 / 8, atol=0.05)
    np.testing.assert_array_equal(draws[7], draw_participants(0, 7, 8, 3))
    assert not np.array_equal(draws, [draw_participants(1, round, 8, 3) for round in range(2000)])


@pytest.mark.parametrize("algorithm", [Local, FedAvg])
def test_absent_clients_keep_all_of_their_state(algorithm, point_envs):
    model = algorithm("MlpPolicy", point_envs(4), client_fraction=0.5, **SMALL)
    watch = Watch()
    model.learn(steps(model, 6), watch)
    assert len(watch.present) == 6 and model.num_timesteps == 6 * 2 * 40
    for round in range(6):
        for client in range(4):
            kept = equal(watch.before[round][client], watch.after[round][client])
            # the first round creates the optimiser's state
            assert kept != watch.present[round][client] or round == 0
            if round == 0 and not watch.present[0][client]:
                n_parameters = len(list(model.policy.parameters()))
                assert equal(watch.before[0][client][:n_parameters], watch.after[0][client][:n_parameters])


def test_a_present_client_learns_as_if_it_were_alone(point_envs):
    together = Local("MlpPolicy", point_envs(3), client_fraction=0.5, **SMALL)
    watch = Watch()
    together.learn(steps(together, 5), watch)
    for client in range(3):
        rounds = int(np.sum([present[client] for present in watch.present]))
        alone = Local("MlpPolicy", point_envs(3), clients=[client], **SMALL)
        if rounds:
            alone.learn(rounds * alone.rollout_size)
        for name, tensor in together.policy.client_state_dict(client).items():
            th.testing.assert_close(tensor, alone.policy.client_state_dict(0)[name], rtol=1e-4, atol=1e-5)


def test_who_missed_an_average_receives_it_before_training_again(point_envs):
    model = FedAvg("MlpPolicy", point_envs(4), client_fraction=0.5, **SMALL)
    watch = Watch()
    model.learn(steps(model, 6), watch)
    n_parameters = len(list(model.policy.parameters()))
    late = 0
    for round in range(1, 6):
        shared = watch.after[round - 1][int(np.flatnonzero(watch.present[round - 1])[0])][:n_parameters]
        for client in np.flatnonzero(watch.present[round]):
            late += not watch.present[round - 1][client]
            assert equal(watch.before[round][client][:n_parameters], shared)
    assert late > 0


def test_who_was_away_between_two_averages_keeps_what_it_learned_since_the_last(point_envs):
    """Averages follow every fifth round; only who missed one of these has something to catch up with."""
    model, watch = FedAvg("MlpPolicy", point_envs(4), average_every=5, client_fraction=0.5, **SMALL), Watch()
    model.learn(steps(model, 16), watch)
    n_parameters, kept = len(list(model.policy.parameters())), 0
    for client in range(4):
        missed, learned = False, False  # an average, and something of its own since the last one
        for round in range(16):
            if watch.present[round][client]:
                unchanged = equal(watch.before[round][client][:n_parameters], watch.after[round - 1][client][:n_parameters])
                assert round == 0 or missed or unchanged
                kept += round > 5 and not watch.present[round - 1][client] and learned and not missed
                missed, learned = False, (round + 1) % 5 != 0
            else:
                missed |= (round + 1) % 5 == 0
    assert kept


def test_fedguide_keeps_the_rows_of_absent_clients_and_goes_on(tmp_path):
    model = FedGuide(
        "MlpPolicy", "Bandit2D", client_fraction=0.5, adapt="advantage", pretraining=TINY_OFFLINE, cache_dir=tmp_path,
        calibrate=True, beta="auto", prior_states=20, **SMALL,
    )  # fmt: skip
    watch = Watch()
    model.learn(steps(model, 6), watch)
    for round in range(1, 6):
        for client in range(4):
            assert equal(watch.before[round][client], watch.after[round][client]) != watch.present[round][client]
    assert np.isfinite(model.mixture_rows).all()
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())


def test_save_and_load_go_on_with_who_is_outdated(point_envs, tmp_path):
    model = FedAvg("MlpPolicy", point_envs(4), client_fraction=0.5, **SMALL)
    model.learn(steps(model, 3))
    model.save(tmp_path / "model")
    loaded = FedAvg.load(tmp_path / "model", env=FederatedVecEnv(point_envs(4), n_envs_per_client=2))
    assert loaded.n_participants == 2
    np.testing.assert_array_equal(loaded.outdated, model.outdated)
    loaded.learn(steps(loaded, 2), reset_num_timesteps=False)
    assert loaded.round == 5


@pytest.mark.parametrize("fraction", [0.0, -0.5, 1.5])
def test_an_impossible_fraction_is_refused(fraction, point_envs):
    with pytest.raises(ValueError, match="client_fraction"):
        Local("MlpPolicy", point_envs(2), client_fraction=fraction, **SMALL)
