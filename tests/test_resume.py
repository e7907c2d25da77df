"""A run that is stopped and goes on is the run that was not stopped: same parameters, same evaluations, bit for bit."""

from __future__ import annotations

import pytest
import torch as th

from sb3_fedguide.common.checkpoint import CheckpointCallback
from sb3_fedguide.common.evaluation import FederatedEvalCallback
from sb3_fedguide.registry import ALGORITHMS, algorithm
from tests.comparisons import same
from tests.conftest import others_slow
from tests.environments import CountingEnv
from tests.small_runs import ROUNDS, STOP, make, train

#: Methods that keep more than others do from round to round are quick tests where only half of the clients take part.
KEEP_MORE = ("fedavg", "fedsvrpgm", "fedrl", "fedguide", "fedguide-a", "fedguide-r")
EVERYBODY, HALF = ("Bandit2D", {}), ("ReacherHard", {"client_fraction": 0.5})
CASES = [(algo, *where) for algo in ALGORITHMS for where in (EVERYBODY, HALF)]


@pytest.mark.parametrize(
    ("algo", "env", "more"), others_slow(CASES, lambda algo, env, more: (algo in KEEP_MORE) == (env == "ReacherHard"))
)
def test_a_new_object_goes_on_from_a_checkpoint(algo, env, more, tmp_path, monkeypatch):
    more = more if algorithm(algo).is_federated else {}
    whole = make(algo, env, **more)
    whole_log, whole_evaluation = train(whole, ROUNDS, tmp_path / "whole.csv")
    # The one that is stopped goes on for a round whose evaluations are in the file already, and then is lost.
    lost = make(algo, env, **more)
    train(lost, STOP + 1, tmp_path / "parts.csv", tmp_path / "checkpoints")
    monkeypatch.setenv("FEDGUIDE_CACHE", str(tmp_path / "no cache"))
    resumed = make(algo, env, **{**more, "seed": 99}).resume(tmp_path / "checkpoints")  # the seed is part of the checkpoint
    assert resumed.round == STOP
    log, evaluation = train(resumed, ROUNDS, tmp_path / "parts.csv")

    assert not (tmp_path / "no cache").exists()  # nothing of the offline stage was made again
    expected, found = whole.policy.state_dict(), resumed.policy.state_dict()
    assert all(th.equal(expected[name], found[name]) for name in expected)
    assert (tmp_path / "parts.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()
    assert repr(log.rounds) == repr({round: whole_log.rounds[round] for round in range(STOP + 1, ROUNDS + 1)})
    assert evaluation.curves == whole_evaluation.curves
    states = [model.save_state() for model in (whole, resumed)]
    for state in states:
        state["env"].pop("seconds")
        for infos in state["attributes"].pop("episode_infos"):
            assert all(info.pop("t") > 0 for info in infos["value"])
    assert same(*states)  # everything else that the next rounds depend on


def test_learning_goes_on_with_environments_of_ones_own(tmp_path):
    def factories():
        return [lambda k=k: CountingEnv(0.3 * k) for k in range(2)]

    def evaluation(name: str) -> FederatedEvalCallback:
        return FederatedEvalCallback(4, 1, 2, tmp_path / name)

    settings = {"rollout_size": 32, "batch_size": 16, "n_epochs": 1, "seed": 0}
    whole = algorithm("local")("MlpPolicy", factories(), **settings)
    whole.learn(4 * 64, evaluation("whole.csv"))
    algorithm("local")("MlpPolicy", factories(), **settings).learn(
        3 * 64, [evaluation("parts.csv"), CheckpointCallback(tmp_path, 2)]
    )
    resumed = algorithm("local")("MlpPolicy", factories(), **settings).resume(tmp_path)
    resumed.learn(2 * 64, evaluation("parts.csv"), reset_num_timesteps=False)
    expected, found = whole.policy.state_dict(), resumed.policy.state_dict()
    assert all(th.equal(expected[name], found[name]) for name in expected)
    assert (tmp_path / "parts.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()


def test_callbacks_of_the_run_have_to_be_there(tmp_path):
    train(make("local", "Bandit2D"), STOP, tmp_path / "parts.csv", tmp_path)
    resumed = make("local", "Bandit2D").resume(tmp_path)
    with pytest.raises(
        ValueError, match="callbacks that this run does not have: RunEvalCallback, CostCallback, DeployedCallback"
    ):
        resumed.learn(256, reset_num_timesteps=False)
    (tmp_path / "parts.csv").write_text("round\n")
    with pytest.raises(ValueError, match=r"parts\.csv has 6 bytes .*rows are missing"):
        train(make("local", "Bandit2D").resume(tmp_path), ROUNDS, tmp_path / "parts.csv")
