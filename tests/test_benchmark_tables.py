"""The tables of ``fedguide benchmark``: every figure by its definition, and the committed results."""

from __future__ import annotations

import csv
import importlib
import json
from pathlib import Path

import numpy as np
import pytest

import fed_envs
from sb3_fedguide.benchmark.aggregate import aggregate, bootstrap_interval, interquartile_mean, normalise, random_actions
from sb3_fedguide.benchmark.results import best_known, measure, read_result, read_results, volatility
from sb3_fedguide.cli.benchmark import main
from sb3_fedguide.cli.benchmark_tables import fitting, rows_of
from tests.result_files import write_result

ROOT = Path(__file__).parents[1]


def test_the_measures_are_those_of_their_definitions(tmp_path):
    """By hand: F = (3 + 7) / 2, deviation 2; CV of seed 0 is sqrt(2/3) / 3, that of seed 1 is 1 / 2."""
    curve = [[5, 100.0], [20, 900.0], [21, 2.0], [30, 3.0], [40, 4.0]]
    write_result(tmp_path, n_rounds=40, rounds_done=40, average=3.0, worst_client=-1.0, curve=curve, success_rates=[0.0, 0.5])
    write_result(
        tmp_path, n_rounds=40, rounds_done=40, seed=1, average=7.0, worst_client=2.0, success_rates=[1.0, 0.5],
        curve=[[5, 50.0], [21, -1.0], [40, -3.0]], seconds={"median_round": 0.25, "total": 1.0}, bytes_up=2000,
    )  # fmt: skip
    results = read_results(tmp_path, "Bandit2D", "tuned", ["fedavg", "local"])
    assert list(results) == ["local"] and [result.seed for result in results["local"]] == [0, 1]
    row = measure(results["local"], at_rounds=[5, 30, 99])
    assert (row.F, row.F_std, row.W, row.worst_client, row.success) == (5.0, 2.0, 3.0, 0.5, 0.5)
    assert row.CV == pytest.approx((np.sqrt(2 / 3) / 3 + 0.5) / 2, rel=1e-12)  # round 20 is none of the last twenty
    assert row.curve == {5: 75.0}  # 30 was not evaluated with every seed
    assert (row.bytes_up_per_round, row.bytes_down_per_round, row.seconds_per_round) == (100.0, 75_000.0, 0.25)
    assert row.broadcast is None and row.paper_F is None
    (one,) = read_results(tmp_path, "Bandit2D", "tuned", ["local"], seeds=[1])["local"]
    assert volatility(one) == 0.5 and one.final == 7.0


def test_bytes_of_the_offline_stage_are_no_bytes_of_rounds(tmp_path):
    """Neither in the files of earlier versions, which have one sum: FedGuide's is then said to be unknown."""
    new = write_result(tmp_path / "new", algo="fedguide", bytes_up=145_006, offline_bytes_up=145_000, offline_bytes_down=0)
    row = measure([read_result(new)])
    assert row.bytes_up_per_round == 6 / read_result(new).n_rounds and row.offline_bytes_up == 145_000
    assert rows_of([row])[0]["up, down offline"] == "145.0 kB, 0 B"
    old = [write_result(tmp_path / algo, algo=algo, env=env) for algo, env in
           (("fedguide", "HopperHard"), ("fedguide", "Bandit2D"), ("fedavg", "HopperHard"))]  # fmt: skip
    unknown, gaussian, averaged = (measure([read_result(path)]) for path in old)
    assert unknown.bytes_up_per_round is None and gaussian.bytes_up_per_round == averaged.bytes_up_per_round > 0
    shown = rows_of([unknown, averaged])
    assert [row["up, down per round"].startswith("-") for row in shown] == [True, False]
    assert "up, down offline" not in shown[0]


def test_volatility_is_not_defined_for_one_round_or_a_mean_of_zero(tmp_path):
    for curve in ([[3, 1.0]], [[2, 1.0], [3, -1.0]]):
        assert volatility(read_result(write_result(tmp_path, curve=curve))) is None


def test_broadcast_and_the_papers_figure_stand_beside_ours(tmp_path, capfd):
    for seed in (0, 1):
        more = {"broadcast": {"average": 4.0 + seed}, "metadata_hash": "x", "env": "HopperHard"}
        write_result(tmp_path, algo="fedavg", seed=seed, average=200.0 + seed, **more)
    assert main(["--envs", "HopperHard", "--table-only", "-f", str(tmp_path), "--markdown", "--at-rounds", "2"]) == 0
    assert capfd.readouterr().out == (
        "## HopperHard-tuned\n\n"
        "| method | seeds | F | worst client | W | CV | round 2 | broadcast | up, down per round "
        "| s per round | paper F |\n"
        "|---|---|---|---|---|---|---|---|---|---|---|\n"
        "| fedavg | 2 | 200.5 ± 0.5 | 0.5 | 200 | 0.333 | 4 | 4.5 | 2.0 kB, 1.0 MB | 0.5 | 216 |\n"
    )


def test_what_is_said_beside_a_baseline_against_its_definition(tmp_path):
    """Differences are of the same seeds; the interval is exact for two seeds, whose resamples have three means."""
    clients = {"local": [[0, 100, [1, 8]], [10, 200, [2, 10]]], "fedavg": [[0, 100, [4, 4]], [10, 200, [5, 5]]]}
    curve = [[1, 0.0], [2, 3.0], [4, 5.0]]
    for algo, level in (("local", 5.0), ("fedavg", 6.0)):
        for seed in (0, 1, *((2,) if algo == "fedavg" else ())):
            ends = {"client_returns": clients[algo][-1][2], "client_curve": clients[algo], "curve": curve}
            write_result(tmp_path, algo=algo, seed=seed, average=level + seed * (1 if algo == "local" else 3), **ends)
    results = read_results(tmp_path, "Bandit2D", "tuned", ["local", "fedavg"])
    best = best_known(result for runs in results.values() for result in runs)
    assert best.tolist() == [5.0, 10.0]
    local, fedavg = (measure(runs, baseline=results["local"], best_known=best) for runs in results.values())
    assert local.difference is None and local.difference_interval is None
    assert fedavg.difference == 2.0 and fedavg.difference_interval == (1.0, 3.0)  # seeds 0 and 1: 6 - 5 and 9 - 6
    assert (local.stuck, fedavg.stuck) == (1.0, 1.0)  # 2 < 0.6 * 5; 5 < 0.6 * 10
    assert local.area == pytest.approx((1.5 * 1 + 4 * 2) / 3)
    assert measure(results["fedavg"], best_known=-best).stuck is None
    assert rows_of([fedavg])[0]["less the baseline's"] == "+2 (1 to 3)"


def test_a_narrow_terminal_cuts_neither_methods_nor_figures():
    row = {
        "method": "fedguide-a",
        "seeds": "3",
        "F": "-32.45 ± 1.27",
        "speed-up": "1.01",
        "up, down per round": "317.6 kB, 317.6 kB",
    }
    assert fitting([row], 200) == [list(row)]
    groups = fitting([row, {**row, "method": "local", "F": "-5"}], 60)
    assert groups == [["method", "seeds", "F", "speed-up"], ["method", "up, down per round"]]
    lines = 1 + sum(3 + len(row[name]) for name in ("method", "F")) + sum(3 + len(name) for name in ("seeds", "speed-up"))
    assert fitting([row], lines)[0] == groups[0] and fitting([row], lines - 1)[0] == ["method", "seeds", "F"]
    assert fitting([row], 5) == [["method", name] for name in list(row)[1:]]  # too narrow for anything: one by one


def test_the_interquartile_mean_of_known_scores():
    eight = np.array([9.0, 1, 2, 3, 4, 5, 6, -50])
    assert interquartile_mean([eight]) == pytest.approx((2 + 3 + 4 + 5) / 4)  # the middle half
    assert interquartile_mean([eight[:4], eight[4:]]) == pytest.approx(3.5)  # however they are divided
    assert interquartile_mean([np.array([1.0, 2, 6])]) == pytest.approx((1 / 12 * 1 + 1 / 3 * 2 + 1 / 12 * 6) / 0.5)
    assert interquartile_mean([np.array([7.0])]) == pytest.approx(7)
    # One run of the first family weighs as much as both of the second: weights 1/2 (score 0), 1/4 (1) and 1/4 (2).
    assert interquartile_mean([np.array([0.0]), np.array([1.0, 2.0])]) == pytest.approx(0.5)
    assert interquartile_mean([np.array([[1.0, 1.0], [2.0, 4.0]])]).tolist() == [1.0, 3.0]


def test_bootstrap_intervals_resample_within_families():
    """Two runs: each resample is (0, 0), (0, 1), (1, 0) or (1, 1). With a family apart, nothing mixes."""
    assert bootstrap_interval([np.array([0.0, 1.0])], confidence=0.6) == (0.0, 1.0)  # 0.2 < P(0) = 1/4 < 0.3
    assert bootstrap_interval([np.array([0.0, 1.0])], confidence=0.4) == (0.5, 0.5)
    assert bootstrap_interval([np.array([3.0, 3.0]), np.array([5.0])]) == (4.0, 4.0)  # unstratified, 3 or 5 could come out
    assert bootstrap_interval([np.array([0.0, 1.0, 5.0])], seed=1) == bootstrap_interval([np.array([0.0, 1.0, 5.0])], seed=1)


def test_scores_are_linear_between_the_levels():
    assert normalise(np.array([-10.0, 0.0, 10.0, 30.0]), -10, 10).tolist() == [0, 0.5, 1, 2]
    with pytest.raises(ValueError, match="is not above"):
        normalise(np.array([1.0]), 2, 2)
    row = aggregate("fedavg", {"A": [5.0], "B": [-1.0]}, {"A": (0, 10), "B": (-2, 2)})
    assert (row.scores, row.n_runs, row.interval) == ({"A": 0.5, "B": 0.25}, 2, None)  # nothing can be resampled
    assert row.iqm == pytest.approx(0.375)


def test_random_actions_return_what_their_density_says():
    """Four peaks of 2 pi 0.2^2 each, on a square of side 3."""
    evaluation = random_actions(fed_envs.load_family("Bandit2D"), n_episodes=500)
    assert evaluation.returns.shape == (4, 500)
    assert evaluation.average == pytest.approx(4 * 2 * np.pi * 0.04 / 9, abs=0.018)


def test_several_families_are_aggregated(tmp_path, capfd):
    content = fed_envs.load_family("Bandit2D").to_dict()
    content["family"], content["clients"] = "Mine", content["clients"][:2]
    (tmp_path / "mine.json").write_text(json.dumps(content))
    own = fed_envs.load_family(tmp_path / "mine.json").content_hash
    for seed, more in enumerate((-0.5, 0.5)):
        for algo, level in {"local": 2.0, "fedavg": 1.0}.items():
            write_result(tmp_path, algo=algo, seed=seed, average=level + more)
            write_result(tmp_path, algo=algo, seed=seed, average=2 * (level + more), env="Mine", metadata_hash=own)
    write_result(tmp_path, algo="fedkl")
    flags = ["--envs", "Bandit2D", "--metadata", str(tmp_path / "mine.json"), "--table-only", "-f", str(tmp_path)]
    tables = {name: str(tmp_path / f"table.{name}") for name in ("json", "csv")}
    assert main([*flags, "--json", tables["json"], "--csv", tables["csv"]]) == 0
    assert "All families" in capfd.readouterr().out
    found = json.loads(Path(tables["json"]).read_text())
    levels = [random_actions(fed_envs.load_family(name)).average for name in ("Bandit2D", tmp_path / "mine.json")]
    kept = [json.loads((tmp_path / "random-actions" / f"{name}.json").read_text()) for name in ("Bandit2D", "Mine")]
    assert [file["average"] for file in kept] == levels
    rows = {row["method"]: row for row in found["aggregate"]}
    assert list(rows) == ["local", "fedavg"] and "Without fedkl" in found["notes"][1]
    assert rows["local"]["scores"] == pytest.approx({"Bandit2D": 1, "Mine": 1})
    expected = {"Bandit2D": (1 - levels[0]) / (2 - levels[0]), "Mine": (2 - levels[1]) / (4 - levels[1])}
    assert rows["fedavg"]["scores"] == pytest.approx(expected)
    assert rows["fedavg"]["interval"][0] < rows["fedavg"]["iqm"] < rows["fedavg"]["interval"][1] < 1
    with open(tables["csv"], newline="") as file:
        records = list(csv.DictReader(file))
    assert [(row["results"], row["method"], float(row["F"])) for row in records] == [
        ("Bandit2D-tuned", "local", 2), ("Bandit2D-tuned", "fedavg", 1), ("Bandit2D-tuned", "fedkl", 1),
        ("Mine-tuned", "local", 4), ("Mine-tuned", "fedavg", 2),
    ]  # fmt: skip
    assert main([*flags, "--baseline", "fedkl"]) == 0
    assert "no aggregate: it needs results of the baseline, fedkl, on every family" in capfd.readouterr().out
    write_result(tmp_path, average=-5.0)
    write_result(tmp_path, average=-5.0, seed=1)
    assert main(flags) == 0
    assert "no aggregate: the baseline, local, is no better than random actions on Bandit2D" in capfd.readouterr().out


def test_the_committed_results_give_the_documented_tables(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    text = importlib.import_module("compare").PAGE.read_text(encoding="utf-8")
    assert text.count("<!-- table: ") >= 10
    assert importlib.import_module("compare").with_tables(text) == text
    for folder in sorted((ROOT / "benchmarks" / "results").glob("*-*/")):
        for path in folder.glob("*-seed*.json"):
            assert read_result(path).method in path.name


def test_the_committed_studies_and_results_give_the_documented_list(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    compare = importlib.import_module("compare")
    text = compare.LIST.read_text(encoding="utf-8")
    assert compare.with_studies(text) == text


def test_the_list_of_studies_counts_the_evaluations_that_each_asks_for(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    compare = importlib.import_module("compare")
    monkeypatch.setattr(compare, "STUDIES", tmp_path)
    for name, settings in {"few": "eval_episodes: 1", "many": "eval_episodes: 1000", "often": "eval_freq: 1"}.items():
        text = f"{{methods: {{local: }}, families: [HopperHard], seeds: [0], rounds: 300, folder: results, {settings}}}"
        (tmp_path / f"{name}.yml").write_text(text)
    hours = [int(line.split("|")[-2]) for line in compare.studies().splitlines()[2:]]
    assert hours[0] < hours[2] < hours[1]
