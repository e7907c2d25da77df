"""Every figure's numbers against values by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest

from sb3_fedguide.benchmark.figures.bars import draw_bars, draw_speed_up
from sb3_fedguide.benchmark.figures.clients import client_returns, draw_clients, share_of_best
from sb3_fedguide.benchmark.figures.comparisons import (
    improvement_interval,
    performance_profile,
    probability_of_improvement,
    profile_band,
)
from sb3_fedguide.benchmark.figures.curves import curve, draw_client_curves, draw_curves
from sb3_fedguide.benchmark.figures.layout import fit_scale, panels
from sb3_fedguide.benchmark.figures.runs import from_result
from sb3_fedguide.benchmark.figures.styles import STYLES, style
from sb3_fedguide.benchmark.results import read_result
from sb3_fedguide.registry import ALGORITHMS, Entry
from tests.result_files import CLIENTS, result, write_result

pytestmark = pytest.mark.usefixtures("coarse_figures")


def test_performance_profiles_are_shares_of_runs_that_score_higher():
    """Family A: 0, 1, 2, 3; B: 1. Above 0: (3/4 + 1) / 2; above 1: (2/4 + 0) / 2. Equal is not above."""
    groups = [np.array([0.0, 1.0, 2.0, 3.0]), np.array([1.0])]
    levels = np.array([-1.0, 0.0, 0.5, 1.0, 3.0])
    assert performance_profile(groups, levels).tolist() == [1.0, 0.875, 0.875, 0.25, 0.0]
    stacked = [np.stack([group, group + 1]) for group in groups]
    assert performance_profile(stacked, levels)[1].tolist() == [1.0, 1.0, 1.0, 0.875, 0.125]
    low, high = profile_band(groups, levels)
    assert (low[0], high[0], low[-1], high[-1]) == (1.0, 1.0, 0.0, 0.0) and low[1] < 0.875 < high[1]
    assert profile_band([np.array([0.0]), np.array([2.0])], np.array([1.0])) == ([0.5], [0.5])  # stratified: nothing mixes


def test_probability_of_improvement_is_the_mann_whitney_statistic():
    """A: x = 1, 3 against y = 1, 2: 1/2 + 0 + 1 + 1 of 4 pairs. B: 5 against 6: 0. Their mean is 0.3125."""
    ours, theirs = [np.array([1.0, 3.0]), np.array([5.0])], [np.array([1.0, 2.0]), np.array([6.0])]
    assert probability_of_improvement(ours, theirs) == 0.3125
    assert probability_of_improvement(theirs, ours) == 1 - 0.3125
    assert probability_of_improvement(ours, ours) == 0.5
    from scipy.stats import mannwhitneyu

    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 6, 7).astype(float), rng.integers(0, 6, 5).astype(float)
    assert probability_of_improvement([x], [y]) == pytest.approx(mannwhitneyu(x, y).statistic / 35)
    # Resamples of A: x is (1, 1), (1, 3), (3, 1) or (3, 3), y likewise; the lowest value, 0 where all of x are 1 and of y 2,
    # has probability 1/16, and the highest, 1 where all of x are 3, has 1/4. B halves them.
    assert improvement_interval(ours, theirs) == (0.0, 0.5)
    assert improvement_interval(ours, ours)[1] > 0.5 > improvement_interval(ours, ours)[0]


def test_curves_are_means_over_seeds_with_the_band_that_they_say(tmp_path):
    runs = [from_result(read_result(result(tmp_path, seed=seed, level=level))) for seed, level in enumerate((1.0, 2.0, 6.0))]
    found = curve(runs, [run.average for run in runs])
    assert found.x.tolist() == [1, 2, 3] and found.mean.tolist() == [3.0, 6.0, 9.0] and found.band is not None
    assert [edge.tolist() for edge in found.band] == [[1.0, 2.0, 3.0], [6.0, 12.0, 18.0]]
    low, high = curve(runs, [run.average for run in runs], band="bootstrap").band
    # Of 27 samples one is (1, 1, 1), with 0.037 > 0.025, and one is (6, 6, 6)
    assert low == pytest.approx([1.0, 2.0, 3.0]) and high == pytest.approx([6.0, 12.0, 18.0])
    pair = curve(runs[:2] * 2, [run.average for run in runs[:2] * 2], band="bootstrap").band
    assert 1.0 <= pair[0][0] < 1.5 < pair[1][0] <= 2.0
    assert curve(runs[:1], [runs[0].average]).band is None
    worst = curve(runs, [run.of("worst") for run in runs])
    assert worst.mean.tolist() == pytest.approx([2.1, 4.2, 6.3])  # 0.7 times the average


def test_only_rounds_that_every_seed_evaluated_are_averaged(tmp_path):
    write_result(tmp_path, curve=[[1, 1.0], [2, 5.0], [3, 3.0]])
    write_result(tmp_path, seed=1, curve=[[1, 3.0], [3, 7.0]])
    runs = [from_result(read_result(tmp_path / "Bandit2D-tuned" / f"local-seed{seed}.json")) for seed in (0, 1)]
    found = curve(runs, [run.average for run in runs])
    assert (found.x.tolist(), found.mean.tolist()) == ([1, 3], [2.0, 5.0])
    write_result(tmp_path, seed=1, curve=[[4, 3.0]])
    runs[1] = from_result(read_result(tmp_path / "Bandit2D-tuned" / "local-seed1.json"))
    with pytest.raises(ValueError, match="no evaluated round in common"):
        curve(runs, [run.average for run in runs])


def test_axes_hold_what_the_files_say(tmp_path):
    path = result(tmp_path, bytes_up=1200, bytes_down=2400, offline_bytes_up=200, offline_bytes_down=400)
    run = from_result(read_result(path))
    assert run.axis("steps").tolist() == [1000, 2000, 3000]
    assert run.axis("seconds").tolist() == [2.0, 4.0, 6.0]  # 3 + 2 + 1 over three rounds: without evaluation
    assert run.axis("bytes").tolist() == [1600, 2600, 3600]  # 600 before the first round
    tested = from_result(read_result(result(tmp_path, test_timesteps=600, seed=1)))
    assert tested.axis("steps").tolist() == pytest.approx([1000, 2000, 3000])  # tests count
    old = from_result(read_result(write_result(tmp_path / "old")))
    for x, what in (("steps", "environment steps"), ("seconds", "seconds of rollout")):
        with pytest.raises(ValueError, match=f"local-seed0.json does not say the {what}.*-x rounds"):
            old.axis(x)
    with pytest.raises(ValueError, match="no returns of single clients"):
        old.of("worst")


def test_clients_below_60_percent_of_their_best_are_stuck(tmp_path):
    groups = {"local": ((10.0, -10.0, 0.0), (4.0, -15.0, -1.0)), "fedavg": ((6.0, -13.9, 0.0), (6.1, -14.1, 0.0))}
    results = {}
    for algo, rows in groups.items():
        results[algo] = []
        for seed, row in enumerate(rows):
            path = result(tmp_path, algo, seed, clients=[3, 5, 8])
            content = json.loads(path.read_text())
            content["deployed"]["client_returns"] = row
            path.write_text(json.dumps(content))
            results[algo].append(read_result(path))
    found = client_returns(results)
    assert found.best.tolist() == [10.0, -10.0, 0.0] and list(found.clients) == [3, 5, 8]
    assert found.stuck.tolist() == [[1, 1, 1], [0, 1, 0]]  # 6 of 10 is not below 60 %
    assert found.mean.tolist() == [[7.0, -12.5, -0.5], [6.05, -14.0, 0.0]]
    assert found.share[0].tolist() == [pytest.approx(0.7), pytest.approx(0.75), -np.inf]
    assert share_of_best(np.array([0.0]), np.array([0.0])).tolist() == [1.0]
    figure = draw_clients("Mine", {name: [from_result(one) for one in group] for name, group in results.items()})
    assert [text.get_text() for text in figure.axes[0].texts[:2]] == ["7.00\n1 of 2", "-12.5\n1 of 2"]
    assert figure.axes[0].get_xticklabels()[0].get_text() == "3\n10.0"
    with pytest.raises(ValueError, match="does not say the clients' final returns"):
        client_returns({"local": [read_result(write_result(tmp_path / "old"))]})


def test_every_registered_algorithm_has_a_look_of_its_own():
    assert set(STYLES) == {name for name, entry in ALGORITHMS.items() if entry.module.startswith("sb3_fedguide.")}
    looks = [style(name) for name in STYLES]
    assert len({(look.color, look.line) for look in looks}) == len({look.marker for look in looks}) == len(looks)
    assert len({(look.color, look.hatch) for look in looks}) == len(looks)  # bars
    every = [style(name, variant) for name in STYLES for variant in (0, 1, 2)]
    assert len({(look.color, str(look.line), look.marker, look.hollow) for look in every}) == len(every)
    assert all(style(name, 1).color == style(name).color for name in STYLES)


def test_algorithms_of_ones_own_look_like_no_other(monkeypatch):
    for number in range(10):
        monkeypatch.setitem(ALGORITHMS, f"mine-{number}", Entry("mine", "Mine"))
    looks = [style(name) for name in ALGORITHMS]
    assert len({(look.color, str(look.line), look.marker) for look in looks}) == len(looks)
    assert style("fedavg") == STYLES["fedavg"] and style("not registered") == style("not registered")


def test_bars_are_the_measures_and_dots_the_seeds(tmp_path):
    runs = {"local": [from_result(read_result(result(tmp_path, seed=seed, level=1.0 + seed))) for seed in (0, 1)]}
    left, right = draw_bars({"Bandit2D": runs}).axes
    assert [bar.get_width() for bar in left.patches] == [4.5]  # F: (3 + 6) / 2
    assert [bar.get_width() for bar in right.patches] == [pytest.approx(3.15)]  # worst client: (2.1 + 4.2) / 2
    points = [list(line.get_xdata()) for line in left.lines]
    assert [3.0, 6.0] in points and [3.0] in points  # seeds, and W
    assert [label.get_text() for label in left.get_yticklabels()] == ["local (2 seeds)"]


def test_the_speed_up_is_that_of_the_tables(tmp_path):
    """Local ends at 3. FedAvg's curve 2, 4, 6 is there after two of three rounds; FedProx's never."""
    levels = {"local": 1.0, "fedavg": 2.0, "fedprox": 0.5}
    runs = {name: [from_result(read_result(result(tmp_path, name, level=level)))] for name, level in levels.items()}
    (axes,) = draw_speed_up({"Bandit2D": runs}).axes
    assert [bar.get_width() for bar in axes.patches] == [1.0, 1.5, 0.0]
    assert [(text.get_text(), text.xy) for text in axes.texts] == [("not reached", (0.0, 2))]
    for baseline, found in (("fedkl", runs), ("local", {"local": runs["local"]})):
        with pytest.raises(ValueError, match=f"the baseline, {baseline}, and of another"):
            draw_speed_up({"Bandit2D": found}, baseline)


def test_legends_name_seeds_and_lie_outside_the_panels(tmp_path):
    runs = {name: [from_result(read_result(result(tmp_path, name, seed))) for seed in range(n)] for name, n in
            (("local", 2), ("fedavg", 1))}  # fmt: skip
    for figure in (draw_curves({"Bandit2D": runs}), draw_client_curves("Bandit2D", runs)):
        figure.canvas.draw()
        (box,) = figure.legends
        assert [text.get_text() for text in box.get_texts()] == ["local (2 seeds)", "fedavg (1 seed)"]
        assert "lowest to highest seed" in box.get_title().get_text()
        assert not any(box.get_window_extent().overlaps(axes.get_window_extent()) for axes in figure.axes)
    assert [axes.get_title(loc="left") for axes in figure.axes] == [f"client {client}" for client in CLIENTS]


@pytest.mark.parametrize(
    ("levels", "scale"),
    [
        ([1.0, 900.0], "linear"),
        ([-5.0, -40.0], "linear"),
        ([-6.0, -900.0], "symlog"),
        ([2.0, -900.0, np.nan], "symlog"),
        ([], "linear"),
    ],
)
def test_far_apart_negative_returns_get_a_log_scale(levels, scale):
    _, (axes,) = panels(1, (3, 3))
    axes.set_ylabel("return")
    fit_scale(axes, levels)
    assert axes.get_yscale() == scale and ("log scale" in axes.get_ylabel()) == (scale == "symlog")
