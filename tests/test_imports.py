"""What is asked for quickly is there quickly: names are loaded when they are first used."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
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


RESOLVED = """
import sys
import fed_envs
from sb3_fedguide.cli.train import main
from sb3_fedguide.registry import ALGORITHMS
from sb3_fedguide.settings.config import CONFIGURATIONS, resolve
for algo in ALGORITHMS:
    for conf in CONFIGURATIONS:
        resolve(algo, fed_envs.load_family("HopperHard"), conf, overrides={"gamma": 0.9})
assert main(["--env", "HopperHard", "-params", "gama:1"]) == main(["--env", "HopperHard", "-params", "gamma:2"]) == 2
print(sorted({"torch", "stable_baselines3", "mujoco"} & set(sys.modules)))
"""


def test_hyperparameters_are_resolved_and_refused_without_pytorch() -> None:
    result = subprocess.run([sys.executable, "-c", RESOLVED], cwd=ROOT, check=True, capture_output=True, text=True)
    assert result.stdout == "[]\n"


def test_every_public_name_can_be_loaded() -> None:
    for name in sb3_fedguide.__all__:
        assert getattr(sb3_fedguide, name) is not None
    assert set(sb3_fedguide._LAZY) | {"__version__"} == set(sb3_fedguide.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        _ = sb3_fedguide.Nothing


#: From the lowest: what stands before may be imported, nothing that stands behind.
LAYERS = (
    "fed_envs", "settings", "state", "server", "priors", "offline", "common", "algorithms", "engines", "benchmark",
    "monitoring", "deployment", "cli",
)  # fmt: skip
#: Modules of the package itself that import nothing above them.
LOWEST = ("registry", "seeding", "exit_codes")


def imported_at_run_time(tree: ast.AST) -> Iterator[str]:
    """Names that a module imports anywhere, without those for type hints alone."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        yield from imported_at_run_time(node)


def room(name: str) -> str:
    package, *rest = name.split(".")
    return "fed_envs" if package == "fed_envs" or not rest or rest[0] in (*LOWEST, "__version__") else rest[0]


@pytest.mark.parametrize("package", LAYERS)
def test_imports_run_down(package: str) -> None:
    paths = [ROOT / "sb3_fedguide" / f"{name}.py" for name in LOWEST] if package == "fed_envs" else []
    paths += (ROOT / package if package == "fed_envs" else ROOT / "sb3_fedguide" / package).rglob("*.py")
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in paths
        for name in imported_at_run_time(ast.parse(path.read_text(encoding="utf-8")))
        if name.startswith(("sb3_fedguide", "fed_envs")) and LAYERS.index(room(name)) > LAYERS.index(package)
    ]
    assert not wrong


def test_every_package_has_its_layer() -> None:
    packages = {path.parent.name for path in (ROOT / "sb3_fedguide").glob("*/__init__.py")}
    assert packages == set(LAYERS) - {"fed_envs"}


def test_test_modules_do_not_import_each_other() -> None:
    """What several tests need is in a module of its own; importing a test module repeats its tests' set-up."""
    for path in (ROOT / "tests").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = []
            if isinstance(node, ast.ImportFrom):
                module = "." * node.level + (node.module or "")
                names = [module, *(f"{module}.{alias.name}" for alias in node.names)]
            elif isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            for name in names:
                assert not any(part.startswith("test_") for part in name.split(".")), f"{path.name} imports {name}"


def test_plain_data_has_one_import_path() -> None:
    from fed_envs import plain_data, state

    assert not set(state.__all__) & set(vars(plain_data))
    for path in [*(ROOT / "sb3_fedguide").rglob("*.py"), *(ROOT / "fed_envs").glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module == "fed_envs.state":
                assert {alias.name for alias in node.names} <= {*state.__all__, "IDENTITY"}, path
