"""The Bandit2D picture: its measures against closed forms, and the command."""

from __future__ import annotations

import json

import numpy as np
import pytest

from fed_envs.bandit2d import PEAKS, SIGMA
from sb3_fedguide.benchmark.bandit2d import Policies
from sb3_fedguide.cli.demo import main


def test_expected_reward_is_the_gaussian_integral_around_a_peak():
    """Around one peak, E exp(-|a - c|^2 / 2 sigma^2) = sigma^2 / (sigma^2 + s^2); the other peaks add next to nothing."""
    std = np.array([[0.05, 0.05], [0.2, 0.2], [0.1, 0.3], [0.15, 0.15]])
    policies = Policies(PEAKS.copy(), std)
    expected = (SIGMA / np.sqrt(SIGMA**2 + std**2)).prod(axis=1)
    np.testing.assert_allclose(policies.expected_reward(), expected, rtol=1e-3)


def test_expected_reward_agrees_with_sampling_where_actions_are_clipped():
    from fed_envs.bandit2d import ACTION_LIMIT, reward

    policies = Policies(np.array([[1.3, 0.2]]), np.array([[0.5, 0.4]]))
    actions = np.random.default_rng(0).normal(policies.mean, policies.std, (400_000, 2))
    sampled = reward(np.clip(actions, -ACTION_LIMIT, ACTION_LIMIT)).mean()
    assert policies.expected_reward()[0] == pytest.approx(sampled, abs=2e-3)


def test_density_integrates_to_one_and_peaks_are_counted_once():
    policies = Policies(np.array([[1.0, 0.0], [0.95, 0.05], [0.0, 0.7], [0.0, -1.0]]), np.full((4, 2), 0.2))
    axis = np.linspace(-2.5, 2.5, 251)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(policies.density(points).sum(axis=1) * (axis[1] - axis[0]) ** 2, 1.0, rtol=1e-6)
    assert policies.peaks_kept() == 2  # (0, 0.7) earns 0.32 of its peak: not kept


def test_the_demo_writes_a_picture_and_its_numbers(tmp_path, capsys):
    conf = tmp_path / "tiny.yml"
    conf.write_text(
        "Bandit2D: {n_rounds: 2, rollout_size: 64, batch_size: 32, n_epochs: 1, bc_weight: 0.3,"
        " pretraining: {bc_updates: 2, dice_updates: 2, dataset_size: 50}}\n"
    )
    folder = tmp_path / "demo"
    assert main(["-f", str(folder), "-conf", str(conf)]) == 0
    output = capsys.readouterr().out
    assert "FedAvg" in output and "FedGuide" in output and "E_pi[r]" in output
    assert (folder / "bandit2d.png").read_bytes().startswith(b"\x89PNG")
    numbers = json.loads((folder / "bandit2d.json").read_text())
    assert set(numbers) == {"Local", "FedAvg", "FedGuide"} and len(numbers["FedGuide"]["curve"]) == 2
    assert all(0 <= numbers[name]["expected_reward"] <= 1 for name in numbers)


def test_a_wrong_flag_is_one_message(capsys):
    with pytest.raises(SystemExit) as exit:
        main(["--rounds", "0"])
    assert exit.value.code == 2 and len(capsys.readouterr().err.splitlines()) == 1
