"""Every client's policy plays its own client's environment, whatever environments a model is given later."""

from __future__ import annotations

import multiprocessing
import sys
from types import ModuleType

import numpy as np
import pytest

from fed_envs import FederatedVecEnv
from sb3_fedguide import FedRL, Local

SIZES = {
    Local: {"rollout_size": 40, "batch_size": 20, "n_epochs": 1},
    FedRL: {"rollout_size": 40, "batch_size": 8, "learning_starts": 20},
}


def make(algorithm=Local, env="Bandit2D", **arguments):
    return algorithm("MlpPolicy", env, seed=3, policy_kwargs={"net_arch": [8]}, **SIZES[algorithm], **arguments)


def peaks(env: FederatedVecEnv) -> list[tuple[float, float]]:
    return [client.unwrapped.client.peak for client in env.envs]


def saved(model, tmp_path):
    model.learn(model.n_clients * model.rollout_size)
    model.save(tmp_path / "model")
    return tmp_path / "model"


@pytest.mark.parametrize("how", ["load", "set_env"])
def test_clients_in_another_order_are_put_in_the_models(how, tmp_path):
    model = make(clients=[0, 1, 2, 3])
    path, own = saved(model, tmp_path), peaks(model.get_env())
    other = FederatedVecEnv("Bandit2D", clients=[2, 0, 3, 1])
    assert peaks(other) != own
    if how == "load":
        model = Local.load(path, env=other)
    else:
        model.set_env(other)
    assert peaks(model.get_env()) == own and model.get_env().client_ids == model.client_ids == [0, 1, 2, 3]
    model.learn(1)


def test_a_name_stands_for_the_clients_that_live_here(tmp_path):
    path = saved(make(clients=[3, 1], n_envs_per_client=2), tmp_path)
    model = Local.load(path, env="Bandit2D")
    assert model.get_env().client_ids == [3, 1] and model.get_env().n_envs_per_client == 2
    model.learn(1, reset_num_timesteps=False)


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (lambda: FederatedVecEnv("Bandit2D", clients=[0, 1]), r"clients \[0, 1\].*holds the clients \[0, 1, 2, 3\]"),
        (lambda: "Reacher", "family Reacher .* federation of the family Bandit2D .*export_parameters"),
        (lambda: [lambda: None], "custom has clients 0 to 0"),
    ],
)
def test_others_are_refused(env, message, tmp_path):
    model = make()
    path = saved(model, tmp_path)
    with pytest.raises(ValueError, match=message):
        Local.load(path, env=env())
    with pytest.raises(ValueError, match=message):
        model.set_env(env())


def test_functions_of_ones_own_do_not_stand_for_a_family(point_envs, tmp_path):
    path = saved(make(env=point_envs(4)), tmp_path)
    with pytest.raises(ValueError, match=r"family Bandit2D .* federation of functions of your own"):
        Local.load(path, env="Bandit2D")
    assert Local.load(path, env=point_envs(4)).learn(1).num_timesteps == 160


@pytest.mark.parametrize("algorithm", [Local, FedRL])
def test_another_number_of_copies(algorithm, tmp_path):
    model = make(algorithm, normalize=True)
    path = saved(model, tmp_path)
    model.save(path)
    loaded = algorithm.load(path, env=FederatedVecEnv("Bandit2D", n_envs_per_client=2))
    assert loaded.learn(1).num_timesteps == 160 and loaded.n_envs == 8
    np.testing.assert_array_equal(loaded.normalizer.obs.count.shape, model.normalizer.obs.count.shape)
    for bad, message in ((3, "n_envs_per_client=3 must divide rollout_size=40"),):
        with pytest.raises(ValueError, match=message):
            algorithm.load(path, env=FederatedVecEnv("Bandit2D", n_envs_per_client=bad))
    with pytest.raises(ValueError, match=r"set_env\(\) keeps the number .*: 1, not 2; .*load"):
        model.set_env(FederatedVecEnv("Bandit2D", n_envs_per_client=2))
    again = algorithm.load(path, env="Bandit2D", n_envs_per_client=4)
    assert again.learn(1).num_timesteps == 160 and again.n_envs == 16


def test_replay_of_other_clients_is_refused(tmp_path):
    model = make(FedRL, clients=[0, 1])
    model.learn(80)
    model.save_replay_buffer(tmp_path / "replay")
    copies = make(FedRL, clients=[0, 1], n_envs_per_client=2)
    copies.load_replay_buffer(tmp_path / "replay.pkl")
    copies.learn(80)
    other = make(FedRL, clients=[1, 0])
    with pytest.raises(ValueError, match=r"clients \[0, 1\], not of \[1, 0\]"):
        other.load_replay_buffer(tmp_path / "replay.pkl")
    assert other.learn(80).replay_buffer.client_ids == [1, 0]


def test_settings_that_a_vec_env_contradicts_are_refused():
    env = FederatedVecEnv("Bandit2D", clients=[0, 1])
    for name, value in {"clients": [1, 0], "n_envs_per_client": 2, "num_threads": 2}.items():
        with pytest.raises(ValueError, match=f"{name}=.* does not fit the FederatedVecEnv"):
            make(env=env, **{name: value})
    assert make(env=env, clients=[0, 1]).n_clients == 2


def _step(env) -> None:
    env.step(np.zeros((16, *env.action_space.shape)))
    env.close()


def test_a_fork_has_threads_of_its_own():
    env = FederatedVecEnv("Reacher", n_envs_per_client=2, num_threads=2)
    env.reset()
    env.step(np.zeros((16, 2)))
    assert env._pool is not None
    child = multiprocessing.get_context("fork").Process(target=_step, args=(env,))
    child.start()
    child.join(20)
    hung, _ = child.is_alive(), child.kill()
    child.join()
    assert not hung and child.exitcode == 0


def test_an_archive_of_another_version_is_one_message(point_envs, small, tmp_path, monkeypatch):
    gone = ModuleType("sb3_fedguide.gone")
    gone.Thing = type("Thing", (), {"__module__": gone.__name__})
    monkeypatch.setitem(sys.modules, gone.__name__, gone)
    model = Local("MlpPolicy", point_envs(2), **small)
    model.thing = gone.Thing()
    model.save(tmp_path / "model.zip")
    monkeypatch.delitem(sys.modules, gone.__name__)
    with pytest.raises(ValueError, match=r"another version .* module sb3_fedguide\.gone; .* import_parameters"):
        Local.load(tmp_path / "model.zip")
