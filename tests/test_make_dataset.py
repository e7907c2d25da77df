"""Minari datasets from arrays and logs, FedGuide on the user's own environments, and what is said where data are missing."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import minari
import numpy as np
import pytest

from sb3_fedguide import FedAvg, FedGuide
from sb3_fedguide.cli.main import main as fedguide
from sb3_fedguide.cli.train import main as train
from sb3_fedguide.offline.make_dataset import make_dataset, read_log
from sb3_fedguide.offline.minari_io import find_dataset, read_minari
from tests import forked
from tests.environments import ACTIONS, pendulum_log

ROOT = Path(__file__).parents[1]


@pytest.fixture(autouse=True)
def datasets(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


def write_csv(path: Path, log: dict[str, np.ndarray]) -> None:
    columns = ["angle_x", "angle_y", "speed", "torque", "reward", "terminated", "episode"]
    flags = [log["terminations"].astype(float), np.cumsum(np.r_[0, log["truncations"][:-1]])]
    table = np.column_stack([log["observations"], log["actions"], log["rewards"], *flags])
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")


def test_arrays_become_a_dataset_that_minari_reads(datasets):
    log = pendulum_log(0)
    folder = make_dataset("robots/arm0-v0", **log, action_space=ACTIONS)
    assert folder == datasets / "robots" / "arm0-v0"
    data = read_minari(find_dataset("robots/arm0-v0"))
    for name in ("observations", "actions", "rewards", "next_observations", "terminations"):
        np.testing.assert_array_equal(getattr(data, name), log[name])
    theirs = minari.load_dataset("robots/arm0-v0")
    assert theirs.total_episodes == 3 and theirs.total_steps == 90 and theirs.action_space == ACTIONS
    with pytest.raises(ValueError, match="there is a dataset robots/arm0-v0 already"):
        make_dataset("robots/arm0-v0", **log, action_space=ACTIONS)
    make_dataset("robots/arm0-v0", **{name: values[:40] for name, values in log.items()}, action_space=ACTIONS, overwrite=True)
    assert len(read_minari(find_dataset("robots/arm0-v0"))) == 40


def test_without_next_observations_the_last_row_of_a_cut_episode_is_left_out(tmp_path):
    log = pendulum_log(1, 30)
    following = log.pop("next_observations")
    data = read_minari(make_dataset(tmp_path / "here", **log, action_space=ACTIONS) / "data")
    keep = ~np.isin(np.arange(30), (19, 29))  # of the two that were cut off
    np.testing.assert_array_equal(data.observations, log["observations"][keep])
    ended = data.terminations
    assert np.flatnonzero(ended).tolist() == [9]
    np.testing.assert_array_equal(data.next_observations[~ended], following[keep][~ended])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rewards": np.ones(89)}, "same number of rows"),
        ({"actions": np.full((90, 1), 3.0)}, r"90 actions lie outside .* the first in row 0: \[3.\]"),
        ({"observations": np.full((90, 3), np.nan)}, "observations has non-finite entries"),
        ({"action_space": gym.spaces.Discrete(2)}, "do not fit the client's action space"),
        ({"terminations": np.full(90, 0.5)}, "90 values true or false"),
        ({"dataset": "no id"}, "is no id of a Minari dataset such as"),
        ({"rewards": np.ones((90, 2))}, "rewards must be one number a row"),
    ],
)
def test_arrays_that_do_not_fit_are_refused_and_nothing_is_written(change, message, datasets):
    with pytest.raises(ValueError, match=message):
        make_dataset(**{"dataset": "robots/arm0-v0", **pendulum_log(0), "action_space": ACTIONS, **change})
    assert not list(datasets.rglob("*.hdf5"))


def test_the_command_makes_one_from_logs_and_fedguide_trains_with_it(tmp_path, capsys):
    names = ["--observations", "angle_x", "angle_y", "speed", "--actions", "torque"]
    write_csv(tmp_path / "arm0.csv", pendulum_log(0))
    log = pendulum_log(5)
    np.savez(tmp_path / "arm1.npz", **log)
    assert fedguide(["dataset", "robots/arm0-v0", str(tmp_path / "arm0.csv"), "--env", "Pendulum-v1", *names]) == 0
    bounds = ["--action-low", "-2", "--action-high", "2"]
    assert fedguide(["dataset", "robots/arm1-v0", str(tmp_path / "arm1.npz"), *bounds]) == 0
    assert "train with --dataset robots/arm1-v0" in capsys.readouterr().out
    assert len(read_minari(find_dataset("robots/arm0-v0"))) == 88
    stage = {"bc_updates": 2, "dice_updates": 2, "prior_updates": 2, "prior_width": 8, "dice_width": 8}
    model = FedGuide(
        "MlpPolicy",
        [lambda: gym.make("Pendulum-v1"), lambda: gym.make("Pendulum-v1", g=5.0)],
        pretraining={"dataset": "robots/arm{client}-v0", **stage},
        rollout_size=40, batch_size=20, prior_states=10, bc_weight=0.5, seed=0,
    )  # fmt: skip
    model.learn(160)
    assert model.round == 2 and model.pretrained


def test_logs_that_do_not_fit_name_file_and_column(tmp_path, capsys):
    (tmp_path / "a.csv").write_text("obs_0,act_0,reward\n1,0.5,x\n")
    (tmp_path / "b.csv").write_text("obs_0,act_0\n1,0.5\n")
    (tmp_path / "c.csv").write_text("obs_0,act_0,reward,terminated\n1,0.5,1,false\n2,0.5,2,TRUE\n")
    for name, more, message in (
        ("a.csv", [], r"a.csv: row 1, column 'reward': 'x' is no number"),
        ("b.csv", [], r"b.csv has no rewards (rewards or reward); it has obs_0, act_0: name them with --rewards"),
        ("b.csv", ["--rewards", "r"], "b.csv has no column 'r'; it has obs_0, act_0"),
        ("nowhere.npz", [], "there is no file"),
    ):
        with pytest.raises(SystemExit):
            fedguide(["dataset", "x-v0", str(tmp_path / name), "--action-low", "-1", "--action-high", "1", *more])
        error = capsys.readouterr().err
        assert message in error and len(error.splitlines()) == 1
    with pytest.raises(SystemExit):
        fedguide(["dataset", "x-v0", str(tmp_path / "c.csv")])
    assert "give the client's action space: --env ID, or --action-low" in capsys.readouterr().err
    log = read_log([tmp_path / "c.csv", tmp_path / "c.csv"])
    assert log["terminations"].tolist() == [0, 1, 0, 1] and log["truncations"].tolist() == [0, 1, 0, 1]


def test_environments_of_ones_own_without_data_say_what_to_give():
    make = [lambda: gym.make("Pendulum-v1")] * 2
    with pytest.raises(ValueError, match=r"FedGuide begins .* pretraining=\{'dataset': 'robots/arm\{client\}-v0'\} .*fedg"):
        FedGuide("MlpPolicy", make, rollout_size=40, batch_size=20).learn(80)
    with pytest.raises(ValueError, match=r"FedAvg begins with an offline stage: .*with bc_weight=0"):
        FedAvg("MlpPolicy", make, rollout_size=40, batch_size=20, bc_weight=0.3).learn(80)


WORLD = """
from wind_world import WindEnv
WindEnv.scripted_policy = classmethod(lambda cls, family, client: None)
"""


def test_a_world_without_data_is_told_so_before_anything_is_written(tmp_path):
    (tmp_path / "silent_world.py").write_text(WORLD)
    argv = ["--gym-packages", "silent_world", "--env", "Wind", "-f", str(tmp_path / "logs")]
    result = forked.train(argv, [tmp_path, ROOT / "docs" / "examples"])
    assert result.returncode == 2
    (error,) = result.stderr.splitlines()
    assert "no behaviour policy for 'Wind'" in error and "scripted_policy (docs/extending.md)" in error
    assert "--dataset ID_OR_PATH" in error and "train_behavior" not in error
    assert not (tmp_path / "logs").exists()


def test_a_dataset_that_is_missing_is_refused_before_anything_is_written(tmp_path, capsys):
    argv = ["--env", "Bandit2D", "--dataset", "robots/nobody-v0", "-f", str(tmp_path / "logs")]
    assert train(argv) == 2
    assert "no Minari dataset 'robots/nobody-v0'" in capsys.readouterr().err and not (tmp_path / "logs").exists()
