"""Monitoring: TensorBoard gets what was promised, and training does not notice."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3.common.logger import HumanOutputFormat, Logger
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
from tensorboard.plugins.custom_scalar.layout_pb2 import Layout
from tensorboard.plugins.hparams import metadata

import fed_envs
from fed_envs import FederatedVecEnv, metadata_figures
from fed_envs.generation import generate_family
from fed_envs.metadata_figures import varying_parameters
from sb3_fedguide import FedAvg, FedGuide, FedGuideA, FedRL, Local
from sb3_fedguide.benchmark.bandit2d import Policies
from sb3_fedguide.cli.main import main
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.evaluation import FederatedEvalCallback
from sb3_fedguide.monitoring import pictures
from sb3_fedguide.monitoring.callbacks import TensorBoardCallback
from sb3_fedguide.monitoring.charts import METRICS, flatten
from sb3_fedguide.monitoring.diagnostics import DiagnosticsCallback
from tests.conftest import assert_same_parameters, others_slow, parameters_of

OFFLINE = {"dataset_size": 50, "bc_updates": 2, "dice_updates": 2, "dice_width": 8, "dice_batch_size": 16}


def events(folder: Path) -> list:
    (path,) = folder.rglob("events.out.tfevents.*")
    return [(event.step, value) for event in EventFileLoader(str(path)).Load() for value in event.summary.value]


def test_the_command_fills_every_tab_from_one_file(tmp_path):
    train = ["train", "--env", "Bandit2D", "--rounds", "4", "--eval-episodes", "1", "--verbose", "0"]
    tiny = ["-params", "rollout_size:40", "batch_size:20", *[f"pretraining.{key}:{n}" for key, n in OFFLINE.items()]]
    assert main([*train, "-f", str(tmp_path / "first"), "--picture-freq", "3", *tiny]) == 0
    found = events(tmp_path / "first")
    drawn = {}
    for step, value in found:
        if value.tag.startswith("pictures/"):
            drawn.setdefault(value.tag, []).append(step // (4 * 40))
    assert drawn == {
        "pictures/heterogeneity": [1],
        "pictures/transport_plan": [1, 3, 4],
        "pictures/densities": [1, 3, 4],
    }
    (layout,) = [value.tensor.string_val[0] for _, value in found if value.tag == "custom_scalars__config__"]
    categories = {category.title: category.chart for category in Layout.FromString(layout).category}
    assert list(categories) == ["Returns", "Losses", "Policy", "Prior", "DICE", "OT-MoE", "Costs"]
    patterns = [pattern for charts in categories.values() for chart in charts for pattern in chart.multiline.tag]
    for pattern in patterns:  # TensorBoard matches them at the beginning of a key
        matched = [tag for tag in {value.tag for _, value in found} if re.match(pattern, tag)]
        assert matched and all(re.fullmatch(pattern, tag) for tag in matched)

    contents = {value.tag: value.metadata.plugin_data.content for _, value in found if value.tag.startswith("_hparams_")}
    experiment = metadata.parse_experiment_plugin_data(contents[metadata.EXPERIMENT_TAG])
    session = metadata.parse_session_start_info_plugin_data(contents[metadata.SESSION_START_INFO_TAG])
    assert metadata.SESSION_END_INFO_TAG in contents
    values = {name: getattr(value, str(value.WhichOneof("kind"))) for name, value in session.hparams.items()}
    assert values["algo"] == "fedguide" and values["seed"] == 0 and values["rollout_size"] == 40
    assert values["pretraining.dice_updates"] == 2 and values["normalize"] is False
    columns = {info.name for info in experiment.hparam_infos}
    assert columns >= set(values) | {"mu", "lambda_global", "buffer_size"}, "other algorithms' runs share the table"
    assert [info.name.tag for info in experiment.metric_infos] == list(METRICS)
    tags = {value.tag for _, value in found}
    assert tags >= set(METRICS) - {"eval/broadcast_mean_reward"}

    assert main([*train, "-f", str(tmp_path / "second"), "--picture-freq", "0", *tiny]) == 0
    assert not [value.tag for _, value in events(tmp_path / "second") if value.tag.startswith("pictures/")]


def test_a_wrong_picture_frequency_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit) as exit:
        main(["train", "--env", "Bandit2D", "--picture-freq", "-1", "-f", str(tmp_path / "logs")])
    assert exit.value.code == 2 and "0 draws no pictures" in capsys.readouterr().err
    assert not (tmp_path / "logs").exists()
    with pytest.raises(ValueError, match="0 draws no pictures"):
        TensorBoardCallback(5, picture_freq=-1)


def test_an_interrupted_run_has_no_end_in_the_hparams_tab(point_envs, small, tmp_path):

    class Interrupt(RoundCallback):
        def _on_round_end(self):
            raise KeyboardInterrupt

    model = Local("MlpPolicy", point_envs(2), tensorboard_log=str(tmp_path), **small)
    with pytest.raises(KeyboardInterrupt):
        model.learn(10_000, [TensorBoardCallback(5, hyperparameters={"seed": 3}), Interrupt()])
    model.logger.close()
    tags = {value.tag for _, value in events(tmp_path)}
    assert metadata.SESSION_START_INFO_TAG in tags and metadata.SESSION_END_INFO_TAG not in tags


def test_hyperparameters_become_flat_plain_values():
    nested = {"a": 1, "b": {"c": True, "d": {"e": "lin_1e-3"}, "f": None}, "g": [64, 64]}
    assert flatten(nested) == {"a": 1, "b.c": True, "b.d.e": "lin_1e-3", "g": "[64, 64]"}
    assert type(flatten(nested)["b.c"]) is bool


def test_the_terminal_gets_no_pictures_and_without_tensorboard_none_are_drawn(small, capsys, monkeypatch):
    """SB3's text outputs raise on pictures."""
    monkeypatch.setattr(pictures, "_rgb", lambda figure: pytest.fail("drawn for nobody"))
    model = FedGuide("MlpPolicy", "Bandit2D", pretraining=OFFLINE, **small)
    model.set_logger(Logger(None, [HumanOutputFormat(sys.stdout)]))
    model.learn(4 * model.rollout_size, TensorBoardCallback(1))
    assert "eff" in capsys.readouterr().out


@pytest.mark.parametrize("algorithm", [FedGuideA, FedAvg, FedRL])
def test_training_is_the_same_bit_for_bit_with_monitoring(algorithm, small, tmp_path):
    if algorithm is FedRL:
        small = {"rollout_size": 32, "learning_starts": 8, "batch_size": 8, "seed": 3, "policy_kwargs": {"net_arch": [8]}}
    if algorithm is FedGuideA:
        small.update(pretraining=OFFLINE, average_every=2)

    def trained(callbacks, **more):
        model = algorithm("MlpPolicy", "Bandit2D", **small, **more)
        return model.learn(3 * 4 * model.rollout_size, callbacks)

    plain = trained([])
    evaluation = FederatedEvalCallback(3, 1, 2)
    watched = trained(
        [evaluation, DiagnosticsCallback(evaluation), TensorBoardCallback(3, 1, {"seed": 3})], tensorboard_log=str(tmp_path)
    )
    assert any(value.tag == "pictures/heterogeneity" for _, value in events(tmp_path))
    for client in range(4):
        assert_same_parameters(parameters_of(plain, client), parameters_of(watched, client))


def test_drawing_is_imported_when_something_is_drawn():
    code = (
        "import sys, sb3_fedguide.monitoring.callbacks as m; m.TensorBoardCallback(3); "
        "assert 'matplotlib' not in sys.modules; from sb3_fedguide.monitoring import pictures; import numpy; "
        "pictures.transport_plan(numpy.eye(3), range(3)); assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


# Pictures


def color_count(picture: np.ndarray, color: tuple[float, ...]) -> int:
    return int((np.abs(picture.astype(int) - np.round(255 * np.array(color[:3]))).max(axis=-1) <= 1).sum())


def test_the_transport_plan_shows_who_is_routed_where():
    from matplotlib import colormaps

    picture = pictures.transport_plan(np.eye(4), range(4))
    assert picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3
    full, empty = (color_count(picture, colormaps["viridis"](value)) for value in (1.0, 0.0))
    assert full / empty == pytest.approx(1 / 3, rel=0.25)  # numbers are written on the full cells
    rows = np.eye(4)[[1, 0, 2, 3]]
    assert not np.array_equal(picture, pictures.transport_plan(rows, range(4)))
    assert max(pictures.transport_plan(np.full((64, 64), 1 / 64), range(64)).shape) < 2000


def test_pictures_of_many_clients_are_as_large_as_those_of_fifty(monkeypatch):
    for module in (pictures, metadata_figures):
        monkeypatch.setattr(module, "DPI", 30)
    plans = [pictures.transport_plan(np.full((n, 8), 1 / 8), range(n)) for n in (50, 70)]
    assert plans[0].shape == plans[1].shape
    crowds = [pictures.heterogeneity(generate_family("Reacher", n), range(n)) for n in (50, 70)]
    assert crowds[0].shape == crowds[1].shape


def test_parameters_that_differ_are_found():
    names, values = varying_parameters(fed_envs.load_family("Bandit2D").clients)
    assert names == ["peak 0", "peak 1"]
    np.testing.assert_array_equal(values, [[1, 0], [0, 1], [-1, 0], [0, -1]])
    reacher = fed_envs.load_family("Reacher")
    names, values = varying_parameters(reacher.clients)
    assert names == ["goal_angle_deg", "goal_x 0", "goal_x 1", "goal_y 0", "goal_y 1", "action_offset 0", "action_offset 1",
                     "reward_scale", "angle_offset"]  # fmt: skip
    assert values[1, 7] == reacher.client(1).reward_scale
    same, empty = varying_parameters(reacher.with_parameters(reward_scale=1.0).clients[:1])
    assert same == [] and empty.shape == (1, 0)


@pytest.mark.parametrize("name", others_slow(fed_envs.FAMILIES, lambda name: f"{name}Hard" not in fed_envs.FAMILIES))
def test_every_family_has_a_small_picture_or_no_numbers_that_differ(name):
    family = fed_envs.load_family(name)
    picture = pictures.heterogeneity(family, range(family.n_clients))
    if name == "MetaWorld10":
        assert picture is None
    else:
        assert picture.dtype == np.uint8 and picture.std() > 10 and picture.size < 1e6
    assert pictures.heterogeneity(family, [0]) is None


def test_densities_show_every_client_and_what_was_sent():
    policies = Policies(np.array([[1.0, 0.0], [-1.0, 0.0]]), np.full((2, 2), 0.2))
    shared = Policies(np.zeros((2, 2)), np.full((2, 2), 0.2))
    alone, sent = pictures.bandit_densities(policies, [0, 3]), pictures.bandit_densities(policies, [0, 3], broadcast=shared)
    assert alone.shape == sent.shape and not np.array_equal(alone, sent)
    swapped = Policies(policies.mean[::-1], policies.std)
    assert not np.array_equal(pictures.bandit_densities(swapped, [0, 3]), alone)


def test_clients_of_ones_own_environments_and_a_part_of_a_family_are_watched_too(point_envs, small, tmp_path):
    for model in (
        FedAvg("MlpPolicy", point_envs(2), tensorboard_log=str(tmp_path / "own"), **small),
        FedAvg("MlpPolicy", FederatedVecEnv("Bandit2D", clients=[1, 3]), tensorboard_log=str(tmp_path / "part"), **small),
    ):
        model.learn(2 * model.rollout_size, [DiagnosticsCallback(), TensorBoardCallback(1)])
    own, part = ({value.tag for _, value in events(tmp_path / name)} for name in ("own", "part"))
    assert not [tag for tag in own if tag.startswith("pictures/")]
    assert part >= {"pictures/heterogeneity", "pictures/densities"}


def test_many_clients_get_a_bounded_picture(monkeypatch):
    drawn = []
    monkeypatch.setattr(pictures, "draw_density", lambda axes, density, title: drawn.append(title))
    figures = []
    monkeypatch.setattr(pictures, "_rgb", lambda figure: figures.append(figure))
    for n_clients in (4, 400):
        policies = Policies(np.zeros((n_clients, 2)), np.ones((n_clients, 2)))
        drawn.clear()
        pictures.bandit_densities(policies, range(n_clients), broadcast=policies)
        assert drawn[-1] == "broadcast policy" and len(drawn) == min(n_clients, pictures.MAX_DENSITIES) + 1
        assert figures[-1].get_suptitle() == ("" if n_clients == 4 else "the first 30 of 400 clients")
