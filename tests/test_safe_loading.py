"""Loading never executes code: parameters as plain arrays, and crafted files in every place from which something is read."""

from __future__ import annotations

import ast
import base64
import copy
import io
import json
import pickle
import zipfile
from pathlib import Path

import minari
import numpy as np
import pytest
import torch as th

import fed_envs
import sb3_fedguide
from sb3_fedguide import FedAvg, FedGuide, FedRL, Local
from sb3_fedguide.cli.main import main
from sb3_fedguide.offline.behavior import BehaviorPolicy
from sb3_fedguide.offline.cache import cached_arrays
from sb3_fedguide.offline.datasets import client_datasets
from sb3_fedguide.offline.minari_io import check_spaces, find_dataset, read_minari
from sb3_fedguide.registry import ALGORITHMS, algorithm
from sb3_fedguide.state.array_files import load_arrays, read_arrays, write_arrays
from tests.conftest import others_slow
from tests.crafted_files import Payload, crafted_npz

OFFLINE = {"dataset_size": 60, "bc_updates": 2, "dice_updates": 2, "prior_updates": 2, "dice_width": 16, "prior_width": 8}
SMALL = {"rollout_size": 50, "batch_size": 25, "pretraining": OFFLINE, "policy_kwargs": {"net_arch": [8]}, "normalize": True}


def made(cls, seed: int = 0, env="Bandit2D", **settings):
    own = {"learning_starts": 10} if issubclass(cls, FedRL) else {"bc_weight": 0.3, "n_epochs": 1}
    return cls("MlpPolicy", env, seed=seed, **copy.deepcopy({**SMALL, **own, **settings}))  # DDPG adds to policy_kwargs


def observations(model, batch: int = 3) -> np.ndarray:
    rng = np.random.default_rng(1)
    return rng.standard_normal((model.n_clients * batch, *model.observation_space.shape)).astype(np.float32)


def assert_same_arrays(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    assert one.keys() == other.keys()
    for name, array in one.items():
        np.testing.assert_array_equal(array, other[name], err_msg=name)


def assert_same_actions(one, other) -> None:
    obs = observations(one)
    for deterministic in (True, False):
        th.manual_seed(0)
        expected = one.predict(obs, deterministic=deterministic)[0]
        th.manual_seed(0)
        np.testing.assert_array_equal(other.predict(obs, deterministic=deterministic)[0], expected)
    client = one.client_ids[-1]
    one_client, other_client = one.client(client), other.client(client)
    np.testing.assert_array_equal(
        other_client.predict(obs[:2], deterministic=True)[0], one_client.predict(obs[:2], deterministic=True)[0]
    )


BEFORE_AND_AFTER = [(algo, env) for algo in ALGORITHMS for env in ("Bandit2D", "Reacher")]


@pytest.mark.parametrize(
    ("algo", "env"), others_slow(BEFORE_AND_AFTER, lambda algo, env: env == "Bandit2D" or algo in ("local", "fedguide"))
)
def test_actions_after_import_are_those_before_export(algo, env, tmp_path):
    trained = made(algorithm(algo), env=env)
    trained.learn(2 * 50 * trained.n_clients)
    trained.export_parameters(tmp_path / "parameters.npz")
    fresh = made(algorithm(algo), seed=7, env=env)
    obs = observations(trained)
    assert not np.array_equal(fresh.predict(obs, deterministic=True)[0], trained.predict(obs, deterministic=True)[0])
    fresh.import_parameters(tmp_path / "parameters.npz")
    assert_same_actions(trained, fresh)
    assert_same_arrays(trained.parameter_arrays(), fresh.parameter_arrays())


def test_the_offline_stage_comes_along_and_training_goes_on_without_it(tmp_path, monkeypatch):
    settings = {"adapt": "advantage", "calibrate": True, "n_experts": 3}
    trained = made(FedGuide, **settings)
    trained.learn(2 * 50 * 4)
    trained.export_parameters(tmp_path / "parameters.npz")
    header = json.loads(str(read_arrays(tmp_path / "parameters.npz")["header"]))
    assert header["parts"] == ["prior", "adaptation", "dice", "experts", "calibration"]
    fresh = made(FedGuide, seed=7, **settings)
    fresh.import_parameters(tmp_path / "parameters.npz")
    points = th.as_tensor(np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32))
    for one, other in zip(trained.experts[1], fresh.experts[1], strict=True):
        expected = trained.prior.log_prob(one, th.zeros(5, 2), points)
        assert th.equal(fresh.prior.log_prob(other, th.zeros(5, 2), points), expected)
    np.testing.assert_array_equal(fresh._dice_values(2, np.zeros((4, 2))), trained._dice_values(2, np.zeros((4, 2))))
    before = fresh.parameter_arrays()
    monkeypatch.setattr("sb3_fedguide.common.warm_start.Pretraining", None)  # anything made again would fail now
    fresh.learn(50 * 4)
    changed = {name for name, array in fresh.parameter_arrays().items() if not np.array_equal(array, before[name])}
    assert {"policy/action_net.weight", "prior/heads", "prior/experts"} <= changed
    assert not any(name.startswith(("dice/", "prior/gram")) for name in changed)


def test_a_model_that_was_not_trained_is_exported_too(tmp_path):
    new = made(FedGuide)
    new.export_parameters(tmp_path / "parameters.npz")
    other = made(FedGuide, seed=7)
    other.learn(50 * 4)
    other.import_parameters(tmp_path / "parameters.npz")
    assert_same_actions(new, other)
    assert not other.pretrained and np.isnan(other.experts).all()


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("exported")
    found = {}
    for name, cls in (("local", Local), ("fedguide", FedGuide)):
        model = made(cls)
        model.learn(50 * 4)
        found[name] = folder / f"{name}.npz"
        model.export_parameters(found[name])
    return found


RELU = {"policy_kwargs": {"net_arch": [8], "activation_fn": th.nn.ReLU}}
DIFFERENT = {
    "activation is 'Tanh' in the file and 'ReLU' here": ("local", Local, RELU),
    "policy/mlp_extractor.policy_net.0.weight is float32 (4, 8, 2) instead of float32 (4, 9, 2)":
        ("local", Local, {"policy_kwargs": {"net_arch": [9]}}),
    "policy/mlp_extractor.policy_net.2.weight is missing": ("local", Local, {"policy_kwargs": {"net_arch": [8, 8]}}),
    "normalize is True in the file and False here": ("local", Local, {"normalize": False}),
    "clients is [0, 1, 2, 3] in the file and [0, 2] here": ("local", Local, {"clients": [0, 2]}),
    "action_low is ['-1.5', '-1.5'] in the file and ['-1.0', '-1.0'] here": ("local", Local, {"env": "Reacher"}),
    "policy is 'StackedMlpPolicy' in the file and 'StackedDDPGPolicy' here": ("local", FedRL, {}),
    "the file holds dice, experts, prior, which this method does not have with its settings": ("fedguide", Local, {}),
    "dice/net.bias_0 is float32 (4, 1, 16) instead of float32 (4, 1, 17)":
        ("fedguide", FedGuide, {"pretraining": {**OFFLINE, "dice_width": 17}}),
    "prior/experts is float32 (4, 4, 2, 3) instead of float32 (4, 5, 2, 3)": ("fedguide", FedGuide, {"n_experts": 5}),
    "the file holds no adaptation, which this model": ("fedguide", FedGuide, {"adapt": "advantage"}),
    "is missing; dice/": ("local-pretrained", FedGuide, {}),
}  # fmt: skip


@pytest.mark.parametrize("message", DIFFERENT)
def test_a_file_of_another_federation_is_refused_with_what_differs(message, exported, tmp_path):
    file, cls, settings = DIFFERENT[message]
    path = exported["local" if file == "local-pretrained" else file]
    if file == "local-pretrained":  # a header that promises what is not there
        path = changed(exported["local"], tmp_path, header={"parts": ["prior", "dice"]})
    model = made(cls, seed=7, **settings)
    before = model.parameter_arrays()
    with pytest.raises(ValueError, match="does not fit this") as refusal:
        model.import_parameters(path)
    assert message in str(refusal.value)
    assert_same_arrays(model.parameter_arrays(), before)
    assert not model.pretrained


def changed(path: Path, folder: Path, header: dict | None = None, arrays: dict | None = None) -> Path:
    """A copy of a file with some of its content replaced, and the right checksum again."""
    content = read_arrays(path)
    content["header"] = np.array(json.dumps({**json.loads(str(content["header"])), **(header or {})}))
    content |= arrays or {}
    write_arrays(folder / "changed.npz", {name: array for name, array in content.items() if array is not None})
    return folder / "changed.npz"


@pytest.mark.parametrize(
    ("header", "arrays", "message"),
    [
        ({"format": "another"}, {}, "its header is missing or different"),
        ({"version": 2}, {}, "has version 2 of the format; this program reads version 1"),
        ({"parts": "prior"}, {}, "does not say which parts"),
        ({"pretrained": 1}, {}, "does not say which parts"),
        ({"clients": None}, {}, "clients is None in the file"),
        ({}, {"header": None}, "its header is missing"),
        ({}, {"header": np.array("[" * 100_000)}, "its header is missing"),
        ({}, {"header": np.zeros(3)}, "its header is missing"),
        ({}, {"policy/log_std": None}, "policy/log_std is missing"),
        ({}, {"policy/more": np.zeros(1)}, "policy/more is not known"),
        ({}, {"policy/log_std": np.zeros((4, 2))}, "policy/log_std is float64 (4, 2) instead of float32 (4, 2)"),
        ({}, {"policy/log_std": np.full((4, 2), np.nan, np.float32)}, "policy/log_std has non-finite entries"),
        ({}, {"normalizer/obs.mean": np.full((4, 2), np.inf)}, "normalizer/obs.mean has non-finite entries"),
        ({}, {"normalizer/ret.var": -np.ones(4)}, "normalizer/ret.var has negative entries"),
    ],
)
def test_a_file_that_lies_is_refused_and_changes_nothing(header, arrays, message, exported, tmp_path):
    model = made(Local, seed=7)
    before = model.parameter_arrays()
    path = changed(exported["local"], tmp_path, header, arrays)
    with pytest.raises(ValueError) as refusal:
        model.import_parameters(path)
    assert message in str(refusal.value) and "changed.npz" in str(refusal.value)
    assert_same_arrays(model.parameter_arrays(), before)


def test_damaged_and_absent_files_are_refused(exported, tmp_path):
    model = made(Local)
    content = exported["local"].read_bytes()
    for number in range(0, len(content), len(content) // 40):  # a changed byte anywhere
        damaged = bytearray(content)
        damaged[number] ^= 0xFF
        (tmp_path / "damaged.npz").write_bytes(bytes(damaged))
        try:
            model.import_parameters(tmp_path / "damaged.npz")
        except ValueError:
            continue
        assert_same_arrays(model.parameter_arrays(), read_without_header(exported["local"]))  # it was in nothing that is read
    for length in (0, 1, len(content) // 2, len(content) - 1):
        (tmp_path / "damaged.npz").write_bytes(content[:length])
        with pytest.raises(ValueError, match=r"damaged\.npz is damaged"):
            model.import_parameters(tmp_path / "damaged.npz")
    with pytest.raises(ValueError, match="there is no parameter file"):
        model.import_parameters(tmp_path / "absent.npz")
    with pytest.raises(ValueError, match="cannot be read: Is a directory"):
        model.import_parameters(tmp_path)


def read_without_header(path: Path) -> dict[str, np.ndarray]:
    return {name: array for name, array in read_arrays(path).items() if name != "header"}


def test_a_small_file_cannot_take_much_memory(tmp_path):
    np.savez_compressed(tmp_path / "bomb.npz", a=np.zeros(10_000_000))
    assert (tmp_path / "bomb.npz").stat().st_size < 100_000
    with pytest.raises(ValueError, match=r"'a\.npy' in it is compressed"):
        read_arrays(tmp_path / "bomb.npz")
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**14,)})
    with zipfile.ZipFile(tmp_path / "lie.npz", "w") as archive:  # says that it is large, and is not
        archive.writestr("a.npy", header.getvalue() + bytes(80))
    with pytest.raises(ValueError, match="is damaged"):
        read_arrays(tmp_path / "lie.npz")


READERS = {
    "arrays": load_arrays,
    "checked arrays": read_arrays,
    "behaviour policy": BehaviorPolicy.load,
    "parameters": lambda path: made(Local).import_parameters(path),
}


@pytest.mark.parametrize("reader", READERS)
def test_a_pickle_in_an_array_file_is_not_executed(reader, tmp_path):
    executed, path = tmp_path / "executed", tmp_path / "crafted.npz"
    crafted_npz(path, executed)
    np.load(path, allow_pickle=True)["payload"]  # it would work
    assert executed.exists()
    executed.unlink()
    with pytest.raises(ValueError, match="allow_pickle=False"):
        READERS[reader](path)
    path.write_bytes(pickle.dumps(Payload(executed)))  # NumPy takes a file that is neither npy nor npz for a pickle
    with pytest.raises(ValueError, match="crafted"):
        READERS[reader](path)
    assert not executed.exists()


def test_a_pickle_in_the_cache_is_not_executed(tmp_path):
    executed = tmp_path / "executed"
    (data,) = client_datasets("Bandit2D", 40, 0, tmp_path / "cache", clients=[1])
    (rows,) = (tmp_path / "cache").rglob("rows.npz")
    crafted_npz(rows, executed, **data.arrays())
    (again,) = client_datasets("Bandit2D", 40, 0, tmp_path / "cache", clients=[1])
    assert_same_arrays(again.arrays(), data.arrays())
    crafted_npz(tmp_path / "entry.npz", executed)
    assert cached_arrays(tmp_path / "entry.npz") is None
    assert not executed.exists()


@pytest.fixture
def run_folder(tmp_path) -> Path:
    argv = [
        "train",
        "--algo",
        "fedavg",
        "--env",
        "Bandit2D",
        "--rounds",
        "1",
        "--verbose",
        "0",
        "--no-eval",
        "-f",
        str(tmp_path / "logs"),
    ]
    assert main([*argv, "-params", "rollout_size:20", "batch_size:10", "bc_weight:0", "n_envs_per_client:1"]) == 0
    return tmp_path / "logs" / "fedavg" / "Bandit2D_1"


def evaluate(run: Path) -> int:
    try:
        return main(["evaluate", str(run), "--episodes", "1"])
    except SystemExit as stop:
        return int(stop.code or 0)


def test_evaluate_executes_nothing_that_a_run_folder_holds(run_folder, tmp_path, capsys):
    executed = tmp_path / "executed"
    data = {"policy_class": {":type:": "x", ":serialized:": base64.b64encode(pickle.dumps(Payload(executed))).decode()}}
    with zipfile.ZipFile(run_folder / "model.zip", "w") as archive:
        archive.writestr("data", json.dumps(data))
    with pytest.raises(KeyError):
        FedAvg.load(run_folder / "model.zip")  # SB3's archive is unpickled, as the docstring says ...
    assert executed.exists()
    executed.unlink()
    assert evaluate(run_folder) == 0  # ... and not read by this command
    capsys.readouterr()

    for name in ("parameters.npz", "deployed.npz"):
        sound = (run_folder / name).read_bytes()
        crafted_npz(run_folder / name, executed)
        assert evaluate(run_folder) == 2
        assert f"{name} is damaged" in capsys.readouterr().err
        np.savez(run_folder / name, another=np.zeros(3))
        assert evaluate(run_folder) == 2
        assert name in capsys.readouterr().err
        (run_folder / name).write_bytes(sound)
    config = run_folder / "config.yml"
    config.write_text(config.read_text() + f"seed: !!python/object/apply:os.mkdir ['{executed}']\n")
    assert evaluate(run_folder) == 2
    assert "config.yml is not valid YAML: could not determine a constructor" in capsys.readouterr().err
    assert not executed.exists()


def test_runs_of_earlier_versions_name_the_way(run_folder, capsys):
    (run_folder / "parameters.npz").unlink()
    assert evaluate(run_folder) == 2
    message = capsys.readouterr().err
    assert "it has no parameters.npz; if you trust it" in message
    FedAvg.load(run_folder / "model.zip", env="Bandit2D").export_parameters(run_folder / "parameters.npz")  # as it says
    assert evaluate(run_folder) == 0


def test_the_environment_that_a_dataset_names_is_not_made(tmp_path, monkeypatch):
    executed = tmp_path / "executed"
    client_datasets("Bandit2D", 40, 0, tmp_path / "cache", clients=[0])
    (metadata,) = (tmp_path / "cache").rglob("metadata.json")
    content = json.loads(metadata.read_text())
    space = content.pop("observation_space")
    spec = {
        "id": "Crafted-v0", "entry_point": "os:mkdir", "kwargs": {"path": str(executed)}, "additional_wrappers": [],
        "disable_env_checker": True, "max_episode_steps": None,
    }  # fmt: skip
    content["env_spec"] = json.dumps(spec)
    metadata.write_text(json.dumps(content))
    with pytest.raises(Exception):  # noqa: B017 (what os.mkdir returns is no environment)
        minari.MinariDataset(metadata.parent)
    assert executed.exists()  # Minari itself would
    executed.rmdir()
    client = fed_envs.load_family("Bandit2D").make(0)
    for read in (read_minari, lambda path: check_spaces(path, client.observation_space, client.action_space)):
        with pytest.raises(ValueError, match="its metadata have no 'observation_space'"):
            read(find_dataset(str(metadata.parent)))
    metadata.write_text(json.dumps({**content, "observation_space": space}))
    assert len(read_minari(metadata.parent)) == 40
    assert not executed.exists()


#: Reads what another process of the same run sent it, over a pipe or Ray's cluster, and no file.
BETWEEN_PROCESSES = Path("engines") / "worker.py"


def test_no_module_unpickles():
    """Calls and keywords that would: this list is what a new reader has to get past."""
    for package in (fed_envs, sb3_fedguide):
        folder = Path(package.__file__).parent
        for path in folder.rglob("*.py"):
            if path.relative_to(folder) == BETWEEN_PROCESSES:
                continue
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Import | ast.ImportFrom):
                    names = {alias.name for alias in node.names} | {getattr(node, "module", None)}
                    assert not names & {"pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}, path
                if isinstance(node, ast.Call):
                    called = ast.unparse(node.func)
                    given = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
                    assert given.get("allow_pickle", "False") == "False", path
                    assert called not in ("eval", "exec", "pickle.load", "yaml.unsafe_load", "yaml.full_load"), path
                    assert called != "np.load" or "allow_pickle" in given, path
                    assert called not in ("th.load", "torch.load") or given.get("weights_only") == "True", path
