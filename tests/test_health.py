"""Runs that go wrong say so: real causes, the round in which they begin, the clients' names, and a remedy."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from sb3_fedguide import FedAvg, FedGuide, FedRL, Local
from sb3_fedguide.cli.train import _short_warnings, main
from sb3_fedguide.monitoring import health
from sb3_fedguide.monitoring.health import HealthCallback, routes_one_to_one

OFFLINE = {"dataset_size": 60, "bc_updates": 2, "dice_updates": 2, "dice_width": 8, "dice_batch_size": 16}
#: FedGuide on Bandit2D that nothing is wrong with: V_phi is constant in a world of one state.
SOUND = {"env": "Bandit2D", "eta": 1.0, "pretraining": OFFLINE}


def warnings_of(model, rounds: int = 1) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(rounds * model.rollout_size * model.n_participants, HealthCallback())
    return [str(warning.message) for warning in caught if warning.filename == health.__file__]


def test_sound_runs_are_silent(small, point_envs):
    for model in (FedAvg("MlpPolicy", point_envs(3), **small), FedGuide("MlpPolicy", **SOUND, **small)):
        assert warnings_of(model, 3) == []
    ddpg = {"rollout_size": 32, "learning_starts": 8, "batch_size": 8, "seed": 0, "policy_kwargs": {"net_arch": [8]}}
    assert warnings_of(FedRL("MlpPolicy", point_envs(2), **ddpg)) == []


def test_a_permutation_is_one_expert_for_each_client_and_none_for_two():
    permutation = np.eye(4)[[2, 0, 3, 1]]
    assert routes_one_to_one(permutation) and routes_one_to_one(0.993 * permutation + 0.007 / 4)
    assert not routes_one_to_one(0.98 * permutation + 0.02 / 4)
    assert not routes_one_to_one(np.eye(4)[[2, 0, 2, 1]]), "two clients share an expert"
    assert not routes_one_to_one(np.full((4, 4), 0.25))
    assert not routes_one_to_one(np.eye(1)), "there is nobody to share with"


def test_a_plan_that_is_a_permutation_is_told_once(small):
    offline = {**OFFLINE, "prior": "gaussian"}
    told = warnings_of(FedGuide("MlpPolicy", **{**SOUND, "env": "Reacher", "eta": 1e-3, "pretraining": offline}, **small), 3)
    told = [line for line in told if "plan" in line]
    assert len(told) == 1
    assert told[0].startswith("round 1: the transport plan is a permutation: ") and "larger eta (now 0.001)" in told[0]


def test_importance_weights_that_collapse_are_named(small):
    """The prior is a narrow density at a peak, the policy covers far more than the action box."""
    wide = {**small, "policy_kwargs": {"net_arch": [8], "log_std_init": 3.0}, "rollout_size": 400, "batch_size": 100}
    told = warnings_of(FedGuide("MlpPolicy", **SOUND, **wide))
    assert len(told) == 1 and told[0].startswith("round 1: client ")
    assert "(effective_sample_share 0.00" in told[0] and 'try prior_loss="sample"' in told[0]
    assert warnings_of(FedGuide("MlpPolicy", **SOUND, **{**wide, "prior_loss": "sample"})) == []


@pytest.mark.parametrize(
    ("settings", "remedies", "others"),
    [
        ({"beta": 0.5}, ['beta="auto"', "calibrate=True", "beta=1"], []),
        ({"beta": "auto"}, ["calibrate=True", "offline data"], ['beta="auto"']),
        ({"beta": "auto", "calibrate": True}, ["try more or better offline data"], ['beta="auto"', "calibrate"]),
    ],
)
def test_a_dice_value_that_misleads_is_named(settings, remedies, others, small):
    model = FedGuide("MlpPolicy", **SOUND, **settings, **small)
    honest, rng = model._dice_values, np.random.default_rng(0)
    noise = lambda obs: rng.normal(size=len(obs)).astype(np.float32)  # noqa: E731
    model._dice_values = lambda index, obs: honest(index, obs) + (noise(obs) if index in (1, 3) else 0)
    told = warnings_of(model, 2)
    assert len(told) == 1, "each client once"
    assert told[0].startswith("round 1: client 1 (explained_variance_dice -") and ", client 3 (" in told[0]
    assert "client 0" not in told[0] and "negative explained variance" in told[0]
    assert all(remedy in told[0] for remedy in remedies) and not any(other in told[0] for other in others)


def test_rounding_is_no_negative_explained_variance(small):
    model = FedGuide("MlpPolicy", **SOUND, **small)
    honest = model._dice_values
    model._dice_values = lambda index, obs: honest(index, obs) + np.float32(1e-4) * (np.arange(len(obs)) % 2)
    assert warnings_of(model) == []


def test_a_divergence_that_explodes_is_told_when_it_does(small, point_envs):
    model = Local("MlpPolicy", point_envs(3), **{**small, "n_epochs": 4})

    class Jump(HealthCallback):
        def _on_round_start(self):
            self.model.learning_rate = 0.1 if self.model.round == 1 else 1e-4
            self.model._setup_lr_schedule()

    with pytest.warns(UserWarning, match=r"^round 2: client 0 \(approx_kl .*fewer n_epochs \(now 4\)") as caught:
        model.learn(3 * model.rollout_size * 3, Jump())
    assert sum("approx_kl" in str(warning.message) for warning in caught) == 1


def test_who_is_absent_is_not_judged(small, point_envs):
    model = Local("MlpPolicy", point_envs(4), client_fraction=0.5, **{**small, "learning_rate": 0.1})
    seen = []

    class Watch(HealthCallback):
        def _on_round_end(self):
            seen.append({model.client_ids[i] for i in np.flatnonzero(model.present)})
            super()._on_round_end()

    with pytest.warns(UserWarning, match="approx_kl") as caught:
        model.learn(model.rollout_size * 2, Watch())
    (message,) = [str(warning.message) for warning in caught if "approx_kl" in str(warning.message)]
    assert {client for client in range(4) if f"client {client} " in message} <= seen[0] and len(seen[0]) == 2


def test_the_command_warns(tmp_path, monkeypatch):
    monkeypatch.setenv("FEDGUIDE_CACHE", str(tmp_path / "cache"))
    offline = [f"pretraining.{name}:{value}" for name, value in {**OFFLINE, "prior": "gaussian"}.items()]
    argv = ["--env", "Reacher", "--rounds", "1", "--verbose", "0", "--no-eval", "-f", str(tmp_path), "--picture-freq", "0"]
    with pytest.warns(UserWarning, match="round 1: the transport plan is a permutation"):
        assert main([*argv, "-params", "rollout_size:40", "batch_size:20", "eta:0.001", *offline]) == 0


def test_warnings_of_this_package_are_one_line_on_the_terminal():
    plain = warnings.formatwarning
    with _short_warnings("train.py"):
        assert warnings.formatwarning(UserWarning("round 3: so"), UserWarning, health.__file__, 3) == (
            "train.py: warning: round 3: so\n"
        )
        assert warnings.formatwarning(UserWarning("so"), UserWarning, __file__, 3) == plain(
            UserWarning("so"), UserWarning, __file__, 3
        )
    assert warnings.formatwarning is plain
