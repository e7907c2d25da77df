"""What of a deployment can be reached from outside: the proxy, TLS, and the certificates behind them."""

from __future__ import annotations

import datetime
import http.client
import http.server
import json
import os
import socket
import ssl
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import pytest
import yaml

from sb3_fedguide.cli.main import main as fedguide
from tests.flower_deployment import CLIENT

pytestmark = pytest.mark.flower


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
    from sb3_fedguide.deployment.flower.processes import free_port
    from sb3_fedguide.deployment.flower.proxy import FleetProxy, ProxyServer

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
    from sb3_fedguide.deployment.flower.proxy import MAX_BODY

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

    from sb3_fedguide.deployment.flower import certificates

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
    assert "before a server certificate of 825 days; remove ca.crt" in capsys.readouterr().err


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
