"""The pull command: download a shared run from the Hugging Face hub, and check it before it becomes a folder here."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_fedguide.cli.arguments import OneLineParser
from sb3_fedguide.cli.hub import FILES, NEEDED, check_repository, check_run, hub_answers, hub_api, hub_errors

if TYPE_CHECKING:
    from huggingface_hub import HfApi

#: Bytes per read, so that an answer that is longer than announced is stopped soon.
CHUNK = 65_536


def main(argv: Sequence[str] | None = None, prog: str = "fedguide pull") -> int:
    """Run the command.

    :return: the exit code: 0, or 2 for wrong input and if the hub does not answer
    """
    parser = _parser(prog)
    arguments = parser.parse_strictly(argv)
    try:
        folder = load_from_hub(arguments.repository, arguments.folder, arguments.revision, arguments.gym_packages)
    except (ValueError, OSError) as error:
        parser.error(" ".join(str(error).split()))
    print(f"wrote {folder}")
    print(f"try: fedguide evaluate {folder}")
    return 0


def _parser(prog: str) -> OneLineParser:
    parser = OneLineParser(prog=prog, description=__doc__)
    flag = parser.add_argument
    flag("repository", metavar="OWNER/NAME", help="a repository on the hub that 'fedguide push' made")
    flag("-f", "--folder", type=Path, default=Path("logs"), metavar="DIR", help="the run goes to DIR/ALGO/FAMILY_<number>; "
         "logs by default")  # fmt: skip
    flag("--revision", metavar="R", help="a branch, tag or commit; the newest by default")
    flag("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules to import first; they register your own "
         "algorithms or environments")  # fmt: skip
    return parser


def load_from_hub(
    repository: str, folder: str | Path = "logs", revision: str | None = None, packages: Sequence[str] = ()
) -> Path:
    """Download a run, check it, and write it; nothing of it is unpickled or imported, and no part of a refused run stays.

    :param repository: ``OWNER/NAME``
    :param folder: the run goes to ``<folder>/<algo>/<family>_<number>``, with the next free number
    :param revision: a branch, tag or commit; the newest by default
    :param packages: modules to import first, which register its algorithm or environments
    :return: the run's folder
    :raises ValueError: if the hub has no such run or does not answer, and for files that are too large, damaged, or do not
        belong together
    :raises OSError: if it cannot be written
    """
    from sb3_fedguide.cli.run_folder import check_log_folder, create_run_folder

    check_repository(repository)
    check_log_folder(Path(folder))
    api = hub_api()
    Path(folder).mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(prefix=".pull-", dir=folder))
    try:
        with hub_errors(api, repository, revision):
            _fetch(api, repository, revision, part)
        try:
            run, _, family = check_run(part, packages)
        except ValueError as error:
            raise ValueError(str(error).replace(str(part), repository)) from None
        target = create_run_folder(Path(folder), run["algo"], family.name)
        os.chmod(part, target.stat().st_mode)  # mkdtemp makes folders private
        os.replace(part, target)
        return target
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _fetch(api: HfApi, repository: str, revision: str | None, folder: Path) -> None:
    """Download the repository's files of a run, all of one commit.

    :raises ValueError: if one is missing or too large
    """
    with hub_answers(api):
        commit = api.model_info(repository, revision=revision, expand=["sha"]).sha
        found = {file.path: int(file.size) for file in api.get_paths_info(repository, list(FILES), revision=commit)
                 if hasattr(file, "size")}  # fmt: skip
    if missing := [name for name in NEEDED if name not in found]:
        raise ValueError(f"{repository} is not a run from 'fedguide push': it has no {missing[0]}")
    for name, bound in FILES.items():  # other files of the answer are ignored
        if name in found:
            if found[name] > bound:
                raise ValueError(f"{name} of {repository} has {found[name]} bytes; the limit is {bound}")
            _download(api, repository, str(commit), name, folder / name)


def _download(api: HfApi, repository: str, commit: str, name: str, path: Path) -> None:
    """:raises ValueError: if the file is too long, whatever its announced size"""
    from huggingface_hub import get_session, hf_hub_url
    from huggingface_hub.utils import build_hf_headers, hf_raise_for_status

    url = hf_hub_url(repository, name, revision=commit, endpoint=api.endpoint)
    headers = {**build_hf_headers(library_name=api.library_name, library_version=api.library_version),
               "Accept-Encoding": "identity"}  # fmt: skip
    n_bytes = 0
    with get_session().stream("GET", url, headers=headers, follow_redirects=True) as response, path.open("wb") as file:
        hf_raise_for_status(response)
        for chunk in response.iter_bytes(CHUNK):
            n_bytes += len(chunk)
            if n_bytes > FILES[name]:
                raise ValueError(f"{name} of {repository} is longer than the limit of {FILES[name]} bytes")
            file.write(chunk)
