"""What surrounds a process: terminals and readers that go away, signals to a whole group, proxies."""

from __future__ import annotations

import http.server
import os
import pty
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

PRINTING = """
import sys
from sb3_fedguide.cli.output import pipe_may_close
@pipe_may_close
def main():
    for number in range({n}):
        print(number)
    return 0
raise SystemExit(main())
"""


@pytest.mark.parametrize("n", [3, 100_000])
def test_a_reader_that_goes_away_is_no_traceback(n):
    command = subprocess.Popen(
        [sys.executable, "-c", PRINTING.format(n=n)], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    if n > 3:
        assert command.stdout.readline() == "0\n"
        command.stdout.close()
    assert command.wait() == (0 if n == 3 else 141)
    assert command.stderr.read() == ""


ROUNDS = """
import sys, time
from sb3_fedguide.cli.signals import StopSignals
with StopSignals() as signals:
    signals.can_wait = True
    print("ready", flush=True)
    while signals.received is None:
        time.sleep(0.01)
    time.sleep(0.3)  # the round goes on, and so does what it prints
    print("of a round", flush=True)
    print("of a round", file=sys.stderr, flush=True)
    open(sys.argv[1], "w").write(str(signals.exit_code))
"""


def test_a_lost_terminal_lets_the_round_end(tmp_path):
    terminal, end = pty.openpty()
    done = tmp_path / "done"
    command = subprocess.Popen(
        [sys.executable, "-c", ROUNDS, str(done)], cwd=ROOT, stdin=end, stdout=end, stderr=end, start_new_session=True
    )
    os.close(end)
    assert os.read(terminal, 100).strip() == b"ready"
    os.close(terminal)
    for _ in range(2):  # the shell's and the kernel's
        command.send_signal(signal.SIGHUP)
        time.sleep(0.05)
    assert command.wait(10) == 0
    assert done.read_text() == "129"


@pytest.mark.slow
@pytest.mark.parametrize("guarded", [True, False])
def test_scripts_that_start_workers(guarded, tmp_path):
    lines = [
        "from sb3_fedguide import Local",
        "from sb3_fedguide.engines.processes import Processes",
        "if True:" if not guarded else "if __name__ == '__main__':",
        "    model = Local('MlpPolicy', 'Bandit2D', rollout_size=16, batch_size=8, n_epochs=1)",
        "    Processes(1).attach(model)",
        "    model.learn(64)",  # and no close(): the worker ends with the script
    ]
    (tmp_path / "script.py").write_text("\n".join(lines))
    done = subprocess.run(
        [sys.executable, tmp_path / "script.py"], env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
        timeout=120,
    )  # fmt: skip
    assert (done.returncode == 0) == guarded, done.stderr
    assert guarded or "own work has to stand below" in done.stderr.splitlines()[-1]


class Answering(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(204)
        self.end_headers()

    def log_message(self, *_):
        pass


@pytest.mark.parametrize("given", [None, "example.org, 10.0.0.1", "*"])
def test_the_loopback_device_needs_no_proxy(given, monkeypatch):
    httpx = pytest.importorskip("httpx")
    pytest.importorskip("flwr")
    from sb3_fedguide.deployment.flower.processes import environment, loopback_without_proxy

    for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")  # nobody answers there
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    if given is not None:
        monkeypatch.setenv("NO_PROXY", given)
    server = http.server.HTTPServer(("127.0.0.1", 0), Answering)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{server.server_port}"
    if given != "*":
        with pytest.raises(httpx.HTTPError):
            httpx.get(url)
    for name, value in loopback_without_proxy().items():
        monkeypatch.setenv(name, value)
        assert given is None or value.startswith(given.replace(" ", ""))
    assert httpx.get(url).status_code == 204
    assert environment(Path("home"))["no_proxy"] == os.environ["no_proxy"]
    server.shutdown()
    server.server_close()
