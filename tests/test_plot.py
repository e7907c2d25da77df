"""``fedguide plot``: the command, from results and run folders to files."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import fed_envs
from sb3_fedguide.benchmark.figures import layout
from sb3_fedguide.benchmark.figures.bars import draw_bars
from sb3_fedguide.cli.main import main
from sb3_fedguide.cli.plot_runs import read_evaluations, read_run_folder
from tests.result_files import CLIENTS, result, two_families, write_result

ROOT = Path(__file__).parents[1]
FORMATS = layout.FORMATS
pytestmark = pytest.mark.usefixtures("coarse_figures")


def is_picture(path: Path) -> bool:
    start = b"\x89PNG\r\n" if path.suffix == ".png" else b"%PDF-"
    return path.read_bytes().startswith(start) and path.stat().st_size > 5000


def test_the_command_writes_every_figure_that_the_data_allow(tmp_path, capfd):
    mine = two_families(tmp_path)
    out = tmp_path / "new" / "figures"
    flags = ["plot", "-f", str(tmp_path), "--envs", "Bandit2D", "--metadata", str(mine), "-o", str(out)]
    assert main(flags) == 0
    names = {"curves-average-rounds", "bars", "cv", "clients-Bandit2D", "clients-Mine", "aggregate", "speedup"}
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
    assert {path.stem for path in (tmp_path / "out").iterdir()} == {"curves-average-rounds", "bars", "cv", "clients-Bandit2D"}


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
    assert f"{folders[1]} is not finished, and is drawn only in learning curves" in capfd.readouterr().err
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
    "--envs Bandit2D --figures rollouts": "rollouts is drawn from folders of runs, e.g. logs/*/HopperHard_1",
    "{run} --figures plan": "plan: no plan.csv in {run}: the method has no transport plan, or the run is",
    "{run} --figures bars --clients 1": "--clients is for rollouts; add rollouts to --figures",
    "{run} --figures rollouts": "is not the folder of a trained run: it has no config.yml",
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
