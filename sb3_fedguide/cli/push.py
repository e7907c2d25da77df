"""The push command: upload a finished run to the Hugging Face hub, as plain arrays and texts with a model card; no pickle."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.cli.arguments import OneLineParser
from sb3_fedguide.cli.hub import (
    CARD,
    CURVE,
    FILES,
    LOGIN,
    RefusedError,
    check_repository,
    check_run,
    hub_answers,
    hub_api,
    hub_errors,
)
from sb3_fedguide.cli.run_folder import EVALUATIONS, write_text, write_yaml

if TYPE_CHECKING:
    from huggingface_hub import HfApi

    from fed_envs import Family


def main(argv: Sequence[str] | None = None, prog: str = "fedguide push") -> int:
    """Run the command.

    :return: the exit code: 0, or 2 for wrong input and if the hub does not answer
    """
    parser = _parser(prog)
    arguments = parser.parse_strictly(argv)
    try:
        url = push_to_hub(arguments.run, arguments.repository, arguments.private, arguments.message, arguments.gym_packages)
    except (ValueError, OSError) as error:
        parser.error(" ".join(str(error).split()))
    print(f"sent {arguments.run} to {url}")
    return 0


def _parser(prog: str) -> OneLineParser:
    parser = OneLineParser(prog=prog, description=__doc__)
    flag = parser.add_argument
    flag("run", metavar="RUN", type=Path, help="folder of a run, e.g. logs/fedguide/HopperHard_1")
    flag("repository", metavar="OWNER/NAME", help="repository on the hub; made if there is none")
    flag("--private", action="store_true", help="only you and people with your permission can see it")
    flag("-m", "--message", metavar="TEXT", help="commit message; by default method, family and rounds")
    flag("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules to import first; they register your own "
         "algorithms or environments")  # fmt: skip
    return parser


def push_to_hub(
    folder: str | Path,
    repository: str,
    private: bool = False,
    message: str | None = None,
    packages: Sequence[str] = (),
) -> str:
    """Upload a run: its parameters, settings, clients' metadata, evaluations, and a model card.

    :param folder: of the run
    :param repository: ``OWNER/NAME``
    :param private: whether a new repository is private
    :param message: of the commit
    :param packages: modules to import first, which register its algorithm or environments
    :return: the address of the repository
    :raises ValueError: for a folder of something else, for a run that 'fedguide pull' would refuse, and if the hub refuses or
        does not answer
    """
    check_repository(repository)
    if message is not None and not message.strip():
        raise ValueError("-m: the message is empty; leave it out for the default, which names method and family")
    api = hub_api()
    from huggingface_hub import get_token

    if get_token() is None:
        raise ValueError(f"there is no token for the hub: {LOGIN}")
    try:
        run, config, family = check_run(Path(folder), packages)
    except RefusedError as error:
        raise ValueError(f"nothing is sent, since 'fedguide pull' would refuse the run: {error}") from None
    with tempfile.TemporaryDirectory() as part:
        _collect(Path(folder), Path(part), repository, run, config.values, family, packages)
        with hub_errors(api, repository):
            return _send(api, repository, Path(part), private, message or f"{run['algo']} on {run['env']}, "
                         f"{run['rounds_done']} rounds")  # fmt: skip


def _collect(
    folder: Path,
    part: Path,
    repository: str,
    run: Mapping[str, Any],
    values: Mapping[str, Any],
    family: Family,
    packages: Sequence[str],
) -> None:
    """Exactly the files to upload, in their own folder.

    :raises ValueError: if one is larger than 'fedguide pull' accepts
    """
    from sb3_fedguide.cli.model_card import draw_curve, write_card

    for name in FILES:
        if name not in (CARD, CURVE) and (folder / name).is_file():
            shutil.copyfile(folder / name, part / name)
    write_yaml(part / "config.yml", _without_paths(values))
    if "deployed" in run and (part / EVALUATIONS).is_file():
        draw_curve(folder, part / CURVE)
    write_text(part / CARD, write_card(part, repository, run, family, packages))
    for path in part.iterdir():
        if path.stat().st_size > FILES[path.name]:
            raise ValueError(
                f"{path.name} has {path.stat().st_size} bytes; the limit of 'fedguide pull' is {FILES[path.name]}"
            )


def _without_paths(values: Mapping[str, Any]) -> dict[str, Any]:
    """The settings, with only the name of a local dataset's folder: the path stays private."""
    offline = dict(values["pretraining"])
    if offline["dataset"] is not None and Path(offline["dataset"]).is_absolute():
        offline["dataset"] = Path(offline["dataset"]).name
    return {**values, "pretraining": offline}


def _send(api: HfApi, repository: str, folder: Path, private: bool, message: str) -> str:
    """One commit with the run's files; files of an earlier run that this one does not have are removed."""
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete

    with hub_answers(api):
        url = api.create_repo(repository, private=private or None, exist_ok=True)
        hidden = private and api.model_info(repository, expand=["private"]).private
        there = {file.path for file in api.get_paths_info(repository, list(FILES))}
    if private and not hidden:
        raise ValueError(f"{repository} exists already and is not private; make it private on {url}, or leave --private out")
    sent = sorted(path.name for path in folder.iterdir())
    changes: list[CommitOperationAdd | CommitOperationDelete] = [
        *(CommitOperationAdd(name, folder / name) for name in sent),
        *(CommitOperationDelete(name) for name in sorted(there & FILES.keys() - set(sent))),
    ]
    with hub_answers(api):
        api.create_commit(repository, changes, commit_message=message)
    return str(url)
