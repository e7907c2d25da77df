"""FederatedVecEnv: bit for bit the single environments, whoever else is there, and a proper SB3 VecEnv."""

from __future__ import annotations

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecNormalize

import fed_envs
from fed_envs import FederatedVecEnv, vec_env
from fed_envs.metadata import Family, parse_family
from fed_envs.seeding import integer_seed
from tests.conftest import others_slow

# Random policies: Hopper falls after some 20 steps, so that this many steps contain many automatic resets.
STEPS = {"bandit2d": 50, "reacher": 160, "locomotion": 250, "point_maze": 190, "metaworld": 33}
# Shorter episodes for worlds that are slow to simulate or do not end before the time limit.
LIMITS = {"metaworld": 10, "point_maze": 60}
# What unfinished steps say; finished ones add to it.
STEP_INFO = {"metaworld": ("success", "is_success"), "point_maze": ("success", "is_success")}


def actions_for(venv: FederatedVecEnv, steps: int, seed: int = 0) -> np.ndarray:
    """Actions a little beyond the bounds, since clipping belongs to the worlds."""
    shape = (steps, venv.num_envs, *venv.action_space.shape)
    return (1.2 * np.random.default_rng(seed).uniform(venv.action_space.low, venv.action_space.high, shape)).astype(np.float32)


def record(venv: FederatedVecEnv, actions: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    return [venv.step(action)[:3] for action in actions]


@pytest.fixture(autouse=True)
def threads_for_few_environments(monkeypatch):
    """Threads are for many environments; here a few of them are to meet threads as well."""
    monkeypatch.setattr(vec_env, "MIN_ROWS_PER_THREAD", 1)


def assert_same(first: list, second: list) -> None:
    for one, two in zip(first, second, strict=True):
        for left, right in zip(one, two, strict=True):
            np.testing.assert_array_equal(left, right)


def short(name: str, steps: int) -> Family:
    return parse_family(fed_envs.load_family(name).to_dict() | {"max_episode_steps": steps, "family": "Short"}, "short")


def is_quick(name: str, copies: int, threads: int) -> bool:
    """One family of each body with several copies and threads, and one with all of their combinations."""
    return name == "ReacherHard" or (f"{name}Hard" not in fed_envs.FAMILIES and (copies, threads) == (3, 2))


COMBINATIONS = [(name, copies, threads) for name in fed_envs.FAMILIES for copies in (1, 3) for threads in (1, 2)]


@pytest.mark.parametrize(("name", "copies", "threads"), others_slow(COMBINATIONS, is_quick))
def test_equals_the_single_environments_bit_for_bit(name, copies, threads):
    family = fed_envs.load_family(name)
    limit = LIMITS.get(family.world, family.max_episode_steps)
    venv = FederatedVecEnv(short(name, limit), copies, num_threads=threads, role=3)
    ids = [(f"fed_envs/{name}-v0", k) for k in range(venv.n_clients) for _ in range(copies)]
    envs = [gymnasium.make(id_, max_episode_steps=limit, client=k) for id_, k in ids]
    seeds = venv.seed(7)
    assert seeds == [integer_seed(7, 3, k, c) for k in range(venv.n_clients) for c in range(copies)]
    observations = venv.reset()
    assert observations.dtype == envs[0].observation_space.dtype
    singles = [env.reset(seed=seed)[0] for env, seed in zip(envs, seeds, strict=True)]
    np.testing.assert_array_equal(observations, singles)
    returns, lengths, ends = np.zeros(venv.num_envs), np.zeros(venv.num_envs, dtype=int), 0
    for actions in actions_for(venv, STEPS[family.world] // copies):
        observations, rewards, dones, infos = venv.step(actions)
        assert rewards.dtype == np.float32 and dones.dtype == bool
        for i, env in enumerate(envs):
            observation, reward, terminated, truncated, info = env.step(actions[i])
            said = {key: info[key] for key in STEP_INFO.get(family.world, ())}
            assert said.items() <= infos[i].items()
            assert rewards[i] == np.float32(reward) and dones[i] == (terminated or truncated)
            returns[i] += reward
            lengths[i] += 1
            if dones[i]:
                ends += 1
                np.testing.assert_array_equal(infos[i]["terminal_observation"], observation)
                assert infos[i]["TimeLimit.truncated"] == (truncated and not terminated)
                assert infos[i]["episode"]["r"] == returns[i] and infos[i]["episode"]["l"] == lengths[i]
                returns[i], lengths[i] = 0.0, 0
                observation, _ = env.reset()
            else:
                assert infos[i] == said
            np.testing.assert_array_equal(observations[i], observation)
    venv.close()
    if not name.startswith("HalfCheetah"):
        assert ends >= venv.num_envs


@pytest.mark.parametrize("name", others_slow(fed_envs.FAMILIES, lambda name: f"{name}Hard" not in fed_envs.FAMILIES))
def test_a_client_does_not_depend_on_its_neighbours(name):
    everyone = FederatedVecEnv(name, 2)
    some = FederatedVecEnv(name, 2, clients=[3, 1])
    alone = FederatedVecEnv(name, 1, clients=[1])
    assert some.client_ids == [3, 1] and everyone.num_envs == 2 * everyone.n_clients
    for venv in (everyone, some, alone):
        venv.seed(5)
    rows = [6, 7, 2, 3]  # clients 3, 3, 1, 1 in everyone
    np.testing.assert_array_equal(everyone.reset()[rows], some.reset())
    alone.reset()
    for actions in actions_for(everyone, 60):
        full, part, single = everyone.step(actions), some.step(actions[rows]), alone.step(actions[[2]])
        for whole, selected, one in zip(full[:3], part[:3], single[:3], strict=True):
            np.testing.assert_array_equal(whole[rows], selected)
            np.testing.assert_array_equal(whole[[2]], one)


def test_threads_change_nothing():
    one, two = FederatedVecEnv("Walker2DHard", 2), FederatedVecEnv("Walker2DHard", 2, num_threads=5)
    for venv in (one, two):
        venv.seed(0)
        venv.reset()
    actions = actions_for(one, 100)
    assert_same(record(one, actions), record(two, actions))
    assert two._pool is not None
    two.close()
    assert_same(record(one, actions[:5]), record(two, actions[:5]))  # close() releases the threads, the simulators stay
    two.close()


def test_roles_and_copies_have_streams_of_their_own():
    starts = []
    for role in (0, 1):
        venv = FederatedVecEnv("HopperHard", 2, role=role)
        venv.seed(0)
        starts.append(venv.reset())
    flat = np.concatenate(starts)
    assert len({tuple(row) for row in flat}) == 32
    venv.seed(None)
    assert not np.array_equal(venv.reset(), starts[1])


def test_truncation_is_not_termination():
    venv = FederatedVecEnv(short("HopperHard", 5))
    venv.seed(0)
    venv.reset()
    zeros = np.zeros((8, 3), dtype=np.float32)
    for _ in range(4):
        assert not venv.step(zeros)[2].any()
    observations, _, dones, infos = venv.step(zeros)
    assert dones.all() and all(info["TimeLimit.truncated"] for info in infos)
    assert all(info["episode"]["l"] == 5 for info in infos)
    assert not any(np.array_equal(info["terminal_observation"], row) for info, row in zip(infos, observations, strict=True))
    falling = FederatedVecEnv("HopperHard")
    falling.seed(0)
    falling.reset()
    ended = [info for actions in actions_for(falling, 60) for info in falling.step(actions)[3] if info]
    assert ended and not any(info["TimeLimit.truncated"] for info in ended)


@pytest.mark.parametrize("name", ["HopperHard", "ReacherHard", "Bandit2D"])
@pytest.mark.parametrize("threads", [1, 2])
def test_inactive_environments_wait(name, threads):
    venv, reference = FederatedVecEnv(name, num_threads=threads), FederatedVecEnv(name)
    for each in (venv, reference):
        each.seed(1)
    before = venv.reset()
    reference.reset()
    venv.active[[0, 2]] = False
    actions = actions_for(venv, 40)
    actions[:, 2] = np.nan  # what an absent client's policy says is nobody's business
    for action in actions:
        observations, rewards, dones, infos = venv.step(action)
        expected = reference.step(np.nan_to_num(action))
        for absent in (0, 2):
            np.testing.assert_array_equal(observations[absent], before[absent])
            assert rewards[absent] == 0.0 and not dones[absent] and infos[absent] == {}
        for got, wanted in zip((observations, rewards, dones), expected[:3], strict=True):
            np.testing.assert_array_equal(got[[1, 3]], wanted[[1, 3]])
    venv.active = True  # they come back where they left
    fresh = FederatedVecEnv(name)
    fresh.seed(1)
    fresh.reset()
    for action in np.nan_to_num(actions):
        got, wanted = venv.step(action), fresh.step(action)
        for left, right in zip(got[:3], wanted[:3], strict=True):
            np.testing.assert_array_equal(left[[0, 2]], right[[0, 2]])
    venv.close()


@pytest.mark.parametrize("name", ["HalfCheetahHard", "ReacherHard", "Bandit2D"])
def test_copies_go_on_like_the_original(name):
    venv = FederatedVecEnv(name, 2, num_threads=2)
    venv.seed(0)
    venv.reset()
    actions = actions_for(venv, 100)
    record(venv, actions[:30])
    venv.active[1] = False
    twins = [copy.deepcopy(venv), pickle.loads(pickle.dumps(venv))]
    expected = record(venv, actions[30:])
    for twin in twins:
        assert_same(record(twin, actions[30:]), expected)
        twin.close()
    venv.close()


def test_results_are_not_overwritten_by_later_steps():
    venv = FederatedVecEnv("HopperHard")
    venv.seed(0)
    kept = [venv.reset()]
    copies = [kept[0].copy()]
    for actions in actions_for(venv, 30):
        observations, rewards, dones, infos = venv.step(actions)
        for array in (observations, rewards, dones, *(info["terminal_observation"] for info in infos if info)):
            kept.append(array)
            copies.append(array.copy())
    for array, as_it_was in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(array, as_it_was)


def test_access_to_the_environments():
    venv = FederatedVecEnv("HopperHard", 2, clients=[1, 4])
    assert [client.client for client in venv.get_attr("client")] == [1, 1, 4, 4]
    venv.set_attr("label", "x", indices=[0, 3])
    assert venv.get_attr("label", indices=3) == ["x"] and not venv.has_attr("label")
    state = np.array([0.0, 1.3, 0.0, 0.0, 0.0, 0.0]), np.zeros(6)
    venv.reset()
    venv.env_method("set_state", *state, indices=2)
    observations, *_ = venv.step(np.zeros((4, 3), dtype=np.float32))
    assert abs(observations[2, 0] - 1.3) < 1e-3
    assert venv.env_is_wrapped(Monitor) == [True] * 4  # episode statistics are recorded here
    assert venv.env_is_wrapped(TimeLimit) == [False] * 4
    assert venv.render_mode is None and venv.unwrapped is venv
    assert venv.name == "HopperHard" and venv.n_clients == 2 and venv.n_envs_per_client == 2


def test_pictures_are_every_clients_own(monkeypatch):
    venv = FederatedVecEnv("Bandit2D", clients=[3, 1], render_mode="rgb_array")
    venv.reset()
    assert venv.render_mode == "rgb_array" and venv.get_attr("render_mode") == ["rgb_array"] * 2
    assert [image.shape for image in venv.get_images()] == [(240, 240, 3)] * 2
    monkeypatch.setattr(type(venv.envs[0].unwrapped), "render", lambda env: env.client)
    assert [client.client for client in venv.get_images()] == [3, 1]


def test_options_reach_the_environments():
    class Env(gymnasium.Env):
        observation_space = spaces.Box(-1, 1, (1,))
        action_space = spaces.Box(-1, 1, (1,))

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.options = options
            return np.zeros(1, dtype=np.float32), {"seed": seed}

    venv = FederatedVecEnv([Env, Env])
    venv.set_options({"start": 1})
    seeds = venv.seed(3)
    venv.reset()
    assert venv.get_attr("options") == [{"start": 1}] * 2 and [info["seed"] for info in venv.reset_infos] == seeds
    venv.reset()
    assert venv.get_attr("options") == [None] * 2 and [info["seed"] for info in venv.reset_infos] == [None, None]


def test_own_environments_are_stepped_like_a_family():
    """Factories of a family's own environments give what the family gives, infos aside."""
    family = short("HopperHard", 30)
    factories = [lambda k=k: family.make(k) for k in range(family.n_clients)]
    own, ours = FederatedVecEnv(factories, 2, clients=[0, 5]), FederatedVecEnv(family, 2, clients=[0, 5])
    assert own.family is None and own.name == "custom" and own.client_ids == [0, 5]
    for venv in (own, ours):
        venv.seed(0)
        venv.reset()
    truncations = 0
    for number, actions in enumerate(0.3 * actions_for(own, 120)):
        own.active = ours.active = np.array([True, number % 3 > 0, True, True])
        got, wanted = own.step(actions), ours.step(actions)
        for left, right in zip(got[:3], wanted[:3], strict=True):
            np.testing.assert_array_equal(left, right)
        for info, expected in zip(got[3], wanted[3], strict=True):
            if expected:
                np.testing.assert_array_equal(info["terminal_observation"], expected["terminal_observation"])
                assert info["TimeLimit.truncated"] == expected["TimeLimit.truncated"]
                assert info["episode"]["r"] == expected["episode"]["r"] and info["episode"]["l"] == expected["episode"]["l"]
                truncations += info["TimeLimit.truncated"]
    assert truncations and "x_velocity" in got[3][0]
    monitored = FederatedVecEnv([lambda: Monitor(gymnasium.make("CartPole-v1"))])
    monitored.seed(0)
    monitored.reset()
    infos = [info for _ in range(100) for info in monitored.step(np.array([0]))[3] if "episode" in info]
    assert infos and all(set(info["episode"]) == {"r", "l", "t"} for info in infos)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"family": "HoperHard"}, "did you mean 'HopperHard'"),
        ({"family": "HopperHard", "clients": [8]}, "clients 0 to 7, not 8"),
        ({"family": "HopperHard", "clients": [1, 1]}, "each once"),
        ({"family": "HopperHard", "clients": []}, "at least one client"),
        ({"family": "HopperHard", "n_envs_per_client": 0}, "n_envs_per_client must be at least 1"),
        ({"family": "HopperHard", "num_threads": 0}, "num_threads must be at least 1"),
        ({"family": "Bandit2D", "render_mode": "human"}, "renders rgb_array, not 'human'"),
        ({"family": []}, "one function per client"),
        ({"family": [lambda: gymnasium.make("CartPole-v1"), lambda: gymnasium.make("Pendulum-v1")]}, "share their spaces"),
        ({"family": [lambda: gymnasium.make("CartPole-v1")], "render_mode": "rgb_array"}, "their own render_mode"),
    ],
)
def test_mistakes_are_value_errors(arguments, message):
    with pytest.raises(ValueError, match=message):
        FederatedVecEnv(**arguments)


def test_one_environment_for_two_clients_is_refused():
    env = gymnasium.make("CartPole-v1")
    with pytest.raises(ValueError, match="new environment at every call"):
        FederatedVecEnv([lambda: env, lambda: env])


def test_wrong_steps_are_value_errors():
    venv = FederatedVecEnv("ReacherHard")
    venv.reset()
    with pytest.raises(ValueError, match=r"shape \(8, 2\), got \(2, 8\)"):
        venv.step(np.zeros((2, 8)))
    with pytest.raises(ValueError, match="without step_async"):
        venv.step_wait()
    actions = np.zeros((8, 2), dtype=np.float32)
    actions[5, 1] = np.nan
    with pytest.raises(ValueError, match=r"client 5: the action \[ *0\. +nan\] is not finite"):
        venv.step(actions)
    with pytest.raises(ValueError):
        venv.active = np.ones(3, dtype=bool)


def test_sb3_ppo_trains_on_it_unmodified():
    venv = FederatedVecEnv("ReacherHard", 1, num_threads=2)
    model = PPO("MlpPolicy", VecNormalize(venv), n_steps=64, batch_size=128, n_epochs=2, seed=0, device="cpu")
    model.learn(2 * 8 * 64)
    assert len(model.ep_info_buffer) == 16  # two episodes of 50 steps for each of eight clients
    returns, lengths = evaluate_policy(model, FederatedVecEnv("ReacherHard"), n_eval_episodes=8, return_episode_rewards=True)
    assert lengths == [50] * 8 and len(set(returns)) == 8
    venv.close()


def test_sb3_ppo_solves_the_bandit():
    """A learning test: a random policy gets about 0.11 a step, a trained one finds a peak."""
    venv = FederatedVecEnv("Bandit2D", 16)
    model = PPO(
        "MlpPolicy", venv, n_steps=16, batch_size=256, n_epochs=10, learning_rate=3e-3, gamma=0.0, seed=0, device="cpu"
    )
    model.learn(20 * 64 * 16)
    mean, _ = evaluate_policy(model, FederatedVecEnv("Bandit2D"), n_eval_episodes=8)
    assert mean > 0.8
