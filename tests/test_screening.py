"""Clients test what the server sends in their own environments, leave what hurts them, and come back for what is better."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from sb3_fedguide import FedAvg, FederatedEvalCallback, FedRL
from sb3_fedguide.common.checkpoint import CheckpointCallback
from sb3_fedguide.common.participation import simulate_delays
from sb3_fedguide.common.screening import LONGEST_WAIT, clearly_better
from sb3_fedguide.server.delays import parse_delays
from sb3_fedguide.server.payload import N_SAMPLES
from tests.conftest import assert_same_parameters, parameters_of

SCREENED = {
    "rollout_size": 128,
    "batch_size": 64,
    "n_epochs": 1,
    "seed": 3,
    "policy_kwargs": {"net_arch": [8]},
    "screening": 0.5,
}


def steady(model: FedAvg, action: float) -> dict[str, np.ndarray]:
    """Parameters of a policy that always takes the same action."""
    arrays = {name: np.zeros(p.shape[1:], dtype=np.float32) for name, p in model.policy.named_parameters()}
    return {**arrays, "action_net.bias": np.full(2, action, dtype=np.float32)}


@pytest.fixture
def trained(point_envs) -> FedAvg:
    """Three clients after two rounds, with a test due and steps left."""
    model = FedAvg("MlpPolicy", point_envs(3), **SCREENED)
    model.learn(2 * 3 * 128)
    model.screening_state["next_round"][:] = 2
    model.screening_state["steps"][:] = 0
    return model


def test_clearly_better_needs_a_margin_and_more_than_noise():
    returns = np.array([10.0, 12.0, 11.0])
    assert clearly_better(returns, returns - 2, 1.5) and not clearly_better(returns, returns - 2, 2.0)
    noisy = np.array([10.0, -10.0, 30.0])
    assert not clearly_better(noisy, np.array([5.0, 4.0, 3.0]), 0.5)  # 6 above, with a standard error of 11
    assert clearly_better(np.array([3.0]), np.array([1.0]), 1.0) and not clearly_better(returns, returns, 0.0)


def test_who_is_sent_something_bad_goes_on_alone(trained):
    own = parameters_of(trained, 0)
    trained.take_broadcasts({0: steady(trained, 30.0), 1: trained.strategy.latest(1)})  # away from everything
    assert trained.screening_state["alone"].tolist() == [True, False, False]
    assert_same_parameters(parameters_of(trained, 0), own)
    assert {name: float(array) for name, array in trained.upload(0).items()} == {N_SAMPLES: 0.0}
    average = trained.strategy.latest(1)
    assert all(np.array_equal(parameters_of(trained, 1)[name], array) for name, array in average.items())
    assert trained.upload(1)[N_SAMPLES] == 128


def test_who_is_alone_comes_back_for_what_is_better_and_takes_all_of_it(trained):
    good = trained.strategy.latest(0)
    trained.mix = 0.5
    trained.policy.load_client(0, steady(trained, 30.0))
    trained.screening_state["alone"][0] = True
    trained.take_broadcasts({0: good})
    assert not trained.screening_state["alone"][0]
    assert all(np.array_equal(parameters_of(trained, 0)[name], array) for name, array in good.items())


def test_who_is_alone_stays_so_while_nothing_better_comes(trained):
    own = parameters_of(trained, 0)
    trained.screening_state["alone"][0] = True
    trained.take_broadcasts({0: steady(trained, 30.0)})
    assert trained.screening_state["alone"][0]
    assert_same_parameters(parameters_of(trained, 0), own)


def test_tests_that_change_nothing_become_rare(trained):
    waits = []
    trained._total_timesteps = 10**9
    for _ in range(6):
        trained.round = int(trained.screening_state["next_round"][0])
        trained.take_broadcasts({0: trained.strategy.latest(0)})
        waits.append(int(trained.screening_state["wait"][0]))
    assert waits[-1] == waits[-2] == LONGEST_WAIT and waits == sorted(waits)
    steps = trained.test_steps
    trained.take_broadcasts({0: trained.strategy.latest(0)})  # none is due in this round
    assert trained.test_steps == steps


def test_tests_cost_no_more_than_their_share_and_are_counted(point_envs, tmp_path):
    evaluation = FederatedEvalCallback(30, 10, 1, tmp_path / "evaluations.csv")
    model = FedAvg("MlpPolicy", point_envs(3), **{**SCREENED, "screening": 0.1})
    model.learn(30 * 3 * 128, evaluation)
    assert model.num_timesteps == 30 * 3 * 128  # tests leave the rounds as many and as long as they were
    steps = model.screening_state["steps"]
    assert 0 < steps.min() and steps.max() <= 0.1 * 30 * 128
    assert model.test_steps == steps.sum() and model.environment_steps == model.num_timesteps + model.test_steps
    with (tmp_path / "evaluations.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    assert int(last["timesteps"]) == model.environment_steps


def test_tests_take_simulated_time(point_envs):
    def seconds(screening: float) -> float:
        model = FedAvg("MlpPolicy", point_envs(3), **{**SCREENED, "screening": screening})
        simulate_delays(model, parse_delays("sync:median=60,spread=0,jitter=0"))
        model.learn(3 * 3 * 128)
        assert (model.test_steps > 0) == (screening > 0)
        return model.delays.seconds

    assert seconds(0.0) == pytest.approx(180.0) and seconds(0.5) > 185


def test_tests_disturb_nothing(point_envs):
    plain, tested = (
        FedAvg("MlpPolicy", point_envs(3), **{**SCREENED, "screening": screening}).learn(3 * 3 * 128)
        for screening in (0.0, 0.5)
    )
    assert tested.test_steps > 0 and not tested.screening_state["alone"].any()
    for client in range(3):
        assert_same_parameters(parameters_of(plain, client), parameters_of(tested, client))


def test_a_client_that_leaves_moves_nobody(point_envs):
    model = FedAvg("MlpPolicy", point_envs(3), **SCREENED)
    model.learn(2 * 3 * 128)
    model.screening_state["alone"][0] = True
    model.learn(3 * 128, reset_num_timesteps=False)
    assert model.strategy.rejected == {}
    uploads = [model.upload(index) for index in (1, 2)]
    assert_same_parameters(parameters_of(model, 1), parameters_of(model, 2))  # they share, the first does not
    assert not np.array_equal(parameters_of(model, 0)["log_std"], uploads[0]["log_std"])


def test_off_policy_clients_test_too(point_envs):
    model = FedRL(
        "MlpPolicy",
        point_envs(2),
        rollout_size=128,
        learning_starts=64,
        seed=1,
        screening=0.5,
        policy_kwargs={"net_arch": [8]},
    )
    model.learn(4 * 2 * 128)
    assert model.test_steps > 0


def test_a_saved_model_remembers_who_is_alone(trained, point_envs, tmp_path):
    trained.screening_state["alone"][2] = True
    trained.save(tmp_path / "model")
    loaded = FedAvg.load(tmp_path / "model", env=point_envs(3))
    assert loaded.upload(2)[N_SAMPLES] == 0 and loaded.upload(1)[N_SAMPLES] == 128


@pytest.mark.filterwarnings("ignore:the environments of clients")
def test_tests_may_begin_later(point_envs, tmp_path):
    off = {**SCREENED, "screening": 0.0}
    model = FedAvg("MlpPolicy", point_envs(3), **off)
    model.learn(2 * 3 * 128, CheckpointCallback(tmp_path, 1))
    resumed = FedAvg("MlpPolicy", point_envs(3), **SCREENED).resume(tmp_path)
    model.screening = 0.5
    for other in (resumed, model):
        other.learn(2 * 3 * 128, reset_num_timesteps=False)
        assert other.test_steps > 0 and other.screening_state["steps"].any()
