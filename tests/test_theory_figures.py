"""Lemma 2 and Theorem 3 in figures: read from hand-made logs as runs write them, and drawn as the paper states them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from torch.utils.tensorboard import SummaryWriter

import fed_envs
from sb3_fedguide.benchmark.figures import layout
from sb3_fedguide.benchmark.figures.theory import (
    Log,
    averaging_points,
    bound_constant,
    draw_lemma2,
    draw_theorem3,
    reduction,
)
from sb3_fedguide.cli.plot import main
from sb3_fedguide.cli.plot_logs import read_scalars
from sb3_fedguide.cli.plot_runs import read_run_folder
from sb3_fedguide.cli.run_folder import events_folder
from sb3_fedguide.cli.train import main as train
from sb3_fedguide.common.value_blend import baseline_metrics

#: Key to the values of rounds 1, 2, ...; ``None`` where nothing was logged.
LEMMA = {
    "client_0/residual_correlation": [0.5, 0.2], "client_3/residual_correlation": [-0.1, 0.4],
    "dice/advantage_variance_online": [4.0, 2.0], "dice/advantage_variance_blend": [5.0, 1.0],
    "dice/advantage_variance_optimal": [3.0, 1.0],
}  # fmt: skip
THEOREM = {"federated/policy_dispersion": [0.25, 1.0, 4.0], "eval/averaging_change": [-1.0, None, 3.0]}


def by_round(values):
    return {key: {n: value for n, value in enumerate(row, 1) if value is not None} for key, row in values.items()}


def run_folder(folder: Path, algo: str = "fedguide", values=None, events: str = ".", **config) -> Path:
    """A run that goes on, with a log of the given values; a round has 800 steps.

    :param events: where in it the log is
    """
    folder.mkdir(parents=True)
    family = fed_envs.load_family("Bandit2D")
    family.dump(folder / "metadata.json")
    (folder / "metadata.sha256").write_text(family.content_hash)
    (folder / "args.yml").write_text(yaml.safe_dump({"algo": algo, "seed": 0, "tensorboard_log": None, "delays": None}))
    (folder / "config.yml").write_text(yaml.safe_dump(config))
    rows = [f"1,800,deployed,{client},1.0,0.0,1.0," for client in range(4)]
    (folder / "evaluations.csv").write_text(
        "\n".join(["round,timesteps,policy,client,mean_return,std_return,mean_length,success_rate", *rows]) + "\n"
    )
    with SummaryWriter(str(folder / events)) as writer:
        for key, row in {"time/round": [1, 2, 3], **(values or {})}.items():
            for n, value in enumerate(row, 1):
                if value is not None:
                    writer.add_scalar(key, value, 800 * n)
    return folder


@pytest.mark.parametrize("events", [".", "tb"])
def test_a_log_is_read_by_rounds(events, tmp_path):
    """Events lie in the folder of a run, and those of an earlier version's in its ``tb``."""
    values = {**LEMMA, **THEOREM}
    scalars = read_scalars(read_run_folder(run_folder(tmp_path / "run", values=values, events=events)))
    assert scalars.keys() == {"time/round", *values}
    for key, by_rounds in by_round(values).items():
        assert scalars[key] == pytest.approx(by_rounds), key  # events have single precision


def test_tensorboard_log_is_where_the_events_are(tmp_path):
    assert events_folder(tmp_path / "local" / "Mine_3", "elsewhere", "Mine", "local") == Path("elsewhere/Mine/local_3")


def test_the_log_of_the_training_command_has_what_both_are_drawn_from(tmp_path):
    flags = ["--algo", "fedguide", "--env", "Bandit2D", "--rounds", "1", "--eval-episodes", "1", "--eval-average"]
    flags += ["--verbose", "0", "--picture-freq", "0", "-f", str(tmp_path)]
    small = ["rollout_size:16", "batch_size:16", "n_epochs:1", "n_envs_per_client:2", "policy_kwargs.net_arch:[8]"]
    offline = ["bc_updates:1", "dice_updates:1", "dice_width:8", "dataset_size:50"]
    assert train([*flags, "-params", *small, *(f"pretraining.{setting}" for setting in offline)]) == 0
    scalars = read_scalars(read_run_folder(tmp_path / "fedguide" / "Bandit2D_1"))
    assert reduction(scalars).ratio.shape == (1,) and averaging_points(scalars).shape == (1, 2)


def test_lemma_2_by_round():
    found = reduction(by_round(LEMMA))
    np.testing.assert_allclose(found.kappa, [0.2, 0.3])
    np.testing.assert_allclose([found.lowest, found.highest], [[-0.1, 0.2], [0.5, 0.4]])
    np.testing.assert_allclose([found.ratio, found.optimal], [[1.25, 0.5], [0.75, 0.5]])
    older = {key: values for key, values in by_round(LEMMA).items() if not key.endswith("optimal")}
    assert np.isnan(reduction(older).optimal).all() and (reduction(older).ratio == found.ratio).all()
    with pytest.raises(ValueError, match="no V_phi"):
        reduction(by_round(THEOREM))


def test_the_logged_optimum_is_the_lemmas():
    """Var(X) (1 - kappa^2) where beta* lies inside [0, 1], and Var(X) where V_phi misleads."""
    rng = np.random.default_rng(0)
    online, noise = rng.normal(size=(2, 500)), rng.normal(size=(2, 500))
    returns = online + rng.normal(size=(2, 500))
    dice = online + np.array([[1.0], [-1.0]]) * (returns - online) + 0.8 * noise
    figures = baseline_metrics(returns, online, dice, online)
    assert 0 < figures["beta_optimal"][0] < 1 == figures["beta_optimal"][1] and figures["residual_correlation"][1] < 0
    variance, best = figures["advantage_variance_online"], figures["advantage_variance_optimal"]
    assert best[0] == pytest.approx(variance[0] * (1 - figures["residual_correlation"][0] ** 2)) and best[1] == variance[1]


def test_theorem_3_in_evaluated_rounds():
    points = averaging_points(by_round(THEOREM))
    assert points.tolist() == [[0.25, 1.0], [4.0, 3.0]]
    assert bound_constant(points) == 2.0  # 1 / sqrt(0.25), and 3 / sqrt(4) is less
    assert bound_constant(np.array([[0.0, 1.0]])) == 0.0
    with pytest.raises(ValueError, match="--eval-average"):
        averaging_points(by_round(LEMMA))


def test_figures_show_what_was_logged():
    logs = [
        Log("fedguide", "fedguide", 0, "Bandit2D", by_round({**LEMMA, **THEOREM})),
        Log(
            "local", "local", 0, "Bandit2D", by_round({"federated/policy_dispersion": [1.0], "eval/averaging_change": [-4.0]})
        ),
    ]
    left, right = draw_lemma2(logs).axes
    np.testing.assert_allclose(left.lines[0].get_ydata(), [0.2, 0.3])
    np.testing.assert_allclose(right.lines[0].get_ydata(), [1.25, 0.5])
    (axes,) = draw_theorem3(logs).axes
    shown = [line.get_xydata().tolist() for line in axes.lines]
    assert shown == [[[0.25, 1.0], [4.0, 3.0]], [[1.0, 4.0]], [[0.25, 2.0], [4.0, 8.0]]]  # C = 4, slope one half
    assert axes.get_xscale() == axes.get_yscale() == "log"


def test_the_command_draws_them_from_folders(tmp_path, monkeypatch):
    monkeypatch.setattr(layout, "FORMATS", ("png",))
    monkeypatch.setattr(layout, "DPI", 20)
    folders = [run_folder(tmp_path / "fedguide", values={**LEMMA, **THEOREM}),
               run_folder(tmp_path / "local", "local", values=THEOREM)]  # fmt: skip
    assert main([*map(str, folders), "--figures", "lemma2", "theorem3", "-o", str(tmp_path / "out")]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["lemma2.png", "theorem3.png"]


@pytest.mark.parametrize(
    ("figure", "algo", "values", "config", "message"),
    [
        ("lemma2", "local", THEOREM, {}, "it has no V_phi"),
        ("theorem3", "local", LEMMA, {}, "train it with --eval-average"),
        ("theorem3", "fedavg", THEOREM, {"server_step": 2.0}, "has server_step 2.0: its server does not send the average"),
        ("theorem3", "fedguide-r", THEOREM, {"server_step": 1.0, "screening": 0.05}, "has screening 0.05"),
    ],
)
def test_what_cannot_be_drawn_says_why(figure, algo, values, config, message, tmp_path, capfd):
    folder = run_folder(tmp_path / "run", algo, values, **config)
    assert main([str(folder), "--figures", figure, "-o", str(tmp_path / "out")]) == 2
    assert message in capfd.readouterr().err and not (tmp_path / "out").exists()


def test_results_of_a_benchmark_have_no_log(tmp_path, capfd):
    from tests.result_files import result

    result(tmp_path)
    flags = ["--envs", "Bandit2D", "-f", str(tmp_path), "--figures", "lemma2", "-o", str(tmp_path / "out")]
    assert main(flags) == 2 and "give them instead of --envs" in capfd.readouterr().err
    assert not (tmp_path / "out").exists()
