"""MetaWorld10: metaworld's own dynamics and rewards, everything from the seed, nothing shared between environments."""

from __future__ import annotations

import copy
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.policies import ENV_POLICY_MAP

import fed_envs
from fed_envs.clients import METAWORLD_TASKS
from fed_envs.metadata import parse_family
from fed_envs.metaworld10 import MetaWorldEnv
from tests.rendering import run_with_osmesa

FAMILY = fed_envs.load_family("MetaWorld10")
CLIENTS = range(10)
PEG, BASKETBALL = 6, 9
#: Parameters of tests: the first task, the last, and the one with a hole in its model; the others are slow tests.
SOME_CLIENTS = [pytest.param(k, marks=() if k in (0, PEG, BASKETBALL) else pytest.mark.slow) for k in CLIENTS]


def make(client: int, **kwargs) -> gymnasium.Env:
    return FAMILY.make(client, **kwargs)


def actions(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (n, 4)).astype(np.float32)


def roll(env: gymnasium.Env, steps: np.ndarray) -> list:
    return [(result[0].tolist(), *result[1:]) for result in map(env.step, steps)]


def test_the_tasks_are_the_papers():
    assert tuple(client.task for client in FAMILY.clients) == METAWORLD_TASKS
    assert METAWORLD_TASKS == (
        "reach-v3", "push-v3", "pick-place-v3", "door-open-v3", "drawer-close-v3", "button-press-topdown-v3",
        "peg-insert-side-v3", "window-open-v3", "sweep-v3", "basketball-v3",
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"client 0 .*task: must be one of reach-v3, .* not 'juggle-v3'"):
        parse_family({**FAMILY.to_dict(), "clients": [{"client": 0, "task": "juggle-v3"}]}, "mine.json")


@pytest.mark.parametrize("client", SOME_CLIENTS)
def test_an_episode_is_metaworlds_to_the_last_bit(client):
    """A second episode of ours, with the positions it drew, in metaworld's own environment."""
    env = make(client)
    env.reset(seed=99)
    roll(env, actions(5))
    observation, _ = env.reset()
    task = env.unwrapped.client.task
    original = ALL_V3_ENVIRONMENTS[task]()
    original._set_task_called, original._partially_observable, original._freeze_rand_vec = True, False, True
    del original.sawyer_observation_space
    original._last_rand_vec = env.unwrapped.sawyer._last_rand_vec.copy()
    expected, _ = original.reset()
    np.testing.assert_array_equal(observation, expected)
    np.testing.assert_array_equal(observation[18:36], observation[:18])
    policy = ENV_POLICY_MAP[task]()
    for noise in actions(60):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            action = np.clip(policy.get_action(expected) + 0.3 * noise, -1, 1).astype(np.float32)
        expected, reward, _, _, info = original.step(action)
        result = env.step(action)
        np.testing.assert_array_equal(result[0], expected)
        assert result[1] == reward and not result[2] and not result[3]
        assert result[4]["success"] == bool(info["success"])
        assert {name: result[4][name] for name in info if name != "success"} == {
            name: float(value) for name, value in info.items() if name != "success"
        }
    original.close()


def test_the_global_generator_is_neither_read_nor_changed():
    traces = []
    for seed in (0, 1):
        np.random.seed(seed)
        before = np.random.get_state()
        env = make(1)
        trace = [env.reset(seed=4)[0].tolist(), env.reset()[0].tolist(), roll(env, actions(5))]
        after = np.random.get_state()
        assert before[0] == after[0] and before[2:] == after[2:]
        np.testing.assert_array_equal(before[1], after[1])
        traces.append(trace)
    assert traces[0] == traces[1]


@pytest.mark.parametrize("client", SOME_CLIENTS)
def test_positions_are_drawn_from_the_tasks_region_at_every_reset(client):
    env = make(client)
    env.reset(seed=0)
    starts, drawn = [], []
    for _ in range(6):
        starts.append(env.reset()[0])
        drawn.append(env.unwrapped.sawyer._last_rand_vec.copy())
        assert (starts[-1][36:] != 0).any()  # the goal is observed
    assert len({tuple(start) for start in starts}) == len({tuple(vector) for vector in drawn}) == 6
    region = env.unwrapped.sawyer._random_reset_space
    assert (region.low <= drawn).all() and (drawn <= region.high).all()


@pytest.mark.parametrize("client", [0, PEG])
def test_fixed_goal_starts_every_episode_in_the_same_place(client):
    env = make(client, fixed_goal=True)
    first = env.reset(seed=0)[0].tolist()
    roll(env, actions(5))
    assert env.reset()[0].tolist() == env.reset(seed=1)[0].tolist() == first
    family = fed_envs.load_family("MetaWorld10", fixed_goal=True)
    assert family.make(client).reset(seed=2)[0].tolist() == first
    assert family.content_hash != FAMILY.content_hash


@pytest.mark.parametrize("client", [3, PEG])
def test_environments_of_one_task_leave_each_other_alone(client):
    """They share a model, in which each has its door or its hole elsewhere."""
    alone = []
    for seed in (1, 2):
        env = make(client)
        start = env.reset(seed=seed)[0].tolist()
        alone.append([start, *roll(env, actions(12, seed))])
    envs = [make(client), make(client)]
    together: list[list] = [[env.reset(seed=seed)[0].tolist()] for env, seed in zip(envs, (1, 2), strict=True)]
    for step in range(12):
        for env, trace, seed in zip(envs, together, (1, 2), strict=True):
            trace += roll(env, actions(12, seed)[step : step + 1])
    assert together == alone
    assert alone[0][0][36:] != alone[1][0][36:]


@pytest.mark.parametrize("client", SOME_CLIENTS)
@pytest.mark.parametrize("steps", [0, 15])
def test_copies_go_on_like_the_original(client, steps):
    env = make(client)
    env.reset(seed=8)
    roll(env, actions(steps, 1))
    twins = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    twins.append(pickle.loads(pickle.dumps(twins[0])))
    make(client).reset(seed=9)  # moves the shared model
    trace = [roll(env, actions(10)), env.reset()[0].tolist(), roll(env, actions(3))]
    for twin in twins:
        assert [roll(twin, actions(10)), twin.reset()[0].tolist(), roll(twin, actions(3))] == trace
    assert len(pickle.dumps(env)) < 100_000  # without the model


def test_actions_beyond_the_bounds_are_clipped():
    envs = [make(2), make(2)]
    for env in envs:
        env.reset(seed=0)
    for action in 3.0 * actions(20):
        assert roll(envs[0], action[None]) == roll(envs[1], np.clip(action, -1, 1)[None])


def test_success_is_of_the_step_and_is_success_of_the_episode():
    env = make(0)
    policy, rng = MetaWorldEnv.scripted_policy(FAMILY, 0), np.random.default_rng(0)
    observation, _ = env.reset(seed=0)
    infos = []
    for _ in range(80):
        observation, _, _, _, info = env.step(policy(observation[None], rng)[0])
        infos.append(info)
    for _ in range(40):
        infos.append(env.step(np.array([0, -1, 1, 0], dtype=np.float32))[4])  # away from the goal
    success = [info["success"] for info in infos]
    assert not success[0] and any(success) and not success[-1]
    assert [info["is_success"] for info in infos] == np.logical_or.accumulate(success).tolist()
    env.reset()
    assert env.step(np.zeros(4, dtype=np.float32))[4]["is_success"] is False


def test_finished_episodes_of_the_vectorised_environment_report_success():
    short = parse_family({**FAMILY.to_dict(), "family": "Short", "max_episode_steps": 80}, "short")
    venv = fed_envs.FederatedVecEnv(short, clients=[0, PEG])
    venv.seed(1)
    observations = venv.reset()
    reach, rng = MetaWorldEnv.scripted_policy(FAMILY, 0), np.random.default_rng(0)
    for _ in range(80):
        moves = np.zeros((2, 4), dtype=np.float32)
        moves[0] = reach(observations[:1], rng)[0]
        observations, _, dones, infos = venv.step(moves)
    assert dones.all() and [info["is_success"] for info in infos] == [True, False]
    assert all(info["TimeLimit.truncated"] for info in infos)
    infos = venv.step(np.zeros((2, 4), dtype=np.float32))[3]
    assert infos == [{"success": False, "is_success": False}] * 2


def test_scripted_policies_solve_their_tasks_and_stay_inside_the_bounds():
    solved = 0
    for client in CLIENTS:
        policy, rng = MetaWorldEnv.scripted_policy(FAMILY, client), np.random.default_rng(client)
        venv = fed_envs.FederatedVecEnv(FAMILY, 2, clients=[client])
        venv.seed(1)
        observations = venv.reset()
        for step in range(200):
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                action = policy(observations, rng)
            assert action.shape == (2, 4) and action.dtype == np.float32 and (np.abs(action) < 1).all()
            if step == 0:
                again = policy(observations, np.random.default_rng(client))
                np.testing.assert_array_equal(action, again)
            observations, _, _, infos = venv.step(action)
            if all(info["is_success"] for info in infos):
                break
        solved += sum(info["is_success"] for info in infos)
    assert solved >= 15, solved  # of 20; with the noise and 500 steps more than 90 % are


def test_noise_of_the_scripted_policy():
    """``tanh(artanh(clip(a, -0.9, 0.9)) + 0.3 n)``."""
    observation = make(BASKETBALL).reset(seed=0)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        wanted = ENV_POLICY_MAP["basketball-v3"]().get_action(observation)
    rng = np.random.default_rng(0)
    acted = MetaWorldEnv.scripted_policy(FAMILY, BASKETBALL)(np.repeat(observation[None], 2000, 0), rng)
    raw = np.arctanh(acted)
    np.testing.assert_allclose(raw.mean(axis=0), np.arctanh(np.clip(wanted, -0.9, 0.9)), atol=0.03)
    np.testing.assert_allclose(raw.std(axis=0), 0.3, atol=0.02)


def test_images_show_the_goal_from_the_first_frame_on():
    run_with_osmesa("""
import numpy as np
import fed_envs
env = fed_envs.load_family("MetaWorld10").make(6, render_mode="rgb_array", width=160, height=120)
env.reset(seed=1)
first = env.render()
assert first.shape == (120, 160, 3) and first.dtype == np.uint8 and first.std() > 10
env.reset(seed=2)
other = env.render()
assert (first != other).any()  # the box with the hole stands elsewhere
twin = fed_envs.load_family("MetaWorld10").make(6)
twin.reset(seed=2)
for _ in range(2):
    a, b = env.step(np.ones(4, dtype=np.float32)), twin.step(np.ones(4, dtype=np.float32))
    env.render()
    assert a[0].tolist() == b[0].tolist()
""")
