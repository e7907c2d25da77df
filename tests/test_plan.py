"""The table of transport plans that a run writes, and its figure."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_fedguide.benchmark.figures.plans import draw_plans
from sb3_fedguide.benchmark.plans import Plans, read_plans
from sb3_fedguide.cli.main import main
from sb3_fedguide.common.checkpoint import CheckpointCallback
from sb3_fedguide.monitoring.plan import PlanCallback
from sb3_fedguide.registry import algorithm
from sb3_fedguide.server.ot_moe import given_heads, head_shares

pytestmark = pytest.mark.usefixtures("coarse_figures")

SMALL = {"rollout_size": 40, "batch_size": 20, "n_epochs": 1, "seed": 3, "n_experts": 3, "bc_weight": 0.0}
OFFLINE = {"dataset_size": 100, "prior_updates": 4, "prior_average_every": 2, "dice_updates": 2}


def federation(algo="fedguide", **more):
    return algorithm(algo)("MlpPolicy", "Bandit2D", pretraining=OFFLINE, **{**SMALL, **more})


def test_a_client_listens_to_the_heads_of_those_who_are_routed_like_it():
    """Clients 0 and 1 share an expert, client 2 has its own."""
    plan = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]) / 3
    assert given_heads(plan).tolist() == [[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 1.0]]
    assert head_shares(plan).tolist() == [0.25, 0.25, 0.0]


@pytest.mark.parametrize("algo", ["fedguide", "fedguide-a"])
def test_every_round_has_the_plan_that_its_mixtures_come_from(algo, tmp_path):
    model = federation(algo)
    model.learn(3 * 4 * 40, PlanCallback(tmp_path / "plan.csv"))
    plans = read_plans(tmp_path / "plan.csv")
    assert plans.rounds.tolist() == [0, 1, 2, 3] and plans.clients == [0, 1, 2, 3] and plans.weights.shape == (4, 4, 3)
    np.testing.assert_allclose(plans.weights[-1], model.mixture_rows, rtol=1e-3, atol=1e-12)
    np.testing.assert_allclose(plans.loads, 1 / 3, atol=1e-3)


def test_who_is_absent_has_no_row(tmp_path):
    model = federation(client_fraction=0.5)
    model.learn(2 * 2 * 40, PlanCallback(tmp_path / "plan.csv"))
    plans = read_plans(tmp_path / "plan.csv")
    there = ~np.isnan(plans.weights[:, :, 0])
    assert there[1:].sum(axis=1).tolist() == [2, 2]
    given = plans.listening
    assert np.isnan(given[0]).all()
    for round in (1, 2):
        np.testing.assert_allclose(given[round][there[round]].sum(axis=1), 1.0, rtol=1e-3)
        assert (given[round][there[round]][:, ~there[round]] == 0.0).all()
    draw_plans(plans, "some are absent").canvas.draw()


def test_methods_without_a_plan_write_nothing(tmp_path):
    algorithm("fedavg")("MlpPolicy", "Bandit2D", rollout_size=40, batch_size=20, bc_weight=0.0, seed=0).learn(
        4 * 40, PlanCallback(tmp_path / "plan.csv")
    )
    assert not list(tmp_path.iterdir())


def test_a_resumed_run_writes_the_same_table(tmp_path):
    federation().learn(4 * 160, PlanCallback(tmp_path / "whole.csv"))
    federation().learn(3 * 160, [PlanCallback(tmp_path / "parts.csv"), CheckpointCallback(tmp_path / "saved", 2)])
    resumed = federation().resume(tmp_path / "saved")
    resumed.learn(2 * 160, PlanCallback(tmp_path / "parts.csv"), reset_num_timesteps=False)
    assert (tmp_path / "parts.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()
    (tmp_path / "parts.csv").write_text("round,client\n")
    with pytest.raises(ValueError, match="rows are missing"):
        federation().resume(tmp_path / "saved").learn(160, PlanCallback(tmp_path / "parts.csv"), reset_num_timesteps=False)


def test_effective_numbers_are_exponentials_of_entropies():
    weights = np.array([[[1.0, 0.0], [1.0, 0.0]], [[0.5, 0.5], [0.5, 0.5]]])
    plans = Plans(np.array([1, 2]), [4, 7], weights)
    np.testing.assert_allclose(plans.effective_experts, [[1.0, 1.0], [2.0, 2.0]])
    np.testing.assert_allclose(plans.effective_clients, [[2.0, 1.0], [2.0, 2.0]])
    assert plans.listening.tolist() == [[[0.5, 0.5], [0.5, 0.5]]] * 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "do not fit"),
        ("round,client,expert_0\n", "has no transport plan yet"),
        ("round,client,expert_0\n1,0,0.5,0.5\n", "do not fit"),
        ("round,client,expert_0\n1,zero,0.5\n", "is not a run's table of transport plans"),
    ],
)
def test_a_damaged_table_says_so(text, message, tmp_path):
    (tmp_path / "plan.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_plans(tmp_path / "plan.csv")


def test_the_command_draws_the_plan_of_a_run(tmp_path, capfd):
    flags = ["--env", "Bandit2D", "-f", str(tmp_path), "--rounds", "2", "--eval-episodes", "1", "--verbose", "0", "-params",
             "rollout_size:40", "n_envs_per_client:2", "bc_weight:0", "batch_size:20"]  # fmt: skip
    offline = [f"pretraining.{name}:{value}" for name, value in OFFLINE.items()]
    assert main(["train", "--algo", "fedguide", *flags, *offline]) == 0
    assert main(["train", "--algo", "local", *flags]) == 0
    fedguide, local = (str(tmp_path / algo / "Bandit2D_1") for algo in ("fedguide", "local"))
    out = tmp_path / "out"
    assert main(["plot", fedguide, local, "--figures", "plan", "-o", str(out)]) == 0
    assert [path.name for path in out.iterdir()] == ["plan-Bandit2D-fedguide-seed0.png"]
    assert f"plan: no plan.csv in {local}" in capfd.readouterr().err
    assert main(["plot", local, "--figures", "plan", "-o", str(out)]) == 2
