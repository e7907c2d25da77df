"""The state of every environment as plain arrays: a new environment that takes it goes on bit for bit like the old one."""

from __future__ import annotations

import json

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from stable_baselines3.common.monitor import Monitor

import fed_envs
from fed_envs import FederatedVecEnv
from fed_envs.metadata import Family, parse_family
from fed_envs.plain_data import freeze, generator, thaw
from fed_envs.state import gives_state, load_state, save_state
from tests.environments import CountingEnv, PointEnv

#: An episode's steps here, and the steps before the state is taken: in mid-episode, but for the one-step bandit.
LIMITS, BEFORE, AFTER = {"metaworld": 12, "bandit2d": 1}, 7, 45


def short(name: str) -> Family:
    family = fed_envs.load_family(name)
    return parse_family(family.to_dict() | {"max_episode_steps": LIMITS.get(family.world, 30), "family": "Short"}, "short")


def actions_for(env, steps: int, seed: int = 0) -> np.ndarray:
    shape = (steps, env.num_envs, *env.action_space.shape)
    return np.random.default_rng(seed).uniform(-1.2, 1.2, shape).astype(np.float32)


def record(env: FederatedVecEnv, actions: np.ndarray) -> list:
    """Everything that a step says, the seconds of an episode apart."""
    trace = []
    for action in actions:
        observations, rewards, dones, infos = env.step(action)
        for info in infos:
            if "episode" in info:
                info["episode"].pop("t")
        trace.append((observations.tolist(), rewards.tolist(), dones.tolist(), repr(infos)))
    return trace


def plain(state) -> bool:
    """Whether a state consists of arrays, JSON values, lists, and dicts with text for keys."""
    if isinstance(state, dict):
        return all(type(key) is str and plain(item) for key, item in state.items())
    if isinstance(state, list):
        return all(map(plain, state))
    if isinstance(state, np.ndarray):
        return not state.dtype.hasobject
    return state is None or type(state) in (bool, int, float, str)


@pytest.mark.parametrize("name", fed_envs.FAMILIES)
def test_a_new_environment_goes_on_like_the_old_one(name):
    family = short(name)
    slow = family.world == "metaworld"
    old = FederatedVecEnv(family, 1 if slow else 2, clients=range(0, family.n_clients, 3 if slow else 1))
    old.seed(5)
    old.reset()
    before, after = np.split(actions_for(old, BEFORE + AFTER), [BEFORE])
    record(old, before)
    state = old.save_state()
    assert plain(state)
    expected = record(old, after)
    assert sum(any(dones) for _, _, dones, _ in expected) >= 1  # resets draw from the restored generators
    new = FederatedVecEnv(family, old.n_envs_per_client, clients=old.client_ids)
    new.seed(6)  # pending seeds are part of what is replaced
    new.load_state(state)
    assert record(new, after) == expected
    old.load_state(state)  # the state is a copy, and an environment can be put back
    assert record(old, after) == expected


@pytest.mark.parametrize("name", fed_envs.FAMILIES)
def test_a_single_environment_in_gymnasiums_wrappers(name):
    def make() -> gymnasium.Env:
        return wrappers.RecordEpisodeStatistics(gymnasium.make(f"fed_envs/{name}-v0", client=1, max_episode_steps=12))

    def roll(env: gymnasium.Env, steps: int, seed: int) -> list:
        env.action_space.seed(seed)
        trace = []
        for _ in range(steps):
            observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
            info.get("episode", {}).pop("t", None)
            trace.append((observation.tolist(), reward, terminated, truncated, repr(info)))
            if terminated or truncated:
                trace.append(env.reset()[0].tolist())
        return trace

    old, new = make(), make()
    old.reset(seed=3)
    roll(old, 5, 0)
    state = save_state(old)
    expected = roll(old, 30, 1)
    load_state(new, state)
    assert roll(new, 30, 1) == expected


def test_environments_that_are_away_keep_their_state():
    old, new = (FederatedVecEnv("Reacher") for _ in range(2))
    old.seed(1)
    old.reset()
    record(old, actions_for(old, 4))
    old.active[::2] = False
    record(old, actions_for(old, 4))
    state = old.save_state()
    new.load_state(state)
    assert new.active.tolist() == old.active.tolist()
    actions = actions_for(old, 60, 2)
    expected = record(old, actions)
    assert record(new, actions) == expected
    for env in (old, new):
        env.active[:] = True
    assert record(new, actions) == record(old, actions)


def counting_env(target: float) -> gymnasium.Env:
    env = wrappers.NormalizeObservation(wrappers.TimeLimit(CountingEnv(target), 9))
    return wrappers.RecordEpisodeStatistics(wrappers.FrameStackObservation(env, 2))


def flat(target: float) -> gymnasium.Env:
    return wrappers.FlattenObservation(counting_env(target))


def test_environments_of_ones_own_in_stateful_wrappers():
    old, new = (FederatedVecEnv([lambda: flat(0.0), lambda: flat(0.5)], 2) for _ in range(2))
    old.seed(4)
    old.reset()
    before, after = np.split(actions_for(old, 40), [13])
    record(old, before)
    state = old.save_state()
    assert plain(state)
    expected = record(old, after)
    new.load_state(state)
    assert record(new, after) == expected


def test_only_what_has_the_methods_everywhere_gives_its_state(point_envs):
    class Halved(gymnasium.ActionWrapper):
        def action(self, action):
            return action / 2

    class Forgetful(PointEnv):
        def save_state(self):
            return {}

    assert gives_state(counting_env(0.0)) and gives_state(Monitor(CountingEnv())) and gives_state(Forgetful())
    assert not gives_state(PointEnv()) and not gives_state(Halved(CountingEnv())) and not gives_state(Halved(Forgetful()))
    env = FederatedVecEnv([Forgetful])
    env.reset()
    state = env.save_state()
    with pytest.raises(ValueError, match=r"Forgetful has no load_state\(\): give it save_state\(\)"):
        env.load_state(state)


def test_states_of_other_environments_are_refused():
    old = FederatedVecEnv("Reacher", clients=[0, 1])
    old.seed(0)
    old.reset()
    state = old.save_state()
    with pytest.raises(ValueError, match=r"2 environments of the clients \[0, 1\], not of 3"):
        FederatedVecEnv("Reacher", clients=[0, 1, 2]).load_state(state)
    with pytest.raises(ValueError, match="another model or version"):
        FederatedVecEnv("Hopper", clients=[0, 1]).load_state(state)
    env = counting_env(0.0)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="with the wrapper RecordEpisodeStatistics"):
        load_state(CountingEnv(), save_state(env))
    with pytest.raises(ValueError, match="without the wrapper TimeLimit"):
        plain_env = CountingEnv()
        plain_env.reset(seed=0)
        load_state(wrappers.TimeLimit(CountingEnv(), 3), save_state(plain_env))


def test_plain_data_come_back_as_they_were():
    rng = np.random.default_rng(3)
    rng.integers(0, 5, 3, dtype=np.int8)  # leaves bits in its buffer
    value = {
        "floats": [0.1, float("inf"), float("nan"), -0.0],
        "scalars": (np.float32(0.1), np.int64(3), np.bool_(True)),
        "by_client": {3: np.arange(4.0), "name": None},
        "odd": {"__type__": "tuple", "value": [1]},
        "rng": rng,
        "zero": np.array(2.0, dtype=np.float32),
    }
    frozen = freeze(value)
    assert plain(frozen)
    assert json.loads(json.dumps(frozen["floats"], allow_nan=False)) == frozen["floats"]
    back = thaw(frozen)
    assert repr(back["floats"]) == repr(value["floats"]) and repr(back["scalars"]) == repr(value["scalars"])
    assert back["by_client"][3].tolist() == [0, 1, 2, 3] and back["by_client"]["name"] is None and back["odd"] == value["odd"]
    assert back["zero"].shape == () and back["zero"].dtype == np.float32
    assert back["rng"].integers(0, 5, 20, dtype=np.int8).tolist() == rng.integers(0, 5, 20, dtype=np.int8).tolist()
    frozen["by_client"]["value"][0][1][:] = 7
    assert value["by_client"][3][0] == 0  # a copy


@pytest.mark.parametrize("value", [object(), {1, 2}, np.array([object()]), {"a": [b"bytes"]}, lambda: None])
def test_anything_else_is_refused(value):
    with pytest.raises(ValueError, match="no plain data"):
        freeze(value)


@pytest.mark.parametrize(
    "state", [{"bit_generator": "Evil"}, {"bit_generator": "PCG64"}, {"bit_generator": "PCG64", "state": 3}, None, {}]
)
def test_damaged_generators_are_refused(state):
    with pytest.raises(ValueError, match="generator"):
        generator(state)


@pytest.mark.parametrize("entry", [{"__type__": "object", "value": []}, {"__type__": "scalar", "value": 3}, {"__type__": 1}])
def test_damaged_entries_are_refused(entry):
    with pytest.raises(ValueError, match="unknown type"):
        thaw(entry)
