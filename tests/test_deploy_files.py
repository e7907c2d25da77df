"""The files under ``deploy/`` and the workflows: what they call exists, and the checkers that are installed find nothing."""

from __future__ import annotations

import configparser
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from sb3_fedguide import __version__
from sb3_fedguide.cli import deploy

ROOT = Path(__file__).resolve().parent.parent
DEPLOY = ROOT / "deploy"
SERVICES = ("server", "client")
COMPOSE = DEPLOY / "compose"


def deployed(words: list[str]) -> object:
    """What ``fedguide WORDS`` would do."""
    assert words[0] == "deploy"
    return deploy._parser().parse_strictly(words[1:])


def unit(name: str) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(interpolation=None)
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read(DEPLOY / "systemd" / f"fedguide-{name}.service")
    return parser


def compose() -> dict:
    return yaml.safe_load((COMPOSE / "compose.yml").read_text())


@pytest.mark.parametrize("name", SERVICES)
def test_a_unit_runs_the_command_that_there_is(name: str) -> None:
    service = unit(name)["Service"]
    program, *words = service["ExecStart"].split()
    options = deployed(words)
    assert program.endswith("/bin/fedguide") and options.config == Path(f"/etc/fedguide/{name}.yml")  # type: ignore[attr-defined]
    assert options.run is getattr(deploy, f"_{name}")  # type: ignore[attr-defined]
    hardened = {"NoNewPrivileges": "yes", "ProtectSystem": "strict", "Restart": "on-failure", "RestartPreventExitStatus": "2"}
    assert hardened.items() <= dict(service).items()
    assert service["SuccessExitStatus"] == "143"  # what SIGTERM ends with


def test_both_units_differ_in_nothing_but_their_part() -> None:
    texts = [(DEPLOY / "systemd" / f"fedguide-{name}.service").read_text().replace(name, "NAME") for name in SERVICES]
    assert texts[0] == texts[1]


@pytest.mark.parametrize("name", SERVICES)
def test_systemd_finds_nothing_wrong(name: str, tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    text = (DEPLOY / "systemd" / f"fedguide-{name}.service").read_text()
    copy = tmp_path / f"fedguide-{name}.service"  # the program and its user are not on this machine
    copy.write_text(re.sub(r"(?m)^ExecStart=\S+", "ExecStart=/bin/true", text).replace("User=fedguide", "User=root"))
    command = ["systemd-analyze", "verify", "--man=no", str(copy)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if "Failed to" in result.stderr and copy.name not in result.stderr:
        pytest.skip(f"systemd-analyze cannot work here: {result.stderr.strip()}")
    assert (result.returncode, result.stderr) == (0, "")


def test_the_containers_run_the_commands_that_there_are() -> None:
    services = compose()["services"]
    assert [deployed(service["command"]).run for service in services.values()] == [  # type: ignore[attr-defined]
        deploy._server, deploy._client, deploy._client,
    ]  # fmt: skip
    for name, service in services.items():
        folders = dict(volume.split(":")[:2][::-1] for volume in service["volumes"])
        config = yaml.safe_load((COMPOSE / folders["/etc/fedguide"] / Path(service["command"][-1]).name).read_text())
        assert Path(config["folder"]).parent == Path("/var/lib/fedguide") and "/var/lib/fedguide" in folders
        assert name == "server" or (config["server"] == "server:9443" and name == f"site_{config['client']}")
        assert service["cap_drop"] == ["ALL"] and service["read_only"] is True


def test_docker_compose_takes_the_file() -> None:
    for program in (["docker", "compose"], ["docker-compose"]):
        if shutil.which(program[0]) and not subprocess.run([*program, "version"], capture_output=True, check=False).returncode:
            command = [*program, "--file", str(COMPOSE / "compose.yml"), "config", "--quiet"]
            result = subprocess.run(command, capture_output=True, text=True, check=False)
            assert result.returncode == 0, result.stderr
            return
    pytest.skip("docker compose is not installed")


@pytest.mark.flower
def test_the_containers_configurations_are_sound(certificates: Path, keys: Path, tmp_path: Path) -> None:
    from sb3_fedguide.deployment.config_files import ClientDeployment, ServerDeployment

    shutil.copytree(COMPOSE, tmp_path / "compose")
    server, sites = tmp_path / "compose" / "server", [tmp_path / "compose" / f"site_{k}" for k in (0, 1)]
    shutil.copytree(certificates, server / "certificates")
    for k, (site, name) in enumerate(zip(sites, ("a", "b"), strict=True)):
        shutil.copy(certificates / "ca.crt", site)
        shutil.copy(keys / name, site / f"client_{k}")
        shutil.copy(keys / f"{name}.pub", server / f"client_{k}.pub")
    told = ServerDeployment(server / "server.yml").process_settings()["server"]
    clients = [ClientDeployment(site / "client.yml") for site in sites]
    assert told["n_clients"] == len(clients) and {client.server for client in clients} == {"server:9443"}
    given = [yaml.safe_load((site / "client.yml").read_text()) for site in sites]
    both = yaml.safe_load((server / "server.yml").read_text())
    for name in ("algo", "env", "seed", "n_rounds"):
        assert both[name] == given[0][name] == given[1][name]


def test_the_image_has_what_is_copied_and_the_command() -> None:
    lines = re.sub(r"\\\n\s*", "", (DEPLOY / "Dockerfile").read_text()).splitlines()
    commands = [line.partition(" ")[::2] for line in lines if line and not line.startswith("#")]
    entry = [json.loads(text) for command, text in commands if command in ("ENTRYPOINT", "CMD")]
    assert entry == [["fedguide"], ["--help"]]
    assert [text for command, text in commands if command == "USER"] == ["10001"]
    kept = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = {name for command, text in commands if command == "COPY" and "--from" not in text for name in text.split()[:-1]}
    assert copied == kept and all((ROOT / name).exists() for name in copied)


def test_hadolint_finds_nothing() -> None:
    if shutil.which("hadolint") is None:
        pytest.skip("hadolint is not installed")
    result = subprocess.run(["hadolint", str(DEPLOY / "Dockerfile")], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (0, "")


@pytest.mark.parametrize("name", ["tests", "release"])
def test_workflows_call_targets_that_there_are(name: str) -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / f"{name}.yml").read_text())
    assert workflow["permissions"] == {"contents": "read"} and workflow[True]  # YAML reads `on` as true
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    assert all(("uses" in step) != ("run" in step) for step in steps)
    targets = {word for step in steps for line in re.findall(r"(?m)^make (.+)$", step.get("run", "")) for word in line.split()}
    assert targets >= {"lint", "type", "test", "test-dist"}
    assert targets <= set(re.findall(r"(?m)^([a-z-]+):", (ROOT / "Makefile").read_text()))


def test_only_the_last_job_of_a_release_may_publish() -> None:
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text())["jobs"]
    assert "permissions" not in jobs["build"]
    assert jobs["publish"]["permissions"] == {"id-token": "write"} and jobs["publish"]["environment"] == "pypi"
    found = re.search(r'(?m)^__version__ = "(.*)"$', (ROOT / "sb3_fedguide" / "__init__.py").read_text())
    assert found is not None and found[1] == __version__  # as the workflow reads it
