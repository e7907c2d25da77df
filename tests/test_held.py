"""What an algorithm declares once is in its checkpoints, model files and parameter files, and goes to workers and back."""

from __future__ import annotations

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
    with pytest.raises(ValueError, match="the file holds scales, which this method has not with its settings"):
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
