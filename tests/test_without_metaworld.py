"""metaworld holds MuJoCo at 3.3.0, so that it is an extra: without it one family is missed, in one clear line."""

from __future__ import annotations

import sys

import gymnasium
import pytest

import fed_envs
from fed_envs.metadata_command import main as metadata
from sb3_fedguide.cli.main import main

SAYS = r"MetaWorld10 needs metaworld, .*pip install 'sb3-fedguide\[metaworld\]'"


@pytest.fixture(autouse=True)
def no_metaworld(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if it were not installed, and our module that needs it had not been imported."""
    for name in list(sys.modules):
        if name.partition(".")[0] == "metaworld":
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "metaworld", None)
    monkeypatch.delitem(sys.modules, "fed_envs.metaworld10", raising=False)
    monkeypatch.delitem(vars(fed_envs), "metaworld10", raising=False)


def test_environments_of_metaworld10_say_what_to_install() -> None:
    family = fed_envs.load_family("MetaWorld10")
    for make in (
        lambda: gymnasium.make("fed_envs/MetaWorld10-v0", client=0),
        lambda: gymnasium.make_vec("fed_envs/MetaWorld10-v0", client=0, num_envs=1),
        lambda: family.make(0),
        lambda: fed_envs.FederatedVecEnv(family),
    ):
        with pytest.raises(ValueError, match=SAYS):
            make()


@pytest.mark.parametrize(
    "command",
    [
        "train --algo local --env MetaWorld10 --rounds 1",
        "train --algo fedguide --env MetaWorld10 --rounds 1",
        "train --algo fedrl --env fed_envs/MetaWorld10-v0 --rounds 1",
        "train --algo local --env MetaWorld10 --rounds 1 --engine processes",
        "benchmark --algos local --envs MetaWorld10 --seeds 0 --rounds 1",
        "tune --algo local --env MetaWorld10 --n-trials 1",
    ],
)
def test_the_commands_say_it_in_one_line_and_write_nothing(command, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    try:
        code = main(command.split())
    except SystemExit as stopped:
        code = stopped.code
    said = capsys.readouterr().err
    assert code == 2 and said.count("\n") == 1
    assert "MetaWorld10 needs metaworld" in said and "sb3-fedguide[metaworld]" in said
    assert not list(tmp_path.iterdir())


def test_other_families_are_as_ever(capsys) -> None:
    for name in fed_envs.FAMILIES:
        if name != "MetaWorld10":
            env = gymnasium.make(f"fed_envs/{name}-v0", client=0)
            env.reset(seed=0)
            env.close()
    assert "fed_envs/MetaWorld10-v0" in gymnasium.registry  # the family is there, in tables and metadata
    assert metadata(["show", "MetaWorld10"]) == 0
