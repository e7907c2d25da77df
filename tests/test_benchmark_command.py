"""``fedguide benchmark``: runs that survive failures and interruptions, and tables whose every figure is checked."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import fed_envs
from sb3_fedguide.cli import benchmark_runs
from sb3_fedguide.cli.benchmark import differences, main, make_plan
from sb3_fedguide.cli.benchmark_arguments import parse_benchmark
from sb3_fedguide.cli.run_folder import exclusive
from sb3_fedguide.cli.train import main as train
from tests.result_files import summary, write_result

ROOT = Path(__file__).parents[1]
#: Stands for the training command: begins a run's folder, then does what the environment says about its seed.
TRAINING = """
import json, os, signal, sys, time
from pathlib import Path
flags = sys.argv[1:]
resumed = "--resume" in flags
value = lambda flag: flags[flags.index(flag) + 1]
folder = Path(value("--resume")) if resumed else Path(value("-f")) / value("--algo") / "Bandit2D_1"
seed = int(folder.parents[1].name.rpartition("seed")[2])
folder.mkdir(parents=True, exist_ok=True)
for name, text in {"config.yml": "n_rounds: 3", "versions.json": "{}", "metadata.sha256": HASH, "metadata.json": "{}"}.items():
    (folder / name).write_text(text)
with open("starts.txt", "a") as file:
    print(folder.parents[1].name, "resumed" if resumed else "new", os.environ["OMP_NUM_THREADS"], file=file, flush=True)
behaviour = {} if resumed else json.loads(os.environ.get("BEHAVIOUR", "{}"))
if behaviour.get(str(seed)) == "fail":
    sys.exit("the disk of client 3 is on fire")
if behaviour.get(str(seed)) == "die":
    os.kill(os.getpid(), signal.SIGKILL)
if behaviour.get(str(seed)) in ("wait", "hang"):
    code = signal.SIG_IGN if behaviour[str(seed)] == "hang" else lambda *_: sys.exit(143)
    signal.signal(signal.SIGTERM, code)
    (folder / "waiting").touch()
    time.sleep(60)
summary = json.loads(SUMMARY)
summary.update(algo=folder.parent.name, seed=seed)
summary["deployed"]["average"] = 10.0 + seed
(folder / "summary.json").write_text(json.dumps(summary))
"""


@pytest.fixture
def quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """The command with the training command replaced, in ``tmp_path``; keywords say what the runs of seeds do."""
    script = tmp_path.parent / f"{tmp_path.name}-training.py"
    constants = f"HASH, SUMMARY = {fed_envs.load_family('Bandit2D').content_hash!r}, {json.dumps(summary())!r}\n"
    script.write_text(constants + TRAINING)
    monkeypatch.setattr(benchmark_runs, "TRAIN", (sys.executable, str(script)))
    monkeypatch.setattr(benchmark_runs, "POLL", 0.01)
    monkeypatch.chdir(tmp_path)

    def run(*flags: str, **behaviour: str) -> int:
        monkeypatch.setenv("BEHAVIOUR", json.dumps({name.removeprefix("seed"): value for name, value in behaviour.items()}))
        return main(["--envs", "Bandit2D", "--rounds", "3", "--eval-episodes", "3", "-f", "results", *flags])

    return run


def starts(folder: Path) -> list[str]:
    path = folder / "starts.txt"
    lines = path.read_text().splitlines() if path.exists() else []
    path.unlink(missing_ok=True)
    return sorted(lines)


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_every_run_gets_its_result_file_and_is_not_repeated(quick, tmp_path, capfd):
    assert quick("--algos", "local", "fedavg", "--seeds", "0", "1", "--processes", "3") == 0
    names = [f"{method}-seed{seed}" for method in ("fedavg", "local") for seed in (0, 1)]
    assert starts(tmp_path) == [f"{name} new 1" for name in names]
    assert files(tmp_path / "results") == [f"Bandit2D-tuned/{name}.json" for name in names]
    assert not (tmp_path / "results" / "Bandit2D-tuned" / "runs").exists()
    result = json.loads((tmp_path / "results/Bandit2D-tuned/fedavg-seed1.json").read_text())
    assert result == {**summary(algo="fedavg", seed=1, average=11.0), "config": {"n_rounds": 3}, "versions": {}}
    captured = capfd.readouterr()
    assert "[4 of 4]" in captured.err and "10.5 ± 0.5" in captured.out
    assert quick("--algos", "local", "fedavg", "--seeds", "0", "1", "2", "--keep-runs", "--markdown") == 0
    assert starts(tmp_path) == ["fedavg-seed2 new 1", "local-seed2 new 1"]
    captured = capfd.readouterr()
    assert "2 runs to do, 0 of them begun before; 4 have their result" in captured.err
    assert "| local | 3 | 11 ± 0.816 |" in captured.out
    assert (tmp_path / "results/Bandit2D-tuned/runs/local-seed2/local/Bandit2D_1/summary.json").exists()
    assert quick("--algos", "local", "fedavg", "--seeds", "0", "1", "2") == 0 and starts(tmp_path) == []


def test_a_run_that_fails_or_is_killed_is_reported_and_does_not_stop_the_others(quick, tmp_path, capfd):
    assert quick("--algos", "local", "--seeds", "0", "1", "2", "3", seed0="fail", seed1="die") == 1
    captured = capfd.readouterr()
    assert "local on Bandit2D, seed 0 failed: it ended with exit code 1:\n  the disk of client 3 is on fire" in captured.err
    assert "local on Bandit2D, seed 1 failed: its process was killed (SIGKILL)" in captured.err
    assert "2 of 4 runs failed: local on Bandit2D, seed 0; local on Bandit2D, seed 1." in captured.err
    assert "12.5 ± 0.5" in captured.out  # what there is
    results = sorted(path.name for path in (tmp_path / "results/Bandit2D-tuned").glob("*.json"))
    assert results == ["local-seed2.json", "local-seed3.json"] and len(starts(tmp_path)) == 4
    assert quick("--algos", "local", "--seeds", "0", "1", "2", "3") == 0
    assert starts(tmp_path) == ["local-seed0 resumed 1", "local-seed1 resumed 1"]
    assert "2 runs to do, 2 of them begun before" in capfd.readouterr().err


@pytest.fixture
def signals() -> Iterator[Callable[[Path, str, int], None]]:
    """Send this process SIGINT once there are ``n`` files like ``pattern``."""

    def send(folder: Path, pattern: str, n: int, times: int = 1) -> None:
        def watch() -> None:
            while len(list(folder.glob(pattern))) < n:
                time.sleep(0.01)
            for _ in range(times):
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(0.3)

        threading.Thread(target=watch, daemon=True).start()

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job of a shell ignores it
    yield send
    signal.signal(signal.SIGINT, handler)


WAITING = "results/Bandit2D-tuned/runs/*/*/*/waiting"


def test_an_interrupt_lets_runs_end_and_keeps_what_is_finished(quick, signals, tmp_path, capfd):
    signals(tmp_path, WAITING, 2)
    behaviour = {"seed1": "wait", "seed2": "wait"}
    assert quick("--algos", "local", "--seeds", "0", "1", "2", "3", "--processes", "2", **behaviour) == 130
    assert [line.split()[0] for line in starts(tmp_path)] == ["local-seed0", "local-seed1", "local-seed2"]
    captured = capfd.readouterr()
    assert "interrupted; 3 runs are not finished; the same command resumes them" in captured.err
    assert "failed" not in captured.err and "local" in captured.out
    assert quick("--algos", "local", "--seeds", "0", "1", "2", "3") == 0
    assert starts(tmp_path) == ["local-seed1 resumed 1", "local-seed2 resumed 1", "local-seed3 new 1"]


def test_a_second_interrupt_kills_what_does_not_end(quick, signals, tmp_path):
    signals(tmp_path, WAITING, 1, times=2)
    began = time.monotonic()
    assert quick("--algos", "local", "--seeds", "0", seed0="hang") == 130
    assert time.monotonic() - began < 20  # it would sleep for a minute
    with exclusive(tmp_path / "results/Bandit2D-tuned/runs/local-seed0"):
        pass
    found = subprocess.run(["ps", "-ax", "-o", "args"], capture_output=True, text=True, check=True).stdout
    assert f"{tmp_path.name}-training.py" not in found


def test_a_run_that_another_process_is_doing_is_left_to_it(quick, tmp_path, capfd):
    folder = tmp_path / "results/Bandit2D-tuned/runs/local-seed0"
    folder.mkdir(parents=True)
    with exclusive(folder):
        assert quick("--algos", "local", "--seeds", "0", "1") == 1
    assert "still going on in another process" in capfd.readouterr().err
    assert starts(tmp_path) == ["local-seed1 new 1"]


def test_results_and_begun_runs_of_other_settings_are_refused(quick, tmp_path, capfd):
    assert quick("--algos", "local", "--seeds", "0", "1", seed1="die") == 1
    before, started = files(tmp_path), starts(tmp_path)
    capfd.readouterr()
    for flags, message in {
        ("--rounds", "4"): "local-seed0.json is of a run with other settings: n_rounds 3, not 4; give another --label",
        ("--eval-episodes", "4"): "--eval-episodes 3, not 4",
        (
            "--rounds",
            "4",
            "--seeds",
            "1",
        ): "local-seed1/local/Bandit2D_1 is of a run with other settings: n_rounds 3, not 4",
    }.items():
        assert quick("--algos", "local", "--seeds", "0", "1", *flags) == 2
        assert message in capfd.readouterr().err
    assert started and starts(tmp_path) == [] and set(files(tmp_path)) == set(before) - {"starts.txt"}


def test_differences_are_of_what_both_know():
    before = {"a": 1, "net": {"arch": [8, 8], "old": 1}, "gone": 2}
    assert differences(before, {"a": 1.0, "net": {"arch": (8, 8), "new": 3}, "added": 0}) == []
    assert differences(before, {"a": 2, "net": {"arch": [8]}}) == ["a 1, not 2", "net.arch [8, 8], not [8]"]


def test_a_killed_run_goes_on_from_its_checkpoint_with_the_same_result(tmp_path, monkeypatch, capfd):
    """The training command itself: killed, gone on with, and equal to a run that nobody killed."""
    monkeypatch.setenv("FEDGUIDE_CACHE", str(tmp_path / "cache"))
    settings = [
        "--rounds", "12", "--eval-episodes", "2", "--save-freq", "3", "-params", "bc_weight:0", "n_epochs:1",
        "policy_kwargs.net_arch:[8]",
    ]  # fmt: skip
    argv = ["--algos", "local", "--envs", "Bandit2D", "--seeds", "5", *settings, "-f", str(tmp_path / "results")]
    (run,) = make_plan(parse_benchmark(argv, "fedguide benchmark"), "fedguide benchmark").runs
    process = benchmark_runs.RunProcess(run)
    process.start()
    while not list(run.log_folder.glob("local/Bandit2D_1/checkpoints/round_*.npz")):
        assert process.is_running(), (run.log_folder / "output.txt").read_text()
        time.sleep(0.01)
    process.kill()
    assert process.outcome().interrupted and not run.result.exists()
    assert main([*argv, "--json", str(tmp_path / "table.json")]) == 0
    assert "1 runs to do, 1 of them begun before" in capfd.readouterr().err
    flags = ["--algo", "local", "--env", "Bandit2D", "--seed", "5", *settings, "--verbose", "0", "-f", str(tmp_path / "whole")]
    assert train(flags) == 0
    whole = json.loads((tmp_path / "whole/local/Bandit2D_1/summary.json").read_text())
    result = json.loads(run.result.read_text())
    assert result["deployed"] == whole["deployed"] and result["config"]["policy_kwargs"]["net_arch"] == [8]
    (row,) = json.loads((tmp_path / "table.json").read_text())["families"]["Bandit2D-tuned"]
    assert row["F"] == whole["deployed"]["average"] and row["seeds"] == [5]
    assert not run.log_folder.exists()


WRONG = {
    "": "--envs FAMILY",
    "--envs HoperHard": "Did you mean 'HopperHard'",
    "--envs Bandit2D --algos fedgiude": "Did you mean 'fedguide'",
    "--envs Bandit2D --baseline locl": "Did you mean 'local'",
    "--envs Bandit2D Bandit2D": "--envs names Bandit2D twice",
    "--envs Bandit2D --algos local local": "--algos names local twice",
    "--envs Bandit2D --seeds 1 1": "--seeds names 1 twice",
    "--envs Bandit2D --seeds -1": "must not be negative",
    "--envs Bandit2D --seeds 99999999999": "below 2^31",
    "--envs Bandit2D --seed 1": "Did you mean '--seeds'",
    "--envs Bandit2D --processes 0": "--processes must be at least 1",
    "--envs Bandit2D --rounds 0": "--rounds must be at least 1",
    "--envs Bandit2D --at-rounds 0": "--at-rounds counts from 1",
    "--envs Bandit2D --label ../x": "part of a folder's name",
    "--envs Bandit2D --engine rya": "invalid choice",
    "--envs Bandit2D --address 1.2.3.4:5": "give --engine ray as well",
    "--envs Bandit2D --json nowhere/x.json": "there is no folder nowhere",
    "--envs Bandit2D -conf papr": "Did you mean 'paper'",
    "--envs Bandit2D --algos local fedavg -params n_epoch:4": "Did you mean 'n_epochs'",
    "--envs Bandit2D --algos local -params batch_size:201": "between 2 and rollout_size=200",
    "--envs Bandit2D --algos fedguide local -params lambda_prior:1": "unknown hyperparameter 'lambda_prior' of local",
    "--envs Bandit2D --table-only": "has no results of Bandit2D",
    "--metadata nowhere.json": "there is no file nowhere.json",
}  # fmt: skip


@pytest.mark.parametrize("line", WRONG)
def test_wrong_input_is_one_message_exit_code_2_and_nothing_on_disk(line, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FEDGUIDE_CACHE", str(tmp_path / "cache"))
    try:
        code = main(shlex.split(line))
    except SystemExit as exit:  # argparse
        code = exit.code
    captured = capfd.readouterr()
    assert code == 2 and WRONG[line] in captured.err and captured.out == ""
    assert captured.err.startswith("fedguide benchmark: error: ") and len(captured.err.splitlines()) == 1
    assert list(tmp_path.rglob("*")) == []


@pytest.mark.parametrize("line", ["--help", "--envs Bandit3D", "--envs Bandit2D --algos nothing"])
def test_neither_help_nor_a_mistyped_name_waits_for_pytorch(line):
    script = (
        "import sys\nfrom sb3_fedguide.cli.benchmark import main\n"
        f"try: code = main({line.split()!r})\nexcept SystemExit as exit: code = exit.code\n"
        "heavy = {'torch', 'stable_baselines3', 'mujoco', 'ray', 'matplotlib', 'scipy'} & set(sys.modules)\n"
        "print('HEAVY', sorted(heavy), code)"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert f"HEAVY [] {0 if line == '--help' else 2}" in result.stdout


def test_damaged_results_are_named(tmp_path, capfd):
    path = write_result(tmp_path)
    for text, reason in {
        "{": "Expecting", "[]": "list indices", '{"algo": "local"}': "is missing", json.dumps(summary(seed=1)): "with seed 1",
        json.dumps(summary(finished=False)): "it ended after 3 of 3", json.dumps(summary(curve=3)): "not iterable",
    }.items():  # fmt: skip
        path.write_text(text)
        assert main(["--envs", "Bandit2D", "--table-only", "-f", str(tmp_path)]) == 2
        message = capfd.readouterr().err
        assert "local-seed0.json" in message and reason in message and "delete it" in message, message
    write_result(tmp_path)
    write_result(tmp_path, seed=1, n_rounds=4)
    assert main(["--envs", "Bandit2D", "--table-only", "-f", str(tmp_path)]) == 2
    assert "cannot stand in one table: their rounds differ (4 and 3)" in capfd.readouterr().err


def test_ray_that_is_not_installed_is_named(tmp_path, monkeypatch, capfd):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main(["--algos", "local", "--envs", "Bandit2D", "--engine", "ray", "-f", str(tmp_path / "results")]) == 2
    assert "pip install 'sb3-fedguide[ray]'" in capfd.readouterr().err
    assert not (tmp_path / "results").exists()
