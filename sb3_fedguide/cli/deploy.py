"""A federation over a network: its certificates and keys, its server, and its clients."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import ssl
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_fedguide.cli.arguments import OneLineParser
from sb3_fedguide.cli.output import pipe_may_close
from sb3_fedguide.cli.run_folder import exclusive, write_json
from sb3_fedguide.cli.signals import StopSignals
from sb3_fedguide.exit_codes import EXIT_FAILED, EXIT_USAGE

if TYPE_CHECKING:
    from sb3_fedguide.deployment.config_files import ClientDeployment

#: In a deployment's folder, the settings of its processes.
CONFIG = "config.json"
#: Log levels of Flower and gRPC in the journal, unless the user's environment sets others; read when they are imported.
QUIET = {"FLWR_LOG_LEVEL": "WARNING", "GRPC_VERBOSITY": "ERROR"}


@pipe_may_close
def main(argv: Sequence[str]) -> int:
    """Run the command.

    :return: the exit code: 0, 1 if a part failed and a retry is useful, 2 for wrong input, 130 after an interrupt
        (SIGINT), 143 after SIGTERM
    """
    arguments = _parser().parse_args(argv)
    for name, level in QUIET.items():
        os.environ.setdefault(name, level)
    signals = StopSignals()
    try:
        _check_installation()
        with signals:
            return arguments.run(arguments)
    except ValueError as error:
        print(f"fedguide deploy: error: {error}", file=sys.stderr)
        return EXIT_USAGE
    except BrokenPipeError:
        raise
    except OSError as error:
        where = "" if error.filename is None else f"{error.filename}: "
        print(f"fedguide deploy: error: {where}{error.strerror or error}", file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:
        return signals.exit_code


def _parser() -> OneLineParser:
    parser = OneLineParser(prog="fedguide deploy", allow_abbrev=False, description=f"{__doc__} See docs/deployment.md.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    certificates = commands.add_parser("certificates", help="make the server's certificate, and an authority if there is none")
    certificates.add_argument("folder", type=Path, metavar="DIR", help="folder for ca.crt, ca.key, server.crt and server.key")
    certificates.add_argument("--host", action="append", required=True, metavar="NAME", help="name or address under which "
                              "clients reach the server; can be given more than once")  # fmt: skip
    certificates.add_argument("--days", type=int, default=825, help="days until the certificate expires (%(default)s)")
    certificates.set_defaults(run=_certificates)
    key = commands.add_parser("key", help="make a client's pair of keys, on the client's machine")
    key.add_argument("folder", type=Path, metavar="DIR", help="folder for NAME and NAME.pub")
    key.add_argument("name", metavar="NAME", help="of the client, e.g. client_0")
    key.set_defaults(run=_key)
    server = commands.add_parser("server", help="run the server until the federation's last round")
    server.add_argument("config", type=Path, metavar="CONFIG", help="YAML file, see docs/deployment.md")
    server.set_defaults(run=_server)
    client = commands.add_parser("client", help="run a client until the federation's last round")
    client.add_argument("config", type=Path, metavar="CONFIG", help="YAML file, see docs/deployment.md")
    client.set_defaults(run=_client)
    return parser


def _check_installation() -> None:
    try:
        from sb3_fedguide.deployment.flower.processes import check_flower_version
    except ModuleNotFoundError as error:
        raise ValueError(f"{error.name} is not installed: pip install 'sb3-fedguide[flower]'") from None
    check_flower_version()


def _certificates(arguments: argparse.Namespace) -> int:
    from sb3_fedguide.deployment.flower.certificates import CA, write_certificates

    if arguments.days < 1:
        raise ValueError(f"--days must be at least 1, not {arguments.days}")
    write_certificates(arguments.folder, arguments.host, arguments.days)
    print(f"{arguments.folder}: give {CA} to every client, and nothing else")
    return 0


def _key(arguments: argparse.Namespace) -> int:
    from sb3_fedguide.deployment.flower.certificates import write_key

    private, public = write_key(arguments.folder, arguments.name)
    print(f"{private} stays on this machine; the server needs {public}:\n{public.read_text().strip()}")
    return 0


def _server(arguments: argparse.Namespace) -> int:
    from sb3_fedguide.deployment.config_files import ServerDeployment
    from sb3_fedguide.deployment.flower.server_node import ServerNode

    deployment = ServerDeployment(arguments.config)
    config = _prepare(deployment.folder)
    with exclusive(deployment.folder):
        write_json(config, deployment.process_settings())
        node = ServerNode(deployment.listen, deployment.certificates, deployment.keys, config, deployment.folder)
        print(f"{deployment.server.n_clients} clients, {deployment.server.n_rounds} rounds, listening on "
              f"{deployment.listen[0]}:{deployment.listen[1]}, writing to {deployment.folder}", flush=True)  # fmt: skip
        return node.run()


def _client(arguments: argparse.Namespace) -> int:
    from sb3_fedguide.deployment.config_files import ClientDeployment
    from sb3_fedguide.deployment.flower.client_node import ClientNode
    from sb3_fedguide.deployment.site_config import read_site_config

    deployment = ClientDeployment(arguments.config)
    read_site_config(deployment.site)
    config = _prepare(deployment.folder)
    node = ClientNode(deployment.server, deployment.ca, deployment.key, config, deployment.folder)
    if not node.finished:
        _check_server(deployment)
    with exclusive(deployment.folder):
        # Report its errors now; in another process, since forks cannot use a GPU that this process has used.
        with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as processes:
            processes.submit(_try_site, deployment).result()
        write_json(config, deployment.process_settings())
        print(f"client {deployment.site.get('client')} of {deployment.server}, writing to {deployment.folder}", flush=True)
        node.run()
        print(
            f"the federation has finished its last round; a new one needs a folder other than {deployment.folder}", flush=True
        )
    return 0


def _check_server(deployment: ClientDeployment) -> None:
    """Check the server's certificate: for Flower, a server with the wrong certificate looks like an absent one.

    :raises ValueError: if ``ca`` holds no certificate
    :raises ConnectionError: if another server answers
    """
    import httpx

    try:
        context = ssl.create_default_context(cafile=deployment.ca)
    except ssl.SSLError:
        raise ValueError(f"{deployment.ca} holds no certificate; it must be the ca.crt of the server's machine") from None
    try:
        # The same route as Flower's, also through a proxy.
        with httpx.Client(verify=context, timeout=10.0) as client:
            client.get(f"https://{deployment.server}/")
    except httpx.HTTPError as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, ssl.SSLCertVerificationError):
            cause = cause.__cause__ or cause.__context__
        if cause is not None:
            why = cause.verify_message
            raise ConnectionError(f"{deployment.server} is not the server that {deployment.ca} vouches for: {why}") from None
        print(f"{deployment.server} does not answer yet ({error}); waiting for it", flush=True)


def _try_site(deployment: ClientDeployment) -> None:
    from sb3_fedguide.deployment.site import SITE, make_site

    make_site(deployment.site, deployment.folder / SITE)


def _prepare(folder: Path) -> Path:
    """Make a deployment's folder, private to this user; return the path of its processes' settings."""
    folder.mkdir(parents=True, exist_ok=True)
    os.chmod(folder, 0o700)
    return folder / CONFIG
