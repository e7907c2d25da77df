"""Behaviour policies: what is shipped, what may be loaded, what is executed."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from sb3_fedguide.offline.behavior import BehaviorPolicy, behavior_policy
from sb3_fedguide.offline.train_behavior import SquashedActions, evaluate_behavior, main

# Mean return of the noisy policy in the nominal backbone: well above what an untrained one gets, and improvable.
SHIPPED = {"Hopper-v5": (1000, 1800), "Walker2d-v5": (1000, 1900), "HalfCheetah-v5": (1400, 2600), "Reacher-v5": (-9, -5)}


def tiny_arrays() -> dict[str, np.ndarray]:
    return {
        "weight_0": np.full((2, 3), 0.5, np.float32),
        "bias_0": np.array([0.0, 1.0], np.float32),
        "log_std": np.zeros(2, np.float32),
        "obs_mean": np.ones(3),
        "obs_var": np.full(3, 4.0),
        "obs_clip": np.float64(10.0),
        "obs_epsilon": np.float64(0.0),
    }


def test_mean_action_and_noise_are_those_of_a_squashed_gaussian() -> None:
    policy = BehaviorPolicy(tiny_arrays(), noise_scale=0.5)
    obs = np.array([[3.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
    np.testing.assert_allclose(policy.mean(obs), [[0.5, 1.5], [0.0, 1.0]], atol=1e-6)
    noise = np.random.default_rng(3).standard_normal((2, 2), dtype=np.float32)
    np.testing.assert_allclose(policy(obs, np.random.default_rng(3)), np.tanh(policy.mean(obs) + 0.5 * noise), atol=1e-6)
    assert policy(obs[0], np.random.default_rng(3)).shape == (2,)


def test_executed_actions_are_strictly_inside_however_large_the_raw_action() -> None:
    arrays = tiny_arrays()
    arrays["bias_0"] = np.array([1e4, -1e4], np.float32)
    actions = BehaviorPolicy(arrays)(np.zeros((5, 3)), np.random.default_rng(0))
    assert actions.dtype == np.float32
    assert (np.abs(actions) < 1.0).all()
    assert (np.abs(actions) > 0.999).all()


@pytest.mark.parametrize("backbone", SHIPPED)
def test_shipped_policies_are_of_medium_quality(backbone: str) -> None:
    policy = behavior_policy(backbone)
    low, high = SHIPPED[backbone]
    assert low < float(policy.arrays["mean_return"]) < high
    n_episodes = 20 if backbone == "Reacher-v5" else 2
    env = gym.make(backbone)
    assert policy.obs_dim == env.observation_space.shape[0]  # type: ignore[index]
    measured = evaluate_behavior(policy, env, n_episodes, seed=77).mean()
    assert low * (1.5 if low < 0 else 0.5) < measured < high * (0.5 if high < 0 else 1.5)


def test_round_trip_and_content_hash(tmp_path: Path) -> None:
    policy = BehaviorPolicy(tiny_arrays())
    policy.save(tmp_path / "policy.npz")
    loaded = BehaviorPolicy.load(tmp_path / "policy.npz")
    obs = np.random.default_rng(0).standard_normal((4, 3))
    np.testing.assert_array_equal(loaded(obs, np.random.default_rng(1)), policy(obs, np.random.default_rng(1)))
    assert loaded.content_hash == policy.content_hash
    assert BehaviorPolicy(tiny_arrays(), noise_scale=2.0).content_hash != policy.content_hash
    changed = tiny_arrays()
    changed["bias_0"] = changed["bias_0"] + 1e-3
    assert BehaviorPolicy(changed).content_hash != policy.content_hash


def test_refuses_pickled_damaged_and_foreign_files(tmp_path: Path) -> None:
    class Payload:
        def __reduce__(self) -> tuple:
            return (Path(tmp_path / "executed").touch, ())

    np.savez(tmp_path / "pickled.npz", format_version=np.int64(1), weight_0=np.array([Payload()], dtype=object))
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04 not a zip file")
    np.savez(tmp_path / "foreign.npz", weight_0=np.zeros(3))
    for name in ("pickled", "broken", "foreign", "absent"):
        with pytest.raises(ValueError, match=name):
            BehaviorPolicy.load(tmp_path / f"{name}.npz")
    assert not (tmp_path / "executed").exists()
    with pytest.raises(ValueError, match="train_behavior --env Ant-v5"):
        behavior_policy("Ant-v5")
    with pytest.raises(ValueError, match="do not fit together"):
        BehaviorPolicy({**tiny_arrays(), "bias_0": np.zeros(3)})


def test_squashing_wrapper_needs_unit_actions() -> None:
    with pytest.raises(ValueError, match=r"actions in \[-1, 1\]"):
        SquashedActions(gym.make("Pendulum-v1"))
    env = SquashedActions(gym.make("Reacher-v5"))
    np.testing.assert_allclose(env.action(np.array([0.5, -10.0])), np.tanh([0.5, -10.0]), atol=2e-6)


def test_training_script_writes_a_policy(tmp_path: Path) -> None:
    output = tmp_path / "Reacher.npz"
    assert main(["--env", "Reacher-v5", "--timesteps", "4096", "--target", "-1000", "-o", str(output)]) == 0
    policy = BehaviorPolicy.load(output)
    assert (policy.obs_dim, policy.action_dim) == (10, 2)
    assert int(policy.arrays["timesteps"]) == 4096
    with pytest.raises(SystemExit):
        main(["--env", "Ant-v5"])
