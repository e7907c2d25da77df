"""Clients that train in groups elsewhere learn what they would learn here, bit for bit."""

from __future__ import annotations

import itertools
import json
import os
import signal

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import EvalCallback

from fed_envs.faults import ClientError
from sb3_fedguide import Local
from sb3_fedguide.cli.train import main
from sb3_fedguide.engines import make_engine
from sb3_fedguide.engines.engine import Engine, EngineError
from sb3_fedguide.engines.processes import Processes
from sb3_fedguide.registry import ALGORITHMS, algorithm
from sb3_fedguide.state.client_axis import join_clients, take_clients
from tests.comparisons import assert_same_training, same
from tests.conftest import others_slow
from tests.environments import CountingEnv
from tests.loop_engine import Here
from tests.small_runs import ROUNDS, make, train

FEDERATED = [name for name in ALGORITHMS if algorithm(name).is_federated]
QUICK = [("local", 1.0), ("fedavg", 0.4), ("fedsvrpgm", 1.0), ("fedrl", 0.4), ("fedguide-a", 1.0), ("fedguide-r", 0.4)]


@pytest.mark.parametrize(
    ("algo", "fraction"), others_slow(itertools.product(FEDERATED, (1.0, 0.4)), lambda *case: case in QUICK)
)
def test_groups_elsewhere_learn_the_same(algo, fraction, tmp_path):
    def run(engine: Engine | None):
        model = make(algo, "Reacher", clients=[0, 3, 4, 6, 7], client_fraction=fraction)
        if engine is not None:
            engine.attach(model)
        return model, *train(model, ROUNDS, tmp_path / f"{engine is None}.csv")

    engine = Here(3)
    (plain, log, evaluation), (other, other_log, other_evaluation) = run(None), run(engine)
    assert_same_training(plain, other)
    assert (tmp_path / "True.csv").read_bytes() == (tmp_path / "False.csv").read_bytes()
    np.testing.assert_array_equal(evaluation.last["deployed"].returns, other_evaluation.last["deployed"].returns)
    for round, values in log.rounds.items():
        assert values.keys() == other_log.rounds[round].keys()
        for name, value in values.items():
            np.testing.assert_allclose(other_log.rounds[round][name], value, rtol=2e-5, atol=1e-7, err_msg=name)
    assert engine.groups == [[0, 3], [1, 4], [2]]
    if fraction < 1:
        assert any(len(asked) < 3 for asked in engine.asked)  # a group of which nobody takes part is not trained


def test_a_run_goes_on_with_another_number_of_workers(tmp_path):
    plain = make("fedguide", "Reacher", clients=[1, 2, 3])
    train(plain, ROUNDS, tmp_path / "plain.csv")
    model = make("fedguide", "Reacher", clients=[1, 2, 3])
    Here(2).attach(model)
    train(model, 2, tmp_path / "parts.csv")
    Here(3).attach(model)
    train(model, 3, tmp_path / "parts.csv")
    model.engine = None
    train(model, ROUNDS, tmp_path / "parts.csv")
    assert_same_training(plain, model)


def test_parts_of_a_state_and_back():
    state = {
        "attributes": {"heads": np.arange(12.0).reshape(4, 3), "obs": np.arange(16.0).reshape(8, 2), "round": 3, "none": None,
                       "streams": {"__type__": "dict", "value": [[2, ["a", "b", "c", "d"]]]},
                       "bytes": {"__type__": "tuple", "value": [1, 2, 3, 4]}},
        "optimizers": [{"parameters": [{"step": np.array(7.0), "exp_avg": np.ones((4, 2))}], "learning_rates": [0.1]}],
        "random": {"torch": np.arange(5)},
    }  # fmt: skip
    shared = {"random"}
    parts = [take_clients(state, group, 4, shared) for group in ([0, 1], [2], [3])]
    np.testing.assert_array_equal(parts[1]["attributes"]["obs"], [[8, 9], [10, 11]])  # both environments of the client
    assert parts[2]["attributes"]["streams"]["value"] == [[2, ["d"]]]
    assert parts[0]["attributes"]["bytes"] == state["attributes"]["bytes"]
    assert same(join_clients(parts, shared), state)


def test_a_state_without_a_client_axis_is_refused():
    with pytest.raises(ValueError, match=r"table in the state has 3 entries for 2 clients.*shared=True"):
        take_clients({"table": np.zeros((3, 2))}, [0], 2, set())


class BreaksAfter(CountingEnv):
    def step(self, action):
        if self.target > 0 and self.steps == 5:
            raise RuntimeError("a cable broke")
        return super().step(action)


def test_a_broken_client_is_named_with_its_round():
    model = Local("MlpPolicy", [lambda target=target: BreaksAfter(target) for target in (-1.0, 1.0)], seed=0, rollout_size=64)
    Here(2).attach(model)
    with pytest.raises(
        ClientError, match=r"client 1, round 1: step\(\) of its environment raised RuntimeError: a cable broke"
    ):
        model.learn(128)


class Interrupted(Here):
    def _train(self, rounds):
        raise KeyboardInterrupt


def test_after_an_interrupt_no_worker_is_asked_again(small):
    plain, model = (Local("MlpPolicy", [lambda: CountingEnv(0.3)] * 2, **small) for _ in range(2))
    engine = Interrupted(2)
    engine.attach(model)
    with pytest.raises(KeyboardInterrupt):
        model.learn(128)
    assert engine.workers == [] and model.engine is None
    plain.learn(128)
    model.learn(128, reset_num_timesteps=False)  # here, from where it was before
    assert_same_training(plain, model)


def test_an_engine_trains_one_model_and_a_model_has_one_engine(small):
    first, second = (Local("MlpPolicy", [lambda: CountingEnv(0.3)], **small) for _ in range(2))
    engine, other = Here(1), Here(1)
    engine.attach(first)
    engine.attach(second)
    assert first.engine is None and second.engine is engine
    other.attach(second)
    assert second.engine is other and engine.workers == []


def test_another_device_is_refused(small, capsys):
    model = Local("MlpPolicy", [lambda: CountingEnv(0.3)], **small)
    model.device = th.device("meta")
    with pytest.raises(ValueError, match="engines train on CPUs, and the device is meta"):
        Here(1).attach(model)
    with pytest.raises(SystemExit):
        main([*SMALL_RUN, "--engine", "processes", "--device", "cuda"])
    assert "--engine processes trains on CPUs" in capsys.readouterr().err


def test_callbacks_that_count_steps_are_refused(small):
    model = Local("MlpPolicy", [lambda: CountingEnv(0.3)] * 2, **small)
    Here(2).attach(model)
    with pytest.raises(ValueError, match="EvalCallback counts environment steps"):
        model.learn(128, EvalCallback(model.get_env()))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(("threads", 2), "must be one of lockstep, processes, ray"), (("processes", 0), "num_actors=0 must be at least 1")],
)
def test_wrong_engines_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_engine(*arguments)


def test_worker_processes_leave_signals_to_the_main_process_and_one_that_is_killed_is_missed(small):
    plain, model = (Local("MlpPolicy", [lambda: CountingEnv(0.3)], **small) for _ in range(2))
    plain.learn(64)
    with Processes(2) as engine:
        engine.attach(model)
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):  # a terminal and a scheduler send them to all
            os.kill(engine._processes[0].pid, number)
        model.learn(64)
        assert_same_training(plain, model)
        processes = list(engine._processes)
        os.kill(processes[0].pid, signal.SIGKILL)
        with pytest.raises(EngineError, match="go on from the last checkpoint"):
            model.learn(64, reset_num_timesteps=False)
        assert model.engine is None
    assert not any(process.is_alive() for process in processes)


SMALL_RUN = [
    "--env", "Bandit2D", "--rounds", "2", "--eval-freq", "1", "--eval-episodes", "2", "--verbose", "0",
    "-params", "rollout_size:64", "pretraining.dataset_size:100", "pretraining.dice_updates:5", "pretraining.bc_updates:5",
]  # fmt: skip


@pytest.mark.parametrize(
    ("engine", "workers"),
    [
        ("processes", "1"),
        pytest.param("processes", "2", marks=pytest.mark.slow),
        pytest.param("ray", "2", marks=pytest.mark.ray),
    ],
)
def test_a_run_with_an_engine_writes_what_a_run_without_writes(engine, workers, tmp_path):
    for name, flags in (("lockstep", []), (engine, ["--engine", engine, "--num-actors", workers])):
        assert main([*SMALL_RUN, "-f", str(tmp_path / name), *flags]) == 0
    plain, other = (tmp_path / name / "fedguide" / "Bandit2D_1" for name in ("lockstep", engine))
    assert (plain / "evaluations.csv").read_bytes() == (other / "evaluations.csv").read_bytes()
    with np.load(plain / "parameters.npz") as ours, np.load(other / "parameters.npz") as theirs:
        assert all(np.array_equal(ours[name], theirs[name]) for name in ours.files)
    summaries = [json.loads((folder / "summary.json").read_text()) for folder in (plain, other)]
    assert summaries[0]["deployed"] == summaries[1]["deployed"] and summaries[0]["bytes_up"] == summaries[1]["bytes_up"]


def test_ray_that_is_not_installed_is_named(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main([*SMALL_RUN, "-f", str(tmp_path / "logs"), "--engine", "ray"]) == 2
    assert "pip install 'sb3-fedguide[ray]'" in capsys.readouterr().err
    assert not (tmp_path / "logs").exists()
