"""``fedguide push`` and ``fedguide pull`` against :mod:`tests.fake_hub`, with what a hostile repository may hold."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

import fed_envs
from sb3_fedguide.cli import hub, pull
from sb3_fedguide.cli.main import main
from sb3_fedguide.cli.model_card import write_card
from tests.command_lines import check_command, commands
from tests.fake_hub import COMMIT, TOKEN, FakeHub
from tests.hostile_repositories import HOSTILE, hostile, of_gymnasium

pytest.importorskip("huggingface_hub")

QUICK = ["--verbose", "0", "--picture-freq", "0", "--save-freq", "0", "--eval-episodes", "2", "-params", "rollout_size:20",
         "batch_size:10", "bc_weight:0", "n_envs_per_client:1", "policy_kwargs.net_arch:[8]"]  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose last exchange replaced its clients' policies."""
    folder = tmp_path_factory.mktemp("logs")
    train = ["train", "--algo", "fedavg", "--env", "Bandit2D", "--rounds", "2", "-f", str(folder)]
    assert main([*train, *QUICK, "mix:1.0"]) == 0
    return folder / "fedavg" / "Bandit2D_1"


@pytest.fixture
def service(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[FakeHub]:
    from huggingface_hub import constants

    server = FakeHub()
    monkeypatch.setattr(constants, "ENDPOINT", server.url)  # read from HF_ENDPOINT where the package is imported first
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", server.url + "/{repo_id}/resolve/{revision}/{filename}")
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_PROGRESS_BARS", True)
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "no token"))
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture
def shared(service: FakeHub, run: Path) -> dict[str, bytes]:
    """The files of a repository ``me/run``, which a test changes."""
    names = [*hub.NEEDED, "deployed.npz", "evaluations.csv", "metadata.sha256", "versions.json"]
    service.repositories["me/run"] = {name: (run / name).read_bytes() for name in names}
    return service.repositories["me/run"]


def refused(argv: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line with which a command ends, with exit code 2."""
    with pytest.raises(SystemExit) as stop:
        main(argv)
    error = capsys.readouterr().err
    assert stop.value.code == 2 and error.count("\n") == 1 and error.startswith(f"fedguide {argv[0]}: error: "), error
    return error


def assert_nothing_stays(folder: Path) -> None:
    assert not folder.exists() or not list(folder.iterdir())


@pytest.fixture(autouse=True)
def _coarse(coarse_figures: None) -> None:
    """Curves are drawn small here."""


def test_what_was_pushed_is_pulled_evaluated_exported_and_trained_on(service, run, tmp_path, capsys):
    assert main(["push", str(run), "me/bandit", "-m", "first"]) == 0
    assert capsys.readouterr().out == f"sent {run} to {service.url}/me/bandit\n"
    files = service.repositories["me/bandit"]
    assert files.keys() == hub.FILES.keys() and service.messages == ["first"]  # no model.zip, flags, paths, events
    assert not any(str(run.parent).encode() in content for content in files.values())
    logs = tmp_path / "logs"
    for number in (1, 2):
        assert main(["pull", "me/bandit", "-f", str(logs), "--revision", COMMIT if number == 2 else "main"]) == 0
        pulled = logs / "fedavg" / f"Bandit2D_{number}"
        assert capsys.readouterr().out.startswith(f"wrote {pulled}\n")
        assert {path.name for path in pulled.iterdir()} == files.keys()
        assert pulled.stat().st_mode == run.stat().st_mode
    assert [path.name for path in logs.iterdir()] == ["fedavg"]
    results = []
    for folder in (run, pulled):
        assert main(["evaluate", str(folder), "--episodes", "2", "-o", str(tmp_path / "result.json")]) == 0
        results.append(json.loads((tmp_path / "result.json").read_text())["policies"])
    assert results[0] == results[1] and set(results[0]) == {"deployed", "broadcast"}
    assert main(["export", str(pulled), "--clients", "2"]) == 0
    train = [
        "train",
        "--algo",
        "fedavg",
        "--env",
        "Bandit2D",
        "--rounds",
        "1",
        "-i",
        str(pulled),
        "--no-eval",
        "-f",
        str(logs),
    ]
    assert main([*train, *QUICK]) == 0


def test_the_card_says_what_the_run_is_and_how_to_use_it(service, run):
    assert main(["push", str(run), "me/bandit"]) == 0
    assert service.messages == ["fedavg on Bandit2D, 2 rounds"]
    _, front, body = service.repositories["me/bandit"]["README.md"].decode().split("---\n", 2)
    front = yaml.safe_load(front)
    assert front["library_name"] == "sb3-fedguide"
    assert {"reinforcement-learning", "stable-baselines3", "federated-learning", "Bandit2D", "fedavg"} <= set(front["tags"])
    (model,) = front["model-index"]
    summary = json.loads((run / "summary.json").read_text())
    values = [metric["value"] for metric in model["results"][0]["metrics"]]
    assert values[0].startswith(f"{summary['deployed']['average']:.3f} +/- ")  # returns of Bandit2D are below 1
    assert values[1] == f"{summary['deployed']['worst_client']:.3f}" and len(values) == 4  # and the broadcast one
    for client, returned in zip(summary["clients"], summary["deployed"]["client_returns"], strict=True):
        assert f"| {client} | {returned:.3f} | " in body
    assert "![Return over rounds](curve.png)" in body and "fedguide pull me/bandit " in body
    assert service.repositories["me/bandit"]["curve.png"].startswith(b"\x89PNG")
    from huggingface_hub import ModelCard

    card = ModelCard(service.repositories["me/bandit"]["README.md"].decode())  # the hub's own reading of it
    assert card.data.eval_results is not None and card.data.eval_results[0].dataset_name == "Bandit2D"


BANDIT, GYMNASIUM = fed_envs.load_family("Bandit2D"), fed_envs.gymnasium_family("Pendulum-v1", [{}] * 4)


@pytest.mark.parametrize(
    ("family", "packages", "clients"),
    [
        (BANDIT, [], "--env Bandit2D"),
        (BANDIT, ["mine", "mine.more"], "--env Bandit2D --gym-packages mine mine.more"),
        (fed_envs.Family.model_validate({**BANDIT.to_dict(), "clients": BANDIT.clients[:2]}), [], "--metadata {there}"),
        (GYMNASIUM, ["robots"], "--metadata {there} --gym-packages robots"),
    ],
    ids=["a shipped family", "with modules", "another of its name", "registered ids"],
)
def test_the_cards_commands_are_understood(family, packages, clients, run):
    summary = {**json.loads((run / "summary.json").read_text()), "env": family.name}
    card = write_card(run, "me/run", summary, family, packages)
    found = commands(card)
    for words in found:
        check_command(words)
    assert [words[1] for words in found] == ["pull", "evaluate", "export", "train"]
    there = f"logs/fedavg/{family.name}_1"
    start = f"fedguide train -i {there} --algo fedavg {clients.format(there=f'{there}/metadata.json')}"
    assert found[-1] == start.split()
    extras = re.search(r"pip install 'sb3-fedguide\[(.*)]'", card)
    assert extras is not None and {"hub", "onnx"} == set(extras[1].split(",")) and found[2][-2:] == ["sb3", "onnx"]


def test_a_second_push_removes_what_the_run_does_not_have(service, run, tmp_path):
    other = shutil.copytree(run, tmp_path / "run")
    assert main(["push", str(other), "me/bandit"]) == 0
    service.repositories["me/bandit"]["notes.md"] = b"somebody's own"
    (other / "deployed.npz").unlink()
    summary = json.loads((other / "summary.json").read_text())
    del summary["deployed"], summary["broadcast"]  # as with --no-eval
    (other / "summary.json").write_text(json.dumps(summary))
    (other / "evaluations.csv").unlink()
    assert main(["push", str(other), "me/bandit"]) == 0
    files = service.repositories["me/bandit"]
    assert files.keys() == {*hub.FILES.keys() - {"deployed.npz", "evaluations.csv", "curve.png"}, "notes.md"}
    assert b"model-index" not in files["README.md"] and b"This run was not evaluated" in files["README.md"]


def test_private_is_private_or_nothing_is_sent(service, run, capsys):
    assert main(["push", str(run), "me/hidden", "--private"]) == 0
    assert service.private == {"me/hidden"}
    service.repositories["me/open"] = {}
    assert "exists already and is not private" in refused(["push", str(run), "me/open", "--private"], capsys)
    assert service.repositories["me/open"] == {}


def test_the_folder_of_a_data_set_stays_here(service, run, tmp_path):
    other = shutil.copytree(run, tmp_path / "run")
    text = (other / "config.yml").read_text()
    assert "dataset: null" in text
    (other / "config.yml").write_text(text.replace("dataset: null", "dataset: /home/me/robots/arm-v0"))
    assert main(["push", str(other), "me/bandit"]) == 0
    assert yaml.safe_load(service.repositories["me/bandit"]["config.yml"])["pretraining"]["dataset"] == "arm-v0"


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("push {run}/nothing me/bandit", "is not the folder of a trained run: it has no summary.json"),
        ("push {run} bandit", "'bandit' is not a repository of the hub: give OWNER/NAME"),
        ("push {run} ../../x", "is not a repository of the hub"),
        ("push {run} me/bandit -m ''", "the message is empty"),
        ("push {run} others/bandit", "(403): You don't have the rights to create a model under this namespace; log in with"),
        ("pull me/nothing -f {logs}", "there is no repository me/nothing on http://127.0.0.1"),
        ("pull me/run -f {logs} --revision v9", "me/run has no revision v9"),
        ("pull me/../run -f {logs}", "is not a repository of the hub"),
        ("pull me/run -f {run}/summary.json", "cannot be made"),
        ("pull me/run -f {logs} --gym-packages no_such_module", "--gym-packages no_such_module"),
    ],
)
def test_wrong_input_is_one_line(argv, message, service, shared, run, tmp_path, capsys):
    words = [word.format(run=run, logs=tmp_path / "logs").replace("''", "") for word in argv.split()]
    assert message in refused(words, capsys)
    assert_nothing_stays(tmp_path / "logs")


def test_without_a_token_nothing_is_sent(service, run, shared, monkeypatch, tmp_path, capsys):
    monkeypatch.delenv("HF_TOKEN")
    assert "there is no token for the hub: log in with 'hf auth login', or set HF_TOKEN" in refused(
        ["push", str(run), "me/bandit"], capsys
    )
    assert service.requests == []
    assert main(["pull", "me/run", "-f", str(tmp_path)]) == 0  # what is public needs none
    capsys.readouterr()
    service.private.add("me/run")
    assert "or it is private and you have no access" in refused(["pull", "me/run", "-f", str(tmp_path)], capsys)
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    assert "(401)" in refused(["push", str(run), "me/bandit"], capsys)


def test_without_network_or_with_another_service_it_is_one_line(service, run, tmp_path, monkeypatch, capsys):
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    for argv in (["push", str(run), "me/bandit"], ["pull", "me/run", "-f", str(tmp_path / "logs")]):
        assert "http://127.0.0.1:9 cannot be reached" in refused(argv, capsys)
    monkeypatch.setattr(constants, "ENDPOINT", service.url + "/large")
    service.large["api/models/me/run"] = b"<html>"
    assert "does not answer as the hub does" in refused(["pull", "me/run", "-f", str(tmp_path / "logs")], capsys)
    assert_nothing_stays(tmp_path / "logs")


@pytest.mark.parametrize("command", ["push {run} me/bandit", "pull me/run -f {logs}"])
def test_without_the_package_one_line_says_what_to_install(command, run, tmp_path, monkeypatch, capsys):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "huggingface_hub" else find(name))
    message = refused([word.format(run=run, logs=tmp_path / "logs") for word in command.split()], capsys)
    assert "pip install 'sb3-fedguide[hub]'" in message
    assert_nothing_stays(tmp_path / "logs")


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_repository_is_refused_and_leaves_nothing(kind, service, shared, run, tmp_path, capsys):
    hostile(kind, shared, run, tmp_path)
    message = refused(["pull", "me/run", "-f", str(tmp_path / "logs")], capsys)
    assert HOSTILE[kind] in message and ".pull-" not in message
    assert not (tmp_path / "executed").exists()
    assert_nothing_stays(tmp_path / "logs")


def test_names_that_lead_elsewhere_and_other_files_are_left_alone(service, shared, tmp_path):
    service.more_names = ["../../outside.txt", "/etc/outside", "model.zip", "sub/parameters.npz"]
    shared["model.zip"] = b"a pickle"
    assert main(["pull", "me/run", "-f", str(tmp_path / "logs")]) == 0
    taken = {path.name for path in (tmp_path / "logs" / "fedavg" / "Bandit2D_1").iterdir()}
    assert taken == shared.keys() - {"model.zip"}
    assert [path.name for path in tmp_path.iterdir()] == ["logs"]
    asked = {path.rpartition("/")[2] for method, path in service.requests if "/resolve/" in path}
    assert asked == taken


def test_sizes_are_bounded_before_and_while_a_file_comes(service, shared, monkeypatch, tmp_path, capsys):
    pulling = ["pull", "me/run", "-f", str(tmp_path / "logs")]
    service.said_sizes["deployed.npz"] = 10**15
    assert "deployed.npz of me/run has 1000000000000000 bytes; the limit is 256000000" in refused(pulling, capsys)
    assert not any(path.endswith("deployed.npz") for method, path in service.requests)
    service.said_sizes = {"versions.json": 10}
    shared["versions.json"] = b" " * (hub.FILES["versions.json"] + pull.CHUNK)
    assert "versions.json of me/run is longer than the limit of 100000 bytes" in refused(pulling, capsys)
    assert_nothing_stays(tmp_path / "logs")


def test_push_says_itself_what_pull_would_refuse(service, run, tmp_path, capsys):
    other = shutil.copytree(run, tmp_path / "run")
    clients = [{"client": k, "id": "Pendulum-v1", "kwargs": {"map": "maps/of:mine"}} for k in range(4)]
    (other / "metadata.json").write_bytes(of_gymnasium(json.loads((run / "metadata.json").read_text()), clients))
    message = refused(["push", str(other), "me/bandit"], capsys)
    assert "nothing is sent, since 'fedguide pull' would refuse the run: client 0 of " in message
    assert "the keyword argument 'maps/of:mine', which may name a file or a module; register" in message
    assert service.requests == []


@pytest.mark.parametrize(
    ("command", "part"),
    [
        ("pull me/run -f {logs}", "sb3_fedguide.cli.pull._download"),
        ("push {run} me/bandit", "huggingface_hub.CommitOperationAdd"),
    ],
)
def test_a_fault_of_this_package_is_not_the_hubs(command, part, service, shared, run, tmp_path, monkeypatch):
    def fault(*_, **__):
        raise TypeError("a fault here")

    monkeypatch.setattr(part, fault)
    with pytest.raises(TypeError, match="a fault here"):
        main([word.format(run=run, logs=tmp_path / "logs") for word in command.split()])
    assert_nothing_stays(tmp_path / "logs")


@pytest.mark.slow
def test_a_user_sets_hf_endpoint(service, run, tmp_path):
    own = {"HF_ENDPOINT": service.url, "HF_TOKEN": TOKEN, "HF_HOME": str(tmp_path), "HF_HUB_DISABLE_XET": "1",
           "HF_HUB_DISABLE_PROGRESS_BARS": "1"}  # fmt: skip
    for argv in (["push", str(run), "me/bandit"], ["pull", "me/bandit", "-f", str(tmp_path / "logs")]):
        done = subprocess.run(
            [sys.executable, "-m", "sb3_fedguide", *argv],
            env={**os.environ, **own},
            capture_output=True,
            text=True,
            check=True,
        )
        assert re.match("sent|wrote", done.stdout) and done.stderr == ""
