"""What `make dist` builds: the wheel by itself outside the repository, and the files of wheel and source distribution."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

import sb3_fedguide

pytestmark = pytest.mark.dist

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("fed_envs", "sb3_fedguide", "zoo_configs")
#: For the code host and its continuous integration alone.
NOT_SHIPPED = (".ci/", ".github/", ".gitignore", ".dockerignore")
PROBE = """
import fed_envs, gymnasium, sb3_fedguide, zoo_configs
from sb3_fedguide.offline.behavior import behavior_policy
for module in (fed_envs, sb3_fedguide, zoo_configs):
    print(module.__file__)
for name in fed_envs.FAMILIES:
    family = fed_envs.load_family(name)
    gymnasium.make(f"fed_envs/{name}-v0", client=family.n_clients - 1).reset(seed=0)
for backbone in ("Reacher-v5", "Hopper-v5", "Walker2d-v5", "HalfCheetah-v5"):
    assert len(behavior_policy(backbone).content_hash) > 8
"""


def built(pattern: str) -> Path:
    files = list((ROOT / "dist").glob(pattern))
    assert len(files) == 1, f"dist/{pattern}: {len(files)} files; make dist first"
    return files[0]


def tracked() -> set[str]:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    return {name for name in listed.split("\0") if name and (ROOT / name).exists()}


def variables() -> dict[str, str]:
    """Of the process, without a PYTHONPATH that leads to the checkout."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A new virtual environment with the wheel; what it requires is lent by the one that the tests run in."""
    folder = tmp_path_factory.mktemp("wheel") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    place = Path(sysconfig.get_path("purelib", "venv", {"base": str(folder), "platbase": str(folder)}))
    install = ["-m", "pip", "--disable-pip-version-check", "--python", folder, "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([sys.executable, *install, built("*.whl")], cwd=folder, env=variables(), check=True)
    # after the wheel's own place on the path; a checkout that is installed there as editable is not found this way
    (place / "lent.pth").write_text("\n".join(dict.fromkeys(sysconfig.get_path(kind) for kind in ("purelib", "platlib"))))
    return folder


def in_environment(environment: Path, folder: Path, program: str, *arguments: str) -> str:
    command = [str(environment / "bin" / program), *arguments]
    result = subprocess.run(command, cwd=folder, env=variables(), capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_the_wheel_finds_families_and_behavior_policies(environment: Path, tmp_path: Path) -> None:
    said = in_environment(environment, tmp_path, "python", "-c", PROBE)
    assert all(line.startswith(str(environment)) for line in said.split()) and len(said.split()) == 3


def test_the_wheels_command_trains(environment: Path, tmp_path: Path) -> None:
    assert "usage: fedguide COMMAND" in in_environment(environment, tmp_path, "fedguide", "--help")
    assert in_environment(environment, tmp_path, "fedguide", "--version").strip() == sb3_fedguide.__version__
    in_environment(environment, tmp_path, "fedguide", "train", "--algo", "fedguide", "--env", "Bandit2D", "--rounds", "1",
                   "--eval-episodes", "2", "-f", "logs", "-params", "n_epochs:1", "rollout_size:32", "batch_size:16",
                   "pretraining.bc_updates:2", "pretraining.dice_updates:2", "pretraining.dataset_size:50")  # fmt: skip
    run = tmp_path / "logs" / "fedguide" / "Bandit2D_1"
    assert (run / "summary.json").is_file() and (run / "parameters.npz").is_file()


@pytest.mark.parametrize("conf", ["tuned", "paper"])
def test_the_wheel_has_settings_for_every_method(environment: Path, tmp_path: Path, conf: str) -> None:
    code = (
        "from sb3_fedguide.registry import ALGORITHMS\n"
        "from sb3_fedguide.settings.config import config_path, read_config\n"
        f"print(*[name for name in ALGORITHMS if read_config(config_path({conf!r}, name))])\n"
    )
    assert len(in_environment(environment, tmp_path, "python", "-c", code).split()) >= 11


def test_the_wheel_has_the_packages_files_and_no_others() -> None:
    with zipfile.ZipFile(built("*.whl")) as wheel:
        names = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert names == {name for name in tracked() if name.split("/")[0] in PACKAGES}


def test_the_source_distribution_has_what_is_tracked_and_no_more() -> None:
    with tarfile.open(built("*.tar.gz")) as archive:
        names = {member.name.partition("/")[2] for member in archive if member.isfile()}
    made = {name for name in names if name == "PKG-INFO" or ".egg-info/" in name}
    assert names - made == {name for name in tracked() if not name.startswith(NOT_SHIPPED)}
    assert {"LICENSE", "constraints.txt", "tests/conftest.py", "docs/conf.py", "MANIFEST.in"} <= names


def test_the_metadata_are_complete() -> None:
    with zipfile.ZipFile(built("*.whl")) as wheel:
        (name,) = [name for name in wheel.namelist() if name.endswith(".dist-info/METADATA")]
        metadata = Parser().parsestr(wheel.read(name).decode())
        assert any(name.endswith(".dist-info/licenses/LICENSE") for name in wheel.namelist())
    assert metadata["Version"] == sb3_fedguide.__version__
    assert metadata["License-Expression"] == "MIT"
    for field in ("Author", "Keywords", "Summary", "Requires-Python", "Project-URL", "Classifier"):
        assert metadata[field], field
    assert metadata["Description-Content-Type"] == "text/markdown" and "# sb3-fedguide" in metadata.get_payload()
    requires = metadata.get_all("Requires-Dist")
    assert [line for line in requires if line.startswith("metaworld")] == ['metaworld>=3.1; extra == "metaworld"']
    assert "mujoco!=4.0.0,<5,>=3.3" in requires
