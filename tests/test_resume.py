"""A run that is stopped and goes on is the run that was not stopped: same parameters, same evaluations, bit for bit."""

from __future__ import annotations

import copy
from pathlib import Path

import pytest
import torch as th

from sb3_fedguide.cli.recorder import CostCallback, DeployedCallback, RunEvalCallback
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.checkpoint import CheckpointCallback
from sb3_fedguide.common.evaluation import FederatedEvalCallback
from sb3_fedguide.registry import ALGORITHMS, algorithm
from tests.test_checkpoint import same
from tests.test_env_state import CountingEnv

ROUNDS, STOP = 4, 2
OFFLINE = {"bc_updates": 2, "dice_updates": 2, "prior_updates": 2, "dataset_size": 200, "prior_width": 8, "dice_width": 8}
COMMON = {
    "rollout_size": 32, "batch_size": 16, "seed": 3, "policy_kwargs": {"net_arch": [8]}, "normalize": True, "bc_weight": 0.3,
    "n_envs_per_client": 2, "pretraining": OFFLINE,
}  # fmt: skip
#: What makes each algorithm keep as much as it can from round to round.
OWN = {
    "fedkl": {"average_every": 2},
    "fedsvrpgm": {"reference_every": 2},
    "fedrl": {"learning_starts": 20, "buffer_size": 90, "train_freq": 8},  # the ring is full in the third round
    "fedguide": {"adapt": "advantage", "calibrate": True, "beta": "auto", "prior_states": 32},
    "fedguide-p": {"prior_loss": "sample", "cost": "param"},
    "fedguide-a": {"average_every": 2, "n_experts": 2, "server_momentum": 0.5},
    "fedguide-r": {"normalize": "shared", "screening": 0.5, "mix": 0.7},
}  # fmt: skip


def make(algo: str, env: str, **more):
    epochs = {} if algo == "fedrl" else {"n_epochs": 2}
    return algorithm(algo)("MlpPolicy", env, **copy.deepcopy({**COMMON, **epochs, **OWN.get(algo, {}), **more}))


class Log(RoundCallback):
    """What each round leaves in the log, without seconds."""

    def __init__(self):
        super().__init__()
        self.rounds = {}

    def _on_round_end(self) -> None:
        values = {name: value for name, value in self.logger.name_to_value.items() if not name.startswith("time/")}
        self.rounds[self.model.round] = {**values, "return": self.model.mean_episode_return()}


def train(model, rounds: int, csv_path: Path, folder: Path | None = None) -> tuple[Log, RunEvalCallback]:
    """Train until ``rounds`` rounds are done, as the command line does."""
    log, evaluation = Log(), RunEvalCallback(ROUNDS, 2, 1, csv_path)
    callbacks = [evaluation, CostCallback(), DeployedCallback(), log]
    if folder is not None:
        callbacks.append(CheckpointCallback(folder, STOP))
    total = rounds * model.rollout_size * model.n_participants
    model.learn(total - model.num_timesteps, callbacks, reset_num_timesteps=model.round == 0)
    return log, evaluation


@pytest.mark.parametrize("algo", ALGORITHMS)
@pytest.mark.parametrize(("env", "more"), [("Bandit2D", {}), ("ReacherHard", {"client_fraction": 0.5})])
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
        ValueError, match="callbacks that this run has not got: RunEvalCallback, CostCallback, DeployedCallback"
    ):
        resumed.learn(256, reset_num_timesteps=False)
    (tmp_path / "parts.csv").write_text("round\n")
    with pytest.raises(ValueError, match=r"parts\.csv has 6 bytes .*rows are missing"):
        train(make("local", "Bandit2D").resume(tmp_path), ROUNDS, tmp_path / "parts.csv")
