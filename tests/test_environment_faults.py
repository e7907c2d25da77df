"""An environment that breaks, and a policy that diverges, name their client and the round."""

from __future__ import annotations

import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import torch as th

from fed_envs import FederatedVecEnv
from fed_envs.faults import ClientError, RowError, run_rows, watched
from sb3_fedguide import FedAvg, FedRL, Local
from sb3_fedguide.cli import train
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.faults import check_experience
from tests import forked
from tests.environments import PointEnv

SMALL = {"rollout_size": 60, "batch_size": 30, "n_envs_per_client": 2, "seed": 3}
LEARNERS = {
    "ppo": (Local, {"n_epochs": 1}),
    "ppo_normalized": (FedAvg, {"n_epochs": 1, "normalize": True}),
    "ddpg": (FedRL, {"learning_starts": 20, "buffer_size": 100}),
}


class Fragile(PointEnv):
    """Breaks in its ``at``-th step, counted over all episodes."""

    def __init__(self, fault: str = "", at: int = 10**9) -> None:
        super().__init__()
        self.fault, self.at, self.count = fault, at, 0

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed, options=options)
        if self.fault == "reset raises" and self.count >= self.at:
            raise OSError("the simulator is gone")
        if self.fault == "reset shape" and self.count >= self.at:
            return observation[:1], info
        return observation, info

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        self.count += 1
        if self.count == self.at:
            if self.fault == "raises":
                raise OSError("the simulator is gone")
            if self.fault == "shape":
                observation = observation[:1]  # NumPy would stretch it
            if self.fault == "nan observation":
                observation[1] = np.nan
            if self.fault == "nan final observation":
                observation[1], terminated, truncated = np.nan, False, True
            if self.fault == "infinite observation":
                observation[1] = np.inf
            if self.fault in ("nan reward", "inf reward"):
                reward = float(self.fault[:3])
            if self.fault == "four values":
                return observation, reward, terminated, info
        return observation, reward, terminated, truncated, info


#: fault to what the message says
FAULTS = {
    "raises": "step() of its environment raised OSError: the simulator is gone",
    "reset raises": "reset() of its environment raised OSError: the simulator is gone",
    "shape": "the observation has the shape (1,), the observation space (3,)",
    "reset shape": "the observation has the shape (1,), the observation space (3,)",
    "four values": "step() of its environment has to return (observation, reward, terminated, truncated, info)",
    "nan observation": "its environment returned",
    "nan final observation": "its environment returned",
    "infinite observation": "its environment returned",
    "nan reward": "its environment returned a reward that is not finite",
    "inf reward": "its environment returned a reward that is not finite",
}


def factories(fault: str, at: int):
    """Three clients; both environments of the one in the middle have the fault."""
    return [Fragile, lambda: Fragile(fault, at), Fragile]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_an_environment_names_client_and_round(learner, fault):
    algorithm, settings = LEARNERS[learner]
    model = algorithm("MlpPolicy", factories(fault, 40), **settings, **SMALL)  # 30 steps of each environment in a round
    with pytest.raises(ClientError) as raised:
        model.learn(5 * 3 * model.rollout_size)
    # where a reset is at fault, the episode in which it comes due ends some steps later
    assert re.match(r"client 1, round [23]: " if "reset" in fault else "client 1, round 2: ", str(raised.value))
    assert FAULTS[fault] in str(raised.value)
    assert raised.value.clients == [1] and raised.value.round == model.round + 1


def test_a_fault_is_seen_in_its_round_even_where_nobody_learns_from_it_yet():
    model = FedRL("MlpPolicy", factories("nan reward", 40), learning_starts=500, buffer_size=1000, **SMALL)
    with pytest.raises(ClientError, match="client 1, round 2: its environment returned a reward that is not finite"):
        model.learn(5 * 3 * model.rollout_size)


def test_a_fault_at_once_is_of_round_1():
    for fault in ("reset raises", "reset shape"):
        with pytest.raises(ClientError, match="client 1, round 1: reset"):
            Local("MlpPolicy", factories(fault, 0), **SMALL).learn(60)


def test_ids_are_named_not_positions():
    env = FederatedVecEnv(factories("raises", 3), clients=[2, 1])
    env.seed(0)
    env.reset()
    env.step(np.zeros((2, 2)))
    env.step(np.zeros((2, 2)))
    with pytest.raises(ClientError, match=r"^client 1: step") as raised:
        env.step(np.zeros((2, 2)))
    assert isinstance(raised.value.__cause__, OSError)


@pytest.mark.parametrize("num_threads", [1, 2])
def test_a_simulator_that_raises_names_its_client(num_threads, monkeypatch):
    env = FederatedVecEnv("Reacher", n_envs_per_client=4, num_threads=num_threads)
    env.seed(0)
    env.reset()
    import mujoco

    broken, original = env.envs[4 * 5 + 2].unwrapped.model, mujoco.mj_step

    def step(model, data, *more):
        if model is broken:
            raise mujoco.FatalError("too many contacts")
        return original(model, data, *more)

    monkeypatch.setattr(mujoco, "mj_step", step)
    with pytest.raises(ClientError, match=r"^client 5: step\(\) of its environment raised FatalError: too many contacts"):
        env.step(np.zeros((32, 2)))
    env.close()


@pytest.mark.parametrize("rows", [range(5), [0, 2, 4, 5]])
@pytest.mark.parametrize("runner", [run_rows, lambda work, rows: watched(work)(iter(rows))])
def test_runners_know_the_row_at_work(rows, runner):
    done = []

    def work(iterator):
        for row in iterator:
            if row == rows[3]:
                raise OSError
            done.append(row)

    with pytest.raises(RowError) as raised:
        runner(work, rows)
    assert raised.value.row == rows[3] and done == list(rows[:3]) and isinstance(raised.value.__cause__, OSError)


def test_the_first_fault_of_a_round_is_the_one_that_is_named():
    rewards, observations = np.zeros((6, 3, 2)), np.zeros((6, 3, 2, 4))
    check_experience([7, 8, 9], {"an observation": observations, "a reward": rewards})
    observations[4, 0, 1, 2], rewards[2, 2, 0] = np.inf, np.nan
    with pytest.raises(ClientError, match="client 9: its environment returned a reward that is not finite, in step 2"):
        check_experience([7, 8, 9], {"an observation": observations, "a reward": rewards})


class Poison(RoundCallback):
    """Breaks parameters of some clients in the middle of a round, as a divergence would."""

    def __init__(self, clients: list[int], name: str) -> None:
        super().__init__()
        self.clients, self.name = clients, name

    def _on_rollout_end(self) -> None:
        if self.model.round == 2:
            with th.no_grad():
                self.model.policy.get_parameter(self.name)[self.clients] = th.nan


@pytest.mark.parametrize("clients", [[0], [1, 2]])
def test_diverged_policies_are_reported_in_their_round(clients, point_envs):
    model = Local("MlpPolicy", point_envs(3), n_epochs=1, **SMALL)
    named = "client 0" if clients == [0] else "clients 1, 2"
    with pytest.raises(ClientError, match=f"^{named}, round 3: the policy has diverged"):
        model.learn(9 * 3 * 60, Poison(clients, "value_net.weight"))
    assert model.round == 2


def test_a_policy_that_really_diverges_is_reported(point_envs):
    model = FedRL("MlpPolicy", point_envs(2), learning_rate=1e30, learning_starts=20, buffer_size=100, **SMALL)
    with pytest.raises(ClientError, match=r"clients? 0.*, round [12]: "):
        model.learn(5 * 2 * 60)


def test_errors_pickle_and_keep_their_first_round():
    error = pickle.loads(pickle.dumps(ClientError([3], "it broke").in_round(12)))
    assert str(error) == "client 3, round 12: it broke" and error.in_round(13) is error


BROKEN_WORLD = """
import numpy as np
from wind_world import WindBatch, WindEnv


class BreakingBatch(WindBatch):
    steps = 0

    def step(self, actions, rows, run=None):
        super().step(actions, rows)
        BreakingBatch.steps += 1
        if BreakingBatch.steps == {at}:
            {fault}


WindEnv.batch_class = BreakingBatch
"""


def test_a_world_that_steps_all_at_once_names_all_its_clients(monkeypatch):
    env = FederatedVecEnv("Bandit2D", clients=[1, 3])
    env.seed(0)
    env.reset()
    monkeypatch.setattr(type(env._batch), "step", lambda *arguments: 1 / 0)
    with pytest.raises(ClientError, match=r"^clients 1, 3: step\(\) of its environment raised ZeroDivisionError"):
        env.step(np.zeros((2, 2)))


def test_the_command_line_prints_one_message_and_writes_no_result(tmp_path):
    fault, message = "self.rewards[1] = np.nan", "client 0, round 2: its environment returned a reward that is not finite"
    root = Path(__file__).parents[1]
    (tmp_path / "broken_world.py").write_text(BROKEN_WORLD.format(at=40, fault=fault))
    argv = ["--gym-packages", "wind_world", "broken_world", "--algo", "fedavg"]
    argv += ["--env", "Wind", "--rounds", "5", "--verbose", "0", "-f", str(tmp_path / "logs"), "--no-eval"]
    argv += ["-params", "rollout_size:60", "batch_size:20", "n_envs_per_client:2", "bc_weight:0"]
    result = forked.train(argv, [tmp_path, root / "docs" / "examples"])
    assert result.returncode == train.EXIT_FAILED, result.stderr
    (error,) = result.stderr.splitlines()
    assert error.startswith(f"train.py: error: {message}")
    (folder,) = (tmp_path / "logs").glob("*/Wind_1")
    assert not (folder / "model.zip").exists() and not (folder / "summary.json").exists()
