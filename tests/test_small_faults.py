"""Slips in names and files: one line that helps, or nothing."""

from __future__ import annotations

import sys

import gymnasium
import pytest

import fed_envs
from fed_envs import registration
from fed_envs.metadata import parse_family
from sb3_fedguide.cli.main import main
from sb3_fedguide.settings.names import nearest

FLAGS = ["--num-threads", "--env", "--algo", "--n-timesteps", "--eval-freq", "--progress"]


@pytest.mark.parametrize(
    ("given", "meant"),
    [("--track", None), ("--x", None), ("--num-thread", "--num-threads"), ("--eval-frq", "--eval-freq"), ("--ENV", "--env")],
)
def test_a_suggestion_is_near_or_there_is_none(given, meant):
    assert nearest(given, FLAGS) == ("" if meant is None else f" Did you mean {meant!r}?")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"clients": None}, "clients: is missing"),
        ({"schema_version": True}, "schema_version: this version .* has True"),
        ({"max_episode_steps": 10**40}, "max_episode_steps: .*less than 2147483648"),
        ({"family": "A" * 300}, "family: .*at most 100 characters"),
    ],
)
def test_metadata_that_are_wrong_name_the_field(change, message):
    content = {**fed_envs.load_family("Hopper").to_dict(), **change}
    with pytest.raises(ValueError, match=message):
        parse_family({name: value for name, value in content.items() if value is not None}, "file.json")


def test_a_way_of_rendering_that_is_not_installed_is_one_message(monkeypatch, capsys):
    def broken(module):
        raise AttributeError("'NoneType' object has no attribute 'glGetError'")

    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.delitem(sys.modules, "mujoco", raising=False)
    monkeypatch.setattr(registration, "import_module", broken)
    with pytest.raises(ValueError, match=r"MUJOCO_GL=osmesa \(AttributeError: .*libosmesa6.*unset MUJOCO_GL"):
        registration.environment_class("locomotion")
    for make in (lambda: fed_envs.load_family("Hopper").make(0), lambda: gymnasium.make("fed_envs/Hopper-v0", client=0)):
        with pytest.raises(ValueError, match="MUJOCO_GL=osmesa"):
            make()
    assert main(["train", "--env", "Hopper", "--rounds", "1"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
