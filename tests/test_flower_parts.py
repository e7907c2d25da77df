"""The parts of a deployment, each by itself: certificates, keys, the proxy, messages, configurations, the pinned app."""

from __future__ import annotations

import datetime
import http.client
import http.server
import json
import os
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import yaml

from sb3_fedguide.cli.main import main as fedguide
from sb3_fedguide.server.transport import Failure, Message
from tests.flower_deployment import SMALL

pytestmark = pytest.mark.flower


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("deployment") / "certificates"
    assert fedguide(["deploy", "certificates", str(folder), "--host", "fed.example.org", "--host", "10.0.0.1"]) == 0
    return folder


class Upstream(http.server.BaseHTTPRequestHandler):
    """Stands for the SuperLink: answers everything with what it was asked."""

    seen: ClassVar[list[str]] = []
    protocol_version = "HTTP/1.1"

    def do_POST(self) -> None:
        self.seen.append(self.path)
        body = self.rfile.read(int(self.headers["content-length"]))
        answer = json.dumps({"path": self.path, "bytes": len(body), "headers": dict(self.headers)}).encode()
        self.send_response(200)
        self.send_header("content-length", str(len(answer)))
        self.send_header("x-flower", "passed")
        self.end_headers()
        self.wfile.write(answer)

    def log_message(self, *arguments: object) -> None:
        pass


@pytest.fixture(scope="module")
def proxy(certificates: Path) -> Iterator[int]:
    """Port of a proxy before an upstream that answers everything."""
    from sb3_fedguide.flower.processes import free_port
    from sb3_fedguide.flower.proxy import FleetProxy, ProxyServer

    upstream = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Upstream)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificates / "server.crt", certificates / "server.key")
    upstream.socket = context.wrap_socket(upstream.socket, server_side=True)
    threading.Thread(target=upstream.serve_forever, daemon=True).start()
    port = free_port()
    passing = FleetProxy(f"https://127.0.0.1:{upstream.server_port}", certificates / "ca.crt")
    with ProxyServer(("0.0.0.0", port), passing, certificates / "server.crt", certificates / "server.key", 1):
        yield port
    upstream.shutdown()
    upstream.server_close()


def tls(certificates: Path, port: int) -> socket.socket:
    context = ssl.create_default_context(cafile=certificates / "ca.crt")
    return context.wrap_socket(socket.create_connection(("127.0.0.1", port), timeout=20), server_hostname="fed.example.org")


def ask(certificates: Path, port: int, request: bytes) -> tuple[int, bytes]:
    """Status and body of the answer to a request that is sent as it stands."""
    with tls(certificates, port) as connection:
        connection.sendall(request)
        response = http.client.HTTPResponse(connection, method=request.split(b" ")[0].decode())
        response.begin()
        return response.status, response.read()


def post(target: str, body: bytes = b"x", *headers: str) -> bytes:
    lines = [f"POST {target} HTTP/1.1", "Host: fed.example.org", f"Content-Length: {len(body)}", *headers, "", ""]
    return "\r\n".join(lines).encode() + body


def test_proxy_passes_the_fleet(certificates: Path, proxy: int) -> None:
    body = os.urandom(5_300_000)  # one of Flower's chunks
    request = post("/v1/fleet/push-object", body, "Flwr-Signature: abc", "X-Forwarded-For: 127.0.0.1", "Accept-Encoding: gzip")
    status, answer = ask(certificates, proxy, request)
    said = json.loads(answer)
    headers = {name.lower(): value for name, value in said["headers"].items()}
    assert (status, said["path"], said["bytes"]) == (200, "/v1/fleet/push-object", len(body))
    assert headers["flwr-signature"] == "abc"
    assert "x-forwarded-for" not in headers and headers["accept-encoding"] == "identity"


CLOSED = [
    "/", "/v1/control/list-nodes", "/v1/control/register-node", "/v1/control/start-run", "/v1/runtime/acquire-task",
    "/v1/fleet", "/v1/fleet/", "/v1/fleet/../control/list-nodes", "/v1/fleet/%2e%2e/control/list-nodes",
    "/v1/fleet/..%2fcontrol/list-nodes", "/v1/fleet/a/../../control/list-nodes", "//v1/control/list-nodes",
    "/v1/Fleet/pull-messages", "/v1/fleet/pull-messages/", "/v1/fleet/pull-messages?x=/v1/control",
    "/v1/fleet/pull-messages#x",
    "/v1/fleet\\..\\control\\list-nodes", "/v1/fleet/pull-messages%0a", "/docs", "/openapi.json", "*",
]  # fmt: skip


@pytest.mark.parametrize("target", CLOSED)
def test_proxy_refuses_everything_else(certificates: Path, proxy: int, target: str) -> None:
    Upstream.seen.clear()
    status, _ = ask(certificates, proxy, post(target))
    assert status in (400, 403) and not Upstream.seen


def test_proxy_refuses_an_absolute_target_and_other_methods(certificates: Path, proxy: int) -> None:
    Upstream.seen.clear()
    for target in ("https://127.0.0.1/v1/control/list-nodes", "https://127.0.0.1/v1/fleet/pull-messages"):
        assert ask(certificates, proxy, post(target))[0] in (400, 403)
    for method in ("GET", "PUT", "DELETE", "OPTIONS", "HEAD", "CONNECT"):
        assert ask(certificates, proxy, post("/v1/fleet/pull-messages").replace(b"POST", method.encode()))[0] in (400, 403)
    assert not Upstream.seen


def test_proxy_passes_no_second_request_in_a_body(certificates: Path, proxy: int) -> None:
    """Neither two lengths, nor a length beside chunks, puts a request past the filter."""
    Upstream.seen.clear()
    hidden = post("/v1/control/list-nodes")
    for headers in (["Transfer-Encoding: chunked"], ["Content-Length: 5"], ["Transfer-Encoding: chunked, identity"]):
        body = b"0\r\n\r\n" + hidden
        with tls(certificates, proxy) as connection:
            connection.sendall(post("/v1/fleet/pull-messages", body, *headers))
            connection.settimeout(2)
            try:
                while connection.recv(65536):
                    pass
            except TimeoutError:
                pass
    assert not [path for path in Upstream.seen if not path.startswith("/v1/fleet/")]


def test_proxy_refuses_what_no_chunk_of_flower_is(certificates: Path, proxy: int) -> None:
    from sb3_fedguide.flower.proxy import MAX_BODY

    assert ask(certificates, proxy, post("/v1/fleet/push-object", b"x" * (MAX_BODY + 1)))[0] == 413


def test_certificates_hold_for_the_hosts_and_no_others(certificates: Path, proxy: int) -> None:
    context = ssl.create_default_context(cafile=certificates / "ca.crt")
    for host in ("fed.example.org", "10.0.0.1", "127.0.0.1", "localhost"):
        with context.wrap_socket(socket.create_connection(("127.0.0.1", proxy)), server_hostname=host) as connection:
            assert connection.version() in ("TLSv1.2", "TLSv1.3")
    with pytest.raises(ssl.SSLCertVerificationError):
        context.wrap_socket(socket.create_connection(("127.0.0.1", proxy)), server_hostname="other.example.org")
    with pytest.raises(ssl.SSLCertVerificationError):
        ssl.create_default_context().wrap_socket(socket.create_connection(("127.0.0.1", proxy)), server_hostname="localhost")
    assert {path.name: path.stat().st_mode & 0o777 for path in certificates.glob("*.key")} == {
        "ca.key": 0o600,
        "server.key": 0o600,
    }


def test_a_new_server_certificate_keeps_the_authority(tmp_path: Path) -> None:
    for host in ("one.example.org", "two.example.org"):
        assert fedguide(["deploy", "certificates", str(tmp_path), "--host", host]) == 0
        files = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
        if host == "one.example.org":
            before = files
    assert files["ca.crt"] == before["ca.crt"] and files["server.crt"] != before["server.crt"]
    context = ssl.create_default_context(cafile=tmp_path / "ca.crt")
    assert context.get_ca_certs()


def test_an_authority_outlives_what_it_signs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """At the end of a server's certificate the authority lives as long again, and where it does not, that is said."""
    from cryptography import x509

    from sb3_fedguide.flower import certificates

    def days_left(path: Path) -> int:
        ends = x509.load_pem_x509_certificate(path.read_bytes()).not_valid_after_utc
        return round((ends - datetime.datetime.now(datetime.UTC)) / datetime.timedelta(days=1))

    def command(folder: Path, *flags: str) -> int:
        return fedguide(["deploy", "certificates", str(folder), "--host", "localhost", *flags])

    long, short = tmp_path / "long", tmp_path / "short"
    assert command(long) == 0
    assert (days_left(long / "ca.crt"), days_left(long / "server.crt")) == (3650, 825)
    monkeypatch.setattr(certificates, "_AUTHORITY_DAYS", 30)
    assert command(short, "--days", "10") == 0
    before = {path.name: path.read_bytes() for path in short.iterdir()}
    capsys.readouterr()
    assert command(short) == 2
    error = capsys.readouterr().err
    assert (
        "give at most 29 days, or remove ca.crt and ca.key to begin with a new authority" in error and error.count("\n") == 1
    )
    assert {path.name: path.read_bytes() for path in short.iterdir()} == before
    assert command(short, "--days", "29") == 0 and days_left(short / "server.crt") == 29
    monkeypatch.setattr(certificates, "_AUTHORITY_DAYS", 0)
    assert command(tmp_path / "ended") == 2
    assert "a server certificate of 825 days would outlive; remove ca.crt" in capsys.readouterr().err


def test_keys(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from sb3_fedguide.flower.certificates import read_public_key

    assert fedguide(["deploy", "key", str(tmp_path), "client_0"]) == 0
    assert (tmp_path / "client_0").stat().st_mode & 0o777 == 0o600
    public = (tmp_path / "client_0.pub").read_text()
    assert public.strip() in capsys.readouterr().out
    assert read_public_key(public) == read_public_key(" ".join(public.split()[:2]))
    assert fedguide(["deploy", "key", str(tmp_path), "client_0"]) == 2
    assert "is there already" in capsys.readouterr().err
    assert (tmp_path / "client_0.pub").read_text() == public
    with pytest.raises(ValueError, match="no public key"):
        read_public_key((tmp_path / "client_0").read_text())


SERVER = {
    "algo": "fedguide", "env": "Bandit2D", "seed": 0, "clients": {0: "a.pub", 1: "b.pub"}, "certificates": "certificates",
    "folder": "out",
}  # fmt: skip
CLIENT = {
    "algo": "fedguide", "env": "Bandit2D", "seed": 0, "client": 0, "server": "localhost:9443", "ca": "certificates/ca.crt",
    "key": "a", "folder": "out",
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
    ("server", {"listen": "9443"}, "no address"),
    ("server", {"listen": "0.0.0.0:94430"}, "no address"),
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
    ("client", {"server": "localhost"}, "no address"),
    ("client", {"ca": "nowhere"}, "there is no file"),
    ("client", {"key": "nowhere"}, "fedguide deploy key"),
    ("client", {"key": "a.pub"}, "others can read"),
    ("client", {"params": {"learnin_rate": 1}}, "Did you mean 'learning_rate'"),
]


@pytest.fixture(scope="module")
def keys(certificates: Path) -> Path:
    folder = certificates.parent
    for name in ("a", "b"):
        assert fedguide(["deploy", "key", str(folder), name]) == 0
    return folder


@pytest.mark.parametrize(("kind", "change", "said"), WRONG, ids=lambda value: None if isinstance(value, dict) else value)
def test_wrong_configurations_are_refused_in_one_line(keys: Path, kind: str, change: dict, said: str, capsys) -> None:
    path = keys / "wrong.yml"
    path.write_text(yaml.safe_dump({**(SERVER if kind == "server" else CLIENT), **change}))
    assert fedguide(["deploy", kind, str(path)]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and "Traceback" not in error


@pytest.mark.parametrize(
    ("authority", "host", "code", "said"),
    [
        ("other/ca.crt", "localhost", 1, "is not the server that"),
        ("certificates/ca.crt", "127.0.0.2", 1, "is not the server that"),
        ("a.pub", "localhost", 2, "holds no certificate"),
    ],
)
def test_a_client_says_who_answers_instead_of_the_server(
    keys: Path, proxy: int, authority: str, host: str, code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fedguide(["deploy", "certificates", str(keys / "other"), "--host", "localhost"]) == 0
    path = keys / "astray.yml"
    path.write_text(yaml.safe_dump({**CLIENT, "ca": authority, "server": f"{host}:{proxy}"}))
    assert fedguide(["deploy", "client", str(path)]) == code
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_the_server_takes_what_concerns_it_from_the_clients_settings(keys: Path) -> None:
    from sb3_fedguide.cli.deploy_config import ROLLOUT_SIZE, ServerDeployment
    from sb3_fedguide.cli.schema import hyperparameters
    from sb3_fedguide.common.federated_ddpg import FederatedDDPG
    from sb3_fedguide.common.federated_ppo import FederatedPPO

    path = keys / "server.yml"
    path.write_text(yaml.safe_dump({**SERVER, "params": {"eta": 0.2, "learning_rate": 1e-3, "n_rounds": 7}}))
    server = ServerDeployment(path).server
    assert (server.n_rounds, server.rollout_size, server.settings) == (7, 200, {"eta": 0.2})
    for cls in (FederatedPPO, FederatedDDPG):
        assert hyperparameters(cls)["rollout_size"][1] == ROLLOUT_SIZE


def test_settings_are_where_the_file_says_whatever_the_working_directory_is(
    keys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sb3_fedguide.cli.deploy_config import ClientDeployment, ServerDeployment

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
        from sb3_fedguide.flower.records import to_records

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
    from sb3_fedguide.flower.transport import FlowerTransport

    requests = {client: Message("round", 1) for client in (0, 1, 2)}
    replies = FlowerTransport(Grid(refused, ["1"]), {b"a": 0, b"b": 1, b"c": 2}).exchange(requests, 60.0)  # type: ignore[arg-type]
    assert replies == {0: Failure("gone"), 1: Message("round", 1), 2: Failure("gone")}


@pytest.mark.usefixtures("task")
@pytest.mark.parametrize(("timeout", "limit"), [(60.0, 60.0), (None, 10 * 365 * 86400.0), (1e12, 10 * 365 * 86400.0)])
def test_no_timeout_is_none(timeout: float | None, limit: float) -> None:
    """Flower would forget a message without a limit after twelve hours, and refuses one that ends after the year 9999."""
    from sb3_fedguide.flower.transport import FlowerTransport

    grid = Grid(["1"])
    assert FlowerTransport(grid, {b"a": 0}).exchange({0: Message("round", 1)}, timeout) == {0: Message("round", 1)}  # type: ignore[arg-type]
    assert grid.limits == [limit]


def test_a_client_that_has_finished_ends_at_once(
    keys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As after a reboot: it waits for no server. With other settings it is refused; what has not finished is started."""
    from sb3_fedguide.common.site import make_site
    from sb3_fedguide.flower import client_node

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
    assert "the federation has had its last round; a new one needs a folder other than" in said.out
    assert "does not answer" not in said.out
    assert command(seed=1) == 2
    assert "is of another run: its seed is 0, here 1" in capsys.readouterr().err
    (folder / "site" / "parameters.npz").unlink()
    with pytest.raises(StartedError):
        command()
    assert not (folder / "finished").exists()


def test_messages_survive_flower(certificates: Path) -> None:
    from sb3_fedguide.flower.records import from_records, to_records

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

    from sb3_fedguide.flower.records import from_records

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
        with pytest.raises(ValueError, match="a message that is none"):
            from_records(wrong)
    for text in ("error: ValueError: secret", "secret", "error: " + "x" * 1000, "error: a\nb"):
        assert from_records(records(json.dumps({"failure": text}))) == Failure("error: unknown")


def test_the_apps_bundle_holds_no_code() -> None:
    import io
    import zipfile

    from sb3_fedguide.flower.server_node import app_bundle

    with zipfile.ZipFile(io.BytesIO(app_bundle().content)) as bundle:
        assert sorted(bundle.namelist()) == [".info/CONTENT", "pyproject.toml"]


def test_flower_is_told_to_be_silent() -> None:
    """Whatever part of the package is imported first, Flower's telemetry is off, in this process and those it starts."""
    code = (
        "import os, sb3_fedguide.flower.client_app, flwr.supercore.telemetry as telemetry; "
        "print(telemetry.FLWR_TELEMETRY_ENABLED, os.environ['FLWR_DISABLE_UPDATE_CHECK'])"
    )
    env = {name: value for name, value in os.environ.items() if not name.startswith("FLWR")}
    said = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert said.stdout.split() == ["0", "1"]


def test_the_server_needs_neither_pytorch_nor_a_simulator() -> None:
    code = (
        "import sys; import sb3_fedguide.cli.deploy_config, sb3_fedguide.flower.server_node, sb3_fedguide.flower.server_app; "
        "print(*{'torch', 'mujoco', 'stable_baselines3'} & sys.modules.keys())"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.split() == []


def test_another_version_of_flower_is_refused(monkeypatch: pytest.MonkeyPatch, capsys, tmp_path: Path) -> None:
    from sb3_fedguide.flower import processes

    monkeypatch.setattr(processes, "version", lambda package: "1.42.0")
    assert fedguide(["deploy", "key", str(tmp_path), "client_0"]) == 2
    assert "flwr 1.42.0 is installed" in capsys.readouterr().err


def test_the_pinned_app_refuses_a_flower_without_what_it_replaces(monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib

    from sb3_fedguide.flower.client_node import run_installed_app

    flower = importlib.import_module("flwr.supernode.runtime.run_clientapp")
    for name in ("install_from_fab", "get_load_client_app_fn"):
        monkeypatch.setattr(flower, name, getattr(flower, name))
    monkeypatch.delattr(flower, "install_from_fab")
    monkeypatch.setattr(flower, "run_clientapp", lambda *_, **__: pytest.fail("the app was run"))
    with pytest.raises(RuntimeError, match="no install_from_fab"):
        run_installed_app("127.0.0.1:1", "token")
