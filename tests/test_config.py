"""The resolver of hyperparameters, and every configuration that ships."""

from __future__ import annotations

import inspect
import subprocess
import sys
import typing
from pathlib import Path

import pytest
import torch as th
from stable_baselines3.common.policies import BasePolicy

import fed_envs
from sb3_fedguide import FedAvg
from sb3_fedguide.common.federated_ppo import FederatedPPO
from sb3_fedguide.registry import ALGORITHMS, Entry, algorithm
from sb3_fedguide.settings import schema
from sb3_fedguide.settings.config import CONFIGURATIONS, OVERLAYS, config_path, parse_params, read_config, resolve
from sb3_fedguide.settings.networks import StochasticNetworkConfig
from sb3_fedguide.settings.signatures import constructors, declared

ROOT = Path(__file__).parent.parent
BANDIT = fed_envs.load_family("Bandit2D")


@pytest.fixture(scope="module")
def one_client():
    """One client of a family, made once for all algorithms."""
    made: dict[tuple[str, int], fed_envs.FederatedVecEnv] = {}

    def make(family: str, n_envs: int) -> fed_envs.FederatedVecEnv:
        if (family, n_envs) not in made:
            made[family, n_envs] = fed_envs.FederatedVecEnv(family, n_envs, clients=[0])
        return made[family, n_envs]

    yield make
    for env in made.values():
        env.close()


@pytest.mark.parametrize("conf", [name for name in CONFIGURATIONS if name not in OVERLAYS])
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_shipped_configuration_constructs_what_it_says(algo, conf, one_client):
    assert set(read_config(config_path(conf, algo))) <= {"default", *fed_envs.FAMILIES}
    made = []
    for name in fed_envs.FAMILIES:
        config = resolve(algo, fed_envs.load_family(name), conf)
        assert config.values.keys() == {"policy", "n_rounds", *schema.hyperparameters(algorithm(algo))}
        env = one_client(name, config.values["n_envs_per_client"])
        if (config.values, env.observation_space, env.action_space) in made:
            continue  # a family's hard clients as its others
        made.append((config.values, env.observation_space, env.action_space))
        model = config.make(env, seed=0)
        for parameter, value in config.values.items():
            if parameter not in ("policy", "n_rounds", "policy_kwargs", "pretraining", "stats_window_size", "clip_range"):
                assert getattr(model, parameter) == schema.schedule_or_value(value), (name, parameter)
        for field, value in config.values["pretraining"].items():
            assert getattr(model.pretraining_config, field) == value
        if not isinstance(model, FederatedPPO):
            continue
        assert model.clip_range(1.0) == config.values["clip_range"]
        assert model.n_steps * model.n_envs_per_client == model.rollout_size == config.values["rollout_size"]
        log_std = config.values["policy_kwargs"]["log_std_init"]
        assert th.allclose(model.policy.log_std, th.full_like(model.policy.log_std, log_std))


@pytest.mark.parametrize("conf", CONFIGURATIONS)
@pytest.mark.parametrize("name", fed_envs.FAMILIES)
def test_methods_are_compared_under_the_same_settings(name, conf):
    """The same PPO, budget, networks, cloning and normalisation; only epochs differ between methods."""
    family = fed_envs.load_family(name)
    shared = {"n_rounds", "policy", *schema.hyperparameters(FederatedPPO)} - {"pretraining", "n_epochs"}
    local = resolve("local", family, conf).values
    for algo in ALGORITHMS:
        values = resolve(algo, family, conf).values
        keys = shared
        if not issubclass(algorithm(algo), FederatedPPO):  # off-policy: the same budget and warm start, another learner
            keys = {"n_rounds", "rollout_size", "gamma", "normalize", "bc_weight"}
        own = {**values, "normalize": bool(values["normalize"])}  # whose statistics they are is a matter of the method
        assert {key: own[key] for key in keys} == {key: local[key] for key in keys}
        for field, value in values["pretraining"].items():
            if field.startswith(("bc_", "dataset")):
                assert value == local["pretraining"][field], field


@pytest.mark.parametrize("name", ["Bandit2D", "Reacher", "HopperHard", "MetaWorld10"])
def test_quick_settings_are_the_tuned_ones_made_small(name):
    family = fed_envs.load_family(name)
    for algo in ("fedrl", "fedguide", "fedguide-r"):
        quick, tuned = (resolve(algo, family, conf).values for conf in ("quick", "tuned"))
        smaller = ("n_rounds", "rollout_size", "pretraining")
        assert {key: quick[key] for key in quick if key not in smaller} == {
            key: tuned[key] for key in tuned if key not in smaller
        }
        assert quick["n_rounds"] <= tuned["n_rounds"] / 3 and quick["rollout_size"] <= tuned["rollout_size"]
        assert quick["rollout_size"] % quick["n_envs_per_client"] == 0
        own, less = quick["pretraining"], ("dataset_size", "bc_updates", "prior_updates", "dice_updates")
        assert {key: own[key] for key in own if key not in less} == {
            key: value for key, value in tuned["pretraining"].items() if key not in less
        }
        assert own["dataset_size"] >= own["bc_batch_size"] and own["dice_updates"] <= tuned["pretraining"]["dice_updates"] / 10


def test_the_papers_settings():
    hopper, reacher = fed_envs.load_family("HopperHard"), fed_envs.load_family("Reacher")
    values = resolve("fedguide", hopper, "paper").values
    assert (values["n_rounds"], values["rollout_size"], values["n_epochs"], values["batch_size"]) == (100, 4096, 4, 64)
    assert (values["learning_rate"], values["normalize"], values["bc_weight"]) == (1e-4, False, 0.3)
    assert (values["lambda_trust"], values["lambda_prior"], values["prior_horizon"], values["eta"]) == (0.05, 0.5, 50, 0.05)
    assert (values["prior_loss"], values["adapt"], values["calibrate"], values["beta"]) == ("snis", "none", False, 0.5)
    assert values["policy_kwargs"]["net_arch"] == [256, 256]
    assert values["pretraining"]["dataset_size"] == 200_000 and values["pretraining"]["dice_epochs"] == 80
    assert resolve("fedavg", hopper, "paper").values["n_epochs"] == 10
    assert resolve("fedguide-a", hopper, "paper").values["average_every"] == 5
    assert resolve("fedguide", reacher, "paper").values["rollout_size"] == 2048
    assert resolve("fedguide", reacher, "paper").values["pretraining"]["dataset_size"] == 20_000
    bandit = resolve("fedguide", BANDIT, "paper").values
    assert (bandit["n_rounds"], bandit["rollout_size"], bandit["prior_horizon"]) == (60, 200, 60)
    assert bandit["policy_kwargs"] == {**values["policy_kwargs"], "log_std_init": -1.0}
    assert (bandit["pretraining"]["dataset_size"], bandit["pretraining"]["dice_epochs"]) == (1000, 100)
    assert bandit["pretraining"]["bc_batch_size"] == 512  # nested settings are merged, not replaced


def write(path: Path, text: str) -> str:
    path.write_text(text)
    return str(path)


def test_layers_default_then_family_then_overrides(tmp_path):
    conf = write(
        tmp_path / "mine.yml",
        "default: &base {n_rounds: 7, learning_rate: 1e-3, gamma: 0.9, policy_kwargs: {net_arch: [8], activation_fn: relu}}\n"
        "Bandit2D: {<<: *base, gamma: 0.8, policy_kwargs: {log_std_init: -2}}\n",
    )
    values = resolve("local", BANDIT, conf, overrides={"policy_kwargs.net_arch": [4, 4], "vf_coef": 1}).values
    assert (values["n_rounds"], values["learning_rate"], values["gamma"], values["vf_coef"]) == (7, 1e-3, 0.8, 1)
    assert values["policy_kwargs"] == {"net_arch": [4, 4], "activation_fn": "relu", "log_std_init": -2, "ortho_init": True}
    assert resolve("local", fed_envs.load_family("Hopper"), conf).values["gamma"] == 0.9
    assert values["batch_size"] == 64  # the constructor's own


def test_a_users_family_starts_from_the_settings_of_its_backbone():
    content = {**BANDIT.to_dict(), "family": "MyBandit"}
    mine = fed_envs.Family.model_validate(content)
    config = resolve("fedguide", mine)
    assert config.entry == "Bandit2D" and config.values == resolve("fedguide", BANDIT).values
    assert resolve("fedguide", mine, entry="Reacher").entry == "Reacher"


def test_rounds_from_timesteps_count_all_clients():
    one_round = 4 * 200
    assert resolve("local", BANDIT, n_timesteps=3 * one_round).n_rounds == 3
    assert resolve("local", BANDIT, n_timesteps=3 * one_round + 1).n_rounds == 4
    with pytest.raises(ValueError, match="n_timesteps=0"):
        resolve("local", BANDIT, n_timesteps=0)


def test_schedules_reach_the_algorithm_and_stay_plain_in_the_config():
    overrides = {"learning_rate": "lin_3e-4", "clip_range": "lin_0.2", "beta": "lin_1"}
    config = resolve("fedguide", BANDIT, overrides=overrides)
    assert config.values["learning_rate"] == "lin_3e-4"
    model = config.make(BANDIT, seed=0)
    assert model.lr_schedule(1.0) == pytest.approx(3e-4) and model.lr_schedule(0.5) == pytest.approx(1.5e-4)
    assert model.clip_range(0.25) == pytest.approx(0.05)
    assert model.beta(0.5) == pytest.approx(0.5)


def test_networks_are_plain_data_that_become_modules():
    config = resolve("local", BANDIT, overrides=parse_params(["policy_kwargs.net_arch:{pi: [8], vf: [16]}",
                                                              "policy_kwargs.activation_fn:relu"]))  # fmt: skip
    policy = config.make(BANDIT, seed=0).policy
    assert policy.mlp_extractor.latent_dim_pi == 8 and policy.mlp_extractor.latent_dim_vf == 16
    assert isinstance(policy.mlp_extractor.policy_net[1], th.nn.ReLU)


def test_params_are_yaml_and_never_evaluated():
    given = ["a:1", "b:3e-4", "c:[64, 64]", "d:null", "e:true", "f:lin_3e-4", "g:-1.5", "h:__import__('os').getcwd()", "i:a:b"]
    assert parse_params(given) == {
        "a": 1, "b": 3e-4, "c": [64, 64], "d": None, "e": True, "f": "lin_3e-4", "g": -1.5,
        "h": "__import__('os').getcwd()", "i": "a:b",
    }  # fmt: skip
    with pytest.raises(ValueError, match="is not a number, text or"):
        parse_params(["a:!!python/object/apply:os.getcwd []"])


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"learning_rat": 1}, "Did you mean 'learning_rate'"),
        ({"clients": [0]}, "unknown hyperparameter 'clients'"),  # has no place in a configuration
        ({"seed": 1}, "unknown hyperparameter 'seed'"),
        ({"average": "all"}, "unknown hyperparameter 'average'"),  # FedAvg's
        ({"n_epochs": 4.5}, "n_epochs must be an integer"),
        ({"n_epochs": True}, "n_epochs must be an integer"),
        ({"n_epochs": 0}, "n_epochs=0 must be at least 1"),
        ({"normalize": 1}, "normalize must be true or false"),
        ({"gamma": 1.5}, "gamma=1.5 must be between 0 and 1"),
        ({"gamma": float("nan")}, "must be finite"),
        ({"learning_rate": 0}, "learning_rate=0 must be positive"),
        ({"learning_rate": "3e-4x"}, "a schedule such as lin_3e-4"),
        ({"learning_rate": "lin_-1"}, "a schedule such as lin_3e-4"),
        ({"batch_size": "lin_64"}, "batch_size must be an integer"),
        ({"prior_loss": "snip"}, "'snis' or 'sample'"),
        ({"beta": "automatic"}, "'auto'"),
        ({"policy": "CnnPolicy"}, "policy must be 'MlpPolicy'"),
        ({"policy_kwargs.net_arc": [1]}, "Did you mean 'net_arch'"),
        ({"policy_kwargs.net_arch": [0]}, "greater than 0"),
        ({"policy_kwargs.net_arch": {"pi": [8]}}, "both pi and vf"),
        ({"policy_kwargs.activation_fn": "nn.Tanh"}, "'tanh'"),
        ({"policy_kwargs": 3}, "must be a mapping"),
        ({"pretraining.dice_update": 3}, "Did you mean 'dice_updates'"),
        ({"pretraining.dice_updates": "100"}, "valid integer"),
        ({"pretraining.dice_updates": 0}, "greater than or equal to 1"),
        ({"pretraining.gamma": 0.9}, "the algorithm's own gamma"),
        ({"n_rounds": 0}, "n_rounds=0 must be at least 1"),
        ({"env.x": 0}, "only pretraining and policy_kwargs have parts"),
    ],
)  # fmt: skip
def test_wrong_values_are_refused_with_the_remedy(overrides, message):
    with pytest.raises(ValueError, match=message):
        resolve("fedguide", BANDIT, overrides=overrides)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Bandit2D: {n_rounds: 3, gama: 0.9}", "Did you mean 'gamma'"),
        ("Bandit2D: 3", "maps families"),
        ("- 1", "maps families"),
        ("", "maps families"),
        ("Bandit2D: {n_rounds: 3", "not valid YAML"),
        ("Bandit2D: {n_rounds: 3, n_rounds: 4}", "is given twice"),
        ("Bandit2D: {n_rounds: 3}\nBandit2D: {n_rounds: 4}", "is given twice"),
        ("Bandit2D: {gamma: 0.9}", "number of rounds is missing"),
        ("Bandit2D: {n_rounds: !!python/name:os.system ''}", "not valid YAML"),
    ],
)
def test_wrong_files_are_refused_with_the_reason(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        resolve("local", BANDIT, write(tmp_path / "wrong.yml", text))


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_signatures_show_and_type_checkers_know_every_parameter(algo):
    cls = algorithm(algo)
    shown = inspect.signature(cls).parameters
    assert list(shown)[:2] == ["policy", "env"] and {"learning_rate", "rollout_size", "seed"} < set(shown)
    assert not any(parameter.kind is parameter.VAR_KEYWORD for parameter in shown.values())
    constructor = next(iter(constructors(cls)))
    taken = constructor.arguments
    assert [*inspect.signature(constructor).parameters] == ["self", *shown]
    for known in (shown, inspect.signature(constructor).parameters):
        assert not [name for name, parameter in known.items() if isinstance(parameter.annotation, str)]
        assert known["policy"].annotation == str | type[BasePolicy] and known["device"].annotation == th.device | str
        assert fed_envs.FederatedVecEnv in typing.get_args(known["env"].annotation)
    assert [*shown] == [*declared(taken)] and schema.declared_arguments(algo) is taken


class Sized(StochasticNetworkConfig):
    width: int = 8


class WithSize(FedAvg):
    network_config: typing.Any = Sized


def test_an_algorithm_of_ones_own_has_its_own_networks(monkeypatch):
    monkeypatch.setitem(ALGORITHMS, "sized", Entry(__name__, "WithSize"))
    assert resolve("sized", BANDIT, overrides={"policy_kwargs.width": 4}).values["policy_kwargs"]["width"] == 4
    with pytest.raises(ValueError, match="width"):
        resolve("sized", BANDIT, overrides={"policy_kwargs.widht": 4})
    monkeypatch.setattr(WithSize, "network_config", "Sized")
    with pytest.raises(ValueError, match=r"network_config must be a subclass of .*NetworkConfig, not 'Sized'"):
        resolve("sized", BANDIT)


WRONG_CALLS = """
from sb3_fedguide import FedAvg, FedGuideA, FedKL, FedRL, Local
class Mine(FedAvg): pass
FedKL("MlpPolicy", env="HopperHard", lambda_global=1, seed=3, mix=lambda left: left)
FedKL("MlpPolicy", "HopperHard", learning_rte=1)
Local("MlpPolicy", "HopperHard", mu=1)
FedRL("MlpPolicy", "HopperHard", n_epochs=3)
FedGuideA("MlpPolicy", "HopperHard", average="every")
Mine("MlpPolicy", "HopperHard", mu=1)
FedKL("MlpPolicy", 3)
"""


@pytest.mark.slow
def test_a_type_checker_refuses_what_constructors_do_not_take(tmp_path):
    path = tmp_path / "calls.py"
    path.write_text(WRONG_CALLS)
    result = subprocess.run([sys.executable, "-m", "mypy", str(path)], cwd=ROOT, capture_output=True, text=True)
    wrong = {int(line.split(":")[1]) for line in result.stdout.splitlines() if ": error:" in line}
    assert wrong == {5, 6, 7, 8, 9, 10}, result.stdout
