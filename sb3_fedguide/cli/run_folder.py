"""The folder of one run: its settings, versions, clients and results."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

if TYPE_CHECKING:
    import numpy as np

#: The federation's learned parameters, as plain arrays: see :meth:`Federation.export_parameters`.
PARAMETERS = "parameters.npz"
#: Parameters of the policies before the last exchange.
DEPLOYED = "deployed.npz"
CHECKPOINTS = "checkpoints"
EVALUATIONS = "evaluations.csv"
#: The transport plan of each round, of methods that have one: see :mod:`sb3_fedguide.monitoring.plan`.
PLAN = "plan.csv"
#: The stage of a running run: see :mod:`sb3_fedguide.cli.status`.
STATUS = "status.json"
PACKAGES = (
    "sb3-fedguide", "stable-baselines3", "gymnasium", "gymnasium-robotics", "metaworld", "mujoco", "torch", "numpy", "scipy",
    "POT", "minari", "pydantic", "tensorboard",
)  # fmt: skip


def check_log_folder(folder: Path, what: str = "log folder", flag: str = "-f") -> None:
    """:raises ValueError: if no run could be written below ``folder``; nothing is created"""
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise ValueError(f"the {what} {folder} cannot be made: {existing} is a file; give another one with {flag}")
    if not os.access(existing, os.W_OK):
        raise ValueError(f"the {what} {folder} cannot be written to ({existing}); give another one with {flag}")


def create_run_folder(log_folder: Path, algo: str, family: str) -> Path:
    """Create ``<log_folder>/<algo>/<family>_<n>`` with the next free number."""
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


def events_folder(folder: Path, tensorboard_log: str | None, family: str, algo: str) -> Path:
    """The folder of TensorBoard events of the run in ``folder``.

    TensorBoard names a run by the folder of its events, so they are in the run's own. Runs of an earlier version have them in
    ``tb``, and continue there.

    :param tensorboard_log: the folder from ``--tensorboard-log``
    """
    if tensorboard_log is not None:
        return Path(tensorboard_log) / family / f"{algo}_{folder.name.rsplit('_', 1)[-1]}"
    return folder / "tb" if (folder / "tb").is_dir() else folder


def parameter_file(trained: str) -> Path:
    """A run's parameter file, from its folder or the file's own path.

    :raises ValueError: if there is none
    """
    from sb3_fedguide.cli.pretrained import find_run, no_such_run

    path = find_run(trained).absolute()
    path = path / PARAMETERS if path.is_dir() else path
    if path.suffix == ".zip":
        raise ValueError(
            f"-i {trained}: SB3's archive would be unpickled, which can execute any code; give the run's folder, or the "
            f"{PARAMETERS} beside it (in Python, export_parameters() of the loaded model writes one)"
        )
    if not path.is_file():
        hint = "" if Path(trained).exists() else no_such_run(trained)
        raise ValueError(f"-i {trained}: there is no {path}; give the folder of a trained run, or its {PARAMETERS}{hint}")
    return path


@contextmanager
def exclusive(folder: Path, wait: bool = False) -> Iterator[None]:
    """Lock this run's folder against other processes; the system releases the lock of a process that dies.

    :param wait: wait until the other process releases the lock
    :raises ValueError: if another process has the lock
    """
    try:
        import fcntl
    except ImportError:  # Windows has no such locks
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            raise ValueError(f"the run in {folder} is still going on in another process") from None
        yield
    finally:
        os.close(descriptor)


def write_text(path: Path, text: str) -> None:
    """Write a file that appears complete or not at all."""
    from fed_envs.files import atomic_file

    with atomic_file(path) as file:
        file.write(text)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    write_text(path, json.dumps(content, indent=2) + "\n")


def write_yaml(path: Path, content: Mapping[str, Any]) -> None:
    write_text(path, yaml.safe_dump(dict(content), sort_keys=False, default_flow_style=None))


def write_deployed(folder: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write the deployed policies as plain arrays beside the saved model; complete or not at all."""
    from sb3_fedguide.state.array_files import write_arrays

    write_arrays(folder / DEPLOYED, arrays)


def read_deployed(folder: Path) -> dict[str, np.ndarray]:
    """Read a file of :func:`write_deployed`; empty if the saved model's policies are the deployed ones.

    :raises ValueError: if the file is damaged
    """
    from sb3_fedguide.state.array_files import read_arrays

    return read_arrays(folder / DEPLOYED) if (folder / DEPLOYED).is_file() else {}


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that determine a run's results."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found
