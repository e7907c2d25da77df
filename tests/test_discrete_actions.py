"""Choices instead of forces: Discrete, MultiDiscrete and MultiBinary actions for every method on PPO."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import distributions as torch_distributions

from sb3_fedguide import FedAvg, FederatedEvalCallback, FedGuide, FedKL, FedProx, FedRL, FedSVRPGM, Local
from sb3_fedguide.common.checkpoint import CheckpointCallback
from sb3_fedguide.common.distributions import Categorical, action_distribution
from sb3_fedguide.monitoring.diagnostics import DiagnosticsCallback
from tests.comparisons import assert_train_equals, sb3_twin
from tests.conftest import assert_same_parameters, parameters_of
from tests.environments import SPACES, ChoiceEnv, choices
from tests.loop_engine import Here

METHODS = [Local, FedAvg, FedProx, FedKL, FedSVRPGM]


def cartpoles(n: int = 2):
    return [lambda: gym.make("CartPole-v1")] * n


@pytest.mark.parametrize("kind", SPACES)
def test_formulas_are_those_of_torch(kind):
    distribution = action_distribution(SPACES[kind])
    generator = th.Generator().manual_seed(0)
    p, q = (3 * th.randn(2, 5, distribution.n_outputs, generator=generator) for _ in range(2))
    actions = th.as_tensor(np.array([np.reshape(SPACES[kind].sample(), -1) for _ in range(10)])).reshape(2, 5, -1)

    def parts(outputs):
        if isinstance(distribution, Categorical):
            return [torch_distributions.Categorical(logits=block) for block in outputs.split(distribution.sizes, dim=-1)]
        return [torch_distributions.Bernoulli(logits=outputs[..., i]) for i in range(outputs.shape[-1])]

    def total(values):
        return th.stack(list(values)).sum(dim=0)

    columns = actions.unbind(-1)
    expected = total(part.log_prob(column.float()) for part, column in zip(parts(p), columns, strict=True))
    th.testing.assert_close(distribution.log_prob(p, None, actions.float()), expected)
    th.testing.assert_close(distribution.entropy(p, None), total(part.entropy() for part in parts(p)).mean(dim=1))
    divergence = total(torch_distributions.kl_divergence(one, two) for one, two in zip(parts(p), parts(q), strict=True))
    th.testing.assert_close(distribution.kl_divergence(p, None, q, None), divergence, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", SPACES)
def test_outputs_with_noise_decide_as_often_as_their_probabilities_say(kind):
    distribution = action_distribution(SPACES[kind])
    outputs = th.randn(1, 1, distribution.n_outputs, generator=th.Generator().manual_seed(1)).expand(1, 20_000, -1)
    th.manual_seed(0)
    for noise in (th.as_tensor(distribution.noise(np.random.default_rng(0), outputs.shape)), distribution.noise_like(outputs)):
        actions = distribution.decide(outputs + noise)
        rows, counts = np.unique(actions[0].numpy(), axis=0, return_counts=True)
        row = th.as_tensor(rows)[None]
        expected = distribution.log_prob(outputs[:, : len(rows)], None, row).exp()[0].numpy()
        np.testing.assert_allclose(counts / 20_000, expected, atol=0.012)
        assert expected.sum() == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize(("ent_coef", "clip_range_vf"), [(0.0, None), (0.01, 0.2)])
def test_train_equals_sb3_on_cartpole(small, monkeypatch, ent_coef, clip_range_vf):
    settings = {**small, "ent_coef": ent_coef, "clip_range_vf": clip_range_vf, "n_envs_per_client": 2}
    model = Local("MlpPolicy", cartpoles(1), **settings)
    assert_train_equals(model, sb3_twin(model, DummyVecEnv(cartpoles(1) * 2)), monkeypatch)


@pytest.mark.parametrize("kind", ["multidiscrete", "multibinary"])
def test_train_equals_sb3_with_several_choices(small, monkeypatch, kind):
    model = Local("MlpPolicy", choices(kind, 1), ent_coef=0.01, **small)
    assert_train_equals(model, sb3_twin(model, DummyVecEnv(choices(kind, 1))), monkeypatch)


@pytest.mark.parametrize("cls", METHODS)
def test_every_method_trains_evaluates_and_gives_its_policies_away(cls, small, tmp_path):
    model = cls("MlpPolicy", cartpoles(), normalize=True, ent_coef=0.01, **small)
    evaluation = FederatedEvalCallback(n_rounds=2, eval_freq=1, n_episodes=2)
    model.learn(2 * 2 * 64, [evaluation, DiagnosticsCallback(evaluation)])
    assert evaluation.last["deployed"].returns.shape == (2, 2) and evaluation.last["deployed"].returns.min() >= 1
    obs = np.random.default_rng(0).standard_normal((8, 4)).astype(np.float32)
    ours = model.predict(obs, deterministic=True)[0]
    assert ours.shape == (8,) and np.issubdtype(ours.dtype, np.integer)
    np.testing.assert_array_equal(model.client(1).predict(obs[4:], deterministic=True)[0], ours[4:])
    model.save(tmp_path / "model")
    model.export_parameters(tmp_path / "parameters.npz")
    loaded = cls.load(tmp_path / "model", env=cartpoles())
    fresh = cls("MlpPolicy", cartpoles(), normalize=True, **{**small, "seed": 8})
    fresh.import_parameters(tmp_path / "parameters.npz")
    for other in (loaded, fresh):
        np.testing.assert_array_equal(other.predict(obs, deterministic=True)[0], ours)
    loaded.learn(2 * 64, reset_num_timesteps=False)
    other = Local("MlpPolicy", choices("discrete"), normalize=True, **small)
    with pytest.raises(ValueError, match="action_space is"):
        other.import_parameters(tmp_path / "parameters.npz")


@pytest.mark.parametrize("kind", SPACES)
def test_programs_give_what_environments_take(kind, small):
    model = Local("MlpPolicy", choices(kind), **small).learn(2 * 64)
    obs = np.random.default_rng(0).standard_normal((2, 3)).astype(np.float32)
    actions = model.client_policy(1).module()(th.as_tensor(obs)).numpy()
    np.testing.assert_array_equal(actions, model.predict(np.concatenate([obs, obs]), deterministic=True)[0][2:])
    assert all(SPACES[kind].contains(action) for action in actions)


@pytest.mark.parametrize("kind", SPACES)
def test_clients_equal_federations_of_one(kind, small):
    together = Local("MlpPolicy", choices(kind, 3), normalize=True, **small).learn(2 * 3 * 64)
    alone = Local("MlpPolicy", choices(kind, 3), clients=[2], normalize=True, **small).learn(2 * 64)
    assert_same_parameters(parameters_of(together, 2), parameters_of(alone, 2))


NEUTRAL = {FedProx: {"mu": 0.0}, FedKL: {"lambda_global": 0.0, "lambda_local": 0.0}, FedSVRPGM: {"beta": 1.0}}


@pytest.mark.parametrize("cls", NEUTRAL)
def test_neutral_settings_are_fedavg_bit_for_bit(cls, small):
    settings = {"average_every": 2, "ent_coef": 0.01, **small}
    neutral = cls("MlpPolicy", choices("multidiscrete"), **NEUTRAL[cls], **settings).learn(3 * 2 * 64)
    fedavg = FedAvg("MlpPolicy", choices("multidiscrete"), **settings).learn(3 * 2 * 64)
    default = cls("MlpPolicy", choices("multidiscrete"), **settings).learn(3 * 2 * 64)
    assert_same_parameters(parameters_of(neutral, 1), parameters_of(fedavg, 1))
    assert not th.equal(parameters_of(default, 1)["action_net.weight"], parameters_of(fedavg, 1)["action_net.weight"])


@pytest.mark.parametrize("cls", [FedKL, FedSVRPGM])
def test_a_checkpoint_goes_on_bit_for_bit(cls, small, tmp_path):
    whole = cls("MlpPolicy", choices("multidiscrete"), **small).learn(4 * 2 * 64)
    cls("MlpPolicy", choices("multidiscrete"), **small).learn(2 * 2 * 64, CheckpointCallback(tmp_path, save_freq=2))
    resumed = cls("MlpPolicy", choices("multidiscrete"), **small).resume(tmp_path)
    resumed.learn(2 * 2 * 64, CheckpointCallback(tmp_path / "more"), reset_num_timesteps=False)
    assert_same_parameters(parameters_of(resumed, 1), parameters_of(whole, 1))


def test_groups_elsewhere_learn_the_same(small):
    here = FedKL("MlpPolicy", choices("multidiscrete"), normalize=True, **small).learn(2 * 2 * 64)
    other = FedKL("MlpPolicy", choices("multidiscrete"), normalize=True, **small)
    Here(2).attach(other)
    other.learn(2 * 2 * 64)
    assert_same_parameters(parameters_of(other, 1), parameters_of(here, 1))


def test_every_kind_of_choice_is_learned(small):
    settings = {**small, "rollout_size": 256, "n_epochs": 4, "batch_size": 64, "learning_rate": 1e-2}
    for kind in SPACES:
        model = Local("MlpPolicy", choices(kind, 1), **settings).learn(256)
        first = model.mean_episode_return()
        model.learn(9 * 256, reset_num_timesteps=False)
        last = np.mean([info["r"] for info in list(model.episode_infos[0])[-32:]])
        assert last > 5.5 > 4.5 > first, (kind, first, last)


@pytest.mark.parametrize(
    ("cls", "space", "settings", "message"),
    [
        (FedRL, spaces.Discrete(2), {}, "DDPG needs continuous actions .* use a method on PPO: FedAvg"),
        (FedGuide, spaces.Discrete(2), {}, "FedGuide's prior over actions needs continuous actions .* use FedAvg"),
        (FedAvg, spaces.MultiBinary(2), {"bc_weight": 0.3}, r"behaviour cloning \(bc_weight\) needs .* leave bc_weight at 0"),
        (FedAvg, spaces.Discrete(2, start=1), {}, "counted from 0"),
        (FedAvg, spaces.Tuple([spaces.Discrete(2)]), {}, "TransformAction"),
        (FedAvg, spaces.Box(-1, 1, (2, 2)), {}, "one-dimensional Box"),
    ],
)
def test_what_needs_other_actions_says_so_in_one_sentence(cls, space, settings, message, small):
    arguments = {} if cls is FedRL else {**small, **settings}
    with pytest.raises(ValueError, match=message) as refusal:
        cls("MlpPolicy", [lambda: ChoiceEnv(space)], **arguments)
    assert len(str(refusal.value).splitlines()) == 1
