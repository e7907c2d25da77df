"""``fedguide evaluate``: the figures of a run come out again, and wrong input says what is wrong."""

from __future__ import annotations

import json

import numpy as np
import pytest

from fed_envs import FederatedVecEnv
from fed_envs.point_maze import PointMazeEnv
from sb3_fedguide.cli.main import main
from sb3_fedguide.common.evaluation import evaluate_federation

SMALL = ["--rounds", "2", "--eval-episodes", "2", "--verbose", "0", "-params", "rollout_size:100", "n_envs_per_client:2",
         "bc_weight:0", "batch_size:50"]  # fmt: skip


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """FedAvg to its last average, and with the hand-over after half of the run that its tuned settings have."""
    folder = tmp_path_factory.mktemp("logs")
    for algo, more in (("local", []), ("fedavg", ["mix:1.0"]), ("fedavg", [])):
        assert main(["train", "--algo", algo, "--env", "Reacher", "-f", str(folder), *SMALL, *more]) == 0
    return {
        "local": folder / "local" / "Reacher_1", "fedavg": folder / "fedavg" / "Reacher_1",
        "handed over": folder / "fedavg" / "Reacher_2",
    }  # fmt: skip


def evaluated(run, *flags, output):
    assert main(["evaluate", str(run), "--episodes", "2", "-o", str(output), *flags]) == 0
    return json.loads(output.read_text())["policies"]


@pytest.mark.parametrize("algo", ["local", "fedavg", "handed over"])
def test_the_last_evaluation_of_the_run_comes_out_again(runs, algo, tmp_path):
    summary = json.loads((runs[algo] / "summary.json").read_text())
    policies = evaluated(runs[algo], output=tmp_path / "result.json")
    assert set(policies) == ({"deployed", "broadcast"} if algo == "fedavg" else {"deployed"})
    for name, values in policies.items():
        np.testing.assert_array_equal(values["client_returns"], summary[name]["client_returns"])
        assert np.shape(values["returns"]) == (8, 2)


def test_other_episodes_and_sampled_actions_give_other_returns(runs, tmp_path):
    default, other, sampled, again = (
        evaluated(runs["local"], *flags, output=tmp_path / "result.json")["deployed"]["returns"]
        for flags in ((), ("--seed", "1"), ("--stochastic",), ("--stochastic",))
    )
    assert default != other and default != sampled
    assert sampled == again


def test_pictures_of_every_client(tmp_path):
    assert main(["train", "--algo", "local", "--env", "Bandit2D", "-f", str(tmp_path), *SMALL]) == 0  # draws without OpenGL
    evaluated(tmp_path / "local" / "Bandit2D_1", "--video", str(tmp_path / "video"), output=tmp_path / "result.json")
    pictures = sorted((tmp_path / "video").iterdir())
    assert len(pictures) == 4
    assert all(picture.read_bytes().startswith(b"GIF8") for picture in pictures)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["{folder}/nothing"], "it has no summary.json"),
        (["{run}", "--episodes", "0"], "--episodes must be at least 1"),
        (["{run}", "--policy", "broadcast"], "no broadcast policy"),
        (["{run}", "-o", "{folder}/missing/result.json"], "there is no folder"),
        (["{damaged}"], "parameters.npz is damaged"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(runs, flags, message, tmp_path, capsys):
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    for name in ("summary.json", "metadata.json", "config.yml"):
        (damaged / name).write_bytes((runs["local"] / name).read_bytes())
    (damaged / "parameters.npz").write_bytes(b"PK nothing")
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", *(flag.format(folder=tmp_path, run=runs["local"], damaged=damaged) for flag in flags)])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert message in error and len(error.splitlines()) == 1


def test_a_video_without_display_or_driver_is_one_message(runs, tmp_path, monkeypatch, capsys):
    for variable in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", str(runs["local"]), "--video", str(tmp_path / "video")])
    assert stop.value.code == 2 and "MUJOCO_GL=osmesa" in capsys.readouterr().err
    assert not (tmp_path / "video").exists()


def test_success_rates_are_evaluated_beside_returns():
    env = FederatedVecEnv("PointMaze", n_envs_per_client=3, clients=[0, 5])
    controllers = [PointMazeEnv.scripted_policy(env.family, client) for client in (0, 5)]
    rng = np.random.default_rng(0)

    def control(obs):
        halves = np.split(obs, 2)
        return np.concatenate([act(half, rng) for act, half in zip(controllers, halves, strict=True)])

    reached = evaluate_federation(control, env)
    assert reached.successes.shape == (2, 3)
    np.testing.assert_array_equal(reached.success_rates, [1.0, 1.0])
    idle = evaluate_federation(lambda obs: np.zeros((6, 2), dtype=np.float32), env)
    assert idle.success_rates.mean() < 1.0
    assert evaluate_federation(lambda obs: np.zeros((8, 2)), FederatedVecEnv("Reacher")).success_rates is None
