"""What a run shows on the terminal: results before clients, digits that fit, and which episodes a return is of."""

from __future__ import annotations

import io
import math

import pytest

import fed_envs
from fed_envs import metadata_figures
from sb3_fedguide import Local
from sb3_fedguide.cli.report import print_summary
from sb3_fedguide.cli.round_table import RoundTable
from sb3_fedguide.common.digits import decimals, shown


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.98345, "0.983"), (-0.98345, "-0.983"), (0.0, "0.000"), (1.0, "1.00"), (-5.2345, "-5.23"), (62.649, "62.6"),
     (812.44, "812"), (12345.6, "12346"), (math.nan, "nan"), (math.inf, "inf")],
)  # fmt: skip
def test_a_number_has_the_digits_that_its_size_is_worth(value, text):
    assert shown(value) == text


def test_numbers_of_a_table_have_those_of_the_largest():
    assert decimals([0.1, -812.0, math.nan]) == 0 and decimals([0.1, 0.9]) == 3 and decimals([]) == 3


def test_results_stand_before_the_clients():
    out = io.StringIO()
    values = {"client_0/ep_rew_mean": 1.0, "client_10/std": 0.5, "eval/mean_reward": 12345.678, "train/n_updates": 3,
              "train/loss": 3e-4, "pictures/x": object(), "client_0/picture": object()}  # fmt: skip
    excluded = {key: ("stdout", "log") if isinstance(value, object) and type(value) is object else None
                for key, value in values.items()}  # fmt: skip
    RoundTable(out).write(values, excluded, 1)
    text = out.getvalue()
    assert text.index("eval/") < text.index("train/") < text.index("client_0/") < text.index("client_10/")
    assert "12346" in text and "0.0003" in text and "picture" not in text
    RoundTable(out).write({"client_0/picture": object()}, {"client_0/picture": ("stdout",)})  # nothing to show is no warning
    assert out.getvalue() == text


def test_the_bar_says_of_which_episodes_its_return_is(capsys):
    model = Local("MlpPolicy", "Bandit2D", rollout_size=20, batch_size=10, bc_weight=0, policy_kwargs={"net_arch": [4]})
    model.learn(20 * 4, progress_bar=True)
    assert f"training return {shown(model.mean_episode_return())}, sampled actions" in capsys.readouterr().err


def test_the_table_at_the_end_has_digits_for_small_returns(capsys):
    numbers = {"client_returns": [0.98345, 0.5], "client_lengths": [1.0, 1.0], "average": 0.741725, "worst_client": 0.5}
    seconds = dict.fromkeys(("total", "pretraining", "rollout", "train", "exchange", "evaluation", "other"), 1.0)
    bytes_ = {f"{part}bytes_{way}": 0 for part in ("", "offline_") for way in ("up", "down")}
    summary = {"algo": "local", "env": "Bandit2D", "seed": 0, "rounds_done": 1, "n_rounds": 1, "clients": [0, 1],
               "deployed": numbers, "seconds": seconds, "rejected_uploads": {}, **bytes_}  # fmt: skip
    print_summary(summary, "logs")
    out = capsys.readouterr().out
    assert "0.983" in out and "0.742" in out and "0.500" in out


def test_the_picture_of_the_clients_has_labelled_axes():
    figure = metadata_figures.heterogeneity(fed_envs.load_family("Reacher"))
    assert figure is not None
    axes, scale = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("client", "parameter")
    assert scale.get_ylabel() == "standard deviations from the mean"
