"""Policies out of a federation: as good where this package is not installed, whatever form they are in."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DDPG, PPO

from sb3_fedguide import FedAvg, FedRL, Local
from sb3_fedguide.cli.main import main
from sb3_fedguide.common.export import Normalization, features_extractor
from sb3_fedguide.common.parameters import read_policies
from sb3_fedguide.common.spaces import describe_space, space_from
from sb3_fedguide.deployment.serve import ServerConfig, serve
from sb3_fedguide.deployment.site import PARAMETERS, SITE, Site
from sb3_fedguide.state.array_files import write_arrays
from tests.environments import SPACES, choices
from tests.loop_transport import LoopTransport

DDPG_SETTINGS = {"rollout_size": 40, "learning_starts": 20, "batch_size": 8, "seed": 3}

#: Loads what it finds in its folder, and compares actions with those that the federation took.
ELSEWHERE = """
import json, sys
from pathlib import Path
import numpy as np, torch as th
for name in ("sb3_fedguide", "fed_envs"):
    sys.modules[name] = None  # an import of it fails from now on
import stable_baselines3
th.set_num_threads(1)
for folder in sorted(path for path in Path(sys.argv[1]).iterdir() if path.is_dir()):
    given = np.load(folder / "given.npz")
    obs, actions = th.from_numpy(given["obs"]), given["actions"]
    model = getattr(stable_baselines3, json.loads((folder / "learner.json").read_text())).load(folder / "client.zip")
    found = {"sb3": model.predict(given["obs"], deterministic=True)[0]}
    if (folder / "client.pt").exists():
        found["torchscript"] = th.jit.load(folder / "client.pt")(obs).numpy()
        found["pt2"] = th.export.load(folder / "client.pt2").module()(obs).numpy()
    for name, taken in found.items():
        np.testing.assert_allclose(taken, actions, atol=1e-6, err_msg=f"{folder.name}: {name}")
    model.save(folder / "again.zip")
    again = type(model).load(folder / "again.zip")
    np.testing.assert_array_equal(again.predict(given["obs"], deterministic=True)[0], found["sb3"])
assert not any(name.startswith(("sb3_fedguide.", "fed_envs.")) for name in sys.modules)
"""


def elsewhere(folder) -> None:
    """Run :data:`ELSEWHERE` in a process that cannot import this package."""
    run = subprocess.run(
        [sys.executable, "-c", ELSEWHERE, str(folder)],
        capture_output=True,
        text=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": ""},
    )
    assert run.returncode == 0, run.stderr


#: Forms of a policy; PyTorch's own take seconds to make.
FORMS = [pytest.param(["zip"], id="sb3"), pytest.param(["zip", "pt", "pt2"], id="all", marks=pytest.mark.slow)]


def give_away(model, folder, name: str, forms: list[str]) -> None:
    """Client 1's policy, beside observations and the federation's own actions for them."""
    target = folder / name
    obs = observations(model)
    rows = slice(6, 12)
    write_arrays(target / "given.npz", {"obs": obs[rows], "actions": model.predict(obs, deterministic=True)[0][rows]})
    (target / "learner.json").write_text(json.dumps(type(model.client(1)).__name__))
    for suffix in forms:
        model.export(1, target / f"client.{suffix}")


def observations(model, batch: int = 6) -> np.ndarray:
    rng = np.random.default_rng(1)
    spread = rng.standard_normal((model.n_clients * batch, *model.observation_space.shape)) * 3
    spread[::5] *= 1e3  # far outside of what was seen, where clipping decides
    return spread.astype(np.float32)


@pytest.mark.parametrize("forms", FORMS)
def test_policies_act_the_same_where_this_package_is_not(point_envs, small, tmp_path, forms):
    relu = {"net_arch": {"pi": [8], "vf": [8, 4]}, "activation_fn": th.nn.ReLU}
    local = Local("MlpPolicy", point_envs(2), normalize=True, **small).learn(2 * 2 * 64)
    plain = FedAvg("MlpPolicy", point_envs(2), **{**small, "policy_kwargs": relu}).learn(2 * 64)
    fedrl = FedRL("MlpPolicy", point_envs(2), normalize=True, **DDPG_SETTINGS).learn(2 * 2 * 40)
    discrete = {kind: Local("MlpPolicy", choices(kind), normalize=True, **small).learn(2 * 64) for kind in SPACES}
    for name, model in {"local": local, "plain": plain, "fedrl": fedrl, **discrete}.items():
        give_away(model, tmp_path, name, forms)
    elsewhere(tmp_path)


def test_a_client_trains_further_with_the_federations_settings(point_envs, small, tmp_path):
    settings = {"ent_coef": 0.02, "vf_coef": 0.3, "max_grad_norm": 0.7, "clip_range": 0.1, "normalize_advantage": False}
    model = Local("MlpPolicy", point_envs(2), normalize=True, **settings, **small).learn(2 * 64)
    model.client(1).save(tmp_path / "client")
    loaded = PPO.load(tmp_path / "client", env=point_envs(2)[1]())
    assert {name: getattr(loaded, name) for name in settings if name != "clip_range"} == {
        name: value for name, value in settings.items() if name != "clip_range"
    }
    assert loaded.clip_range(1.0) == 0.1 and loaded.batch_size == 16
    loaded.learn(64)
    fedrl = FedRL("MlpPolicy", point_envs(2), noise_sigma=0.3, **DDPG_SETTINGS)
    assert fedrl.client(0).action_noise._sigma[0] == 0.3


def test_normalisation_far_from_zero_is_exact():
    """In float32, a large mean with a small deviation would leave nothing of the observation."""
    rng = np.random.default_rng(0)
    mean, var = rng.uniform(900, 1000, 5), rng.uniform(1e-4, 1e-3, 5)
    obs = (mean + 3 * np.sqrt(var) * rng.standard_normal((50, 5))).astype(np.float32)
    extractor = features_extractor(spaces.Box(-np.inf, np.inf, (5,)), Normalization.of(mean, var))(spaces.Box(0, 1, (5,)))
    expected = np.clip((obs - mean) / np.sqrt(var + 1e-8), -10, 10).astype(np.float32)
    np.testing.assert_array_equal(extractor(th.as_tensor(obs)).numpy(), expected)


@pytest.mark.slow
def test_onnx(point_envs, small, tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    model = Local("MlpPolicy", point_envs(2), normalize=True, **small).learn(2 * 64)
    obs = observations(model)
    model.export(1, tmp_path / "client.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "client.onnx")
    for n_rows in (1, 6):
        (actions,) = session.run(["actions"], {"observations": obs[6 : 6 + n_rows]})
        np.testing.assert_allclose(actions, model.predict(obs, deterministic=True)[0][6 : 6 + n_rows], atol=1e-6)


def test_unknown_suffixes_and_missing_packages_are_one_sentence(point_envs, small, tmp_path, monkeypatch):
    model = Local("MlpPolicy", point_envs(1), **small)
    with pytest.raises(ValueError, match=r"must be one of \.zip, \.pt2, \.pt, \.onnx"):
        model.export(0, tmp_path / "client.pth")
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ValueError, match=r"onnx is not installed: pip install 'sb3-fedguide\[onnx\]'"):
        model.export(0, tmp_path / "client.onnx")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-np.inf, np.inf, (3,), np.float64),
        spaces.Box(np.array([-1, -np.inf], np.float32), np.array([1, 2.5], np.float32)),
        spaces.Box(0, 255, (4, 5, 3), np.uint8),
        spaces.Discrete(5, start=-2),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary(4),
        spaces.Dict({"b": spaces.Discrete(2), "a": spaces.Dict({"x": spaces.Box(0, 1, (2, 2))})}),
    ],
    ids=str,
)
def test_spaces_as_plain_data(space):
    assert space_from(json.loads(json.dumps(describe_space(space), allow_nan=False))) == space


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    small = ["-params", "rollout_size:100", "n_envs_per_client:2", "bc_weight:0", "batch_size:50"]
    argv = ["--algo", "fedavg", "--env", "Reacher", "--rounds", "2", "--no-eval", "--verbose", "0", "-f", str(folder)]
    assert main(["train", *argv, *small]) == 0
    return folder / "fedavg" / "Reacher_1"


@pytest.mark.parametrize("policy", ["deployed", "broadcast"])
def test_policies_of_a_run(run, policy, tmp_path, capsys):
    model = FedAvg.load(run / "model.zip")  # after the last exchange
    obs = observations(model)
    assert main(["export", str(run), "--policy", policy, "--clients", "3", "1", "-o", str(tmp_path)]) == 0
    assert capsys.readouterr().out == f"wrote {tmp_path / 'client_3.zip'}\nwrote {tmp_path / 'client_1.zip'}\n"
    ours = model.predict(obs, deterministic=True)[0][18:24]
    loaded = PPO.load(tmp_path / "client_3.zip")
    theirs = loaded.predict(obs[18:24], deterministic=True)[0]
    assert np.allclose(theirs, ours, atol=1e-6) == (policy == "broadcast")
    assert loaded.observation_space == model.observation_space and loaded.n_epochs == model.n_epochs


def test_the_policy_of_a_deployed_client(small, tmp_path, capsys):
    """Nothing is known but the client's folder."""
    models = [FedAvg("MlpPolicy", "Bandit2D", clients=[k], normalize=True, **small) for k in range(2)]
    config = ServerConfig("fedavg", 2, 2, 64, 3, models[0].server_settings(), wait=0.0, poll=0.0)
    transport = LoopTransport(lambda k: Site(models[k], 2, tmp_path / str(k) / SITE, eval_freq=None), [0, 1])
    serve(config, transport, tmp_path / "server")
    assert (tmp_path / "1" / SITE / PARAMETERS).is_file()
    assert main(["export", str(tmp_path / "1"), "--format", "sb3", "pt2"]) == 0
    folder = tmp_path / "1" / SITE / "policies"
    obs = observations(models[1])
    ours = models[1].predict(obs, deterministic=True)[0]
    np.testing.assert_allclose(PPO.load(folder / "client_1.zip").predict(obs, deterministic=True)[0], ours, atol=1e-6)
    program = th.export.load(folder / "client_1.pt2").module()
    np.testing.assert_allclose(program(th.as_tensor(obs)).numpy(), ours, atol=1e-6)
    with pytest.raises(SystemExit):
        main(["evaluate", str(tmp_path / "1")])
    assert "'fedguide export' makes" in capsys.readouterr().err


def test_a_file_of_ddpg_policies(point_envs, tmp_path):
    model = FedRL("MlpPolicy", point_envs(2), normalize=True, tau=0.1, **DDPG_SETTINGS).learn(2 * 40)
    model.export_parameters(tmp_path / "parameters.npz")
    policies = read_policies(tmp_path / "parameters.npz")
    obs = observations(model)
    single = policies[1].to_sb3()
    assert type(single) is DDPG and single.tau == 0.1
    np.testing.assert_allclose(single.predict(obs[6:])[0], model.predict(obs)[0][6:], atol=1e-6)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["{folder}/nothing"], "is not a folder of a run or of a deployed client"),
        (["{run}", "--clients", "9"], "there is no client 9"),
        (["{folder}/early"], "a client writes it after the federation's last round"),
        (["{folder}/damaged"], "is damaged"),
        (["{folder}/lies"], "its header does not belong to its arrays"),
        (["{folder}/old"], "is of an earlier version"),
        (["{run}", "--fromat", "sb3"], "--format"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(run, flags, message, tmp_path, capsys):
    from sb3_fedguide.state.array_files import read_arrays

    for name in ("early", "damaged", "lies", "old"):
        (tmp_path / name).mkdir()
    (tmp_path / "early" / "round_000002.npz").touch()
    (tmp_path / "damaged" / PARAMETERS).write_bytes(b"PK nothing")
    for name, change in (("lies", {"activation": "Linear"}), ("old", {"spaces": None})):
        arrays = read_arrays(run / PARAMETERS)
        header = {**json.loads(str(arrays["header"])), **change}
        arrays["header"] = np.array(json.dumps({key: value for key, value in header.items() if value is not None}))
        write_arrays(tmp_path / name / PARAMETERS, arrays)
    with pytest.raises(SystemExit) as stop:
        main(["export", *(flag.format(folder=tmp_path, run=run) for flag in flags)])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert message in error and len(error.splitlines()) == 1
