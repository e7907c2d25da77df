"""Registered environments as clients: several ids, or one with several keyword arguments."""

from __future__ import annotations

import json
import pickle
import re

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import fed_envs
from fed_envs import FederatedVecEnv
from sb3_fedguide import Local
from sb3_fedguide.cli.evaluate import main as evaluate
from sb3_fedguide.cli.train import main
from sb3_fedguide.deployment.site_config import make_client, read_site_config
from sb3_fedguide.offline.make_dataset import make_dataset
from tests.conftest import assert_same_parameters
from tests.environments import ACTIONS, pendulum_log
from tests.loop_engine import Here

SMALL = ["--eval-episodes", "2", "--verbose", "0", "-params", "rollout_size:60", "batch_size:30", "n_envs_per_client:1",
         "n_epochs:1", "policy_kwargs.net_arch:[4]"]  # fmt: skip
PLAIN = [*SMALL, "bc_weight:0"]
GRAVITIES = (9.81, 5.0, 2.0)


@pytest.fixture
def robots(tmp_path):
    (tmp_path / "robots.yml").write_text("".join(f"- {{g: {g}}}\n" for g in GRAVITIES))
    return str(tmp_path / "robots.yml")


def test_a_family_of_registered_environments():
    family = fed_envs.gymnasium_family("Pendulum-v1", [{"g": g} for g in GRAVITIES])
    assert (family.name, family.max_episode_steps, family.n_clients) == ("Pendulum_v1", 200, 3)
    env = FederatedVecEnv(family, 2)
    assert [inside.g for inside in (one.env.unwrapped for one in env.envs)] == [9.81, 9.81, 5.0, 5.0, 2.0, 2.0]
    check_env(family.make(1).unwrapped, skip_render_check=True)
    single, alone = family.make(2), gym.make("Pendulum-v1", g=2.0)
    np.testing.assert_array_equal(single.reset(seed=4)[0], alone.reset(seed=4)[0])
    for _ in range(200):
        one, other = (each.step(np.array([0.7], dtype=np.float32)) for each in (single, alone))
        np.testing.assert_array_equal(one[0], other[0])
        assert one[1:4] == other[1:4]
    assert one[3]
    spec = family.make(1).spec
    assert gym.make(pickle.loads(pickle.dumps(spec))).unwrapped.env.unwrapped.g == 5.0


def test_it_is_what_a_list_of_functions_is():
    functions = [lambda g=g: gym.make("Pendulum-v1", g=g) for g in GRAVITIES]
    family = fed_envs.gymnasium_family("Pendulum-v1", [{"g": g} for g in GRAVITIES])
    models = [Local("MlpPolicy", env, rollout_size=60, batch_size=30, seed=1) for env in (functions, family, family)]
    Here(2).attach(models[2])
    first, *others = [model.learn(360) for model in models]
    for other in others:
        for client in range(3):
            assert_same_parameters(*(model.policy.client_state_dict(client) for model in (first, other)))


def test_the_command_line_trains_goes_on_and_evaluates(robots, tmp_path, capsys):
    argv = ["--algo", "fedavg", "--env", "Pendulum-v1", "--client-kwargs", robots, "--env-kwargs", "max_episode_steps:50"]
    argv = [*argv, "-f", str(tmp_path / "logs")]
    assert main([*argv, "--rounds", "1", *PLAIN]) == 0
    folder = tmp_path / "logs" / "fedavg" / "Pendulum_v1_1"
    family = fed_envs.load_family(str(folder / "metadata.json"))
    assert [client.kwargs for client in family.clients] == [{"max_episode_steps": 50, "g": g} for g in GRAVITIES]
    with pytest.warns(UserWarning, match="the environments of clients 0, 1, 2 give no state"):
        assert main(["--resume", str(folder), "--rounds", "2"]) == 0
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["rounds_done"] == 2 and summary["n_clients"] == 3
    capsys.readouterr()
    assert evaluate([str(folder), "--episodes", "2"]) == 0
    result = json.loads(capsys.readouterr().out)["policies"]["deployed"]
    assert result["client_returns"] == pytest.approx(summary["deployed"]["client_returns"])
    assert result["client_lengths"] == [50.0] * 3
    site = {"algo": "fedavg", "metadata": str(folder / "metadata.json"), "client": 1, "seed": 0, "params": {"bc_weight": 0.0}}
    model, _ = make_client(read_site_config(site))
    assert model.client_ids == [1] and model.get_env().envs[0].env.unwrapped.g == 5.0


def test_fedguide_trains_several_ids_with_a_dataset(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    gym.register("Arm-v0", "gymnasium.envs.classic_control.pendulum:PendulumEnv", max_episode_steps=30, kwargs={"g": 1.0})
    try:
        for client in range(2):
            make_dataset(f"robots/arm{client}-v0", **pendulum_log(client), action_space=ACTIONS)
        argv = ["--env", "Arm-v0,Pendulum-v1", "--rounds", "1", "--dataset", "robots/arm{client}-v0", "-f", str(tmp_path)]
        stage = ["pretraining.bc_updates:2", "pretraining.dice_updates:2", "pretraining.prior_updates:2", "prior_states:10"]
        assert main([*argv, *SMALL, *stage, "pretraining.prior_width:8", "pretraining.dice_width:8"]) == 0
        summary = json.loads((tmp_path / "fedguide" / "Arm_v0_Pendulum_v1_1" / "summary.json").read_text())
        assert summary["finished"] and len(summary["deployed"]["client_returns"]) == 2
    finally:
        del gym.registry["Arm-v0"]


ERRORS = {
    "--env Pendulum-v1": "Pendulum-v1 is one environment, .* --client-kwargs FILE, .* --env Pendulum-v1,Pendulum-v1",
    "--env Pendulum-v1,Pendulm-v1": "client 1 .*: no environment 'Pendulm-v1' .* did you mean 'Pendulum-v1'",
    "--env Pendulum-v1,os:Pendulum-v1": "client 1 .*: no environment 'os:Pendulum-v1' is registered",
    "--env Pendulum-v1,Pendulum-v1 --client-kwargs ROBOTS": "--env has 2 ids and .* has 3 entries",
    "--env Pendulum-v1,MountainCarContinuous-v0": "all clients must share their spaces: client 1 has observation_space",
    "--env Pendulum-v1 --client-kwargs ROBOTS --env-kwargs gg:3": "client 0: .* raised TypeError: .*'gg'",
    "--env Pendulum-v1 --client-kwargs ROBOTS --env-kwargs max_episode_steps:-1": "Pendulum-v1 has no time limit",
    "--env Pendulum-v1 --client-kwargs nowhere.yml": "cannot read the configuration nowhere.yml",
    "--env Bandit2D --client-kwargs ROBOTS": "--client-kwargs and --env-kwargs are for the ids of registered environments",
    "--env Pendulm-v1": "unknown environment 'Pendulm-v1'",
}


@pytest.mark.parametrize("flags", ERRORS)
def test_wrong_ids_and_arguments_are_one_message(flags, robots, tmp_path, capsys):
    assert main([*flags.replace("ROBOTS", robots).split(), "--algo", "fedavg", "-f", str(tmp_path / "logs"), *PLAIN]) == 2
    error = capsys.readouterr().err
    assert re.search(ERRORS[flags], error), error
    assert not (tmp_path / "logs").exists()


def test_without_data_the_command_says_what_to_give(robots, tmp_path, capsys):
    argv = ["--env", "Pendulum-v1", "--client-kwargs", robots, "-f", str(tmp_path / "logs"), *SMALL]
    assert main(["--algo", "fedavg", *argv]) == 2
    error = capsys.readouterr().err
    assert "Pendulum-v1 brings no offline data: give a Minari dataset with --dataset" in error and "bc_weight:0" in error
    assert not (tmp_path / "logs").exists()


def test_values_that_are_no_json_are_refused():
    with pytest.raises(ValueError, match=r"client 0 .*: kwargs: must be numbers, texts, lists and mappings"):
        fed_envs.gymnasium_family("Pendulum-v1", [{"g": object()}])
    with pytest.raises(ValueError, match=r"fed_envs\.gymnasium_family"):
        FederatedVecEnv(["Pendulum-v1", "Pendulum-v1"])
    with pytest.raises(ValueError, match="there are 1 ids and 2 sets"):
        fed_envs.gymnasium_family(["Pendulum-v1"], [{}, {}])
