"""The metadata files, their schema, the generator and its command line."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import fed_envs
from fed_envs import clients, metadata
from fed_envs.generation import PAPER_SEEDS, generate_family
from fed_envs.metadata import Family, load_family, parse_family, read_family
from fed_envs.metadata_command import main
from fed_envs.metadata_figures import ranges, varying_parameters
from fed_envs.registration import METADATA_FOLDER

# SHA-256 of the paper's figures, client by client: canonical JSON of the list of clients, numbers as floats.
PAPER_CLIENTS = {
    "Hopper": "fed03f641c5fe492",
    "Walker2D": "fed03f641c5fe492",
    "HopperHard": "c2553adc427be056",
    "Walker2DHard": "c2553adc427be056",
    "HalfCheetah": "844b96005ad898f1",
    "HalfCheetahHard": "88243fc4c6cfbff6",
    "Reacher": "19086fa0cf63aa38",
    "ReacherHard": "b33b0639f0b60c97",
    "Bandit2D": "44b9b3c0dd32042e",
}

# The paper's Appendix B, to its last printed digit: field -> (smallest, largest, how to print).
PAPER_RANGES = {
    "Hopper": {
        "mass_scale": ("0.972", "1.462", ".3f"),
        "damping_scale": ("0.779", "1.367", ".3f"),
        "friction_scale": ("0.887", "1.267", ".3f"),
        "action_gain": ("0.818", "1.002", ".3f"),
        "forward_reward_weight": ("0.906", "1.095", ".3f"),
        "ctrl_cost_weight": ("9.83e-04", "1.74e-03", ".2e"),
        "instability_cost_weight": ("0.0000", "0.0234", ".4f"),
    },
    "HopperHard": {
        "mass_scale": ("0.862", "1.698", ".3f"),
        "damping_scale": ("0.613", "1.767", ".3f"),
        "friction_scale": ("0.417", "1.476", ".3f"),
        "action_gain": ("0.620", "0.902", ".3f"),
        "forward_reward_weight": ("0.752", "1.339", ".3f"),
        "ctrl_cost_weight": ("6.95e-04", "3.83e-03", ".2e"),
        "instability_cost_weight": ("0.0000", "0.0339", ".4f"),
    },
    "HalfCheetah": {
        "mass_scale": ("0.959", "1.097", ".3f"),
        "damping_scale": ("0.963", "1.156", ".3f"),
        "friction_scale": ("0.940", "1.183", ".3f"),
        "action_gain": ("0.850", "1.023", ".3f"),
        "forward_reward_weight": ("0.948", "1.077", ".3f"),
        "ctrl_cost_weight": ("0.0899", "0.1232", ".4f"),
        "instability_cost_weight": ("0.0000", "0.0000", ".4f"),
        "reset_noise_scale": ("0.0885", "0.1125", ".4f"),
    },
    "HalfCheetahHard": {
        "mass_scale": ("0.943", "1.078", ".3f"),
        "damping_scale": ("0.898", "1.204", ".3f"),
        "friction_scale": ("0.851", "1.376", ".3f"),
        "action_gain": ("0.670", "1.066", ".3f"),
        "forward_reward_weight": ("0.906", "1.102", ".3f"),
        "ctrl_cost_weight": ("0.0919", "0.1391", ".4f"),
        "instability_cost_weight": ("0.0121", "0.0352", ".4f"),
        "reset_noise_scale": ("0.0600", "0.1441", ".4f"),
    },
    "Reacher": {"reward_scale": ("0.621", "1.332", ".3f"), "angle_offset": ("-0.132", "0.188", ".3f")},
    "ReacherHard": {
        "mass_scale": ("0.598", "1.955", ".3f"),
        "damping_scale": ("0.568", "1.923", ".3f"),
        "gear_scale": ("0.587", "1.954", ".3f"),
        "reward_scale": ("0.698", "1.522", ".3f"),
        "angle_offset": ("-0.192", "0.074", ".3f"),
    },
}
# Families that are ours, and how many clients they have.
OWN_FAMILIES = {"MetaWorld10": 10, "PointMaze": 8, "PointMazeHard": 8}
GENERATED = sorted({*PAPER_CLIENTS, "PointMaze", "PointMazeHard"})
PAPER_RANGES["Walker2D"] = PAPER_RANGES["Hopper"]
PAPER_RANGES["Walker2DHard"] = PAPER_RANGES["HopperHard"]


def hopper_hard() -> dict:
    return load_family("HopperHard").to_dict()


def canonical_hash(clients: list[dict]) -> str:
    def as_floats(value):
        if isinstance(value, dict):
            return {key: as_floats(entry) for key, entry in value.items()}
        if isinstance(value, list):
            return [as_floats(entry) for entry in value]
        return float(value) if isinstance(value, (int, float)) else value

    return hashlib.sha256(json.dumps(as_floats(clients), sort_keys=True).encode()).hexdigest()[:16]


@pytest.mark.parametrize("name", sorted(PAPER_CLIENTS))
def test_shipped_families_are_the_papers(name):
    written = json.loads((METADATA_FOLDER / f"{name}.json").read_text())["clients"]
    assert canonical_hash(written) == PAPER_CLIENTS[name]
    for fields, client in zip(written, load_family(name).clients, strict=True):
        assert fields == {field: client.model_dump(mode="json")[field] for field in fields}


@pytest.mark.parametrize(("name", "field"), [(name, field) for name, fields in PAPER_RANGES.items() for field in fields])
def test_shipped_ranges_are_those_of_appendix_b(name, field):
    values = [getattr(client, field) for client in load_family(name).clients]
    smallest, largest, how = PAPER_RANGES[name][field]
    assert (format(min(values), how), format(max(values), how)) == (smallest, largest)


@pytest.mark.parametrize(("name", "norms"), [("Reacher", ("0.265", "1.173")), ("ReacherHard", ("0.412", "1.178"))])
def test_action_offset_norms_are_those_of_appendix_b(name, norms):
    offsets = [np.hypot(*client.action_offset) for client in load_family(name).clients]
    assert (f"{min(offsets):.3f}", f"{max(offsets):.3f}") == norms


def test_every_shipped_file_is_a_family_and_named_after_it():
    assert set(fed_envs.FAMILIES) == {*PAPER_CLIENTS, *OWN_FAMILIES}
    for name in fed_envs.FAMILIES:
        family = load_family(name)
        assert family.name == name
        assert family.n_clients == OWN_FAMILIES.get(name, 4 if name == "Bandit2D" else 8)


def test_data_folder_and_module_of_the_same_name_live_together():
    assert Path(metadata.__file__).name == "metadata.py"
    assert Path(metadata.__file__).with_suffix("").joinpath("HopperHard.json").is_file()
    assert not Path(metadata.__file__).with_suffix("").joinpath("__init__.py").exists()


def test_import_is_light():
    code = "import sys, fed_envs; print([m for m in ('mujoco', 'torch', 'stable_baselines3', 'pydantic') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"


@pytest.mark.parametrize("name", sorted(PAPER_SEEDS))
def test_generator_gives_back_the_papers_families(name):
    assert generate_family(name, 8, PAPER_SEEDS[name], name=name).content_hash == load_family(name).content_hash


@pytest.mark.parametrize("name", GENERATED)
def test_generated_families_are_valid_reproducible_and_all_different(name):
    family = generate_family(name, 30, seed=1)
    assert family.n_clients == 30
    assert family.content_hash == generate_family(name, 30, seed=1).content_hash
    if name == "Bandit2D":
        assert [client.peak for client in family.clients] == [clients.BANDIT2D_PEAKS[k % 4] for k in range(30)]
    else:
        assert family.content_hash != generate_family(name, 30, seed=2, name=family.name).content_hash
        assert len({client.model_copy(update={"client": 0}) for client in family.clients}) == 30


def test_generated_reacher_sectors_spread_over_the_circle():
    family = generate_family("ReacherHard", 12, seed=3)
    assert [client.goal_angle_deg for client in family.clients] == [30.0 * k for k in range(12)]
    for client in family.clients:
        middle = np.degrees(np.arctan2(sum(client.goal_y), sum(client.goal_x))) % 360
        assert abs((middle - client.goal_angle_deg + 180) % 360 - 180) < 3.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("Hoppper", 3, 0), "no presets for 'Hoppper'"),
        (("Hopper", 0, 0), "at least one client"),
        (("Hopper", 3, -1), "seed"),
        (("Hopper", 3, 0, "9 lives"), "family"),
    ],
)
def test_generator_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        generate_family(*arguments)


def changed(**fields) -> dict:
    return {**hopper_hard(), **fields}


def with_client(position: int, **fields) -> dict:
    content = hopper_hard()
    content["clients"][position].update(fields)
    return content


def without(position: int, field: str) -> dict:
    content = hopper_hard()
    del content["clients"][position][field]
    return content


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        (with_client(3, mass_scale=-1.0), ("client 3", "mass_scale", "greater than 0", "-1.0")),
        (with_client(3, mass_scale=float("nan")), ("client 3", "mass_scale", "finite")),
        (with_client(2, ctrl_cost_weight=float("inf")), ("client 2", "ctrl_cost_weight", "finite")),
        (with_client(1, action_gain="0.8"), ("client 1", "action_gain", "valid number")),
        (with_client(1, action_gain=True), ("client 1", "action_gain", "valid number")),
        (with_client(5, masss_scale=1.0), ("client 5", "masss_scale", "not a known field")),
        (without(6, "damping_scale"), ("client 6", "damping_scale", "missing")),
        (with_client(4, client=3), ("client ids", "[0, 1, 2, 3, 3, 5, 6, 7]")),
        (with_client(7, client=8), ("client ids", "8]")),
        (with_client(0, reset_noise_scale=2.0), ("client 0", "reset_noise_scale", "less than or equal to 1")),
        (with_client(0, floor_priority=1), ("client 0", "floor_priority")),
        (changed(clients=[]), ("clients", "at least one")),
        (changed(clients=[3]), ("client ?", "entry 0")),
        (changed(world="ocean"), ("world", "ocean")),
        (changed(backbone="Ant-v5"), ("backbone", "Ant-v5", "Hopper-v5")),
        (changed(max_episode_steps=0), ("max_episode_steps", "greater than or equal to 1")),
        (changed(family="a name"), ("family", "a name")),
        (changed(schema_version=2), ("schema_version", "2")),
        (changed(colour="red"), ("colour", "not a known field")),
        ([], ("JSON object", "list")),
    ],
)
def test_broken_metadata_are_refused_by_file_client_and_field(tmp_path, content, parts):
    path = tmp_path / "broken.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError) as caught:
        load_family(path)
    for part in (str(path), *parts):
        assert part in str(caught.value)


def test_all_problems_are_named_at_once(tmp_path):
    content = with_client(3, mass_scale=-1.0)
    del content["clients"][5]["action_gain"]
    with pytest.raises(ValueError, match=r"(?s)client 3.*mass_scale.*\n.*client 5.*action_gain"):
        parse_family(content, "x")


@pytest.mark.parametrize(
    ("family", "fields", "message"),
    [
        ("Reacher", {"goal_x": [0.2, 0.1]}, "goal_x: the lower bound"),
        ("Reacher", {"goal_x": [0.2, 0.3]}, r"goal_x\.1"),
        ("Reacher", {"goal_x": [0.2, 0.25], "goal_y": [0.2, 0.25]}, "middle of the goal box"),
        ("Reacher", {"goal_x": [0.2]}, "goal_x"),
        ("Reacher", {"action_offset": [1.5, 0.0]}, r"action_offset\.0"),
        ("ReacherHard", {"preference": "lazy"}, "preference"),
        ("Bandit2D", {"peak": [0.5, 0.5]}, "peak: must be one of"),
        ("Bandit2D", {"off_peak_weight": 1.5}, "off_peak_weight"),
    ],
)
def test_broken_clients_of_other_worlds_are_refused(family, fields, message):
    content = load_family(family).to_dict()
    content["clients"][1].update(fields)
    with pytest.raises(ValueError, match=f"client 1.*{message}"):
        parse_family(content, "x")


def test_files_that_are_not_metadata(tmp_path):
    with pytest.raises(ValueError, match=r"cannot read .*No such file"):
        load_family(tmp_path / "missing.json")
    path = tmp_path / "bad.json"
    path.write_text("{]")
    with pytest.raises(ValueError, match=r"bad\.json is not valid JSON"):
        load_family(path)
    path.write_text(json.dumps(hopper_hard()).replace('"world"', '"backbone": "Hopper-v5", "world"', 1))
    with pytest.raises(ValueError, match="'backbone' is given twice"):
        load_family(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="cannot read"):
        load_family(path)


def test_mistyped_names_get_the_nearest():
    for mistyped in ("HoperHard", "hopperhard", "Hopper-Hard"):
        with pytest.raises(ValueError, match="did you mean 'HopperHard'"):
            load_family(mistyped)
    with pytest.raises(ValueError, match="known are Bandit2D"):
        load_family("zzz")


def test_files_come_back_as_they_were_written(tmp_path):
    family = generate_family("ReacherHard", 5, seed=7)
    path = tmp_path / "mine.json"
    family.dump(path)
    assert read_family(path) == family
    assert read_family(path).content_hash == family.content_hash
    assert [entry.name for entry in tmp_path.iterdir()] == ["mine.json"]
    before = path.read_text()
    with pytest.raises(OSError):
        family.dump(tmp_path / "no_such_folder" / "mine.json")
    assert path.read_text() == before


def test_hash_covers_what_defines_the_environments_and_nothing_else():
    content = hopper_hard()
    own = load_family("HopperHard").content_hash
    assert parse_family({**content, "description": "other words"}, "x").content_hash == own
    assert parse_family(with_client(0, mass_scale=0.9158038), "x").content_hash != own
    assert parse_family({**content, "max_episode_steps": 999}, "x").content_hash != own
    # Optional fields written out at their defaults change nothing.
    assert parse_family(with_client(0, floor_priority=False), "x").content_hash == own


def test_parameters_for_all_clients():
    family = load_family("Bandit2D", off_peak_weight=0.1)
    assert [client.off_peak_weight for client in family.clients] == [0.1] * 4
    assert family.content_hash != load_family("Bandit2D").content_hash
    assert load_family(family) is family
    with pytest.raises(ValueError, match="off_peak_wieght"):
        load_family("Bandit2D", off_peak_wieght=0.1)


def test_families_are_frozen():
    family = load_family("HopperHard")
    with pytest.raises(ValueError, match="frozen"):
        family.clients[0].mass_scale = 2.0
    assert isinstance(family, Family)


@pytest.mark.parametrize("client", [8, -1, 1.5, True])
def test_unknown_clients_are_refused(client):
    with pytest.raises(ValueError, match="HopperHard has clients 0 to 7"):
        load_family("HopperHard").client(client)


def test_command_generates_shows_and_validates(tmp_path, capsys):
    path = str(tmp_path / "my.json")
    assert main(["generate", "--family", "HopperHard", "--clients", "16", "--seed", "1", "-o", path]) == 0
    assert load_family(path) == generate_family("HopperHard", 16, 1)
    assert main(["validate", path, "Reacher"]) == 0
    assert main(["show", path]) == 0
    output = capsys.readouterr().out
    assert "HopperHard_16_seed1" in output and "very_heavy" in output and load_family(path).content_hash in output
    assert main(["generate", "--family", "Bandit2D", "--clients", "5", "--name", "Five"]) == 0
    assert parse_family(json.loads(capsys.readouterr().out), "output").name == "Five"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["validate", "HoperHard"], "did you mean 'HopperHard'"),
        (["show", "missing.json"], "No such file"),
        (["generate", "--family", "Nope", "--clients", "3"], "no presets for 'Nope'"),
        (["generate", "--family", "Hopper", "--clients", "3", "-o", "no_such_folder/my.json"], "no_such_folder"),
    ],
)
def test_command_errors_are_one_message(arguments, message, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and error.count("\n") == 1


def test_command_runs_as_a_module(tmp_path):
    command = [sys.executable, "-W", "error", "-m", "fed_envs.metadata", "validate", "broken.json"]
    (tmp_path / "broken.json").write_text(json.dumps(with_client(3, mass_scale=-1.0)))
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env={**os.environ, "PYTHONWARNINGS": ""})
    assert result.returncode == 2
    assert "broken.json: client 3" in result.stderr and "Traceback" not in result.stderr


def test_plot_draws_a_familys_clients_and_how_far_its_hard_one_reaches(tmp_path, capsys):
    assert main(["plot", "Hopper", "MetaWorld10", "-o", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "left out heterogeneity-MetaWorld10" in said and "ranges-Hopper.png" in said
    names = {f"{name}.{kind}" for name in ("heterogeneity-Hopper", "ranges-Hopper") for kind in ("png", "pdf")}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert all(path.stat().st_size > 5000 for path in tmp_path.iterdir())
    assert main(["plot", "Hoper", "-o", str(tmp_path / "none")]) == 2 and not (tmp_path / "none").exists()


def test_ranges_have_a_panel_for_each_number_and_a_dot_for_each_client():
    families = [load_family("Hopper"), load_family("HopperHard")]
    figure = ranges(families)
    names = list(dict.fromkeys(name for family in families for name in varying_parameters(family.clients)[0]))
    panels = {axes.get_title(): axes for axes in figure.axes if axes.get_title()}
    assert list(panels) == [name.replace("_", " ") for name in names]
    for place, family in enumerate(families):
        drawn = panels["mass scale"].get_lines()[place].get_ydata()
        assert drawn.tolist() == [client.mass_scale for client in family.clients]
    with pytest.raises(ValueError, match="Hopper, Reacher are not of one world"):
        ranges([load_family("Hopper"), load_family("Reacher")])
