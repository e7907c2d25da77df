"""The training command: what it refuses, what it writes, and that what is asked for reaches the run."""

from __future__ import annotations

import csv
import json
import os
import re
import runpy
import shlex
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml

import fed_envs
from sb3_fedguide import FedGuide, Local
from sb3_fedguide.cli import recorder
from sb3_fedguide.cli.arguments import parse_train
from sb3_fedguide.cli.main import main as fedguide
from sb3_fedguide.cli.request import find_family, resolve_request
from sb3_fedguide.cli.train import main, prepare
from sb3_fedguide.common.evaluation import evaluate_federation, evaluation_env

ROOT = Path(__file__).parents[1]
QUICK = ["--env", "Bandit2D", "--rounds", "2", "--verbose", "0", "--eval-episodes", "3"]
NO_OFFLINE = ["-params", "bc_weight:0"]
TINY_OFFLINE = ["-params", "pretraining.bc_updates:2", "pretraining.dice_updates:2", "pretraining.dataset_size:50"]


def prepared(*argv: str):
    arguments = parse_train(argv, "train.py")
    return prepare(resolve_request(arguments, find_family(arguments)), "")


def test_nothing_is_read_or_parsed_twice(monkeypatch, tmp_path):
    """By way of Python's calls: whoever imported a function by name is seen too."""
    watched, calls = ("read_yaml", "parse_params", "parse_delays", "complete"), Counter()
    (tmp_path / "mine.yml").write_text("default: {n_rounds: 2, bc_weight: 0, rollout_size: 40, batch_size: 20}")

    def profile(frame, event, _):
        if event == "call" and frame.f_code.co_name in watched and "sb3_fedguide" in frame.f_code.co_filename:
            calls[frame.f_code.co_name] += 1

    sys.setprofile(profile)
    try:
        run = prepared("--algo", "fedavg", "--env", "Bandit2D", "-conf", str(tmp_path / "mine.yml"), "-params",
                       "mix:0.5", "--delays", "async:median=60")  # fmt: skip
    finally:
        sys.setprofile(None)
    assert calls == dict.fromkeys(watched, 1)
    assert run.model.mix == 0.5 and run.model.delays.settings.median == 60 and "median=60.0" in run.arguments.delays


WRONG = {
    "--algo fedgiude --env Bandit2D": "Did you mean 'fedguide'",
    "--algo FedGuide --env Bandit2D": "Did you mean 'fedguide'",
    "--env HoperHard": "Did you mean 'HopperHard'",
    "--env fed_envs/HoperHard-v0": "Did you mean 'HopperHard'",
    "--env CartPole-v1": "CartPole-v1 is one environment, and a federation has several clients",
    "": "--env FAMILY",
    "--env Bandit2D --rouns 3": "Did you mean '--rounds'",
    "--env Bandit2D extra": "unknown argument 'extra'",
    "--env Bandit2D --rounds x": "invalid int value",
    "--env Bandit2D --rounds 0": "--rounds must be at least 1",
    "--env Bandit2D -n -5": "--n-timesteps must be at least 1",
    "--env Bandit2D -n 100 --rounds 3": "give one of them",
    "--env Bandit2D --rounds 3 -params n_rounds:4": "give one of them",
    "--env Bandit2D -n 100 -params n_rounds:4": "give one of them",
    "--env Bandit2D --n-envs-per-client 4 -params n_envs_per_client:8": "give one of them",
    "--env Bandit2D --n-envs-per-client 7": "must divide rollout_size=200",
    "--env Bandit2D --eval-freq 0": "--eval-freq must be at least 1",
    "--env Bandit2D --eval-episodes 0": "--eval-episodes must be at least 1",
    "--env Bandit2D --num-threads 0": "--num-threads must be at least 1",
    "--env Bandit2D --verbose 9": "invalid choice",
    "--env Bandit2D --seed 1.5": "invalid int value",
    "--env Bandit2D --seed 99999999999": "below 2^31",
    "--env Bandit2D --device gpu": "unknown device 'gpu'",
    "--env Bandit2D --device meta": "not available on this machine",
    "--env Bandit2D -conf papr": "Did you mean 'paper'",
    "--env Bandit2D -conf nowhere/mine.yml": "no configuration 'nowhere/mine.yml'",
    "--env Bandit2D -params": "expected at least one argument",
    "--env Bandit2D -params n_epochs": "takes key:value pairs",
    "--env Bandit2D -params n_epochs:": "takes key:value pairs",
    "--env Bandit2D -params n_epochs:1 n_epochs:2": "gives 'n_epochs' twice",
    "--env Bandit2D -params n_epoch:4": "Did you mean 'n_epochs'",
    "--env Bandit2D -params n_epochs:four": "n_epochs must be an integer",
    "--env Bandit2D -params batch_size:201": "between 2 and rollout_size=200",
    "--env Bandit2D -params gamma:2": "gamma=2 must be between 0 and 1",
    "--env Bandit2D -params lambda_trust:-1": "lambda_trust=-1 must be at least 0",
    "--env Bandit2D -params pretraining.dice_f:kl2": "'soft_chi', 'kl' or 'chi2'",
    "--env Bandit2D --metadata nowhere.json": "there is no file nowhere.json",
    "--env Bandit2D --dataset nowhere/here-v0": "no Minari dataset 'nowhere/here-v0'",
    "--env Bandit2D --dataset {client}/here-v0": "no Minari dataset '0/here-v0'",
}  # fmt: skip


@pytest.mark.parametrize("line", WRONG)
def test_wrong_input_is_one_message_exit_code_2_and_nothing_on_disk(line, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FEDGUIDE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    try:
        code = main(shlex.split(line))
    except SystemExit as exit:  # argparse
        code = exit.code
    captured = capfd.readouterr()
    assert code == 2
    assert WRONG[line] in captured.err
    assert captured.err.startswith("train.py: error: ") and len(captured.err.splitlines()) == 1
    assert captured.out == ""
    assert [path for path in tmp_path.rglob("*") if path.name != "minari"] == []


def test_wrong_metadata_is_refused_before_anything_is_written(tmp_path, capsys):
    content = fed_envs.load_family("Hopper").to_dict()
    content["clients"][3]["mass_scale"] = -1.0
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(content))
    assert main(["--metadata", str(path), "-f", str(tmp_path / "logs")]) == 2
    message = capsys.readouterr().err
    assert "mine.json" in message and "client 3" in message and "mass_scale" in message
    assert not (tmp_path / "logs").exists()
    fed_envs.load_family("Hopper").dump(path)
    assert main(["--metadata", str(path), "--env", "Reacher"]) == 2
    assert "do not belong together" in capsys.readouterr().err


def test_a_log_folder_that_cannot_be_is_refused(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    for flag in ("-f", "-tb"):
        assert main(["--env", "Bandit2D", flag, str(tmp_path / "file" / "logs")]) == 2
        assert "is a file" in capsys.readouterr().err


def test_other_commands(capsys):
    assert fedguide(["trian"]) == 2 and "Did you mean 'train'" in capsys.readouterr().err
    assert fedguide([]) == 2
    assert fedguide(["--help"]) == 0 and "train" in capsys.readouterr().out
    assert fedguide(["train", "--env", "Bandit2"]) == 2
    assert capsys.readouterr().err.startswith("fedguide train: error: unknown environment")


@pytest.mark.parametrize(
    "arguments", ["--help", "--env Bandit3D", "--algo nothing --env Bandit2D", "--env Bandit2D -params x"]
)
def test_neither_help_nor_a_mistyped_name_waits_for_pytorch(arguments):
    script = (
        "import sys\nfrom sb3_fedguide.cli.train import main\n"
        f"try: code = main({arguments.split()!r})\nexcept SystemExit as exit: code = exit.code\n"
        "heavy = {'torch', 'stable_baselines3', 'mujoco', 'matplotlib', 'minari', 'scipy'} & set(sys.modules)\n"
        "print('HEAVY', sorted(heavy), code)"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert f"HEAVY [] {0 if arguments == '--help' else 2}" in result.stdout


@pytest.fixture(scope="module")
def local_run(tmp_path_factory):
    """Two rounds of Local through the script itself."""
    folder = tmp_path_factory.mktemp("local")
    argv = ["train.py", "--algo", "local", *QUICK, "--seed", "5", *NO_OFFLINE, "n_epochs:2", "-f", str(folder)]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setattr(sys, "argv", argv)
        patch.setattr(sys, "orig_argv", [sys.executable, *argv])
        with pytest.raises(SystemExit) as exit:
            runpy.run_path("train.py", run_name="__main__")
    assert exit.value.code == 0
    return folder / "local" / "Bandit2D_1"


def test_a_run_folder_says_what_was_run(local_run):
    names = {path.name for path in local_run.iterdir() if not path.name.startswith("events.out.tfevents.")}
    assert names == {
        "args.yml", "checkpoints", "command.txt", "config.yml", "evaluations.csv", "metadata.json", "metadata.sha256",
        "model.zip", "parameters.npz", "summary.json", "versions.json",
    }  # fmt: skip
    config = yaml.safe_load((local_run / "config.yml").read_text())
    assert (config["n_epochs"], config["bc_weight"], config["n_rounds"], config["rollout_size"]) == (2, 0, 2, 200)
    assert config["gae_lambda"] == 0.95  # defaults are written out
    assert config["policy_kwargs"]["log_std_init"] == -1
    arguments = yaml.safe_load((local_run / "args.yml").read_text())
    assert arguments["seed"] == 5 and arguments["algo"] == "local"
    command = shlex.split((local_run / "command.txt").read_text())
    assert command[1:6] == ["train.py", "--algo", "local", "--env", "Bandit2D"] and command[0] == sys.executable
    versions = json.loads((local_run / "versions.json").read_text())
    assert versions["stable-baselines3"].startswith("2.9") and "torch" in versions and "python" in versions
    family = fed_envs.load_family(local_run / "metadata.json")
    assert family.content_hash == fed_envs.load_family("Bandit2D").content_hash
    assert (local_run / "metadata.sha256").read_text().strip() == family.content_hash
    assert len(list(local_run.glob("events.out.tfevents.*"))) == 1


def test_evaluations_and_summary_agree_with_the_saved_model(local_run):
    summary = json.loads((local_run / "summary.json").read_text())
    with (local_run / "evaluations.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["round"], row["client"]) for row in rows] == [(str(r), str(c)) for r in (1, 2) for c in range(4)]
    deployed = summary["deployed"]
    np.testing.assert_allclose(deployed["client_returns"], [float(row["mean_return"]) for row in rows[4:]], rtol=1e-5)
    assert deployed["average"] == pytest.approx(np.mean(deployed["client_returns"]))
    assert deployed["worst_client"] == min(deployed["client_returns"])
    assert [point[0] for point in deployed["curve"]] == [1, 2] and deployed["curve"][-1][1] == deployed["average"]
    assert summary["finished"] and summary["rounds_done"] == 2 and summary["timesteps"] == 2 * 4 * 200
    assert (summary["seed"], summary["algo"], summary["env"]) == (5, "local", "Bandit2D")
    assert (summary["bytes_up"], summary["bytes_down"]) == (0, 0) and "broadcast" not in summary
    model = Local.load(local_run / "model.zip", env="Bandit2D")
    again = evaluate_federation(lambda obs: model.predict(obs, deterministic=True)[0], evaluation_env(model, 3))
    np.testing.assert_allclose(again.client_returns, deployed["client_returns"], rtol=1e-6)


def test_the_same_seed_gives_the_same_run_in_the_next_folder(local_run, capsys):
    argv = ["--algo", "local", *QUICK, "--seed", "5", *NO_OFFLINE, "n_epochs:2", "-f", str(local_run.parents[1])]
    assert main(argv) == 0
    again = local_run.parent / "Bandit2D_2"
    assert (again / "evaluations.csv").read_text() == (local_run / "evaluations.csv").read_text()
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""  # --verbose 0
    assert main([*argv[:-2], "--seed", "6", "--no-eval", "-f", argv[-1]]) == 0
    third = local_run.parent / "Bandit2D_3"
    assert not (third / "evaluations.csv").exists() and "deployed" not in json.loads((third / "summary.json").read_text())


def test_fedguide_from_the_offline_stage_to_the_table(tmp_path, capsys):
    argv = ["--algo", "fedguide-a", "--env", "Bandit2D", "--rounds", "2", "-f", str(tmp_path), "-tb", str(tmp_path / "tb")]
    assert main([*argv, *TINY_OFFLINE, "average_every:1", "beta:auto", "--progress"]) == 0
    captured = capsys.readouterr()
    assert all(text in captured.out for text in ("average", "worst", "bytes", "Bandit2D_1", "client"))
    assert "2/2" in captured.err  # the bar of the rounds
    folder = tmp_path / "fedguide-a" / "Bandit2D_1"
    assert not list(folder.glob("events.*"))
    assert len(list((tmp_path / "tb" / "Bandit2D" / "fedguide-a_1").iterdir())) == 1
    documented = (ROOT / "docs" / "log_keys.md").read_text()
    for key in _tensorboard_keys(tmp_path / "tb" / "Bandit2D" / "fedguide-a_1"):
        assert f"`{re.sub(r'^client_[0-9]+/', 'client_<k>/', key)}`" in documented, key
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["bytes_up"] > 0 and summary["bytes_down"] > 0 and summary["seconds"]["pretraining"] > 0
    model = FedGuide.load(folder / "model.zip")
    assert model.beta == "auto" and model.pretraining_config.dice_updates == 2


def _tensorboard_keys(folder: Path) -> list[str]:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    keys = events.Tags()["scalars"]
    assert "federated/bytes_up" in keys and "client_3/eval_mean_reward" in keys
    return keys


def test_an_interrupted_run_keeps_what_there_is(tmp_path, monkeypatch, capsys):
    ended = recorder.CostCallback._on_round_end

    def interrupt(self):
        ended(self)
        if self.model.round == 2:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(recorder.CostCallback, "_on_round_end", interrupt)
    argv = ["--algo", "fedavg", "--env", "Bandit2D", "--rounds", "30", "--eval-freq", "1", "-f", str(tmp_path), *NO_OFFLINE]
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job of a shell ignores it
    try:
        assert main([*argv, "--verbose", "0"]) == 130
    finally:
        signal.signal(signal.SIGINT, handler)
    assert "interrupted in round" in capsys.readouterr().err
    folder = tmp_path / "fedavg" / "Bandit2D_1"
    summary = json.loads((folder / "summary.json").read_text())
    assert not summary["finished"] and summary["rounds_done"] == 2 and len(summary["deployed"]["curve"]) == 2
    assert summary["bytes_up"] > 0 and (folder / "model.zip").exists()


def test_a_users_metadata_reaches_training_and_evaluation(tmp_path):
    content = fed_envs.load_family("Hopper").to_dict()
    content["family"], content["clients"] = "MyHopper", content["clients"][:2]
    content["clients"][1].update(mass_scale=1.75, ctrl_cost_weight=0.03, reset_noise_scale=0.002)
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(content))
    run = prepared("--algo", "local", "--metadata", str(path), "--n-envs-per-client", "2", "-params", "rollout_size:128")
    reference = fed_envs.load_family("Hopper").make(0).unwrapped
    for env in (run.model.get_env(), evaluation_env(run.model, 3)):
        masses = env.get_attr("model")
        clients = env.get_attr("client")
        per_client = env.n_envs_per_client
        assert env.num_envs == 2 * per_client
        for index, (model, client) in enumerate(zip(masses, clients, strict=True)):
            entry = content["clients"][index // per_client]
            np.testing.assert_allclose(model.body_mass[1:], _unscaled(reference)[1:] * entry["mass_scale"], rtol=1e-6)
            assert client.ctrl_cost_weight == entry["ctrl_cost_weight"]
            assert client.reset_noise_scale == entry["reset_noise_scale"]


def _unscaled(env) -> np.ndarray:
    return env.model.body_mass / np.where(np.arange(env.model.nbody) == 0, 1.0, env.client.mass_scale)


def test_flags_and_params_reach_the_algorithm():
    run = prepared(
        "--algo", "fedavg", "--env", "fed_envs/Bandit2D-v0", "-n", "4000", "--n-envs-per-client", "4", "--seed", "9",
        "-params", "average_every:3", "average_until:null", "learning_rate:1e-3", "policy_kwargs.net_arch:[8]",
    )  # fmt: skip
    model = run.model
    assert (model.average_every, model.average_until, model.learning_rate, model.seed) == (3, None, 1e-3, 9)
    assert model.n_envs_per_client == 4 and model.policy.mlp_extractor.latent_dim_pi == 8
    assert run.config.n_rounds == 5 and run.family.name == "Bandit2D"


def test_a_negative_seed_is_drawn():
    seeds = {prepared("--env", "Bandit2D", "--algo", "local", "--seed", "-1").model.seed for _ in range(2)}
    assert len(seeds) == 2 and min(seeds) >= 0


def test_a_given_dataset_is_checked_against_the_clients(tmp_path, monkeypatch, capsys):
    from sb3_fedguide.offline.datasets import client_datasets, dataset_folder

    client_datasets("Bandit2D", 40, 0, tmp_path / "cache")
    folders = [dataset_folder(fed_envs.load_family("Bandit2D"), k, 40, 0, tmp_path / "cache") for k in range(4)]
    monkeypatch.chdir(tmp_path)
    for k, folder in enumerate(folders):
        (tmp_path / f"data-{k}").symlink_to(folder)
    assert main(["--env", "Reacher", "--algo", "local", "--dataset", "data-{client}"]) == 2
    assert "does not fit" in capsys.readouterr().err
    run = prepared("--env", "Bandit2D", "--algo", "local", "--dataset", "data-{client}")
    assert run.model.pretraining_config.dataset == "data-{client}"
