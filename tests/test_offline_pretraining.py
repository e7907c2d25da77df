"""The cached offline stage: what a piece's key covers, that entries are reused, and that clients stay independent."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from pydantic import ValidationError
from torch import nn

from sb3_fedguide.offline import pretraining
from sb3_fedguide.offline.pretraining import PretrainedPrior, Pretraining, PretrainingConfig
from sb3_fedguide.priors import GaussianPrior
from sb3_fedguide.state.stacked import stack_module

TINY: dict[str, Any] = {
    "dataset_size": 80,
    "bc_updates": 20,
    "bc_batch_size": 16,
    "prior_updates": 20,
    "prior_batch_size": 16,
    "prior_width": 8,
    "prior_average_every": 10,
    "dice_updates": 10,
    "dice_batch_size": 16,
    "dice_width": 8,
}


def stage(cache: Path, clients: list[int], family: str = "Hopper", **changes: Any) -> Pretraining:
    return Pretraining(family, clients, PretrainingConfig(**{**TINY, **changes}), seed=4, cache_dir=cache)


def actor(n_clients: int, seed: int = 0) -> nn.Module:
    with th.random.fork_rng(devices=[]):
        th.manual_seed(seed)
        return stack_module(nn.Sequential(nn.Linear(11, 8), nn.Tanh(), nn.Linear(8, 3)), n_clients)


def forbid_training(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("clone", "train_dice", "federated_trunk"):
        monkeypatch.setattr(pretraining, name, None)


def test_lengths_are_epochs_with_a_floor() -> None:
    config = PretrainingConfig(bc_updates=2000, bc_epochs=40, dice_epochs=80, dice_batch_size=512)
    assert config.n_updates("bc", 5_000) == 2000  # 40 epochs are 400 updates only
    assert config.n_updates("bc", 100_000) == 40 * 196
    assert config.n_updates("dice", 100_000) == 80 * 196
    assert config.n_updates("prior", 100_000) == config.prior_updates


def test_settings_out_of_range_are_refused() -> None:
    for wrong in ({"dice_omega": 0.0}, {"bc_updates": 0}, {"gamma": 1.0}, {"dice_f": "other"}, {"learning_rate": 1.0}):
        with pytest.raises(ValidationError):
            PretrainingConfig.model_validate(wrong)


def test_behaviour_cloning_starts_from_the_given_actor_and_leaves_it_alone(tmp_path: Path) -> None:
    networks = actor(2)
    before = {name: tensor.clone() for name, tensor in networks.state_dict().items()}
    cloned = stage(tmp_path, [0, 1]).behavior_cloning(networks)
    for name, tensor in networks.state_dict().items():
        assert th.equal(tensor, before[name])
        assert cloned[name].shape == tensor.shape
        assert 0.0 < (cloned[name] - tensor).abs().max() < 0.1  # 20 Adam steps of 3e-4
    raw = stage(tmp_path, [0, 1]).behavior_cloning(networks, normalize=False)
    other = stage(tmp_path, [0, 1]).behavior_cloning(actor(2, seed=1))
    assert not th.equal(raw["0.weight"], cloned["0.weight"])
    assert not th.equal(other["0.weight"], cloned["0.weight"])


def test_behaviour_cloning_imitates(tmp_path: Path) -> None:
    pieces = stage(tmp_path, [0], dataset_size=400, bc_updates=400, bc_learning_rate=3e-3)
    (data,) = pieces.datasets()
    mean, var = data.moments()
    networks = actor(1)
    obs = th.as_tensor((data.observations - mean) / np.sqrt(var + 1e-8), dtype=th.float32)[None]

    def error() -> float:
        with th.no_grad():
            return float((networks(obs)[0] - th.as_tensor(data.actions)).square().mean())

    initial = error()
    networks.load_state_dict(pieces.behavior_cloning(networks))
    assert error() < 0.7 * min(initial, float(data.actions.var(axis=0).mean()))


def every_piece(pieces: Pretraining) -> dict[str, np.ndarray]:
    """Everything that the stage makes, each array with the clients first."""
    prior = pieces.prior()
    arrays = {f"bc {name}": tensor.numpy() for name, tensor in pieces.behavior_cloning(actor(len(pieces.client_ids))).items()}
    arrays |= {f"dice {name}": tensor.numpy() for name, tensor in pieces.dice().state_dict().items()}
    arrays |= {"heads": prior.heads, "moments": prior.moments, "grams": np.stack([item.gram for item in prior.statistics])}
    return arrays


def test_pieces_are_cached_and_clients_independent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    together = every_piece(stage(tmp_path / "a", [0, 1, 2]))
    alone = every_piece(stage(tmp_path / "b", [1]))
    joined = every_piece(stage(tmp_path / "b", [2, 1]))  # client 1 from the cache, client 2 new
    for name, array in together.items():
        np.testing.assert_array_equal(array[1], alone[name][0], err_msg=name)
        np.testing.assert_array_equal(array[[2, 1]], joined[name], err_msg=name)
    forbid_training(monkeypatch)
    for name, array in every_piece(stage(tmp_path / "a", [0, 1, 2])).items():
        np.testing.assert_array_equal(array, together[name], err_msg=name)


def test_a_damaged_entry_is_made_again(tmp_path: Path) -> None:
    made = every_piece(stage(tmp_path, [0, 1]))
    files = sorted((tmp_path / "pretraining").rglob("*.npz"))
    assert {file.parent.name for file in files} == {"bc", "dice", "prior", "trunk"}
    for number, file in enumerate(files):
        content = file.read_bytes()
        file.write_bytes(content[: len(content) // 2] if number % 2 else b"")
    for name, array in every_piece(stage(tmp_path, [0, 1])).items():
        np.testing.assert_array_equal(array, made[name], err_msg=name)


@pytest.mark.parametrize(
    ("change", "pieces_that_differ"),
    [
        ({"dice_omega": 1.0}, {"dice"}),
        ({"dice_updates": 11}, {"dice"}),
        ({"gamma": 0.9}, {"dice"}),
        ({"bc_learning_rate": 1e-3}, {"bc"}),
        ({"prior_learning_rate": 1e-2}, {"heads"}),
        ({"dataset_size": 81}, {"bc", "dice", "heads"}),
    ],
)
def test_a_changed_setting_changes_its_own_piece_only(tmp_path_factory: Any, change: dict, pieces_that_differ: set) -> None:
    cache = tmp_path_factory.getbasetemp() / "settings"
    before, after = every_piece(stage(cache, [0])), every_piece(stage(cache, [0], **change))
    differing = {name.split()[0] for name, array in before.items() if not np.array_equal(array, after[name])}
    assert differing - {"moments", "grams"} == pieces_that_differ


def test_prior_of_a_family(tmp_path: Path) -> None:
    pieces = stage(tmp_path, [0, 2])
    prior = pieces.prior()
    assert isinstance(prior, PretrainedPrior)
    assert prior.heads.shape == (2, 3, 9)
    assert prior.moments.shape == (2, 9, 9)
    assert prior.bytes_up > 0
    assert not any(parameter.requires_grad for parameter in prior.prior.parameters())
    for head, statistics in zip(prior.heads, prior.statistics, strict=True):
        np.testing.assert_allclose(prior.prior.solve_head(statistics), head, rtol=1e-6)


def test_bandit_has_a_gaussian_prior_without_traffic(tmp_path: Path) -> None:
    prior = stage(tmp_path, [0, 3], family="Bandit2D").prior()
    assert isinstance(prior.prior, GaussianPrior)
    assert (prior.bytes_up, prior.bytes_down) == (0, 0)
    np.testing.assert_allclose(prior.prior.mean_and_covariance(prior.heads[1])[0], [0.0, -1.0], atol=0.1)


def test_progress_names_the_pieces_and_is_silent_from_the_cache(tmp_path: Path) -> None:
    stages: list[tuple[str, int, int]] = []

    def run() -> None:
        every_piece(
            Pretraining(
                "Hopper", [0], PretrainingConfig(**TINY), cache_dir=tmp_path, progress=lambda *report: stages.append(report)
            )
        )

    run()
    assert {name for name, _, _ in stages} == {"data", "behaviour cloning", "prior", "DICE"}
    for piece in ("behaviour cloning", "prior", "DICE"):
        done, total = [report[1:] for report in stages if report[0] == piece][-1]
        assert done == total
    stages.clear()
    run()
    assert {name for name, _, _ in stages} <= {"data"}


def test_environments_of_ones_own_need_a_dataset(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="bring no offline data"):
        Pretraining(None, [0, 1], cache_dir=tmp_path).datasets()
