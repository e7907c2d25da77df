"""What is asked for quickly is there quickly: names are loaded when they are first used."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import sb3_fedguide

ROOT = Path(__file__).resolve().parent.parent
HEAVY = {
    "torch",
    "optuna",
    "sqlalchemy",
    "wandb",
    "trackio",
    "mujoco",
    "stable_baselines3",
    "gymnasium",
    "numpy",
    "scipy",
    "ot",
    "matplotlib",
    "minari",
}


def imported_by(*command: str) -> set[str]:
    """Top-level packages that a fresh interpreter imports, by its own account."""
    result = subprocess.run(
        [sys.executable, "-X", "importtime", *command], cwd=ROOT, check=True, capture_output=True, text=True
    )
    lines = [line for line in result.stderr.splitlines() if line.startswith("import time:")]
    return {line.rpartition("|")[2].strip().partition(".")[0] for line in lines}


@pytest.mark.parametrize(
    "command", [("-c", "import sb3_fedguide"), ("train.py", "--help"), ("-m", "sb3_fedguide", "tune", "--help")], ids=" ".join
)
def test_package_and_help_load_nothing_heavy(command: tuple[str, ...]) -> None:
    names = imported_by(*command)
    assert "sb3_fedguide" in names
    assert not HEAVY & names


def test_every_public_name_can_be_loaded() -> None:
    for name in sb3_fedguide.__all__:
        assert getattr(sb3_fedguide, name) is not None
    assert set(sb3_fedguide._LAZY) | {"__version__"} == set(sb3_fedguide.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        _ = sb3_fedguide.Nothing
