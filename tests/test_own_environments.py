"""Environments of the user's own, as they come: checkpoints, Stable-Baselines3's Monitor, engines, and what they return."""

from __future__ import annotations

import warnings

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from fed_envs import FederatedVecEnv
from fed_envs.faults import ClientError
from sb3_fedguide import FedAvg, FedRL, Local
from sb3_fedguide.common.callbacks import RoundProgressCallback
from sb3_fedguide.common.checkpoint import CheckpointCallback
from sb3_fedguide.common.evaluation import FederatedEvalCallback, evaluate_federation
from tests.comparisons import assert_same_training
from tests.conftest import assert_same_parameters
from tests.environments import CountingEnv, PointEnv
from tests.loop_engine import Here

SMALL = {"rollout_size": 30, "batch_size": 15, "seed": 3}
ROUND = 2 * SMALL["rollout_size"]


def pendulum() -> gym.Env:
    return gym.make("Pendulum-v1", max_episode_steps=20)


def monitored_car() -> gym.Env:
    return Monitor(gym.make("MountainCarContinuous-v0", max_episode_steps=20))


def once(caught) -> str:
    (message,) = {str(warning.message) for warning in caught if "began anew" in str(warning.message)}
    return message


@pytest.mark.parametrize("algorithm", [Local, FedRL])
@pytest.mark.parametrize("factory", [pendulum, monitored_car])
def test_a_run_of_ordinary_environments_goes_on_from_its_checkpoint(algorithm, factory, tmp_path):
    def make():
        settings = {**SMALL, "learning_starts": 20, "buffer_size": 100} if algorithm is FedRL else SMALL
        return algorithm("MlpPolicy", [factory, factory], n_envs_per_client=2, **settings)

    make().learn(2 * ROUND, CheckpointCallback(tmp_path, 2))
    resumed = []
    for _ in range(2):
        model = make().resume(tmp_path)
        before = model._last_obs.copy()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model.learn(2 * ROUND, CheckpointCallback(tmp_path / "later"), reset_num_timesteps=False)
        assert once(caught).startswith("the environments of clients 0, 1 give no state")
        assert model.round == 4 and not np.array_equal(before, model._last_obs)
        resumed.append(model)
    for client in (0, 1):  # what comes after is determined by the checkpoint
        assert_same_parameters(*(model.policy.client_state_dict(client) for model in resumed))


def test_an_episode_that_had_only_been_reset_is_not_lost():
    old, new = (FederatedVecEnv([pendulum, pendulum], clients=[0, 1]) for _ in range(2))
    old.seed(3)
    first = old.reset()
    new.load_state(old.save_state())
    assert new.lost.tolist() == [True, True]
    rows, observations, clients = new.begin_lost_episodes()
    assert rows.tolist() == [0, 1] and clients == [] and not new.lost.any()
    np.testing.assert_array_equal(observations, first)
    for env in (old, new):
        env.step(np.ones((2, 1), dtype=np.float32))
    assert old.save_state()["envs"] == new.save_state()["envs"]
    old.load_state(new.save_state())  # it stands there already
    assert not old.lost.any()
    new.active[1] = False
    old.step(np.ones((2, 1), dtype=np.float32))
    new.load_state(old.save_state() | {"active": new.active})
    assert new.begin_lost_episodes()[2] == [0]  # who is away stays away
    new.active[:] = True
    assert new.begin_lost_episodes()[2] == [1]


@pytest.mark.parametrize("factory", [pendulum, monitored_car])
def test_workers_keep_ordinary_environments(factory, tmp_path):
    plain, other = (Local("MlpPolicy", [factory] * 3, **SMALL) for _ in range(2))
    plain.learn(4 * 90, CheckpointCallback(tmp_path / "plain", 2))
    Here(2).attach(other)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*began anew")
        other.learn(4 * 90, CheckpointCallback(tmp_path / "other", 2))
    assert_same_training(plain, other)
    engine = Here(2)
    engine.attach(other)
    with pytest.warns(UserWarning, match="clients 0, 1, 2 give no state"):  # new workers have not stepped them
        other.learn(90, reset_num_timesteps=False)


def test_exact_environments_in_a_monitor_go_on_exactly(tmp_path):
    def make():
        return Local("MlpPolicy", [lambda: Monitor(CountingEnv(0.2)), lambda: CountingEnv(0.4)], **SMALL)

    whole = make().learn(4 * ROUND)
    make().learn(2 * ROUND, CheckpointCallback(tmp_path, 2))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*began anew")
        resumed = make().resume(tmp_path).learn(2 * ROUND, reset_num_timesteps=False)
    for client in (0, 1):
        assert_same_parameters(*(model.policy.client_state_dict(client) for model in (whole, resumed)))
    assert resumed.get_env().envs[0].total_steps == 4 * SMALL["rollout_size"]


def test_evaluation_leaves_monitors_files_alone(tmp_path):
    factories = [lambda k=k: Monitor(PointEnv(), str(tmp_path / f"arm{k}")) for k in range(2)]
    model = Local("MlpPolicy", factories, **SMALL)
    model.learn(2 * ROUND, FederatedEvalCallback(2, 1, n_episodes=3))
    for client in range(2):
        header, names, *episodes = (tmp_path / f"arm{client}.monitor.csv").read_text().splitlines()
        assert header.startswith("#") and names == "r,l,t"
        assert len(episodes) == len(model.episode_infos[client]) >= 2
    assert Monitor(PointEnv(), str(tmp_path / "later")).results_writer is not None


def test_two_monitors_of_one_file_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"Monitor of client 1 writes to .*x.monitor.csv, and so does that of client 0: give"):
        FederatedVecEnv([lambda: Monitor(PointEnv(), str(tmp_path / "x"))] * 2)


class Odd(PointEnv):
    """Returns what people's environments return."""

    def __init__(self, kind: str = "") -> None:
        super().__init__(length=7)
        self.kind = kind

    def reset(self, *, seed=None):  # no options, as Stable-Baselines3 allows
        observation, info = super().reset(seed=seed)
        if self.kind == "old reset":
            return observation
        return (list(observation), info) if self.kind == "list" else (observation, info)

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        done = terminated or truncated
        return {
            "list": lambda: [observation.tolist(), np.float32(reward), np.bool_(terminated), int(truncated), info],
            "array reward": lambda: (
                observation.astype(np.float64),
                np.array([reward]),
                np.array(terminated),
                truncated,
                info,
            ),
            "episode": lambda: (observation, reward, terminated, truncated, {"episode": 3}),
            "success": lambda: (observation, reward, terminated, truncated, {"is_success": True} if done else {}),
            "none": lambda: (observation, reward, terminated, truncated, {"is_success": None}),
            "strange success": lambda: (observation, reward, terminated, truncated, {"is_success": np.ones(2)}),
            "no info": lambda: (observation, reward, terminated, truncated, None),
            "endless": lambda: (observation, reward, False, False, info),
        }.get(self.kind, lambda: (observation, reward, terminated, truncated, info))()


@pytest.mark.parametrize("kind", ["list", "array reward", "episode", "none"])
def test_what_stable_baselines3_takes_is_taken(kind):
    plain, odd = (Local("MlpPolicy", [Odd, lambda kind=kind: Odd(kind)], **SMALL) for kind in ("", kind))
    for model in (plain, odd):
        model.learn(2 * ROUND, FederatedEvalCallback(2, 1, n_episodes=2))
    assert_same_parameters(plain.policy.client_state_dict(1), odd.policy.client_state_dict(1))
    assert odd.episode_infos[1][0]["l"] == 7


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("old reset", r"client 1, round 1: reset\(\) of its environment has to return \(observation, info\), as in Gymnasium"),
        ("no info", r"client 1, round 1: step\(\) .* returned 5 values \(ndarray, float, bool, bool, NoneType\)"),
        ("endless", r"client 1, round 1: an episode of the evaluation has not ended after 50 steps.*TimeLimit"),
        ("strange success", r"client 1, round 1: the is_success of its environment is neither true nor false"),
    ],
)
def test_anything_else_names_client_and_remedy(kind, message):
    model = Local("MlpPolicy", [Odd, lambda: Odd(kind)], **SMALL)
    with pytest.raises(ClientError, match=message):
        model.learn(ROUND, FederatedEvalCallback(1, 1, n_episodes=2, max_steps=50))


class NoSeed(PointEnv):
    def reset(self):
        return super().reset()


class NoSpaces(gym.Env):
    pass


def needs_a_name(name):
    return PointEnv()


@pytest.mark.parametrize(
    ("factory", "message"),
    [
        (needs_a_name, r"client 1: the function .* raised TypeError: .*functools.partial"),
        (lambda: 1 / 0, r"client 1: the function that makes its environment raised ZeroDivisionError"),
        (lambda: None, r"client 1: the function .* returned a NoneType, which is no gymnasium.Env"),
        (lambda: DummyVecEnv([PointEnv]), r"client 1: .* returned a DummyVecEnv, .* the function of one environment"),
        (NoSpaces, r"client 1: its environment has no observation_space; set it in the constructor"),
        (pendulum, r"all clients must share their spaces: client 1 has observation_space"),
    ],
)
def test_constructors_that_fail_name_their_client(factory, message):
    with pytest.raises(ValueError, match=message):
        FederatedVecEnv([PointEnv, factory])


def test_a_reset_without_seed_is_named():
    with pytest.raises(ClientError, match=r"client 1, round 1: reset\(\) .* reset\(\) takes seed and options"):
        Local("MlpPolicy", [PointEnv, NoSeed], **SMALL).learn(ROUND)


def test_successes_that_only_some_clients_report(tmp_path):
    model = FedAvg("MlpPolicy", [Odd, lambda: Odd("success")], **SMALL)
    callback = FederatedEvalCallback(1, 1, n_episodes=2, csv_path=tmp_path / "evaluations.csv")
    model.learn(ROUND, [callback, CheckpointCallback(tmp_path, 1)])
    assert callback.last["deployed"].success_list == [None, 1.0]
    rates = [row.rsplit(",", 1)[1] for row in (tmp_path / "evaluations.csv").read_text().splitlines()[1:3]]
    assert rates == ["", "1"]
    again = FederatedEvalCallback(1, 1, n_episodes=2)
    again.load_state(callback.save_state())
    assert again.last["deployed"].success_list == [None, 1.0]


def test_evaluations_have_a_bound_by_default():
    env = FederatedVecEnv([lambda: Odd("endless")], 2)
    with pytest.raises(ClientError, match="client 0: an episode of the evaluation has not ended after 9 steps"):
        evaluate_federation(lambda obs: np.zeros((2, 2)), env, max_steps=9)


def test_the_progress_bar_counts_the_rounds_of_the_whole_run(tmp_path, monkeypatch):
    bars = []
    monkeypatch.setattr(RoundProgressCallback, "_on_training_end", lambda self: bars.append((self.bar.n, self.bar.total)))
    Local("MlpPolicy", [PointEnv, PointEnv], **SMALL).learn(4 * ROUND, CheckpointCallback(tmp_path, 2), progress_bar=True)
    model = Local("MlpPolicy", [CountingEnv, CountingEnv], **SMALL).learn(3 * ROUND - 1, progress_bar=True)
    model.learn(2 * ROUND, reset_num_timesteps=False, progress_bar=True)
    model.learn(1, progress_bar=True)
    assert bars == [(4, 4), (3, 3), (5, 5), (1, 1)]
