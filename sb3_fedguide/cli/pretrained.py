"""Runs in the package, by the name of their family: for an evaluation right after the installation."""

from __future__ import annotations

from pathlib import Path

from sb3_fedguide.settings.names import nearest

#: A folder for each, with the files of a run that evaluations read, and `provenance.json` with its origin.
PRETRAINED = Path(__file__).parents[1] / "pretrained"


def shipped_runs() -> dict[str, Path]:
    """Family to the folder of its run."""
    return {folder.name: folder for folder in sorted(PRETRAINED.iterdir()) if folder.is_dir()}


def find_run(given: str | Path) -> Path:
    """The folder or file ``given``, or else the shipped run of that name, in upper or lower case."""
    by_lower = {name.lower(): folder for name, folder in shipped_runs().items()}
    return Path(given) if Path(given).exists() else by_lower.get(str(given).lower(), Path(given))


def no_such_run(given: str | Path) -> str:
    """The end of a message about a folder that does not exist."""
    shipped = shipped_runs()
    return f"; there is no such folder.{nearest(str(given), shipped)} Shipped with this package: {', '.join(shipped)}"
