"""``fedguide plot``: every figure's numbers against values by hand, and the command from results to files."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import fed_envs
from sb3_fedguide.algorithms import ALGORITHMS
from sb3_fedguide.benchmark.figures import layout
from sb3_fedguide.benchmark.figures.bars import draw_bars, draw_speed_up
from sb3_fedguide.benchmark.figures.clients import client_returns, share_of_best
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
from sb3_fedguide.cli.main import main
from sb3_fedguide.cli.plot_runs import read_evaluations, read_run_folder
from tests.test_benchmark_command import summary, write_result

ROOT = Path(__file__).parents[1]
CLIENTS = [0, 1, 2, 3]
FORMATS = layout.FORMATS


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Small pictures, and no PDFs, whose fonts take long: both again where a test is about them."""
    monkeypatch.setattr(layout, "DPI", 60)
    monkeypatch.setattr(layout, "FORMATS", ("png",))


def result(folder: Path, algo: str = "local", seed: int = 0, level: float = 1.0, label: str = "tuned", **changes) -> Path:
    """A finished run of three rounds; the client-average returns are 1, 2 and 3 times ``level``, clients lie around it."""
    around = np.array([0.7, 0.9, 1.1, 1.3])
    returns = [[round, 1000 * round, list(level * round * around)] for round in (1, 2, 3)]
    content = summary(
        algo=algo, seed=seed, average=3 * level, worst_client=2.1 * level, curve=[[r, level * r] for r in (1, 2, 3)],
        timesteps=3000, clients=CLIENTS, offline_bytes_up=0, offline_bytes_down=0,
        seconds={"median_round": 0.5, "total": 9.0, "rollout": 3.0, "train": 2.0, "exchange": 1.0},
    )  # fmt: skip
    content["deployed"] |= {"client_returns": returns[-1][2], "client_curve": returns}
    content |= changes
    path = folder / f"{content['env']}-{label}" / f"{algo}-seed{seed}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def two_families(folder: Path) -> Path:
    """Bandit2D and a family of two of its clients with two methods and seeds; the family's file."""
    content = fed_envs.load_family("Bandit2D").to_dict()
    content["family"], content["clients"] = "Mine", content["clients"][:2]
    path = folder / "mine.json"
    path.write_text(json.dumps(content))
    own = fed_envs.load_family(path).content_hash
    for name, family_hash in (("Bandit2D", fed_envs.load_family("Bandit2D").content_hash), ("Mine", own)):
        for seed in (0, 1):
            result(folder, "local", seed, 1.0 + 0.1 * seed, env=name, metadata_hash=family_hash)
            result(folder, "fedavg", seed, 0.8 + 0.3 * seed, env=name, metadata_hash=family_hash)
        kept = folder / "random-actions" / f"{name}.json"
        kept.parent.mkdir(exist_ok=True)
        kept.write_text(json.dumps({"metadata_hash": family_hash, "average": 0.3}))
    return path


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
    with pytest.raises(ValueError, match="does not say the clients' final returns"):
        client_returns({"local": [read_result(write_result(tmp_path / "old"))]})


def test_every_registered_algorithm_has_a_look_of_its_own():
    assert set(STYLES) == {name for name, (module, _) in ALGORITHMS.items() if module.startswith("sb3_fedguide.")}
    looks = [style(name) for name in STYLES]
    assert len({(look.color, look.line) for look in looks}) == len({look.marker for look in looks}) == len(looks)
    assert len({(look.color, look.hatch) for look in looks}) == len(looks)  # bars
    every = [style(name, variant) for name in STYLES for variant in (0, 1, 2)]
    assert len({(look.color, str(look.line), look.marker, look.hollow) for look in every}) == len(every)
    assert all(style(name, 1).color == style(name).color for name in STYLES)


def test_algorithms_of_ones_own_look_like_no_other(monkeypatch):
    for number in range(10):
        monkeypatch.setitem(ALGORITHMS, f"mine-{number}", ("mine", "Mine"))
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


def is_picture(path: Path) -> bool:
    start = b"\x89PNG\r\n" if path.suffix == ".png" else b"%PDF-"
    return path.read_bytes().startswith(start) and path.stat().st_size > 5000


def test_the_command_writes_every_figure_that_the_data_allow(tmp_path, capfd):
    mine = two_families(tmp_path)
    out = tmp_path / "new" / "figures"
    flags = ["plot", "-f", str(tmp_path), "--envs", "Bandit2D", "--metadata", str(mine), "-o", str(out)]
    assert main(flags) == 0
    names = {"curves-average-rounds", "bars", "clients-Bandit2D", "clients-Mine", "aggregate", "speedup"}
    assert {path.name for path in out.iterdir()} == {f"{name}.png" for name in names}
    assert all(is_picture(path) for path in out.iterdir())
    captured = capfd.readouterr()
    assert captured.out.count("wrote ") == len(names) and captured.err == ""


def test_figures_are_png_and_pdf_and_come_out_again_to_the_byte(tmp_path, monkeypatch):
    assert set(FORMATS) == {"png", "pdf"}
    monkeypatch.setattr(layout, "FORMATS", FORMATS)
    result(tmp_path)
    flags = ["plot", "-f", str(tmp_path), "--envs", "Bandit2D", "--figures", "bars", "-o", str(tmp_path / "out")]
    assert main(flags) == 0
    written = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    assert set(written) == {"bars.png", "bars.pdf"} and all(is_picture(tmp_path / "out" / name) for name in written)
    assert main(flags) == 0
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == written


def test_what_the_data_do_not_allow_is_left_out_with_a_reason(tmp_path, capfd):
    result(tmp_path)
    assert main(["plot", "-f", str(tmp_path), "--envs", "Bandit2D", "-o", str(tmp_path / "out")]) == 0
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 2 and "left out aggregate: " in lines[0] and "left out speedup: " in lines[1]
    assert {path.stem for path in (tmp_path / "out").iterdir()} == {"curves-average-rounds", "bars", "clients-Bandit2D"}


def test_results_of_several_labels_stand_side_by_side(tmp_path, monkeypatch):
    from sb3_fedguide.benchmark.figures import bars

    result(tmp_path, "local")
    result(tmp_path, "fedavg", label="plain")
    result(tmp_path, "local", label="plain", level=2.0)
    drawn = {}
    monkeypatch.setattr(bars, "draw_bars", lambda comparison: drawn.update(comparison) or draw_bars(comparison))
    flags = ["plot", "-f", str(tmp_path), "--envs", "Bandit2D", "--label", "tuned", "plain", "-o", str(tmp_path / "out")]
    assert main([*flags, "--figures", "bars"]) == 0
    runs = {name: (group[0].variant, float(group[0].average[-1])) for name, group in drawn["Bandit2D"].items()}
    assert runs == {"local, tuned": (0, 3.0), "local, plain": (1, 6.0), "fedavg, plain": (0, 3.0)}


def run_folder(folder: Path, algo: str, seed: int, level: float, finished: bool = True) -> Path:
    """A run's folder as training leaves it, or as it is meanwhile."""
    folder.mkdir(parents=True)
    family = fed_envs.load_family("Bandit2D")
    family.dump(folder / "metadata.json")
    (folder / "metadata.sha256").write_text(family.content_hash)
    rows = ["round,timesteps,policy,client,mean_return,std_return,mean_length,success_rate"]
    for round in (1, 2, 3):
        for policy, more in (("deployed", 0), ("broadcast", 9)):
            rows += [f"{round},{1000 * round},{policy},{client},{level * round + more},0,1," for client in CLIENTS]
    (folder / "evaluations.csv").write_text("\n".join(rows) + "\n")
    if finished:
        content = json.loads(result(folder / "made", algo, seed, level).read_text())
        (folder / "summary.json").write_text(json.dumps(content))
    else:
        (folder / "args.yml").write_text(f"algo: {algo}\nseed: {seed}\n")
    return folder


def test_run_folders_are_drawn_finished_or_not(tmp_path, capfd):
    folders = [run_folder(tmp_path / "a", "local", 0, 1.0), run_folder(tmp_path / "b", "fedavg", 1, 2.0, finished=False)]
    one, other = map(read_run_folder, folders)
    assert (one.method, one.family, one.seed, one.average.tolist()) == ("local", "Bandit2D", 0, [1, 2, 3])
    assert (other.method, other.family, other.seed, other.result) == ("fedavg", "Bandit2D", 1, None)
    assert one.axis("steps").tolist() == other.axis("steps").tolist() == [1000, 2000, 3000]
    assert one.axis("seconds").tolist() == [2.0, 4.0, 6.0]
    out = tmp_path / "out"
    assert (
        main(["plot", *map(str, folders), "-x", "steps", "--of", "clients", "-o", str(out), "--figures", "curves", "bars"])
        == 0
    )
    assert is_picture(out / "curves-clients-steps-Bandit2D.png") and is_picture(out / "bars.png")
    assert f"{folders[1]} is not finished, and is drawn in learning curves only" in capfd.readouterr().err
    assert main(["plot", *map(str, folders), "-x", "seconds", "-o", str(out)]) == 2
    assert f"curves: {folders[1]} does not say the seconds" in capfd.readouterr().err


def test_an_evaluation_that_is_being_written_does_not_count_yet(tmp_path):
    path = run_folder(tmp_path / "a", "local", 0, 1.0) / "evaluations.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:-6]) + "\n")  # two rows of round 3 are there
    rounds, _, clients, returns = read_evaluations(path)
    assert rounds.tolist() == [1, 2] and clients == CLIENTS and returns.shape == (2, 4)
    path.write_text("\n".join(lines[:2] + lines[4:]) + "\n")
    with pytest.raises(ValueError, match="round 2 has other clients"):
        read_evaluations(path)


WRONG = {
    "": "give folders of runs, or the families",
    "nowhere": "nowhere is not the folder of a run with evaluations: it has no evaluations.csv",
    "{run} {run}": "are both of local on Bandit2D with seed 0; give one of them",
    "{run} --envs Bandit2D": "not both",
    "{run} --algos local": "--algos chooses results of a benchmark",
    "{run} --baseline lokal": "Did you mean 'local'?",
    "{broken}": "is not a run's table of evaluations",
    "{empty}": "has no evaluation yet",
    "{unknown}": "is not the folder of a run: args.yml: ",
    "--envs Bandit3D": "Did you mean 'Bandit2D'?",
    "--envs Reacher": "has no results of Reacher with these methods and seeds; there are Bandit2D-plain, Bandit2D-tuned",
    "--envs Bandit2D --label pain": "has no results of Bandit2D with these",
    "--envs Bandit2D --label a/b": "--label 'a/b'",
    "--envs Bandit2D --label tuned tuned": "--label names the same results twice",
    "--envs Bandit2D --seeds 7": "has no results of Bandit2D with these",
    "--envs Bandit2D --algos fedavgg": "unknown algorithm 'fedavgg'. Did you mean 'fedavg'?",
    "--envs Bandit2D --figures curve": "unknown figure 'curve'. Did you mean 'curves'?",
    "--envs Bandit2D --figures aggregate": "aggregate: it needs finished runs on several families",
    "--envs Bandit2D --figures bars speedup": "speedup: it needs finished runs of the baseline, local, and of another",
    "--envs Bandit2D --figures bars --of worst": "--of is for learning curves; add curves to --figures",
    "--envs Bandit2D --label plain -x steps": "curves: {folder}/Bandit2D-plain/local-seed0.json does not say the environment",
    "--envs Bandit2D --label plain --of worst": "no returns of single clients",
    "--envs Bandit2D --label plain --figures clients": "does not say the clients' final returns",
    "--envs Bandit2D -x time": "invalid choice: 'time'",
    "--envs Bandit2D --ouput x": "Did you mean '--output'?",
    "--envs Bandit2D -o {run}/summary.json/x": "the output folder {run}/summary.json/x cannot be made",
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("inputs")
    result(folder)
    write_result(folder, label="plain")
    places = {"folder": folder, **{name: folder / "logs" / name for name in ("run", "broken", "empty", "unknown")}}
    for name in ("run", "broken", "empty"):
        run_folder(places[name], "local", 0, 1.0)
    (places["broken"] / "evaluations.csv").write_text("round,policy\n1,deployed\n")
    (places["empty"] / "evaluations.csv").write_text("round,timesteps,policy,client,mean_return\n")
    run_folder(places["unknown"], "local", 0, 1.0, finished=False)
    (places["unknown"] / "args.yml").unlink()
    return {name: str(path) for name, path in places.items()}


@pytest.mark.parametrize("line", WRONG)
def test_wrong_input_is_one_line_exit_code_2_and_nothing_on_disk(line, inputs, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    words = shlex.split(line.format(**inputs))
    if "--envs" in words:
        words += ["-f", inputs["folder"]]
    try:
        code = main(["plot", *words])
    except SystemExit as exit:  # argparse
        code = exit.code
    captured = capfd.readouterr()
    assert code == 2 and WRONG[line].format(**inputs) in captured.err and captured.out == ""
    assert captured.err.startswith("fedguide plot: error: ") and len(captured.err.splitlines()) == 1
    assert list(tmp_path.rglob("*")) == []


def test_damaged_results_and_returns_that_are_no_numbers(tmp_path, capfd):
    path = result(tmp_path)
    result(tmp_path, "fedavg", level=float("nan"))
    flags = ["plot", "-f", str(tmp_path), "--envs", "Bandit2D", "-o", str(tmp_path / "out")]
    assert main([*flags, "--figures", "curves", "clients"]) == 0  # a policy that diverged is no reason to draw nothing
    path.write_text("{")
    capfd.readouterr()
    assert main(flags) == 2
    message = capfd.readouterr().err
    assert "local-seed0.json is not the result of a run" in message and message.count("\n") == 1


def test_without_matplotlib_one_line_says_so(tmp_path, monkeypatch, capfd):
    result(tmp_path)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["plot", "-f", str(tmp_path), "--envs", "Bandit2D"]) == 2
    assert capfd.readouterr().err == (
        "fedguide plot: error: drawing needs matplotlib, which is not installed; install it with 'pip install matplotlib'\n"
    )


@pytest.mark.parametrize("line", ["--help", "--envs Bandit2D --figures nothing"])
def test_neither_help_nor_a_mistyped_name_waits_for_matplotlib(line):
    script = (
        "import sys\nfrom sb3_fedguide.cli.main import main\n"
        f"try: code = main(['plot', *{line.split()!r}])\nexcept SystemExit as exit: code = exit.code\n"
        "heavy = {'torch', 'stable_baselines3', 'mujoco', 'matplotlib', 'scipy', 'numpy'} & set(sys.modules)\n"
        "print('HEAVY', sorted(heavy), code)"
    )
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert f"HEAVY [] {0 if line == '--help' else 2}" in found.stdout
