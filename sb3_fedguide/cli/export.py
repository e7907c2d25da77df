"""The export command: clients' policies from a run's or a deployment's folder, for use without this package."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_fedguide.cli.arguments import OneLineParser
from sb3_fedguide.cli.pretrained import PRETRAINED, find_run
from sb3_fedguide.cli.run_folder import PARAMETERS, read_deployed

if TYPE_CHECKING:
    from sb3_fedguide.common.export import ClientPolicy

#: Name for ``--format`` to the suffix of the file.
SUFFIXES = {"sb3": ".zip", "pt2": ".pt2", "torchscript": ".pt", "onnx": ".onnx"}


def main(argv: Sequence[str] | None = None, prog: str = "fedguide export") -> int:
    """Run the command.

    :return: the exit code: 0, or 2 for wrong input
    """
    parser = _parser(prog)
    arguments = parser.parse_strictly(argv)
    try:
        for path in _export(arguments):
            print(f"wrote {path}")
    except (ValueError, OSError) as error:
        parser.error(" ".join(str(error).split()))
    return 0


def _parser(prog: str) -> OneLineParser:
    parser = OneLineParser(prog=prog, description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    flag = parser.add_argument
    flag("folder", metavar="FOLDER", type=Path, help="folder of a run, e.g. logs/fedguide/HopperHard_1, or of a deployed "
         f"client; or the {PARAMETERS} itself")  # fmt: skip
    flag("--clients", type=int, nargs="+", metavar="K", help="clients to export; all by default")
    flag("--format", nargs="+", choices=tuple(SUFFIXES), default=["sb3"], help="an archive for stable_baselines3, a "
         "torch.export program, TorchScript, or ONNX")  # fmt: skip
    flag("--policy", choices=("deployed", "broadcast"), default="deployed", help="a run's policies after local "
         "training, or those that the server sent then; a deployed client has only the latter")  # fmt: skip
    flag("-o", "--output", type=Path, metavar="DIR", help="folder of the files; by default policies in FOLDER")
    return parser


def _export(arguments: argparse.Namespace) -> Iterator[Path]:
    from sb3_fedguide.common.export import write_policy

    file = _parameter_file(find_run(arguments.folder))
    policies = _policies(file, arguments.policy)
    clients = list(policies) if arguments.clients is None else arguments.clients
    if unknown := [client for client in clients if client not in policies]:
        raise ValueError(f"--clients: there is no client {unknown[0]} in {file}; it has {', '.join(map(str, policies))}")
    beside = Path() if file.is_relative_to(PRETRAINED) else file.parent
    folder = beside / "policies" if arguments.output is None else arguments.output
    for client in clients:
        for name in arguments.format:
            path = folder / f"client_{client}{SUFFIXES[name]}"
            write_policy(policies[client], path)
            yield path


def _parameter_file(path: Path) -> Path:
    from sb3_fedguide.deployment.site import SITE
    from sb3_fedguide.state.checkpoint_files import checkpoints

    for candidate in (path, path / PARAMETERS, path / SITE / PARAMETERS):
        if candidate.is_file():
            return candidate
    if any(checkpoints(folder) for folder in (path, path / SITE)):
        raise ValueError(f"{path} has no {PARAMETERS} yet: a client writes it after the federation's last round")
    raise ValueError(f"{path} is not a folder of a run or of a deployed client: it has no {PARAMETERS}")


def _policies(file: Path, policy: str) -> dict[int, ClientPolicy]:
    from sb3_fedguide.common.parameters import read_policies

    return read_policies(file, read_deployed(file.parent) if policy == "deployed" else {})
