"""``fedguide benchmark --study``: a file says what is compared; its rows are benchmarks with common tables and figures."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

import fed_envs
from sb3_fedguide.benchmark import results
from sb3_fedguide.benchmark.costs import estimate
from sb3_fedguide.benchmark.figures import layout
from sb3_fedguide.benchmark.figures.styles import style
from sb3_fedguide.benchmark.results import measure, read_result
from sb3_fedguide.cli import benchmark, benchmark_runs, plot
from sb3_fedguide.cli.benchmark import main, prepare_benchmark
from sb3_fedguide.cli.benchmark_arguments import parse_benchmark
from sb3_fedguide.cli.benchmark_costs import cost_rows, costs_of, offline_seconds, total_hours
from sb3_fedguide.cli.benchmark_runs import Outcome
from sb3_fedguide.cli.benchmark_tables import Tables, latex, rows_of
from sb3_fedguide.cli.delays import read_delays
from sb3_fedguide.cli.plot import FIGURES
from sb3_fedguide.cli.study_file import read_study
from sb3_fedguide.cli.train import main as train
from sb3_fedguide.settings import evaluation
from sb3_fedguide.settings.config import resolve
from tests.result_files import result, two_families

STUDIES = sorted((Path(__file__).parents[1] / "benchmarks" / "studies").glob("*.yml"))
STUDY = {
    "families": ["Bandit2D"], "seeds": [0, 1], "rounds": 3, "eval_episodes": 3, "folder": "results", "at_rounds": [2],
    "methods": {
        "local": None,
        "fedavg": {"seeds": [0]},
        "fedavg (slow)": {"algo": "fedavg", "label": "slow", "params": {"n_epochs": 1, "policy_kwargs": {"net_arch": [8, 8]}}},
    },
}  # fmt: skip


def write(folder: Path, **changes) -> str:
    path = folder / "mine.yml"
    path.write_text(yaml.safe_dump({**STUDY, **changes}, sort_keys=False))
    return str(path)


def plan_of(path: str, *flags: str):
    return prepare_benchmark(
        parse_benchmark(["--study", path, "--dry-run", *flags], "fedguide benchmark"), "fedguide benchmark"
    )


def done(folder: Path, algo: str, seed: int, level: float, label: str = "tuned", **more) -> None:
    config = {"n_rounds": 3, "n_epochs": 1 if label == "slow" else 4}
    result(folder, algo, seed, level, label, n_rounds=3, config=config, **more)


def test_rows_are_runs_of_their_own_settings_in_the_order_of_seeds(tmp_path):
    done(tmp_path / "results", "local", 0, 1.0)
    plan = plan_of(write(tmp_path))
    assert [(run.name, run.result.parent.name) for run in plan.runs] == [
        ("fedavg on Bandit2D, seed 0", "Bandit2D-tuned"),
        ("fedavg (slow) on Bandit2D, seed 0", "Bandit2D-slow"),
        ("local on Bandit2D, seed 1", "Bandit2D-tuned"),
        ("fedavg (slow) on Bandit2D, seed 1", "Bandit2D-slow"),
    ]
    assert [run.name for run in plan.done] == ["local on Bandit2D, seed 0"]
    assert [config.values["n_epochs"] for config in plan.configs] == [4, 1, 4, 1]
    assert [config.values["policy_kwargs"]["net_arch"] for config in plan.configs] == [None, [8, 8], None, [8, 8]]
    assert {config.n_rounds for config in plan.configs} == {3}
    assert all("-f" in run.flags and str(tmp_path) in str(run.result) for run in plan.runs)


def test_delays_and_the_evaluation_of_averages_reach_the_runs(tmp_path):
    methods = {"local": None, "local, late": {"algo": "local", "label": "late", "delays": "deadline:median=60,deadline=90"}}
    path = write(tmp_path, methods=methods, eval_average=True, seeds=[0])
    plain, late = plan_of(path).runs
    assert "--eval-average" in plain.flags and "--delays" not in plain.flags
    assert late.flags[late.flags.index("--delays") + 1] == "deadline:median=60,deadline=90"
    assert "--picture-freq" not in plain.flags  # folders are kept, and pictures with them
    done(tmp_path / "results", "local", 0, 1.0, "late", delays=str(read_delays("deadline:median=60,deadline=90")))
    assert [run.title for run in plan_of(path).done] == ["local, late"]
    done(tmp_path / "results", "local", 0, 1.0, "late", delays=str(read_delays("deadline:median=60,deadline=91")))
    with pytest.raises(ValueError, match=r"method 'local, late': .* other settings: --delays .*deadline=91.0"):
        plan_of(path)


def test_a_part_of_a_study_can_be_chosen(tmp_path):
    path = write(tmp_path)
    assert [run.name for run in plan_of(path, "--algos", "fedavg", "--seeds", "0").runs] == [
        "fedavg on Bandit2D, seed 0", "fedavg (slow) on Bandit2D, seed 0",
    ]  # fmt: skip
    assert [run.title for run in plan_of(path, "--algos", "fedavg (slow)").runs] == ["fedavg (slow)"] * 2
    elsewhere = plan_of(path, "-f", str(tmp_path / "elsewhere"))
    assert all(tmp_path / "elsewhere" in run.result.parents for run in elsewhere.runs)


def test_hyperparameters_reach_the_runs_as_they_are(tmp_path):
    params = {"learning_rate": "lin_3e-4", "ent_coef": 1e-05, "prior_loss": "sample"}
    nested = {"pretraining": {"dataset": "Größe 🙂/{client}"}}
    (config,) = plan_of(write(tmp_path, methods={"fedguide": {"params": {**params, **nested}}}, seeds=[0])).configs
    assert {name: config.values[name] for name in params} == params
    assert config.values["pretraining"]["dataset"] == nested["pretraining"]["dataset"]


@pytest.mark.parametrize("figures", [("bars",), pytest.param(FIGURES, marks=pytest.mark.slow)], ids=["bars", "all"])
def test_what_a_study_ends_with(figures, tmp_path, monkeypatch, capfd):
    """Runs that are there stand in for those that the study does; tables and figures lie beside the results."""
    monkeypatch.setattr(plot, "FIGURES", figures)
    monkeypatch.setattr(layout, "DPI", 20)
    monkeypatch.setattr(layout, "FORMATS", ("png",))
    results = tmp_path / "results"
    results.mkdir()
    file = two_families(results)
    own = fed_envs.load_family(file).content_hash
    for family, family_hash in {"Bandit2D": fed_envs.load_family("Bandit2D").content_hash, "Mine": own}.items():
        for seed in (0, 1):
            done(results, "fedavg", seed, 0.5, "slow", env=family, metadata_hash=family_hash)
    started = []

    def run_here(runs, n_processes, signals, report, say):
        for run in runs:
            started.append(run.name)
            report(run, Outcome(problem="no electricity"))

    monkeypatch.setattr(benchmark_runs, "run_here", run_here)
    monkeypatch.setattr(benchmark, "prepare", lambda *_: None)  # no network is needed
    path = write(tmp_path, metadata=["results/mine.json"], seeds=[0, 1, 2], overview=["F", "W"])
    assert main(["--study", path, "--markdown"]) == 1
    captured = capfd.readouterr()
    assert started == [f"{name} on {family}, seed 2" for name in ("local", "fedavg (slow)") for family in ("Bandit2D", "Mine")]
    assert "## F by family" in captured.out and "| Bandit2D | 3.15 ± 0.15 | 2.4 | 1.5 ± 0 |" in captured.out
    folder = results / "studies" / "mine"
    assert (folder / "tables.md").read_text() == captured.out
    rows = json.loads((folder / "tables.json").read_text())["families"]["Bandit2D"]
    assert [(row["method"], row["seeds"]) for row in rows] == [("local", [0, 1]), ("fedavg", [0]), ("fedavg (slow)", [0, 1])]
    assert "\\toprule" in (folder / "tables.tex").read_text()
    assert (folder / "tables.csv").read_text().startswith("results,method")
    drawn = {"curves": "curves-average-rounds.png", "bars": "bars.png", "clients": "clients-Mine.png",
             "aggregate": "aggregate.png", "speedup": "speedup.png"}  # fmt: skip
    for figure in figures:
        assert figure not in drawn or (folder / drawn[figure]).stat().st_size > 1000


@pytest.mark.parametrize("flags", [[], ["--table-only"]], ids=["all there", "table only"])
def test_results_are_read_once_for_tables_and_figures(flags, tmp_path, monkeypatch):
    monkeypatch.setattr(plot, "FIGURES", ("bars",))
    monkeypatch.setattr(layout, "DPI", 20)
    monkeypatch.setattr(layout, "FORMATS", ("png",))
    for seed in (0, 1):
        done(tmp_path / "results", "local", seed, 1.0)
    read = []
    monkeypatch.setattr(results, "read_result", lambda path: read.append(path.name) or read_result(path))
    assert main(["--study", write(tmp_path, methods={"local": None}, eval_average=True), *flags]) == 0
    before = 0 if flags else 2  # each is held against the settings that are asked for
    assert len(read) == before + 2
    assert (tmp_path / "results" / "studies" / "mine" / "bars.png").is_file()


def test_a_study_with_averages_ends_with_figures_of_its_runs_logs(tmp_path, monkeypatch, capfd):
    """The runs are real, but done in this process."""
    monkeypatch.setattr(plot, "FIGURES", ())
    monkeypatch.setattr(layout, "DPI", 20)
    monkeypatch.setattr(layout, "FORMATS", ("png",))

    def run_here(runs, n_processes, signals, report, say):
        for run in runs:
            assert train(run.flags) == 0
            report(run, Outcome(benchmark_runs._content(run)))

    monkeypatch.setattr(benchmark_runs, "run_here", run_here)
    small = {"rollout_size": 16, "batch_size": 16, "n_epochs": 1, "n_envs_per_client": 2, "bc_weight": 0.0}
    path = write(tmp_path, methods={"local": None}, params=small, seeds=[0], rounds=1, eval_average=True)
    assert main(["--study", path]) == 0
    assert (tmp_path / "results" / "studies" / "mine" / "theorem3.png").is_file()
    assert "it has no V_phi" in capfd.readouterr().err  # why there is no lemma2


def test_a_dry_run_lists_and_writes_nothing(tmp_path, capfd):
    path = write(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert main(["--study", path, "--dry-run"]) == 0
    captured = capfd.readouterr()
    assert "fedavg (slow)" in captured.out and "offline stage, once" in captured.out and captured.err == ""
    assert sorted(tmp_path.rglob("*")) == before
    assert main(["--envs", "Bandit2D", "--algos", "local", "--dry-run", "-f", str(tmp_path / "none")]) == 0
    assert "missing" in capfd.readouterr().out and sorted(tmp_path.rglob("*")) == before


def test_the_offline_stage_counts_once_for_a_seed_and_setting(tmp_path):
    plan = plan_of(write(tmp_path, methods={"local": None, "fedavg": None, "fedguide": None, "fedguide-p": None}))
    costs = costs_of(plan, 5, 3)
    cloning = [key for _, key in offline_seconds(plan, costs) if json.loads(key)[0] == "bc"]
    value = [key for _, key in offline_seconds(plan, costs) if json.loads(key)[0] == "dice"]
    assert len(cloning) == 2 and len(value) == 2  # a seed each, whatever the number of methods
    once = sum(offline_seconds(plan, costs).values())
    assert total_hours(plan, 5, 3) == pytest.approx((once + sum(cost.rounds + cost.evaluation for cost in costs)) / 3600)
    assert cost_rows(plan, costs)[-1]["missing"] == "8"


def test_an_estimate_is_near_what_was_measured():
    """HopperHard with four environments per client: 2.65 s a round on a quiet core (docs/performance.md), 254 s offline."""
    family = fed_envs.load_family("HopperHard")
    cost = {algo: estimate(algo, resolve(algo, family).values, family, 0, 5, 10) for algo in ("local", "fedavg", "fedguide")}
    assert cost["local"].rounds / 100 == pytest.approx(2.65, rel=0.05)
    assert cost["fedavg"].rounds > 1.15 * cost["local"].rounds  # eight epochs, not four
    assert sum(cost["fedguide"].offline.values()) == pytest.approx(254, rel=0.05)
    assert set(cost["local"].offline) < set(cost["fedguide"].offline)
    paper = resolve("fedguide", family, "paper").values
    assert sum(estimate("fedguide", paper, family, 0, 5, 10).offline.values()) > 3600


@pytest.mark.parametrize(
    ("algo", "settings", "average", "number"),
    [
        ("local", {}, False, 4), ("local", {}, True, 8), ("fedavg", {}, False, 7), ("fedavg", {}, True, 7),
        ("fedavg", {"average": "critic"}, False, 4), ("fedavg", {"average_until": 10}, False, 5),
        ("fedguide-a", {"average_every": 20}, False, 5), ("fedguide-a", {"average_every": 20}, True, 8),
    ],
)  # fmt: skip
def test_every_evaluation_is_in_the_estimate(algo, settings, average, number, monkeypatch):
    """Deployed policies in rounds 10, 20, 24 and 25; what the server sends in 10, 20 and the last."""
    monkeypatch.setattr(evaluation, "LAST_ROUNDS", 2)
    family = fed_envs.load_family("Bandit2D")
    values = resolve(algo, family, overrides={"n_rounds": 25, **settings}).values
    one = 3 * family.n_clients * 40 / 1e6  # episodes of one step
    assert estimate(algo, values, family, 0, 10, 3, average).evaluation / one == pytest.approx(number)


def test_the_evaluations_that_a_study_asks_for_are_in_its_hours(tmp_path):
    without, with_averages = [plan_of(write(tmp_path, eval_average=average)) for average in (False, True)]
    assert total_hours(without, 5, 3) < total_hours(without, 5, 30)
    assert total_hours(without, 5, 3) < total_hours(with_averages, 5, 3)


def test_the_offline_stage_of_a_bandit_has_a_thousand_rows_and_no_trunk():
    family = fed_envs.load_family("Bandit2D")

    def offline(**settings):
        overrides = {f"pretraining.{name}": value for name, value in settings.items()}
        found = estimate("fedguide", resolve("fedguide", family, overrides=overrides).values, family, 0, 5, 10).offline
        return {json.loads(key)[0]: seconds for key, seconds in found.items()}

    assert offline() == offline(dataset_size=1000) == offline(prior="gaussian") != offline(dataset_size=2000)
    assert offline(prior="diffusion").keys() - offline().keys() == {"prior"}


WRONG = {
    "metods: {local: }": "unknown key in the study: 'metods'. Did you mean 'methods'?",
    "methods: {}": "a study has at least methods and families",
    "methods: {fedgiude: }\nfamilies: [Bandit2D]": "unknown algorithm 'fedgiude'. Did you mean 'fedguide'?",
    "methods: {fedavg (old): }\nfamilies: [Bandit2D]": "has no algorithm; give it algo: fedavg",
    "methods: {local: {parms: {}}}\nfamilies: [Bandit2D]": "unknown key in method 'local': 'parms'. Did you mean 'params'?",
    "methods: {local: }\nfamilies: [Bandit3D]": "unknown environment 'Bandit3D'. Did you mean 'Bandit2D'?",
    "methods: {local: }": "families is missing",
    "methods: {local: }\nfamilies: [Bandit2D]\nseeds: [0, -1]": "the study.seeds",
    "methods: {local: }\nfamilies: [Bandit2D]\nseeds: []": "the study.seeds: list should have at least 1 item",
    "methods: {local: {seeds: []}}\nfamilies: [Bandit2D]": "method 'local'.seeds: list should have at least 1 item",
    "methods: {local: {families: []}}\nfamilies: [Bandit2D]": "method 'local'.families: list should have at least 1 item",
    "methods: {local: {seeds: [1, 1]}}\nfamilies: [Bandit2D]": "seeds of method 'local' names 1 twice",
    "methods: {local: }\nfamilies: [Bandit2D]\nrounds: 0": "the study.rounds",
    "methods: {local: }\nfamilies: [Bandit2D]\nbaseline: locl": "Did you mean 'local'?",
    "methods: {local: }\nfamilies: [Bandit2D]\noverview: [G]": "unknown column in overview: 'G'",
    "methods: {local: {families: [HopperHard]}}\nfamilies: [Bandit2D]": "unknown family of method 'local': 'HopperHard'",
    "methods: {local: {params: {n_epoch: 1}}}\nfamilies: [Bandit2D]": "method 'local': unknown hyperparameter 'n_epoch'",
    "methods: {local: {conf: papr}}\nfamilies: [Bandit2D]": "Did you mean 'paper'?",
    "methods: {'': }\nfamilies: [Bandit2D]": "a method has the name ''; give",
    "methods: {local: , '  ': {algo: fedavg}}\nfamilies: [Bandit2D]": "a method has the name '  '; give",
    "methods: {local: {params: {learning_rate: 2020-01-01}}}\nfamilies: [Bandit2D]": "'local': params.learning_rate must",
    "methods: {local: }\nfamilies: [Bandit2D]\nparams: {policy_kwargs: {net_arch: !!set {8}}}": "kwargs.net_arch must",
    "methods: {local: {delays: asink}}\nfamilies: [Bandit2D]": "--delays asink",
    "methods: {local: , mine: {algo: local}}\nfamilies: [Bandit2D]": "'local' and 'mine' are both local with the label",
    "methods: {local: , local: }": "the key 'local' is given twice",
    "[1, 2]": "a study has at least",
}  # fmt: skip


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_file_is_one_message_and_nothing_on_disk(text, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yml").write_text(text)
    assert main(["--study", "mine.yml"]) == 2
    captured = capfd.readouterr()
    assert WRONG[text] in captured.err and "mine.yml" in captured.err and captured.out == "", captured.err
    assert len(captured.err.splitlines()) == 1 and [path.name for path in tmp_path.iterdir()] == ["mine.yml"]


FLAGS = {
    "-params n_epochs:1": "the study's file sets -params",
    "--label x": "the study's file sets --label",
    "--envs HopperHard": "unknown family of the study: 'HopperHard'",
    "--algos fedkl": "unknown method of the study: 'fedkl'",
    "--seeds 7": "--seeds leaves no run of the study; give",
    "--algos fedavg --seeds 1": "--algos with --seeds leaves no run of the study; give",
    "--algos local --envs Reacher": "--algos with --envs leaves no run of the study; give",
    "--algos local --envs Reacher --table-only": "--algos with --envs leaves no run of the study; give",
    "--table-only": "has no results of Bandit2D",
    "--table-only --dry-run": "contradict each other",
}


@pytest.mark.parametrize("line", FLAGS)
def test_flags_that_contradict_a_study_are_refused(line, tmp_path, capfd):
    methods = {"local": {"families": ["Bandit2D"]}, "fedavg": {"seeds": [0]}}
    path = write(tmp_path, methods=methods, families=["Bandit2D", "Reacher"])
    try:
        code = main(["--study", path, *line.split()])
    except SystemExit as exit:
        code = exit.code
    assert code == 2 and FLAGS[line] in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == [tmp_path / "mine.yml"]


def test_latex_says_the_same_as_the_other_tables(tmp_path):
    measures = [
        replace(measure([read_result(result(tmp_path, level=level))]), method=name)
        for name, level in (("fedavg (a_b) & more", -1.0), ("local", 2.0))
    ]
    rows = rows_of(measures)
    lines = latex(Tables({"Bandit2D": measures}, (), ("100 %",))).splitlines()
    assert lines[0] == "% needs \\usepackage{booktabs}" and lines[-1] == "% 100 %"
    inside = lines[lines.index("\\midrule") + 1 : lines.index("\\bottomrule")]
    assert inside[0].startswith("fedavg (a\\_b) \\& more & 1 & $-$3 & ") and inside[0].endswith(" \\\\")
    assert inside[1].removesuffix(" \\\\").split(" & ") == list(rows[1].values())
    assert f"{{l{'r' * (len(rows[0]) - 1)}}}" in lines[lines.index("\\toprule") - 1]


def test_the_settings_of_one_method_are_drawn_differently():
    looks = [style("fedguide-r", variant) for variant in range(8)]
    assert len({(look.color, str(look.line), look.marker) for look in looks}) == len(looks)


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_committed_studies_can_be_read(path):
    study = read_study(path)
    assert study.title and set(study.families) <= set(fed_envs.FAMILIES)
    assert all(Path(file).is_file() for file in study.metadata)


@pytest.mark.slow
@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_committed_studies_are_sound_and_fit_the_committed_results(path):
    plan = plan_of(str(path))
    assert plan.runs or plan.done
