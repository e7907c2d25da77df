"""The contract of every registered id and every client: checkers, pickling, seeding, and parameters that really act."""

from __future__ import annotations

import copy
import json
import pickle
import warnings

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import fed_envs
from tests.conftest import ends_first
from tests.rendering import check_pictures, run_with_osmesa

CLIENTS = [(name, k) for name in fed_envs.FAMILIES for k in range(fed_envs.load_family(name).n_clients)]
LEGGED = [(name, k) for name, k in CLIENTS if fed_envs.load_family(name).world == "locomotion"]
REACHERS = [(name, k) for name, k in CLIENTS if fed_envs.load_family(name).world == "reacher"]
FAMILY_NAMES = {
    "Bandit2D",
    "Reacher",
    "ReacherHard",
    "Hopper",
    "HopperHard",
    "Walker2D",
    "Walker2DHard",
    "HalfCheetah",
    "HalfCheetahHard",
    "MetaWorld10",
    "PointMaze",
    "PointMazeHard",
}

# What the checkers say about Gymnasium's own environments too: infinite observation bounds, action bounds other than 1.
ALLOWED_WARNINGS = {
    "mujoco": ("A Box observation space minimum value is -infinity", "A Box observation space maximum value is infinity"),
    "bandit2d": (
        "For Box action spaces, we recommend using a symmetric and normalized space",
        "We recommend you to use a symmetric and normalized Box action space",
    ),
}


def make(name: str, client: int = 0, **kwargs) -> gymnasium.Env:
    return gymnasium.make(f"fed_envs/{name}-v0", client=client, **kwargs)


def roll(env: gymnasium.Env, seed: int, steps: int = 60) -> list:
    """A seeded trajectory as plain data, resets included."""
    actions = np.random.default_rng(seed)
    observation, info = env.reset(seed=seed)
    trace: list = [observation.tolist(), info]
    for _ in range(steps):
        action = actions.uniform(env.action_space.low, env.action_space.high).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        trace += [observation.tolist(), reward, terminated, truncated, info]
        if terminated or truncated:
            trace.append(env.reset()[0].tolist())
    return trace


def test_all_families_are_registered():
    assert FAMILY_NAMES <= set(fed_envs.FAMILIES)
    for name in FAMILY_NAMES:
        spec = gymnasium.spec(f"fed_envs/{name}-v0")
        assert spec.max_episode_steps == fed_envs.load_family(name).max_episode_steps
        assert isinstance(spec.entry_point, str)


@pytest.mark.parametrize(("name", "client"), ends_first(CLIENTS))
def test_checkers_find_nothing_but_the_named_warnings(name, client):
    world = fed_envs.load_family(name).world
    allowed = ALLOWED_WARNINGS["bandit2d" if world == "bandit2d" else "mujoco"]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        env = make(name, client)
        check_env(env.unwrapped, skip_render_check=True)
        sb3_check_env(env, skip_render_check=True)
    unexpected = [str(entry.message) for entry in caught if not any(text in str(entry.message) for text in allowed)]
    assert not unexpected


@pytest.mark.parametrize(("name", "client"), ends_first(CLIENTS))
def test_specs_pickle_and_serialise_and_make_the_same_environment(name, client):
    env = make(name, client)
    spec = EnvSpec.from_json(env.spec.to_json())
    assert pickle.loads(pickle.dumps(env.spec)).kwargs == env.spec.kwargs == {"family": name, "client": client}
    assert roll(gymnasium.make(spec), 3, 20) == roll(env, 3, 20)


@pytest.mark.parametrize(("name", "client"), ends_first(CLIENTS))
def test_reset_seed_determines_everything(name, client):
    env = make(name, client)
    first = roll(env, 11)
    assert roll(env, 11) == first
    assert roll(make(name, client), 11) == first
    if name != "Bandit2D":
        assert env.reset(seed=1)[0].tolist() != env.reset(seed=2)[0].tolist()


@pytest.mark.parametrize("name", fed_envs.FAMILIES)
def test_environments_pickle_in_mid_episode(name):
    env = make(name, 2)
    roll(env, 5, 7)
    twins = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    rng = np.random.default_rng(0)
    for _ in range(40):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        observation, reward, terminated, truncated, _ = env.step(action)
        start = env.reset()[0] if terminated or truncated else None
        for twin in twins:
            result = twin.step(action)
            assert result[0].tolist() == observation.tolist()
            assert result[1:4] == (reward, terminated, truncated)
            if start is not None:
                assert twin.reset()[0].tolist() == start.tolist()


@pytest.mark.parametrize("name", fed_envs.FAMILIES)
def test_clients_are_different_worlds_with_one_interface(name):
    family = fed_envs.load_family(name)
    envs = [family.make(k) for k in range(family.n_clients)]
    assert all(env.observation_space == envs[0].observation_space for env in envs)
    assert all(env.action_space == envs[0].action_space for env in envs)
    limit = 1.5 if name == "Bandit2D" else 1.0
    assert (envs[0].action_space.low == -limit).all() and (envs[0].action_space.high == limit).all()
    if name != "Bandit2D":  # there all peaks are equal in the paper's setting
        traces = [str(roll(env, 0, 5)) for env in envs]
        assert len(set(traces)) == family.n_clients


@pytest.mark.parametrize("name", ["Bandit2D", "Reacher", "ReacherHard", "HalfCheetah", "HalfCheetahHard"])
def test_episodes_end_at_the_time_limit(name):
    """Hopper and Walker2D fall earlier; test_vec_env.py truncates them with a short limit."""
    env = make(name, 1)
    env.reset(seed=0)
    limit = fed_envs.load_family(name).max_episode_steps
    ends = [env.step(np.zeros(env.action_space.shape, dtype=np.float32))[2:4] for _ in range(limit)]
    assert all(end == (False, False) for end in ends[:-1])
    assert ends[-1] == ((True, True) if name == "Bandit2D" else (False, True))


def nominal(model_name: str) -> mujoco.MjModel:
    return gymnasium.make(model_name).unwrapped.model


@pytest.mark.parametrize(("name", "client"), LEGGED)
def test_built_locomotion_environment_has_its_clients_parameters(name, client):
    family = fed_envs.load_family(name)
    parameters = family.clients[client]
    env = make(name, client).unwrapped
    base, model = nominal(family.backbone), env.model
    floor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "floor")
    assert model.body_mass[0] == base.body_mass[0]
    np.testing.assert_allclose(model.body_mass[1:], base.body_mass[1:] * parameters.mass_scale, rtol=1e-12)
    np.testing.assert_allclose(model.body_subtreemass[1:], base.body_subtreemass[1:] * parameters.mass_scale, rtol=1e-12)
    np.testing.assert_array_equal(model.body_inertia, base.body_inertia)
    np.testing.assert_allclose(model.dof_damping, base.dof_damping * parameters.damping_scale, rtol=1e-12)
    np.testing.assert_allclose(model.geom_friction[floor], base.geom_friction[floor] * parameters.friction_scale, rtol=1e-12)
    np.testing.assert_array_equal(np.delete(model.geom_friction, floor, 0), np.delete(base.geom_friction, floor, 0))
    np.testing.assert_array_equal(model.actuator_gear, base.actuator_gear)  # the gain acts on actions, not on the gear

    env.reset(seed=0)
    resets = np.array([env.reset()[0] for _ in range(50)])
    positions = resets[:, : model.nq - 1] - env.init_qpos[1:]
    assert 0.8 * parameters.reset_noise_scale < np.abs(positions).max() <= parameters.reset_noise_scale

    action = np.linspace(-1.0, 0.9, model.nu).astype(np.float32)
    _, reward, _, _, info = env.step(action)
    applied = np.clip(parameters.action_gain * action, -1.0, 1.0)
    np.testing.assert_allclose(env.data.ctrl, applied, rtol=1e-6)
    np.testing.assert_allclose(info["reward_forward"], parameters.forward_reward_weight * info["x_velocity"], rtol=1e-12)
    np.testing.assert_allclose(info["reward_ctrl"], -parameters.ctrl_cost_weight * (applied**2).sum(), rtol=1e-6)
    unstable = env.data.qpos[2] ** 2 + 0.25 * (
        env.data.qvel[2] ** 2 if family.backbone == "HalfCheetah-v5" else (env.data.qvel[2:5] ** 2).sum()
    )
    np.testing.assert_allclose(info["reward_instability"], -parameters.instability_cost_weight * unstable, rtol=1e-12)
    np.testing.assert_allclose(reward, sum(info[key] for key in info if key.startswith("reward_")), rtol=1e-12)


@pytest.mark.parametrize("name", ["HopperHard", "Walker2DHard", "HalfCheetahHard"])
@pytest.mark.parametrize("floor_priority", [False, True])
def test_friction_at_the_contacts(name, floor_priority):
    """Without priority the larger friction of foot and floor acts, so the client's floor only matters on HalfCheetah."""
    family = fed_envs.load_family(name)
    for client in (3, 4):
        env = make(name, client, floor_priority=floor_priority).unwrapped
        model, data = env.model, env.data
        floor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "floor")
        env.reset(seed=0)
        rng = np.random.default_rng(0)
        seen = 0
        for _ in range(60):
            env.step(rng.uniform(-1, 1, model.nu).astype(np.float32))
            for contact in data.contact:
                if floor not in contact.geom:
                    continue
                other = contact.geom.sum() - floor
                own = family.clients[client].friction_scale * nominal_floor(name)
                expected = own if floor_priority else max(own, model.geom_friction[other, 0])
                np.testing.assert_allclose(contact.friction[0], expected, rtol=1e-9)
                seen += 1
        assert seen > 10


def nominal_floor(name: str) -> float:
    return {"HopperHard": 1.0, "Walker2DHard": 0.7, "HalfCheetahHard": 0.4}[name]


@pytest.mark.parametrize(("name", "client"), REACHERS)
def test_built_reacher_environment_has_its_clients_parameters(name, client):
    parameters = fed_envs.load_family(name).clients[client]
    env = make(name, client).unwrapped
    base, model = nominal("Reacher-v5"), env.model
    np.testing.assert_allclose(model.body_mass[1:], base.body_mass[1:] * parameters.mass_scale, rtol=1e-12)
    np.testing.assert_allclose(model.dof_damping, base.dof_damping * parameters.damping_scale, rtol=1e-12)
    np.testing.assert_allclose(model.actuator_gear, base.actuator_gear * parameters.gear_scale, rtol=1e-12)

    env.reset(seed=0)
    starts = []
    for _ in range(60):
        env.reset()
        starts.append(env.data.qpos.copy())
    angles, goals = np.array(starts)[:, :2], np.array(starts)[:, 2:]
    assert np.abs(angles - parameters.angle_offset).max() <= 0.1 and np.abs(angles - parameters.angle_offset).max() > 0.08
    for axis, (low, high) in enumerate((parameters.goal_x, parameters.goal_y)):
        assert low <= goals[:, axis].min() and goals[:, axis].max() <= high
        assert goals[:, axis].max() - goals[:, axis].min() > 0.7 * (high - low)
    assert np.linalg.norm(goals, axis=1).max() < 0.25

    # The reward from its definition, on states read from the simulator.
    weights = {"default": (1, 1, 0, 0), "speed": (1, 1, 0.1, 0), "stability": (1, 1, 0, 0.01), "efficiency": (1, 3, 0, 0)}
    w_distance, w_control, w_speed, w_joints = weights[parameters.preference]

    def distance() -> float:
        return float(np.linalg.norm(env.data.body("fingertip").xpos - env.data.body("target").xpos))

    rng = np.random.default_rng(client)
    for _ in range(10):
        action = rng.uniform(-1, 1, 2).astype(np.float32)
        before = distance()
        _, reward, _, _, info = env.step(action)
        applied = np.clip(action + np.array(parameters.action_offset), -1, 1)
        np.testing.assert_allclose(env.data.ctrl, applied, rtol=1e-5, atol=1e-7)
        expected = -w_distance * distance() - w_control * (applied**2).sum()
        expected += w_speed * (before - distance()) / 0.02 - w_joints * (env.data.qvel[:2] ** 2).sum()
        np.testing.assert_allclose(reward, parameters.reward_scale * expected, rtol=1e-5)
        np.testing.assert_allclose(sum(info.values()), reward, rtol=1e-9)


def test_unreachable_goals_are_redrawn():
    """The diagonal sectors' boxes have a corner outside the reach; a box that is mostly outside it shows the redrawing."""
    env = make("Reacher", 1, goal_x=(0.1, 0.249), goal_y=(0.1, 0.249)).unwrapped
    env.reset(seed=0)
    goals = []
    for _ in range(300):
        env.reset()
        goals.append(env.data.qpos[2:].copy())
    norms = np.linalg.norm(goals, axis=1)
    assert norms.max() < 0.25 and norms.max() > 0.24


@pytest.mark.parametrize("client", range(4))
@pytest.mark.parametrize("off_peak_weight", [1.0, 0.1])
def test_bandit_rewards(client, off_peak_weight):
    from fed_envs.bandit2d import PEAKS, SIGMA, reward

    env = make("Bandit2D", client, off_peak_weight=off_peak_weight)
    rng = np.random.default_rng(client)
    actions = rng.uniform(-1.5, 1.5, (50, 2)).astype(np.float32)
    expected = []
    for action in actions.astype(float):
        heights = [
            (1.0 if m == client else off_peak_weight) * np.exp(-((action - PEAKS[m]) ** 2).sum() / (2 * SIGMA**2))
            for m in range(4)
        ]
        expected.append(max(heights))
    got = []
    for action in actions:
        assert env.reset()[0].tolist() == [0.0, 0.0]
        observation, value, terminated, _, _ = env.step(action)
        assert terminated and observation.tolist() == [0.0, 0.0]
        got.append(value)
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    np.testing.assert_array_equal(reward(actions.reshape(5, 10, 2), client, off_peak_weight), np.reshape(got, (5, 10)))
    assert reward(PEAKS[client], client, off_peak_weight) == 1.0
    np.testing.assert_array_equal(reward(actions, client + 4, off_peak_weight), got)  # client c owns peak c mod 4


def test_own_metadata(tmp_path):
    from fed_envs.generation import generate_family

    family = generate_family("HopperHard", 11, seed=4)
    path = str(tmp_path / "mine.json")
    family.dump(path)
    by_path = make("HopperHard", 10, metadata=path)
    by_content = make("HopperHard", 10, metadata=family.to_dict())
    by_family = family.make(10)
    assert roll(by_path, 1) == roll(by_content, 1) == roll(by_family, 1)
    (tmp_path / "mine.json").unlink()
    recovered = gymnasium.make(EnvSpec.from_json(by_family.spec.to_json()))  # the spec needs no file beside it
    assert roll(recovered, 1) == roll(by_family, 1)
    assert json.loads(by_family.spec.to_json())["id"] == "fed_envs/HopperHard_11_seed4-v0"


def test_own_time_limit():
    content = fed_envs.load_family("HalfCheetah").to_dict() | {"max_episode_steps": 7, "family": "Short"}
    env = fed_envs.metadata.parse_family(content, "x").make(3)
    env.reset(seed=0)
    assert [env.step(env.action_space.sample())[3] for _ in range(7)] == [False] * 6 + [True]
    with pytest.raises(ValueError, match=r"max_episode_steps 7.*registered for 1000.*make\(client\)"):
        make("HalfCheetah", 3, metadata=content)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"client": 8}, "HopperHard has clients 0 to 7, not 8"),
        ({"mass_scael": 1.0}, "client 0: mass_scael: is not a known field"),
        ({"mass_scale": 0.0}, "client 0: mass_scale: .*greater than 0"),
        ({"metadata": "Walker2DHard"}, "backbone 'Walker2d-v5'.*registered for 'Hopper-v5'"),
        ({"metadata": "Bandit2D"}, "world 'bandit2d'"),
        ({"metadata": 3}, "metadata must be a path"),
        ({"metadata": "nowhere.json"}, "cannot read the metadata file nowhere.json"),
        ({"render_mode": "ascii"}, "renders human, rgb_array"),
    ],
)
def test_mistakes_are_value_errors(arguments, message):
    with pytest.raises(ValueError, match=message), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Gymnasium warns about the render mode before the environment refuses it
        make("HopperHard", **{"client": 0, **arguments})


def test_wrong_action_shapes_are_value_errors():
    env = make("HopperHard").unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(3,\), got \(1, 3\)"):
        env.step(np.zeros((1, 3), dtype=np.float32))


SLOW_PICTURES = [pytest.param(name, marks=pytest.mark.slow) for name in ("Walker2DHard", "HalfCheetahHard", "ReacherHard")]


@pytest.mark.parametrize("name", ["HopperHard", *SLOW_PICTURES])
def test_rgb_arrays_without_a_display(name):
    check_pictures(name)


@pytest.mark.slow  # tests of FederatedVecEnv have Bandit2D's pictures
def test_pictures_of_several_clients():
    run_with_osmesa("""
import fed_envs
clients = fed_envs.FederatedVecEnv("ReacherHard", clients=[0, 5], render_mode="rgb_array")
clients.reset()
assert [image.shape for image in clients.get_images()] == [(480, 480, 3)] * 2
clients.close()
""")
