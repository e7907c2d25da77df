"""The parts of a deployment, each by itself: keys, messages, configurations, the pinned app."""

from __future__ import annotations

import json
import logging
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

import fed_envs
from sb3_fedguide.cli.main import main as fedguide
from sb3_fedguide.deployment.transport import Failure, Message
from sb3_fedguide.settings.config import resolve
from tests.flower_deployment import CLIENT, SMALL

pytestmark = pytest.mark.flower


def test_keys(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from sb3_fedguide.deployment.flower.certificates import read_public_key

    assert fedguide(["deploy", "key", str(tmp_path), "client_0"]) == 0
    assert (tmp_path / "client_0").stat().st_mode & 0o777 == 0o600
    public = (tmp_path / "client_0.pub").read_text()
    assert public.strip() in capsys.readouterr().out
    assert read_public_key(public) == read_public_key(" ".join(public.split()[:2]))
    assert fedguide(["deploy", "key", str(tmp_path), "client_0"]) == 2
    assert "exists already" in capsys.readouterr().err
    assert (tmp_path / "client_0.pub").read_text() == public
    with pytest.raises(ValueError, match="no public key"):
        read_public_key((tmp_path / "client_0").read_text())


SERVER = {
    "algo": "fedguide", "env": "Bandit2D", "seed": 0, "clients": {0: "a.pub", 1: "b.pub"}, "certificates": "certificates",
    "folder": "out",
}  # fmt: skip
WRONG = [
    ("server", {"algo": "fedgiude"}, "Did you mean 'fedguide'"),
    ("server", {"algo": None}, "algo"),
    ("server", {"sed": 1}, "Did you mean 'seed'"),
    ("server", {"seed": -1}, "seed"),
    ("server", {"seed": "1"}, "seed"),
    ("server", {"n_rounds": 0}, "n_rounds=0"),
    ("server", {"min_clients": 3}, "min_clients=3"),
    ("server", {"start_clients": 3}, "start_clients=3"),
    ("server", {"timeout": 0}, "timeout"),
    ("server", {"params": {"eta": 0}}, "eta"),
    ("server", {"params": {"eta": "high"}}, "eta"),
    ("server", {"params": {"learnin_rate": 1}}, "Did you mean 'learning_rate'"),
    ("server", {"params": {"gamma": 2}}, "gamma=2 must be between 0 and 1"),
    ("server", {"listen": "9443"}, "not an address"),
    ("server", {"listen": "0.0.0.0:94430"}, "not an address"),
    ("server", {"certificates": "nowhere"}, "fedguide deploy certificates"),
    ("server", {"clients": {0: "a.pub", 1: "a.pub"}}, "same key"),
    ("server", {"clients": {1: "a.pub", 2: "b.pub"}}, "numbered from 0"),
    ("server", {"clients": {}}, "clients"),
    ("server", {"clients": {0: "none.pub"}}, "there is no file"),
    ("server", {"clients": {0: "a"}}, "no public key"),
    ("server", {"clients": ["a.pub"]}, "clients"),
    ("client", {"algo": "fedgiude"}, "Did you mean 'fedguide'"),
    ("client", {"sever": "localhost:9443"}, "sever"),
    ("client", {"env": "HoperHard"}, "Did you mean 'HopperHard'"),
    ("client", {"client": 4}, "4"),
    ("client", {"server": "localhost"}, "not an address"),
    ("client", {"ca": "nowhere"}, "there is no file"),
    ("client", {"key": "nowhere"}, "fedguide deploy key"),
    ("client", {"key": "a.pub"}, "others can read"),
    ("client", {"params": {"learnin_rate": 1}}, "Did you mean 'learning_rate'"),
]


@pytest.mark.parametrize(("kind", "change", "said"), WRONG, ids=lambda value: None if isinstance(value, dict) else value)
def test_wrong_configurations_are_refused_in_one_line(keys: Path, kind: str, change: dict, said: str, capsys) -> None:
    path = keys / "wrong.yml"
    path.write_text(yaml.safe_dump({**(SERVER if kind == "server" else CLIENT), **change}))
    assert fedguide(["deploy", kind, str(path)]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and "Traceback" not in error


def test_the_server_takes_what_concerns_it_from_the_clients_settings(keys: Path) -> None:
    from sb3_fedguide.deployment.config_files import ServerDeployment

    path = keys / "server.yml"
    path.write_text(yaml.safe_dump({**SERVER, "params": {"eta": 0.2, "learning_rate": 1e-3, "n_rounds": 7}}))
    server = ServerDeployment(path).server
    assert (server.n_rounds, server.rollout_size, server.settings) == (7, 200, {"eta": 0.2, "normalize": False})


def test_the_server_takes_the_quick_settings_as_clients_do(keys: Path) -> None:
    from sb3_fedguide.deployment.config_files import ServerDeployment

    path = keys / "server.yml"
    path.write_text(yaml.safe_dump({**SERVER, "conf": "quick"}))
    quick = resolve("fedguide", fed_envs.load_family("Bandit2D"), "quick")
    server = ServerDeployment(path).server
    assert (server.n_rounds, server.rollout_size) == (quick.n_rounds, quick.values["rollout_size"])


def test_settings_are_where_the_file_says_whatever_the_working_directory_is(
    keys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sb3_fedguide.deployment.config_files import ClientDeployment, ServerDeployment

    (keys / "own.yml").write_text(yaml.safe_dump({"default": {"n_rounds": 7}}))
    monkeypatch.chdir(tmp_path)
    server, client = keys / "server_own.yml", keys / "client_own.yml"
    server.write_text(yaml.safe_dump({**SERVER, "conf": "own.yml"}))
    client.write_text(yaml.safe_dump({**CLIENT, "conf": "own.yml"}))
    assert ServerDeployment(server).server.n_rounds == 7
    assert ClientDeployment(client).site["conf"] == str(keys / "own.yml")
    client.write_text(yaml.safe_dump({**CLIENT, "conf": "paper"}))
    assert ClientDeployment(client).site["conf"] == "paper"


class Grid:
    """Stands for Flower's: both clients are online, and answer at once."""

    def __init__(self, *pushed: list[str | None]) -> None:
        self.pushed, self.limits = list(pushed), []

    def get_nodes(self) -> list[Any]:
        return [SimpleNamespace(public_key=key, node_id=number) for number, key in enumerate((b"a", b"b"))]

    def push_messages(self, messages: list[Any]) -> list[str | None]:
        self.limits += [message.metadata.ttl for message in messages]
        return self.pushed.pop(0)

    def pull_messages(self, numbers: list[str]) -> list[Any]:
        from sb3_fedguide.deployment.flower.records import to_records

        assert all(numbers)
        content = to_records(Message("round", 1))
        return [
            SimpleNamespace(metadata=SimpleNamespace(reply_to_message_id=number), content=content, has_error=lambda: False)
            for number in numbers
        ]


@pytest.fixture
def task(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in the process of a round loop: Flower's messages say which it is."""
    from flwr.supercore.task_identity import TaskIdentity

    for name in ("_task_id", "_run_id", "_node_id"):
        monkeypatch.setattr(TaskIdentity, name, 1)


@pytest.mark.usefixtures("task")
@pytest.mark.parametrize("refused", [[], [None], [""]], ids=["too large", "refused", "not stored"])
def test_a_request_that_flower_does_not_take_is_a_failure(refused: list[str | None]) -> None:
    """Flower has no exception for it, and the others' answers count."""
    from sb3_fedguide.deployment.flower.transport import FlowerTransport

    requests = {client: Message("round", 1) for client in (0, 1, 2)}
    replies = FlowerTransport(Grid(refused, ["1"]), {b"a": 0, b"b": 1, b"c": 2}).send_and_receive(requests, 60.0)  # type: ignore[arg-type]
    assert replies == {0: Failure("gone"), 1: Message("round", 1), 2: Failure("gone")}


@pytest.mark.usefixtures("task")
@pytest.mark.parametrize(("timeout", "limit"), [(60.0, 60.0), (None, 10 * 365 * 86400.0), (1e12, 10 * 365 * 86400.0)])
def test_no_timeout_is_none(timeout: float | None, limit: float) -> None:
    """Flower would forget a message without a limit after twelve hours, and refuses one that ends after the year 9999."""
    from sb3_fedguide.deployment.flower.transport import FlowerTransport

    grid = Grid(["1"])
    assert FlowerTransport(grid, {b"a": 0}).send_and_receive({0: Message("round", 1)}, timeout) == {0: Message("round", 1)}  # type: ignore[arg-type]
    assert grid.limits == [limit]


def test_a_client_that_has_finished_ends_at_once(
    keys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As after a reboot: it waits for no server. With other settings it is refused; what has not finished is started."""
    from sb3_fedguide.deployment.flower import client_node
    from sb3_fedguide.deployment.site import make_site

    class StartedError(Exception):
        pass

    def start(*_: object) -> None:
        raise StartedError

    monkeypatch.setattr(client_node, "FlowerProcess", start)
    folder, path = tmp_path / "out", keys / "finished.yml"
    own = {"algo": "fedavg", "env": "Bandit2D", "client": 0, "params": SMALL, "eval_freq": 0, "cache_dir": str(tmp_path)}

    def command(seed: int = 0) -> int:
        connection = {"server": "localhost:1", "ca": "certificates/ca.crt", "key": "a", "folder": str(folder)}
        path.write_text(yaml.safe_dump({**own, "seed": seed, **connection}))
        return fedguide(["deploy", "client", str(path)])

    site = make_site({**own, "seed": 0}, folder / "site")
    for message in (
        Message("setup", 0, facts={"run": "r"}),
        Message("finish", 1, facts={"run": "r", "broadcast": 0, "after": 0}),
    ):
        site.handle(message)
    with pytest.raises(StartedError):  # parameters are there, and the server has not had the answer
        command()
    assert "localhost:1 does not answer yet" in capsys.readouterr().out
    (folder / "finished").touch()
    assert command() == 0
    said = capsys.readouterr()
    assert "the federation has finished its last round; a new one needs a folder other than" in said.out
    assert "does not answer" not in said.out
    assert command(seed=1) == 2
    assert "is of another run: its seed is 0, here 1" in capsys.readouterr().err
    (folder / "site" / "parameters.npz").unlink()
    with pytest.raises(StartedError):
        command()
    assert not (folder / "finished").exists()


def test_messages_survive_flower(certificates: Path) -> None:
    from sb3_fedguide.deployment.flower.records import from_records, to_records

    payload = {
        "prior.head": np.arange(6, dtype=np.float32).reshape(2, 3),
        "n_samples": np.float32(7),
        "none": np.zeros((0, 2), np.float32),
    }
    message = Message("round", 3, payload, {"figures": {"a": 1.5}, "none": None, "list": [1, True]})
    back = from_records(to_records(message))
    assert isinstance(back, Message)
    assert (back.kind, back.round, back.facts) == ("round", 3, message.facts)
    for name, array in payload.items():
        assert back.payload[name].dtype == np.float32 and back.payload[name].shape == np.shape(array)
        np.testing.assert_array_equal(back.payload[name], array)
    assert from_records(to_records(Message("join", 0))) == Message("join", 0)
    assert from_records(to_records(Failure("error: ValueError"))) == Failure("error: ValueError")


def test_foreign_messages_are_errors_and_nothing_else() -> None:
    from flwr.app import Array, ArrayRecord, ConfigRecord, RecordDict

    from sb3_fedguide.deployment.flower.records import from_records

    def records(text: str, **arrays: Array) -> RecordDict:
        return RecordDict({"message": ConfigRecord({"text": text}), "payload": ArrayRecord(arrays)})

    good = json.dumps({"kind": "round", "round": 1, "facts": {}})
    assert isinstance(from_records(records(good)), Message)
    pickled = Array("float32", (1,), "numpy.ndarray", b"\x80\x04K\x01.")
    texts = [
        "",
        "{",
        "[]",
        "1",
        "null",
        "{}",
        good.replace("round", "attack"),
        good.replace("1", '"1"'),
        good.replace("{}", "[]"),
        "[" * 100_000,
    ]
    for wrong in [
        RecordDict(),
        *map(records, texts),
        records(good, x=pickled),
        records(good, x=Array("float32", (1,), "torch", b"x")),
    ]:
        with pytest.raises(ValueError, match="not a valid message"):
            from_records(wrong)
    for text in ("error: ValueError: secret", "secret", "error: " + "x" * 1000, "error: a\nb"):
        assert from_records(records(json.dumps({"failure": text}))) == Failure("error: unknown")


def test_the_apps_bundle_holds_no_code() -> None:
    import io
    import zipfile

    from sb3_fedguide.deployment.flower.server_node import app_bundle

    with zipfile.ZipFile(io.BytesIO(app_bundle().content)) as bundle:
        assert sorted(bundle.namelist()) == [".info/CONTENT", "pyproject.toml"]


def test_a_run_that_flower_ended_early_has_failed(tmp_path, keys, certificates, capsys) -> None:
    """Flower's process ends with code 0 also where its token was refused, before the first round."""
    from sb3_fedguide.deployment.flower.server_app import FINISHED
    from sb3_fedguide.deployment.flower.server_node import ServerNode

    node = ServerNode(("127.0.0.1", 0), certificates, {}, tmp_path / "server.json", tmp_path)
    assert [node._outcome(code) for code in (None, 2, 0)] == [1, 2, 1]
    assert "start the server again" in capsys.readouterr().err
    (tmp_path / FINISHED).touch()
    assert node._outcome(0) == 0


def test_flower_is_told_to_be_silent() -> None:
    """Whatever part of the package is imported first, Flower's telemetry is off, in this process and those it starts."""
    code = (
        "import os, sb3_fedguide.deployment.flower.client_app, flwr.supercore.telemetry as telemetry; "
        "print(telemetry.FLWR_TELEMETRY_ENABLED, os.environ['FLWR_DISABLE_UPDATE_CHECK'])"
    )
    env = {name: value for name, value in os.environ.items() if not name.startswith("FLWR")}
    said = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert said.stdout.split() == ["0", "1"]


def test_the_server_needs_neither_pytorch_nor_a_simulator() -> None:
    code = (
        "import sys; from sb3_fedguide.deployment import config_files; "
        "from sb3_fedguide.deployment.flower import server_app, server_node; "
        "print(*{'torch', 'mujoco', 'stable_baselines3'} & sys.modules.keys())"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.split() == []


def test_another_version_of_flower_is_refused(monkeypatch: pytest.MonkeyPatch, capsys, tmp_path: Path) -> None:
    from sb3_fedguide.deployment.flower import processes

    monkeypatch.setattr(processes, "version", lambda package: "1.42.0")
    assert fedguide(["deploy", "key", str(tmp_path), "client_0"]) == 2
    assert "flwr 1.42.0 is installed" in capsys.readouterr().err


def test_the_pinned_app_refuses_a_flower_without_what_it_replaces(monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib

    from sb3_fedguide.deployment.flower.client_node import run_installed_app

    flower = importlib.import_module("flwr.supernode.runtime.run_clientapp")
    for name in ("install_from_fab", "get_load_client_app_fn"):
        monkeypatch.setattr(flower, name, getattr(flower, name))
    monkeypatch.delattr(flower, "install_from_fab")
    monkeypatch.setattr(flower, "run_clientapp", lambda *_, **__: pytest.fail("the app was run"))
    with pytest.raises(RuntimeError, match="no install_from_fab"):
        run_installed_app("127.0.0.1:1", "token")


def test_the_journal_has_the_lines_of_this_package_and_of_others_what_is_wrong(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from sb3_fedguide.cli.deploy import QUIET
    from sb3_fedguide.deployment.flower import server_app

    for name in QUIET:
        monkeypatch.setenv(name, "")
        del os.environ[name]
    assert fedguide(["deploy", "server", "nowhere.yml"]) == 2
    assert (os.environ["FLWR_LOG_LEVEL"], os.environ["GRPC_VERBOSITY"]) == ("WARNING", "ERROR")  # read by Flower's processes
    root = logging.getLogger()
    handlers, levels = root.handlers[:], {name: logging.getLogger(name).level for name in ("", "sb3_fedguide")}
    try:
        server_app.set_up_journal()
        for name in ("grpc", "httpx", "some_other_package"):
            assert not logging.getLogger(name).isEnabledFor(logging.INFO) and logging.getLogger(name).isEnabledFor(
                logging.WARNING
            )
        assert logging.getLogger("sb3_fedguide.deployment.serve").isEnabledFor(logging.INFO)
    finally:
        root.handlers[:] = handlers
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)
        logging.getLogger("flwr").propagate = True


def test_the_example_on_one_machine_is_understood(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sb3_fedguide.deployment.config_files import ClientDeployment, ServerDeployment
    from sb3_fedguide.deployment.site_config import read_site_config

    text = (Path(__file__).parent.parent / "docs" / "deployment.md").read_text()
    example = text[text.index("## Try it on one machine") : text.index("## 1. Install")]
    monkeypatch.chdir(tmp_path)
    for line in example.splitlines():
        if line.startswith(("fedguide deploy certificates", "fedguide deploy key")):
            assert fedguide(line.split()[1:]) == 0
    server, client = re.findall(r"^```yaml\n(.*?)^```", example, re.MULTILINE | re.DOTALL)
    other = client.replace("client: 0", "client: 1").replace("client_0", "client_1").replace("site_0", "site_1")
    for name, content in {"server": server, "client_0": client, "client_1": other}.items():
        (tmp_path / f"{name}.yml").write_text(content)
    assert sorted(ServerDeployment(tmp_path / "server.yml").keys.values()) == [0, 1]
    for k in (0, 1):
        deployment = ClientDeployment(tmp_path / f"client_{k}.yml")
        read_site_config(deployment.site)
        assert (deployment.site["client"], deployment.folder.name) == (k, f"site_{k}")
