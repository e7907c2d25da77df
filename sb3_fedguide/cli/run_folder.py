"""The folder of one run: what was asked for, with which versions, on whose data, and what came out."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import re
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

if TYPE_CHECKING:
    import numpy as np

#: Parameters of the policies before the last exchange.
DEPLOYED = "deployed.npz"
PACKAGES = (
    "sb3-fedguide", "stable-baselines3", "gymnasium", "gymnasium-robotics", "metaworld", "mujoco", "torch", "numpy", "scipy",
    "POT", "minari", "pydantic", "tensorboard",
)  # fmt: skip


def check_log_folder(folder: Path) -> None:
    """:raises ValueError: if no run could be written below ``folder``; nothing is created"""
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise ValueError(f"the log folder {folder} cannot be made: {existing} is a file; give another one with -f")
    if not os.access(existing, os.W_OK):
        raise ValueError(f"the log folder {folder} cannot be written to ({existing}); give another one with -f")


def create_run_folder(log_folder: Path, algo: str, family: str) -> Path:
    """``<log_folder>/<algo>/<family>_<n>`` with the next free number, claimed by its creation."""
    parent = log_folder / algo
    parent.mkdir(parents=True, exist_ok=True)
    pattern = re.compile(rf"{re.escape(family)}_(\d+)")
    taken = [int(match[1]) for path in parent.iterdir() if (match := pattern.fullmatch(path.name))]
    number = max(taken, default=0) + 1
    while True:  # a run that starts at the same moment may take the number first
        folder = parent / f"{family}_{number}"
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            number += 1


def write_text(path: Path, text: str) -> None:
    """The file appears complete or not at all."""
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".part")
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)  # mkstemp makes files private
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    write_text(path, json.dumps(content, indent=2) + "\n")


def write_yaml(path: Path, content: Mapping[str, Any]) -> None:
    write_text(path, yaml.safe_dump(dict(content), sort_keys=False, default_flow_style=None))


def write_deployed(folder: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """The policies that the clients deploy, as plain arrays beside the saved model; complete or not at all."""
    import numpy as np

    temporary = folder / f"{DEPLOYED}.part"
    with temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    temporary.replace(folder / DEPLOYED)


def read_deployed(folder: Path) -> dict[str, np.ndarray]:
    """What :func:`write_deployed` wrote; nothing where the saved model's policies are the deployed ones.

    :raises ValueError: if the file is damaged
    """
    import zipfile

    import numpy as np

    if not (folder / DEPLOYED).is_file():
        return {}
    try:
        with np.load(folder / DEPLOYED, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (ValueError, OSError, zipfile.BadZipFile) as error:
        raise ValueError(f"{folder / DEPLOYED} cannot be read: {error}") from None


def versions() -> dict[str, str]:
    """Of Python and the packages that decide what a run computes."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found
