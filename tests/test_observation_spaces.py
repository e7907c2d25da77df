"""Observations that are no flat arrays: the federation flattens them, and a client takes them as they are."""

from __future__ import annotations

import logging

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO

from fed_envs import FederatedVecEnv
from fed_envs import factories as env_factories
from sb3_fedguide import FedAvg, FedRL, Local
from sb3_fedguide.common.evaluation import evaluate_federation
from sb3_fedguide.common.parameters import read_policies
from tests.conftest import assert_same_parameters, parameters_of

BOX = spaces.Box(-5, 5, (3,), np.float32)
PLAIN = {
    "dict": spaces.Dict(
        {
            "b": spaces.Box(-5, 5, (2, 2), np.float32),
            "a": spaces.Discrete(3),
            "c": spaces.MultiDiscrete([2, 4]),
            "d": spaces.MultiBinary(2),
        }
    ),
    "matrix": spaces.Box(-5, 5, (2, 3), np.float64),
    "image": spaces.Box(0, 255, (36, 36, 3), np.uint8),
    "dict with an image": spaces.Dict({"image": spaces.Box(0, 255, (36, 36, 1), np.uint8), "speed": BOX}),
    "choice": spaces.Discrete(5),
}
#: Gymnasium flattens these, and SB3 has no policy for them.
NOT_OF_SB3 = {
    "nested": spaces.Dict({"arm": spaces.Dict({"joints": BOX, "grip": spaces.Discrete(2)}), "speed": BOX}),
    "tuple": spaces.Tuple([BOX, spaces.Discrete(2)]),
    "counted from one": spaces.Dict({"a": spaces.Discrete(3, start=1)}),
}


class SpaceEnv(gym.Env):
    """Observations drawn from a space, whatever it is."""

    def __init__(self, space: spaces.Space) -> None:
        self.observation_space, self.steps = space, 0
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.steps += 1
        return self.observation_space.sample(), -float(np.abs(action - 0.3).sum()), False, self.steps >= 6, {}


def factories(space: spaces.Space, n: int = 2):
    return [lambda: SpaceEnv(space)] * n


def raw_and_flat(space: spaces.Space, n: int = 5):
    space.seed(9)
    raw = [space.sample() for _ in range(n)]
    return raw, np.array([spaces.flatten(space, observation) for observation in raw])


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("kind", PLAIN)
def test_a_client_takes_what_its_environment_returns(kind, normalize, small, tmp_path):
    space = PLAIN[kind]
    model = FedAvg("MlpPolicy", factories(space), normalize=normalize, **small).learn(2 * 64)
    raw, flat = raw_and_flat(space)
    ours = model.predict(np.concatenate([flat, flat]), deterministic=True)[0][5:]
    assert np.ptp(ours, axis=0).min() > 0, "the actions must depend on the observation"
    model.client(1).save(tmp_path / "client")
    model.save(tmp_path / "model")
    model.export_parameters(tmp_path / "parameters.npz")
    for single in (
        PPO.load(tmp_path / "client.zip"),
        FedAvg.load(tmp_path / "model").client(1),
        read_policies(tmp_path / "parameters.npz")[1].to_sb3(),
    ):
        theirs = [single.predict(observation, deterministic=True)[0] for observation in raw]
        np.testing.assert_allclose(theirs, ours, atol=1e-5)
    program = model.client_policy(1).module()
    np.testing.assert_allclose(program(th.as_tensor(flat.astype(np.float32))).numpy(), ours, atol=1e-5)


def test_the_same_is_learned_as_with_the_users_own_wrapper(small):
    space = PLAIN["dict"]
    ours = Local("MlpPolicy", factories(space), **small).learn(2 * 2 * 64)
    wrapped = [lambda: gym.wrappers.FlattenObservation(SpaceEnv(space))] * 2
    theirs = Local("MlpPolicy", wrapped, **small).learn(2 * 2 * 64)
    assert_same_parameters(parameters_of(ours, 1), parameters_of(theirs, 1))
    assert theirs.client(1).observation_space == theirs.observation_space, "of what is inside, nothing is known"


def test_a_client_trains_further_on_its_own_environment(small, tmp_path):
    model = Local("MlpPolicy", factories(PLAIN["dict"]), normalize=True, **small).learn(2 * 64)
    model.client(0).save(tmp_path / "client")
    PPO.load(tmp_path / "client", env=SpaceEnv(PLAIN["dict"])).learn(64)


def test_ddpg_too(tmp_path):
    settings = {"rollout_size": 40, "learning_starts": 20, "batch_size": 8, "buffer_size": 100}
    model = FedRL("MlpPolicy", factories(PLAIN["dict"]), normalize=True, **settings).learn(2 * 40)
    raw, flat = raw_and_flat(PLAIN["dict"])
    single = model.client(1)
    ours = model.predict(np.concatenate([flat, flat]))[0][5:]
    np.testing.assert_allclose([single.predict(observation)[0] for observation in raw], ours, atol=1e-5)


def test_evaluation_flattens_too(small):
    model = Local("MlpPolicy", factories(PLAIN["dict"]), **small)
    env = model.get_env().copies(3, role=1)
    assert evaluate_federation(lambda obs: model.predict(obs)[0], env).returns.shape == (2, 3)


@pytest.mark.parametrize("kind", NOT_OF_SB3)
def test_where_sb3_has_no_policy_the_client_says_what_it_takes(kind, small, caplog):
    space = NOT_OF_SB3[kind]
    model = Local("MlpPolicy", factories(space), normalize=True, **small).learn(2 * 64)
    _, flat = raw_and_flat(space)
    with caplog.at_level(logging.WARNING):
        single = model.client(1)
    assert "client 1's policy takes gymnasium.spaces.flatten(space, observation)" in caplog.text
    ours = model.predict(np.concatenate([flat, flat]), deterministic=True)[0][5:]
    np.testing.assert_allclose(single.predict(flat, deterministic=True)[0], ours, atol=1e-5)


def test_that_they_are_flattened_is_said_once(caplog):
    env_factories._say_flattened.cache_clear()
    with caplog.at_level(logging.WARNING, logger="fed_envs"):
        FederatedVecEnv(factories(PLAIN["matrix"], 3), n_envs_per_client=2).copies(2, role=1)
    (record,) = caplog.records
    assert "FlattenObservation) to the shape (6,)" in record.getMessage()


def test_clients_with_other_spaces_of_the_same_size_are_refused():
    other = spaces.Dict({"x": spaces.Box(-5, 5, (6,), np.float64)})
    with pytest.raises(ValueError, match="all clients must share their spaces"):
        FederatedVecEnv([lambda: SpaceEnv(PLAIN["matrix"]), lambda: SpaceEnv(other)])


def test_observations_without_a_size_are_refused():
    with pytest.raises(ValueError, match="must have one size"):
        FederatedVecEnv(factories(spaces.Sequence(BOX)))


@pytest.mark.parametrize("cls", [Local, FedRL])
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("MultiInputPolicy", "must be 'MlpPolicy' .* observations that are a Dict are flattened for it"),
        ("CnnPolicy", "must be 'MlpPolicy' .* images are flattened for it"),
        ("MlpLstmPolicy", "must be 'MlpPolicy' .* other networks are policy_kwargs"),
    ],
)
def test_names_of_other_policies_get_an_answer(cls, name, message):
    with pytest.raises(ValueError, match=message):
        cls(name, factories(PLAIN["dict"]))


def test_predict_of_the_federation_says_what_it_takes(small):
    model = Local("MlpPolicy", factories(PLAIN["dict"]), **small)
    with pytest.raises(ValueError, match="takes flat observations of all 2 clients"):
        model.predict(PLAIN["dict"].sample())
