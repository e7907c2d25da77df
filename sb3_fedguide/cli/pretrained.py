"""Runs that come with the package, by the name of their family: something to evaluate right after installing."""

from __future__ import annotations

from pathlib import Path

from sb3_fedguide.settings.names import nearest

#: A folder for each, with those of a run's files that evaluations read, and `provenance.json`: where they come from.
PRETRAINED = Path(__file__).parents[1] / "pretrained"


def shipped_runs() -> dict[str, Path]:
    """Family to the folder of its run."""
    return {folder.name: folder for folder in sorted(PRETRAINED.iterdir()) if folder.is_dir()}


def find_run(given: str | Path) -> Path:
    """The folder or file that ``given`` is, or else the shipped run of that name, in any case of letters."""
    by_lower = {name.lower(): folder for name, folder in shipped_runs().items()}
    return Path(given) if Path(given).exists() else by_lower.get(str(given).lower(), Path(given))


def no_such_run(given: str | Path) -> str:
    """What to add to a message about a folder that does not exist."""
    shipped = shipped_runs()
    return f"; there is no such folder.{nearest(str(given), shipped)} Shipped with this package: {', '.join(shipped)}"
