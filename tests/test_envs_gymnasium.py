"""With nominal parameters the client environments are Gymnasium's own, to the last bit."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import fed_envs
from fed_envs.metadata import Family, parse_family

NOMINAL = {
    "mass_scale": 1.0,
    "damping_scale": 1.0,
    "friction_scale": 1.0,
    "action_gain": 1.0,
    "forward_reward_weight": 1.0,
    "instability_cost_weight": 0.0,
}
WEIGHTS = {
    "Hopper-v5": {"ctrl_cost_weight": 1e-3, "reset_noise_scale": 5e-3},
    "Walker2d-v5": {"ctrl_cost_weight": 1e-3, "reset_noise_scale": 5e-3},
    "HalfCheetah-v5": {"ctrl_cost_weight": 0.1, "reset_noise_scale": 0.1},
}
REACHER = {
    "goal_angle_deg": 0.0,
    "goal_x": [-0.2, 0.2],
    "goal_y": [-0.2, 0.2],
    "action_offset": [0.0, 0.0],
    "reward_scale": 1.0,
    "angle_offset": 0.0,
}


def family(backbone: str, **client) -> Family:
    content = {
        "schema_version": 1,
        "family": "Nominal",
        "world": "reacher" if backbone == "Reacher-v5" else "locomotion",
        "backbone": backbone,
        "max_episode_steps": 50 if backbone == "Reacher-v5" else 1000,
        "clients": [{"client": 0, **client}],
    }
    return parse_family(content, "nominal")


def compare(ours: gymnasium.Env, theirs: gymnasium.Env, steps: int, seed: int) -> int:
    """Step both with the same actions; return how many episodes ended."""
    rng = np.random.default_rng(seed)
    episodes = 0
    observation, _ = ours.reset(seed=seed)
    np.testing.assert_array_equal(observation, theirs.reset(seed=seed)[0])
    for _ in range(steps):
        action = rng.uniform(-1, 1, ours.action_space.shape).astype(np.float32)
        observation, reward, terminated, truncated, info = ours.step(action)
        expected = theirs.step(action)
        np.testing.assert_array_equal(observation, expected[0])
        assert (reward, terminated, truncated) == expected[1:4]
        for key, value in expected[4].items():
            assert info[key] == value, key
        if terminated or truncated:
            episodes += 1
            observation, _ = ours.reset()
            np.testing.assert_array_equal(observation, theirs.reset()[0])
    return episodes


@pytest.mark.parametrize(("backbone", "episodes"), [("Hopper-v5", 20), ("Walker2d-v5", 10), ("HalfCheetah-v5", 1)])
def test_nominal_locomotion_is_gymnasiums(backbone, episodes):
    ours = family(backbone, **NOMINAL, **WEIGHTS[backbone]).make(0)
    theirs = gymnasium.make(backbone)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.unwrapped.metadata["render_fps"] == theirs.unwrapped.metadata["render_fps"]
    assert compare(ours, theirs, 1001, seed=3) >= episodes


@pytest.mark.parametrize("backbone", ["Hopper-v5", "Walker2d-v5", "HalfCheetah-v5"])
def test_reward_weights_and_noise_are_gymnasiums_arguments(backbone):
    weights = {"forward_reward_weight": 1.289231, "ctrl_cost_weight": 0.0389, "reset_noise_scale": 0.0132}
    ours = family(backbone, **{**NOMINAL, **weights}).make(0)
    compare(ours, gymnasium.make(backbone, **weights), 300, seed=5)


def test_healthy_ranges_are_gymnasiums():
    """States around every limit, not only those that a random policy reaches."""
    rng = np.random.default_rng(0)
    for backbone in ("Hopper-v5", "Walker2d-v5"):
        ours, theirs = family(backbone, **NOMINAL, **WEIGHTS[backbone]).make(0).unwrapped, gymnasium.make(backbone).unwrapped
        ours.reset(seed=0)
        theirs.reset(seed=0)
        outcomes = set()
        for _ in range(300):
            qpos = ours.init_qpos + rng.normal(0, 0.2, ours.model.nq)
            qpos[1] = rng.uniform(0.6, 2.2)
            qpos[2] = rng.uniform(-0.4, 0.4) if backbone == "Hopper-v5" else rng.uniform(-1.2, 1.2)
            qvel = rng.normal(0, 60.0 if rng.random() < 0.3 else 1.0, ours.model.nv)
            for env in (ours, theirs):
                env.set_state(qpos, qvel)
            action = rng.uniform(-1, 1, ours.model.nu).astype(np.float32)
            result, expected = ours.step(action), theirs.step(action)
            np.testing.assert_array_equal(result[0], expected[0])
            assert result[1:3] == expected[1:3]
            outcomes.add(result[2])
        assert outcomes == {False, True}


def test_nominal_reacher_is_gymnasiums():
    ours, theirs = family("Reacher-v5", **REACHER).make(0), gymnasium.make("Reacher-v5")
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    compared = 0
    for seed in range(12):
        ours.reset(seed=seed)
        theirs.reset(seed=seed)
        if np.linalg.norm(ours.unwrapped.data.qpos[2:]) >= 0.2:
            continue  # Gymnasium redraws such goals, we accept them up to 0.25
        compare(ours, theirs, 49, seed)
        compared += 1
    assert compared >= 6


def test_scaled_dynamics_are_those_of_a_scaled_model():
    """Set Gymnasium's own model to client 1's parameters by hand: the same trajectory, with actions scaled outside."""
    import mujoco

    client = fed_envs.load_family("HopperHard").clients[1]
    ours = fed_envs.load_family("HopperHard").make(1)
    theirs = gymnasium.make(
        "Hopper-v5",
        forward_reward_weight=client.forward_reward_weight,
        ctrl_cost_weight=client.ctrl_cost_weight,
        reset_noise_scale=client.reset_noise_scale,
    )
    model = theirs.unwrapped.model
    model.body_mass[1:] *= client.mass_scale
    model.dof_damping[:] *= client.damping_scale
    model.geom_friction[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "floor")] *= client.friction_scale
    mujoco.mj_setConst(model, mujoco.MjData(model))
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(ours.reset(seed=1)[0], theirs.reset(seed=1)[0])
    for _ in range(200):
        action = rng.uniform(-1, 1, 3).astype(np.float32)
        result = ours.step(action)
        expected = theirs.step(np.clip(action * np.float32(client.action_gain), -1, 1))
        np.testing.assert_array_equal(result[0], expected[0])
        assert result[1:4] == expected[1:4]
        if result[2]:
            np.testing.assert_array_equal(ours.reset()[0], theirs.reset()[0])
