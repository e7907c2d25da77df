"""The documented example of an algorithm of one's own works as the page says."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import fed_envs
from fed_envs import FederatedVecEnv
from fed_envs.metadata import parse_family
from sb3_fedguide.cli.evaluate import main as evaluate
from sb3_fedguide.cli.train import main
from sb3_fedguide.registry import ALGORITHMS, register_algorithm
from tests import forked

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "docs" / "examples"
SMALL = ["--rounds", "2", "-params", "rollout_size:60", "batch_size:20", "n_envs_per_client:2", "bc_weight:0"]
WINDS = np.array([[0.05, 0.0], [0.0, 0.05], [-0.05, 0.0]])


@pytest.fixture
def registries():
    """What the example registers is forgotten again."""
    from fed_envs import clients, registration

    kept = registration.FAMILIES, registration.ENTRY_POINTS, clients.CLIENT_MODELS, clients.BACKBONES
    before = [dict(registry) for registry in kept]
    yield
    for registry, content in zip(kept, before, strict=True):
        registry.clear()
        registry.update(content)


@pytest.mark.parametrize("name", ["half_averaging", "wind_world"])
def test_the_page_shows_the_file(name):
    code = (EXAMPLES / f"{name}.py").read_text().split("\n\n", 2)[2]
    assert code.strip() in (ROOT / "docs" / "extending.md").read_text()


def test_the_example_trains_from_the_command_line(tmp_path):
    argv = ["--gym-packages", "half_averaging", "--algo", "half-averaging", "--env", "Bandit2D", "-f", str(tmp_path), *SMALL]
    result = forked.train(argv, [EXAMPLES])
    assert result.returncode == 0, result.stderr
    summary = json.loads((tmp_path / "half-averaging" / "Bandit2D_1" / "summary.json").read_text())
    assert summary["rounds_done"] == 2 and summary["bytes_up"] > 0


def test_the_example_does_what_it_says(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    from half_averaging import HalfAveraging

    model = HalfAveraging("MlpPolicy", "Bandit2D", rollout_size=20, batch_size=10, seed=0)
    before = model.policy.client_state_dict(1)
    average = {name: np.full_like(tensor.numpy(), 2.0) for name, tensor in before.items()}
    model.receive(1, average)
    for name, tensor in model.policy.client_state_dict(1).items():
        np.testing.assert_allclose(tensor.numpy(), 0.5 * before[name].numpy() + 1.0, rtol=1e-6)
    del ALGORITHMS["half-averaging"]


def test_a_taken_name_is_refused():
    with pytest.raises(ValueError, match="taken"):
        register_algorithm("fedavg", "somewhere:Else")
    with pytest.raises(ValueError, match="module:Class"):
        register_algorithm("mine", "somewhere")
    register_algorithm("fedavg", "sb3_fedguide.algorithms.fedavg:FedAvg")  # the same again is no mistake


def test_a_missing_module_is_one_message(capsys, tmp_path):
    assert main(["--gym-packages", "no_such_module", "--env", "Bandit2D", "-f", str(tmp_path / "logs")]) == 2
    assert "--gym-packages no_such_module" in capsys.readouterr().err
    assert not (tmp_path / "logs").exists()


def test_the_example_world_keeps_the_contracts(monkeypatch, registries):
    monkeypatch.syspath_prepend(EXAMPLES)
    env = gymnasium.make("wind_world:fed_envs/Wind-v0", client=2)
    check_env(env.unwrapped, skip_render_check=True)
    assert env.unwrapped.client.wind == (-0.05, 0.0)
    clients = FederatedVecEnv("Wind", n_envs_per_client=2)
    assert clients.n_clients == 3
    clients.seed(0)
    first = clients.reset()
    pickled = pickle.loads(pickle.dumps(clients))
    actions = np.full((6, 2), 0.3, dtype=np.float32)
    for one, other in zip(clients.step(actions)[:2], pickled.step(actions)[:2], strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(clients.step(actions)[0] - first, 2 * (0.03 + np.repeat(WINDS, 2, axis=0)), atol=1e-6)
    with pytest.raises(ValueError, match=r"client 0 .*wind"):
        parse_family({**json.loads((EXAMPLES / "Wind.json").read_text()), "clients": [{"client": 0, "wind": "north"}]}, "file")


def test_fedguide_trains_in_the_example_world(tmp_path, capsys):
    argv = ["--gym-packages", "wind_world", "--env", "Wind", "-f", str(tmp_path)]
    argv += [*SMALL[:-1], "pretraining.dataset_size:200", "pretraining.bc_updates:5", "pretraining.prior_updates:5"]
    result = forked.train([*argv, "pretraining.dice_updates:5", "prior_states:20"], [EXAMPLES])
    assert result.returncode == 0, result.stderr
    summary = json.loads((tmp_path / "fedguide" / "Wind_1" / "summary.json").read_text())
    assert summary["n_clients"] == 3 and summary["rounds_done"] == 2
    with pytest.raises(SystemExit):
        evaluate([str(tmp_path / "fedguide" / "Wind_1")])
    error = capsys.readouterr().err
    assert "must be one of" in error and "trained with --gym-packages wind_world: give it here as well" in error


def test_taken_names_of_worlds_and_families_are_refused(tmp_path):
    with pytest.raises(ValueError, match="taken"):
        fed_envs.register_world("reacher", "somewhere:Else", fed_envs.Client, ("Reacher-v5",))
    fed_envs.load_family("Reacher").dump(tmp_path / "other.json")
    with pytest.raises(ValueError, match="registered already"):
        fed_envs.register_family(tmp_path / "other.json")
