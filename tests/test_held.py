"""What an algorithm declares once is in its checkpoints, model files and parameter files, and goes to workers and back."""

from __future__ import annotations

import copy
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th

from sb3_fedguide import FedAvg, FedGuide
from sb3_fedguide.common.checkpoint import CheckpointCallback
from sb3_fedguide.priors import GaussianPrior
from sb3_fedguide.state.array_files import read_arrays
from sb3_fedguide.state.client_axis import take_clients
from sb3_fedguide.state.held import Held
from tests.comparisons import assert_same_training
from tests.loop_engine import Here

SMALL = {"rollout_size": 16, "batch_size": 8, "n_epochs": 1, "seed": 0, "policy_kwargs": {"net_arch": [4]}}


class Scaled(FedAvg):
    """Holds a number per client, a module that all share and a further array that only rounds give."""

    state_attributes = (
        Held("scales", part="scales", file="scales"),
        Held("table", shared=True, part="scales", file="table/"),
        Held("sums", part="sums", file="sums", later=True),
        "counts",
    )
    scales: np.ndarray
    table: th.nn.Module
    sums: np.ndarray
    counts: dict[str, np.ndarray]

    def _setup_state(self):
        super()._setup_state()
        n = self.n_clients
        self.hold(
            scales=lambda: np.ones(n), sums=lambda: np.full(n, np.nan), counts=lambda: {"rounds": np.zeros(n, dtype=int)}
        )
        self.hold(table=lambda: th.nn.Linear(3, 5).requires_grad_(False))  # as many rows as there are clients, or more

    def _finish_training(self):
        for index in np.flatnonzero(self.present):
            self.scales[index] *= 2 + self.client_ids[index]
            self.sums[index] = self.scales[index]
            self.counts["rounds"][index] += 1


def scaled(seed: int = 0) -> Scaled:
    return Scaled("MlpPolicy", "Bandit2D", **{**SMALL, "seed": seed})


def assert_holds_the_same(one: Scaled, other: Scaled) -> None:
    np.testing.assert_array_equal(one.scales, other.scales)
    np.testing.assert_array_equal(one.sums, other.sums)
    assert all(th.equal(tensor, other.table.state_dict()[name]) for name, tensor in one.table.state_dict().items())


def test_a_declaration_is_enough(tmp_path):
    model = scaled()
    model.learn(2 * 16 * 4, CheckpointCallback(tmp_path, 1))
    assert model.scales.tolist() == [4, 9, 16, 25] and model.counts["rounds"].tolist() == [2] * 4
    resumed = scaled(seed=7).resume(tmp_path)
    model.save(tmp_path / "model.zip")
    loaded = Scaled.load(tmp_path / "model.zip")
    for other in (resumed, loaded):
        assert_holds_the_same(model, other)
        assert other.counts["rounds"].tolist() == [2] * 4
    model.export_parameters(tmp_path / "parameters.npz")
    imported = scaled(seed=7)
    imported.import_parameters(tmp_path / "parameters.npz")
    assert_holds_the_same(model, imported)
    assert imported.counts["rounds"].tolist() == [0] * 4  # not declared as a part of parameter files


def test_workers_get_their_clients_part_and_all_of_what_is_shared():
    plain, other = scaled(), scaled()
    other.table.load_state_dict(plain.table.state_dict())
    Here(2).attach(other)
    for model in (plain, other):
        model.learn(2 * 16 * 4)
    assert_same_training(plain, other)
    part = take_clients(plain.save_state(), [1, 3], 4, {"identity", "shared", "strategy", "random"})
    assert part["attributes"]["scales"].tolist() == [9, 25] and part["attributes"]["counts"]["rounds"].tolist() == [2, 2]
    assert part["shared"]["table"]["weight"].shape == (5, 3)


def test_what_only_rounds_give_is_left_out_of_files_until_it_is_there(tmp_path):
    model, trained = scaled(), scaled(seed=7)
    model.pretrain()
    model.export_parameters(tmp_path / "parameters.npz")
    assert "scales" in (names := read_arrays(tmp_path / "parameters.npz").keys()) and "sums" not in names
    trained.learn(16 * 4)
    trained.import_parameters(tmp_path / "parameters.npz")
    assert_holds_the_same(model, trained)
    with pytest.raises(ValueError, match="the file holds scales, which this method does not have with its settings"):
        FedAvg("MlpPolicy", "Bandit2D", **SMALL).import_parameters(tmp_path / "parameters.npz")


def test_fedguide_takes_a_file_from_before_the_first_round_as_new(tmp_path):
    offline = {"dataset_size": 60, "dice_updates": 2, "prior_updates": 2, "dice_width": 4}
    settings = {**SMALL, "pretraining": offline, "calibrate": True, "adapt": "advantage"}
    model, trained = (FedGuide("MlpPolicy", "Bandit2D", **{**settings, "seed": seed}) for seed in (0, 7))
    assert isinstance(model.prior, GaussianPrior) and np.isnan(model.experts).all()
    model.pretrain()
    model.export_parameters(tmp_path / "parameters.npz")
    trained.learn(16 * 4)
    assert trained.calibrated.all() and np.isfinite(trained.experts).all() and trained.recent_statistics["weight"].all()
    trained.import_parameters(tmp_path / "parameters.npz")
    assert not trained.calibrated.any() and np.isnan(trained.experts).all() and not trained.recent_statistics["weight"].any()
    np.testing.assert_array_equal(trained.heads, model.heads)


OFFLINE = {"dataset_size": 60, "dice_updates": 2, "prior_updates": 2, "dice_width": 4}


def guide(**settings) -> FedGuide:
    return FedGuide("MlpPolicy", "Bandit2D", **{**SMALL, "pretraining": OFFLINE, **settings})


@pytest.mark.parametrize(
    "settings, missing", [({"adapt": "advantage"}, "offline_statistics"), ({"calibrate": True}, "dice_scale")]
)
def test_a_state_of_other_settings_is_refused(settings, missing, tmp_path):
    plain, other = guide(), guide(**settings)
    plain.learn(16 * 4, CheckpointCallback(tmp_path / "plain", 1))
    other.learn(16 * 4, CheckpointCallback(tmp_path / "other", 1))
    weights = guide(**settings).policy.state_dict()
    resumed = guide(**settings)
    with pytest.raises(ValueError, match=f"it holds no {missing}, and a FedGuide with these settings has one"):
        resumed.resume(tmp_path / "plain")
    assert resumed.round == 0 and all(th.equal(tensor, weights[name]) for name, tensor in resumed.policy.state_dict().items())
    with pytest.raises(ValueError, match=f"it holds {missing}, and a FedGuide with these settings has none"):
        guide().resume(tmp_path / "other")
    assert getattr(guide(**settings).resume(tmp_path / "other"), missing) is not None


def test_a_saved_model_takes_the_settings_that_it_has_data_for(tmp_path):
    plain, adapting = guide(), guide(adapt="advantage")
    for name, model in {"plain": plain, "adapting": adapting}.items():
        model.pretrain()
        model.save(tmp_path / f"{name}.zip")
    with pytest.raises(ValueError, match="went through the offline stage with adapt='none'"):
        FedGuide.load(tmp_path / "plain.zip", adapt="advantage")
    plain.adapt = "advantage"
    with pytest.raises(ValueError, match="went through the offline stage with adapt='none'"):
        plain.learn(16 * 4)
    still = FedGuide.load(tmp_path / "adapting.zip", env="Bandit2D", adapt="none")
    still.learn(16 * 4)
    np.testing.assert_array_equal(still.heads, adapting.heads)
    calibrated = FedGuide.load(tmp_path / "plain.zip", env="Bandit2D", calibrate=True)
    calibrated.learn(16 * 4)
    assert calibrated.calibrated is not None and calibrated.calibrated.all()


def test_settings_may_change_before_training():
    model = guide()
    model.calibrate, model.adapt = True, "advantage"
    model.learn(16 * 4)
    assert model.calibrated is not None and model.calibrated.all()
    assert model.offline_statistics is not None and model.offline_statistics["gram"].any()


def test_nothing_is_made_before_it_is_read_nor_twice(tmp_path, monkeypatch):
    made: list[str] = []
    for name in ("_untrained_prior", "_untrained_dice", "_no_experts", "_no_statistics"):
        make = getattr(FedGuide, name)
        monkeypatch.setattr(FedGuide, name, lambda *args, make=make, name=name: (made.append(name), make(*args))[1])
    wide = {"pretraining": {**OFFLINE, "dice_width": 512}, "calibrate": True, "adapt": "advantage"}  # 4 MB of it
    untrained = guide(**wide)
    untrained.save(tmp_path / "untrained.zip")
    assert not FedGuide.load(tmp_path / "untrained.zip").pretrained
    assert made == [] and (tmp_path / "untrained.zip").stat().st_size < 200_000

    model = guide(calibrate=True, adapt="advantage")
    model.learn(16 * 4, CheckpointCallback(tmp_path, 1))
    model.save(tmp_path / "model.zip")
    made.clear()
    loaded = FedGuide.load(tmp_path / "model.zip", env="Bandit2D")
    loaded.learn(16 * 4, reset_num_timesteps=False)
    assert made == []
    resumed = guide(calibrate=True, adapt="advantage").resume(tmp_path)
    resumed.learn(16 * 4, reset_num_timesteps=False)
    assert made.count("_untrained_prior") == made.count("_untrained_dice") == 1 and "_no_experts" not in made
    np.testing.assert_array_equal(resumed.experts, loaded.experts)
    model.export_parameters(tmp_path / "parameters.npz")
    made.clear()
    imported = guide(calibrate=True, adapt="advantage")
    imported.import_parameters(tmp_path / "parameters.npz")
    np.testing.assert_array_equal(imported.experts, model.experts)
    assert len(made) == len(set(made)) == 4


def test_copies_make_their_own():
    model = guide()
    for other in (copy.deepcopy(model), pickle.loads(pickle.dumps(model))):
        other.n_experts = 2
        assert other.heads.shape == (4, 2, 3) and "heads" not in vars(model)
        assert other.experts.shape[1] == 2 and "experts" not in vars(model)


class Early(FedAvg):
    """Declares what its constructor sets, one of them an attribute's own."""

    state_attributes = (
        Held("heads", part="h", file="h"),
        Held("box.sums", part="b", file="b"),
        Held("late", part="l", file="l", later=True),
    )

    def __init__(self, policy, env, **fedavg):
        self.heads, self.box, self.late = np.arange(4.0), SimpleNamespace(sums=np.zeros(4)), np.full(4, np.nan)
        super().__init__(policy, env, **fedavg)


def test_files_hold_what_a_constructor_sets_and_what_is_an_attributes_own(tmp_path):
    model, taking = (Early("MlpPolicy", "Bandit2D", **{**SMALL, "seed": seed}) for seed in (0, 7))
    model.pretrain()
    model.heads[:], model.box.sums[:] = 5, 7
    model.export_parameters(tmp_path / "parameters.npz")
    assert {"h", "b"} < read_arrays(tmp_path / "parameters.npz").keys()
    taking.import_parameters(tmp_path / "parameters.npz")
    assert taking.heads.tolist() == [5] * 4 and taking.box.sums.tolist() == [7] * 4

    trained = Early("MlpPolicy", "Bandit2D", **{**SMALL, "seed": 7})
    trained.learn(16 * 4)
    trained.late[:] = 1
    before = {name: array.copy() for name, array in trained.parameter_arrays().items()}
    with pytest.raises(ValueError, match=r"late must be reset.* hold\(\)"):
        trained.import_parameters(tmp_path / "parameters.npz")
    after = trained.parameter_arrays()
    assert before.keys() == after.keys() and all(np.array_equal(array, after[name]) for name, array in before.items())


class Wrong(FedAvg):
    given: object

    def _setup_state(self):
        super()._setup_state()
        self.hold(heads=self.given)


class Hidden(Wrong):
    given = staticmethod(list)
    heads = None


def test_hold_takes_functions():
    for given in (np.zeros(4), th.nn.Linear(2, 2)):
        with pytest.raises(TypeError, match=r"hold\(heads=...\) takes a function"):
            type("Given", (Wrong,), {"given": given})("MlpPolicy", "Bandit2D", **SMALL)
    with pytest.raises(TypeError, match=r"Hidden.heads hides what hold\(heads=...\) makes"):
        Hidden("MlpPolicy", "Bandit2D", **SMALL)
    with pytest.raises(AttributeError, match="headz"):
        guide().headz  # noqa: B018
