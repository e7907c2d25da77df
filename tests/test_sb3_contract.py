"""What scripts written for Stable-Baselines3 rely on: callbacks, buffers of episodes, settings, single clients."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.ppo import MlpPolicy

from fed_envs import FederatedVecEnv
from sb3_fedguide import FedAvg, FederatedDDPG, FederatedPPO, FedGuide, FedKL, FedProx, FedRL, FedSVRPGM, Local
from sb3_fedguide.common.episodes import EpisodeStatistics
from sb3_fedguide.settings import schema
from sb3_fedguide.settings.ranges import Range, check_values, range_of
from sb3_fedguide.settings.schema import hyperparameters
from sb3_fedguide.settings.signatures import types_of
from tests.environments import PointEnv
from tests.loop_engine import Here

PPO_SIZES = {"rollout_size": 40, "batch_size": 20, "n_epochs": 1}
DDPG_SIZES = {"rollout_size": 40, "batch_size": 8, "learning_starts": 20}
SIZES = [(Local, PPO_SIZES), (FedRL, DDPG_SIZES)]
NETWORK = {"seed": 3, "policy_kwargs": {"net_arch": [8]}}


class Recorder(BaseCallback):
    """What on_step sees; ends the training after ``end`` steps of all environments."""

    def __init__(self, end: int | None = None) -> None:
        super().__init__()
        self.end, self.seen, self.lengths = end, [], []

    def _on_step(self) -> bool:
        self.seen.append({name: self.locals[name] for name in ("new_obs", "rewards", "dones", "infos", "actions")})
        self.lengths.append(len(self.model.ep_info_buffer))
        return self.end is None or self.n_calls < self.end


@pytest.mark.parametrize(("algorithm", "sizes"), SIZES)
def test_callbacks_see_the_present_step(algorithm, sizes, point_envs, monkeypatch):
    model = algorithm("MlpPolicy", point_envs(2), n_envs_per_client=2, normalize=True, **sizes, **NETWORK)
    returned, step = [], FederatedVecEnv.step_wait
    monkeypatch.setattr(FederatedVecEnv, "step_wait", lambda env: returned.append(step(env)) or returned[-1])
    recorder = Recorder()
    model.learn(2 * 2 * model.rollout_size, callback=recorder)
    assert len(recorder.seen) == len(returned) == 40
    for seen, (new_obs, rewards, dones, infos) in zip(recorder.seen, returned, strict=True):
        assert seen["new_obs"] is new_obs and seen["rewards"] is rewards and seen["dones"] is dones and seen["infos"] is infos
        assert seen["rewards"].shape == seen["dones"].shape == (4,) and seen["actions"].shape == (4, 2)
    ended = [int(step["dones"].sum()) for step in recorder.seen]
    assert recorder.lengths == [sum(ended[:step]) for step in range(40)] and sum(ended) == len(model.ep_info_buffer) > 4


@pytest.mark.parametrize(("algorithm", "sizes"), SIZES)
def test_training_stops_after_so_many_episodes(algorithm, sizes):
    model = algorithm("MlpPolicy", "Reacher", **{**sizes, "rollout_size": 400}, **NETWORK)
    model.learn(10_000, callback=StopTrainingOnMaxEpisodes(3))
    assert model.num_timesteps == 3 * 50 * 8  # SB3 counts the episodes of one environment, here of one in eight


class Reaching(PointEnv):
    """Says whether it succeeded."""

    def step(self, action):
        *step, info = super().step(action)
        return *step, {**info, "is_success": self.target > 0}

    def save_state(self):
        return {"position": self.position, "steps": self.steps}

    def load_state(self, state):
        self.position, self.steps = state["position"], state["steps"]


@pytest.mark.parametrize("engine", [False, True])
def test_success_rate_averages_clients_first(engine):
    targets = (-0.5, 0.5, 0.5)
    model = Local("MlpPolicy", [lambda t=t: Reaching(t, length=10 if t < 0 else 20) for t in targets], **PPO_SIZES, **NETWORK)
    if engine:
        Here(2).attach(model)
    logged = {}
    model.set_logger(type("Spy", (), {"record": lambda self, key, value, **_: logged.update({key: value}), "dump": len})())
    model.logger.dump = lambda step: None
    model.learn(3 * model.rollout_size)
    assert logged["rollout/success_rate"] == pytest.approx(2 / 3)
    assert logged["client_0/success_rate"] == 0.0 and logged["client_2/success_rate"] == 1.0
    assert len(model.ep_success_buffer) == len(model.ep_info_buffer) == sum(map(len, model.episode_infos)) == 8


class Memory(PointEnv):
    """Knows which observation followed which."""

    def reset(self, **kwargs):
        observation, info = super().reset(**kwargs)
        self.pairs, self.last = getattr(self, "pairs", set()), observation
        return observation, info

    def step(self, action):
        before = self.last
        self.last, *rest = super().step(action)
        self.pairs.add((before.tobytes(), self.last.tobytes()))
        return self.last, *rest


class Failing(BaseCallback):
    def _on_step(self) -> bool:
        if self.n_calls == 13:
            raise KeyboardInterrupt
        return True


def memories(model):
    return [env.pairs for env in model.get_env().envs]


@pytest.mark.parametrize("callback", [lambda: Recorder(end=13), Failing])
def test_nothing_is_stored_across_an_interrupted_rollout(callback):
    model = FederatedDDPG("MlpPolicy", [lambda: Memory(0.5, length=15)] * 2, **DDPG_SIZES, **NETWORK)
    try:
        model.learn(400, callback=callback())
    except KeyboardInterrupt:
        pass
    assert model.num_timesteps == 26
    model.learn(80, reset_num_timesteps=False)
    buffer = model.replay_buffer
    for client, pairs in enumerate(memories(model)):
        assert buffer.sizes[client] in (52, 53)
        for row in range(buffer.sizes[client]):
            pair = buffer.observations[row, client].tobytes(), buffer.next_observations[row, client].tobytes()
            assert pair in pairs, row


@pytest.mark.parametrize("callback", [lambda: Recorder(end=13), Failing])
def test_an_interrupted_rollout_goes_on_where_the_environments_stand(callback):
    model = Local("MlpPolicy", [lambda: Memory(0.5, length=15)] * 2, **PPO_SIZES, **NETWORK)
    try:
        model.learn(400, callback=callback())
    except KeyboardInterrupt:
        pass
    model.learn(80, reset_num_timesteps=False)
    buffer = model.rollout_buffer
    for client, pairs in enumerate(memories(model)):
        obs, starts = buffer.raw_observations[:, client, 0], buffer.episode_starts[:, client, 0]
        for row in range(1, len(obs)):
            assert starts[row] or (obs[row - 1].tobytes(), obs[row].tobytes()) in pairs
        known = {observation for pair in pairs for observation in pair}
        assert obs[0].tobytes() in known and starts.sum() >= 2


def test_one_client_carries_all_settings(point_envs):
    given = {
        "learning_rate": 1e-3, "batch_size": 20, "n_epochs": 3, "gamma": 0.9, "gae_lambda": 0.8, "clip_range": 0.1,
        "clip_range_vf": 0.3, "normalize_advantage": False, "ent_coef": 0.01, "vf_coef": 0.7, "max_grad_norm": 0.4, "seed": 3,
    }  # fmt: skip
    network = {"net_arch": [8], "ortho_init": False, "log_std_init": -1.0, "optimizer_kwargs": {"eps": 1e-4}}
    model = Local(
        "MlpPolicy", point_envs(2), rollout_size=40, n_envs_per_client=2, stats_window_size=7, policy_kwargs=network, **given
    )
    client = model.client(1)
    for name, value in given.items():
        own = getattr(client, name)
        assert (own(0.5) if callable(own) else own) == value, name
    assert client.n_steps == 40 and client._stats_window_size == 7
    assert client.policy.optimizer.param_groups[0]["eps"] == 1e-4 and not client.policy.ortho_init
    client.set_env(client._wrap_env(point_envs(2)[1]()))
    client.learn(40)

    given = {
        "learning_rate": 1e-3, "buffer_size": 99, "learning_starts": 9, "batch_size": 8, "tau": 0.1, "gamma": 0.9,
        "gradient_steps": 2, "seed": 3,
    }  # fmt: skip
    client = FedRL("MlpPolicy", point_envs(2), rollout_size=40, train_freq=4, stats_window_size=7, **given).client(0)
    for name, value in given.items():
        assert getattr(client, name) == value, name
    assert client.train_freq.frequency == 4 and client._stats_window_size == 7


def test_every_range_is_checked_by_the_constructors(point_envs):
    """Before the environments are made, so before the offline stage."""
    for kind in (FedGuide, FedProx, FedKL, FedSVRPGM, FedRL):
        for name, hint in types_of(kind).items():
            if (limits := range_of(hint)) is None:
                continue
            with pytest.raises(ValueError, match=name):
                kind("MlpPolicy", point_envs(2), **{name: limits.low - 1})
            with pytest.raises(ValueError, match=f"{name} must be a"):
                check_values(types_of(kind), {name: "many"})
    for name, value in {"n_epochs": 2.5, "gamma": float("nan"), "clip_range_vf": -0.2, "n_epochs ": None}.items():
        with pytest.raises(ValueError, match=name.strip()):
            Local("MlpPolicy", point_envs(2), **{name.strip(): value})
    with pytest.raises(ValueError, match="learning_rate"):
        Local("MlpPolicy", point_envs(2), learning_rate=lambda left: -left)
    check_values(
        types_of(FedGuide), {"n_epochs": np.int64(2), "gamma": np.float32(0.9), "clip_range_vf": None, "beta": "auto"}
    )


class Own(FedAvg):
    def __init__(self, policy, env, kappa: Annotated[float, Range(0, 1)] = 0.5, kind: Literal["a", "b"] = "a", **fedavg):
        self.kappa, self.kind = kappa, kind
        super().__init__(policy, env, **fedavg)


def test_a_constructor_of_ones_own_states_its_ranges_in_its_types(point_envs):
    assert hyperparameters(Own)["kappa"][1] == 0.5 and "mix" in hyperparameters(Own)
    assert Own("MlpPolicy", point_envs(2), 0.7, mix=0.5, **PPO_SIZES, **NETWORK).kappa == 0.7
    for wrong, message in (
        ({"kappa": 1.5}, "kappa=1.5 must be between 0 and 1"),
        ({"kind": "c"}, "must be one of a, b"),
    ):
        with pytest.raises(ValueError, match=message):
            Own("MlpPolicy", point_envs(2), **wrong, **PPO_SIZES, **NETWORK)
    with pytest.raises(ValueError, match="kappa=2 must be"):
        schema.check_value("kappa", 2, hyperparameters(Own)["kappa"][0])


def test_ranges_hold_for_what_load_changes(point_envs, tmp_path):
    model = Local("MlpPolicy", point_envs(2), **PPO_SIZES, **NETWORK)
    model.save(tmp_path / "model")
    with pytest.raises(ValueError, match="n_epochs"):
        Local.load(tmp_path / "model", n_epochs=0)
    larger = Local.load(tmp_path / "model", env=point_envs(2), rollout_size=80)
    assert larger.learn(1).num_timesteps == 160


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"policy": MlpPolicy}, ValueError, "policy=ActorCriticPolicy holds one agent.*'MlpPolicy'"),
        ({"policy": "CnnPolicy"}, ValueError, "policy='CnnPolicy' must be 'MlpPolicy'"),
        ({"use_sde": True}, ValueError, "use_sde is not supported: exploration noise"),
        ({"target_kl": 0.1}, ValueError, "target_kl is not supported.*n_epochs"),
        ({"n_steps": 64}, ValueError, "n_steps is not supported.*rollout_size"),
        (
            {"policy_kwargs": {"features_extractor_class": th.nn.Flatten}},
            ValueError,
            "features_extractor_class is not.*wrapper",
        ),
        ({"policy_kwargs": {"squash_output": True}}, ValueError, "squash_output is not supported"),
        ({"policy_kwargs": {"net_arc": [8]}}, TypeError, "did you mean 'net_arch'"),
        ({"learning_rat": 1e-3}, TypeError, r"FedAvg\(\) has no argument 'learning_rat'; did you mean 'learning_rate'"),
    ],
)
def test_what_is_not_supported_is_refused_with_a_reason(point_envs, arguments, error, message):
    with pytest.raises(error, match=message):
        FedAvg(**{"policy": "MlpPolicy", "env": point_envs(2), **arguments})
    if "policy_kwargs" not in arguments and arguments.keys() != {"learning_rat"} and "n_steps" not in arguments:
        with pytest.raises(error):
            FederatedPPO(**{"policy": "MlpPolicy", "env": point_envs(2), **arguments})


class Halved(FedAvg):
    def __init__(self, policy, env, kappa: Annotated[float, Range(0, 1)] = 0.5, *more, **fedavg):
        super().__init__(policy, env, *more, **fedavg)


def test_wrong_calls_name_the_class_and_what_is_by_position(point_envs):
    for make in (FedAvg, FedKL, Local, FedRL):
        name = make.__name__
        with pytest.raises(TypeError, match=rf"^{name}\(\) takes policy and env by position and everything else by keyword"):
            make("MlpPolicy", point_envs(2), 3e-4)
        with pytest.raises(TypeError, match=rf"^{name}\(\) missing 2 required positional arguments: 'policy' and 'env'"):
            make()
    with pytest.raises(ValueError, match="kappa=2 must be between 0 and 1"):
        Halved("MlpPolicy", point_envs(2), 2.0)
    with pytest.raises(TypeError, match=r"^FedAvg\(\) takes policy and env by position"):
        Halved("MlpPolicy", point_envs(2), 0.5, 3e-4)


def test_n_steps_off_policy_are_not_those_of_a_rollout(point_envs):
    with pytest.raises(ValueError, match=r"n_steps is not supported: .*one-step returns"):
        FedRL("MlpPolicy", point_envs(2), n_steps=3)


def test_vec_normalize_is_a_setting(point_envs):
    with pytest.raises(ValueError, match=r"single VecNormalize.*normalize=True"):
        Local("MlpPolicy", VecNormalize(DummyVecEnv(point_envs(1))))


@pytest.mark.parametrize(("algorithm", "sizes"), SIZES)
def test_predict_and_learn_say_what_is_missing(algorithm, sizes, point_envs, tmp_path):
    model = algorithm("MlpPolicy", point_envs(1), **sizes, **NETWORK)
    with pytest.raises(ValueError, match="mixing Gym API"):
        model.predict(point_envs(1)[0]().reset())
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    with pytest.raises(ValueError, match=r"no environments to train in.*set_env"):
        loaded.learn(40)
    loaded.set_env(point_envs(1))
    assert loaded.learn(40).num_timesteps == 40


@pytest.mark.parametrize(("algorithm", "sizes"), SIZES)
def test_policies_take_numbers_of_any_kind(algorithm, sizes, point_envs):
    policy = algorithm("MlpPolicy", point_envs(2), **sizes, **NETWORK).policy
    observations = np.arange(12).reshape(4, 3)
    actions = [policy.predict(observations.astype(kind), deterministic=True)[0] for kind in (np.float32, np.float64, np.int64)]
    np.testing.assert_array_equal(actions[0], actions[1])
    np.testing.assert_array_equal(actions[0], actions[2])


def test_statistics_are_one_mixin():
    assert issubclass(FederatedPPO, EpisodeStatistics) and issubclass(FederatedDDPG, EpisodeStatistics)
