"""Inputs that lie, made by Hypothesis: whatever comes in, the answer is a sound run, or exit code 2 with one message.

Nothing is on the disk in either case, since a run writes only when it is called, and here it is not.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import fed_envs
from fed_envs.metadata_command import main as metadata_command
from sb3_fedguide.cli.evaluate import main as evaluate
from sb3_fedguide.cli.main import main as fedguide
from sb3_fedguide.cli.train import Run, main
from sb3_fedguide.settings import schema
from sb3_fedguide.settings.config import NESTED, resolve
from sb3_fedguide.settings.networks import StochasticNetworkConfig
from sb3_fedguide.settings.pretraining import PretrainingConfig


def fuzz(max_examples: int) -> settings:
    """A third of the examples, or with ``$FUZZ`` all, as in ``make test-slow``."""
    max_examples = max_examples if os.environ.get("FUZZ") else max_examples // 3
    quiet = [HealthCheck.function_scoped_fixture]
    return settings(max_examples=max_examples, derandomize=True, deadline=None, database=None, suppress_health_check=quiet)


PARTS = {"pretraining": PretrainingConfig, "policy_kwargs": StochasticNetworkConfig}
NAMES = sorted(
    {"policy", "n_rounds", *schema.all_names(), *(f"{part}.{field}" for part in PARTS for field in PARTS[part].model_fields)}
)

ODD_TEXT = st.sampled_from(
    [
        "", " ", "\0", "a\0b", "é", "\U0001d518", "\ud800", "../../etc/passwd", "/", ".", "..", "~nobody/x", "~", "x" * 300,
        "x/" * 2000, "-1", "-", "--", "null", "{client}", "{0}", "%s", "$HOME", "\n", "a\nb", "\udc80", "\x1b[31m",
        "nan", "inf", "1e999", "0x10", "1_000", "true", "lin_", "lin_1e999", "lin_nan", "9" * 400, "9" * 5000,
        "-0.0", "1:30", "2020-13-45", "[1,", "{a: 1}", "*a", "&a [*a]", "!!python/object/apply:os.mkdir [executed]",
        "!!int ''", "!!timestamp x", "!!binary x", "'", '"', "? a", "[]", "{}", "[[[[1]]]]"
    ]
)  # fmt: skip
NUMBERS = st.one_of(
    st.integers(-3, 300), st.integers(), st.floats(), st.sampled_from([2**31, 2**63, 2**64, 10**30, 1e-320, -0.0])
)
TEXT = st.one_of(ODD_TEXT, st.text(max_size=8))
PLAIN = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, TEXT),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(TEXT, inner, max_size=3)),
    max_leaves=6,
)


@pytest.fixture
def refuse(tmp_path, monkeypatch, capfd):
    """Runs a command; it may end with 0, or with 2 and one message that is no traceback, and leaves the disk as it was."""
    monkeypatch.setenv("FEDGUIDE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setattr(Run, "__call__", lambda run: 0)
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)

    def call(command, argv) -> str:
        before = sorted(tmp_path.rglob("*"))
        try:
            code = command(argv)
        except SystemExit as stop:  # argparse
            code = stop.code
        error = capfd.readouterr().err
        assert code in (0, 2)
        assert (code == 0) == (error == ""), error
        assert "Traceback" not in error and len(error) < 20_000
        assert sorted(tmp_path.rglob("*")) == before
        return error

    return call


def argument(text: str) -> str:
    """What a shell can hand over: no NUL, and no surrogate but where a byte was no UTF-8."""
    return text.replace("\0", "").encode("utf-8", "replace").decode()


FLAGS = [
    "--algo", "--env", "--metadata", "--dataset", "-n", "--rounds", "--n-envs-per-client", "-conf", "-params",
    "--seed", "-f", "-tb", "--cache-dir", "--eval-freq", "--eval-episodes", "--device", "--num-threads", "--verbose",
    "--gym-packages", "--unknown"
]  # fmt: skip


@fuzz(150)
@given(flags=st.lists(st.tuples(st.sampled_from(FLAGS), st.one_of(NUMBERS.map(str), TEXT)), min_size=1, max_size=2))
@example(flags=[("-f", "x" * 300)])
@example(flags=[("-tb", "x" * 300)])
@example(flags=[("--cache-dir", "x" * 300)])
@example(flags=[("-conf", "x" * 300)])
@example(flags=[("-conf", ".")])
@example(flags=[("--metadata", "x" * 300)])
@example(flags=[("--env", "../Hopper")])
@example(flags=[("--resume", "x" * 300)])
@example(flags=[("--dataset", "x" * 300)])
@example(flags=[("-n", "9" * 400)])
@example(flags=[("--seed", "-" + "9" * 400)])
@example(flags=[("--num-threads", str(2**40))])
@example(flags=[("--eval-episodes", str(2**40))])
@example(flags=[("--dataset", "~nobody/x")])
@example(flags=[("--gym-packages", ".")])
@example(flags=[("--rounds", "9" * 5000)])
@example(flags=[("--cache-dir", "/dev/null/x")])
def test_flags(flags, refuse):
    argv = [part for flag, value in flags for part in (flag, argument(value))]
    if not any(flag == "--env" for flag, _ in flags):
        argv = ["--env", "Bandit2D", *argv]
    refuse(main, ["--algo", "local", "--verbose", "0", *argv])


@fuzz(250)
@given(
    algo=st.sampled_from(["local", "fedguide", "fedrl", "fedsvrpgm"]),
    params=st.dictionaries(st.one_of(st.sampled_from(NAMES), TEXT), st.one_of(NUMBERS.map(str), TEXT), min_size=1, max_size=2),
)
@example(algo="local", params={"learning_rate": "!!python/object/apply:os.mkdir [executed]"})
@example(algo="local", params={"learning_rate": ".nan"})
@example(algo="local", params={"n_epochs": "9" * 400})
@example(algo="local", params={"learning_rate": "9" * 400})
@example(algo="local", params={"pretraining.dice_v_coef": ".nan"})
@example(algo="local", params={"pretraining.dataset_size": str(10**15)})
@example(algo="local", params={"policy_kwargs.log_std_init": "1e300"})
@example(algo="local", params={"policy_kwargs.net_arch": "[8192" + ", 8192" * 40 + "]"})
@example(algo="local", params={"rollout_size": "true"})
@example(algo="local", params={"policy_kwargs.net_arch": "[" * 3000})
@example(algo="local", params={"policy_kwargs.net_arch": "&a [*a]"})
@example(algo="local", params={"rollout_size": str(10**14)})
@example(algo="local", params={"policy_kwargs.net_arch": f"[{10**9}, {10**9}]"})
@example(algo="fedguide", params={"n_experts": str(10**12)})
@example(algo="fedrl", params={"buffer_size": str(10**15)})
def test_params(algo, params, refuse):
    pairs = [argument(f"{key}:{value}") for key, value in params.items()]
    refuse(main, ["--env", "Bandit2D", "--algo", algo, "--verbose", "0", "-params", *pairs])


@pytest.mark.parametrize(
    "argv",
    [["-params", "policy_kwargs.net_arch:" + "[" * 90_000], ["-params", "x" * 90_000 + ":1"], ["--device", "x" * 90_000]],
)
def test_a_long_value_leaves_a_message_that_can_be_read(argv, refuse):
    error = refuse(main, ["--env", "Bandit2D", "--algo", "local", "--verbose", "0", *argv])
    assert 0 < len(error) < 2500 and error.startswith("train.py: error: ")


BOMB = "\n".join([f"k{i}: &a{i} [{', '.join([f'*a{i - 1}' if i else '1'] * 9)}]" for i in range(12)])
MERGES = "a0: &a0 {x: 1, y: 2}\n" + "\n".join(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}" for i in range(1, 12))
HOSTILE_YAML = [
    b"", b"\xff\xfe\x00", b"\x80abc", b"a: b: c", b"[1, 2]", b"default: 3", b"default: {n_rounds: 1, n_rounds: 2}",
    b"default: !!python/object/apply:os.mkdir [executed]", b"default: {learning_rate: !!python/name:os.mkdir }",
    b"--- \n---\n", b"[" * 5000, b"{a: " * 5000, BOMB.encode(), f"default:\n  {BOMB.splitlines()[0]}".encode(),
    MERGES.encode(), b"default: &a {policy_kwargs: *a}", b"default: {1: 2, null: 3, [1]: 4}",
    b"default: {2020-13-45: 1}", b"default: {x: !!int ''}", b"default: {x: !!timestamp 'x'}",
    b"default: {n_rounds: " + b"9" * 5000 + b"}", b"x: " + b"y" * 2_000_000, b"default: \0"
]  # fmt: skip


@fuzz(60)
@given(content=st.one_of(st.binary(max_size=40), st.text(max_size=40).map(lambda text: text.encode("utf-8", "replace"))))
def test_yaml_of_any_bytes(content, refuse, tmp_path):
    (tmp_path / "mine.yml").write_bytes(content)
    assert refuse(main, ["--env", "Bandit2D", "--algo", "local", "--verbose", "0", "-conf", str(tmp_path / "mine.yml")])


@pytest.mark.parametrize("content", HOSTILE_YAML, ids=range(len(HOSTILE_YAML)))
def test_hostile_yaml(content, refuse, tmp_path):
    (tmp_path / "mine.yml").write_bytes(content)
    error = refuse(main, ["--env", "Bandit2D", "--algo", "local", "-conf", str(tmp_path / "mine.yml")])
    assert "mine.yml" in error and len(error) < 2000


@fuzz(200)
@given(
    algo=st.sampled_from(["local", "fedguide", "fedrl"]),
    entry=st.dictionaries(st.one_of(st.sampled_from([*NAMES, *NESTED]), TEXT), PLAIN, max_size=3),
)
def test_yaml_of_any_values(algo, entry, refuse, tmp_path):
    text = json.dumps({"default": {"n_rounds": 1, "rollout_size": 100, **entry}})  # JSON is YAML
    (tmp_path / "mine.yml").write_text(text)
    refuse(main, ["--env", "Bandit2D", "--algo", algo, "--verbose", "0", "-conf", str(tmp_path / "mine.yml")])


def paths(content, prefix=()):
    """Every place in nested lists and dictionaries."""
    found = [prefix] if prefix else []
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in items:
        found += paths(value, (*prefix, key))
    return found


def replaced(content, path, value):
    content = json.loads(json.dumps(content))
    inner = content
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return content


CONTENTS = {
    name: fed_envs.load_family(name).to_dict() for name in ("Bandit2D", "Hopper", "ReacherHard", "PointMaze", "MetaWorld10")
}
PLACES = st.sampled_from([(name, path) for name, content in CONTENTS.items() for path in paths(content)])


@fuzz(300)
@given(place=PLACES, value=PLAIN, extra=st.one_of(st.none(), st.tuples(TEXT, PLAIN)))
@example(place=("Hopper", ("clients", 3, "mass_scale")), value=float("nan"), extra=None)
@example(place=("Hopper", ("clients", 3, "mass_scale")), value=True, extra=None)
@example(place=("Hopper", ("family",)), value="../x", extra=None)
@example(place=("Hopper", ("family",)), value="Hopper\n", extra=None)
@example(place=("Hopper", ("world",)), value=[], extra=None)
@example(place=("Hopper", ("backbone",)), value={}, extra=None)
@example(place=("Hopper", ("schema_version",)), value=True, extra=None)
@example(place=("Hopper", ("max_episode_steps",)), value=10**30, extra=None)
@example(place=("PointMaze", ("clients", 0, "maze")), value=["#" * 5] * 5, extra=None)
def test_metadata_of_any_values(place, value, extra, refuse, tmp_path):
    name, path = place
    content = replaced(CONTENTS[name], path, value)
    if extra is not None:
        content[extra[0]] = extra[1]
    (tmp_path / "mine.json").write_text(json.dumps(content))
    error = refuse(metadata_command, ["validate", str(tmp_path / "mine.json")])
    trained = refuse(main, ["--metadata", str(tmp_path / "mine.json"), "--algo", "local", "--verbose", "0"]) if error else ""
    assert bool(error) == bool(trained)


HOSTILE_JSON = [
    b"", b"\xff\xfe", b"[]", b"null", b"{", b'{"family": 1, "family": 2}', b"[" * 100_000, b'{"a":' * 100_000,
    b"9" * 5000, b'{"schema_version": 1e999}', b'{"schema_version": 1, "clients": ' + b"9" * 5000 + b"}", b"NaN",
    b'"\\ud800"', b"\xef\xbb\xbf{}"
]  # fmt: skip


@pytest.mark.parametrize("content", HOSTILE_JSON, ids=range(len(HOSTILE_JSON)))
def test_hostile_json(content, refuse, tmp_path):
    (tmp_path / "mine.json").write_bytes(content)
    for command, argv in ((metadata_command, ["validate"]), (main, ["--metadata"])):
        error = refuse(command, [*argv, str(tmp_path / "mine.json")])
        assert "mine.json" in error and len(error.splitlines()) == 1 and len(error) < 2000
    assert refuse(metadata_command, ["validate", str(tmp_path)])  # a folder
    assert refuse(main, ["--metadata", str(tmp_path)])


COMMAND_WORDS = ["generate", "show", "validate", "--family", "Hopper", "--clients", "--seed", "-o", "--name"]


@fuzz(60)
@given(argv=st.lists(st.one_of(st.sampled_from(COMMAND_WORDS), NUMBERS.map(str), TEXT), max_size=6))
@example(argv=["generate", "--family", "Hopper", "--clients", "0"])
@example(argv=["generate", "--family", "Hopper", "--clients", "2", "--seed", "-1"])
@example(argv=["generate", "--family", "Hopper", "--clients", "2", "--seed", str(2**40)])
@example(argv=["generate", "--family", "Hopper", "--clients", "2", "--name", "../x"])
@example(argv=["generate", "--family", "Hopper", "--clients", "2", "-o", "nowhere/x.json"])
def test_metadata_command(argv, refuse):
    argv = [argument(part) for part in argv]
    if "-o" in argv and argv[:1] == ["generate"] and "nowhere/x.json" not in argv:
        argv = ["show", *argv]  # which knows no -o: a sound one would write
    refuse(metadata_command, argv)


@fuzz(40)
@given(dataset=TEXT, metadata=st.one_of(st.none(), PLAIN, st.binary(max_size=20)))
@example(dataset="x", metadata={"data_format": "hdf5", "observation_space": "{}", "action_space": "[]"})
@example(dataset="x", metadata=[])
def test_datasets(dataset, metadata, refuse, tmp_path):
    folder = tmp_path / "minari" / "mine-v0" / "data"
    if metadata is not None:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "metadata.json").write_bytes(metadata if isinstance(metadata, bytes) else json.dumps(metadata).encode())
    for given_name in (argument(dataset), "mine-v0"):
        if given_name and given_name.strip(".") != "":
            assert refuse(main, ["--env", "Bandit2D", "--algo", "local", "--dataset", given_name])


@fuzz(150)
@given(
    entry=st.dictionaries(st.sampled_from(NAMES), PLAIN, max_size=3), algo=st.sampled_from(["local", "fedrl", "fedguide-a"])
)
@example(entry={"pretraining.dice_v_coef": float("inf")}, algo="local")
@example(entry={"pretraining.gamma": 0.5}, algo="local")
@example(entry={"learning_rate": True}, algo="local")
def test_hyperparameters_are_complete_and_sound_or_refused(entry, algo):
    try:
        values = resolve(algo, fed_envs.load_family("Bandit2D"), overrides=entry).values
    except ValueError as error:
        assert str(error) and len(str(error)) < 5000
        return
    assert json.loads(json.dumps(values, allow_nan=False)) == values  # plain data, and finite


RUN_FILES = ("summary.json", "metadata.json", "config.yml", "parameters.npz")


@fuzz(60)
@given(file=st.sampled_from(RUN_FILES), content=st.one_of(PLAIN, st.binary(max_size=30)))
@example(file="summary.json", content={"algo": [], "env": "x", "rounds_done": 1})
@example(file="config.yml", content={"n_rounds": 1, "rollout_size": 10**14})
def test_folders_of_runs(file, content, refuse, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir(exist_ok=True)
    sound = {"summary.json": {"algo": "local", "env": "Bandit2D", "rounds_done": 1}, "metadata.json": CONTENTS["Bandit2D"],
             "config.yml": {"n_rounds": 1, "rollout_size": 100}, "parameters.npz": ""}  # fmt: skip
    for name in RUN_FILES:
        data = content if name == file else sound[name]
        (folder / name).write_bytes(data if isinstance(data, bytes) else json.dumps(data).encode())
    error = refuse(evaluate, [str(folder)])
    assert len(error.splitlines()) == 1


@fuzz(60)
@given(file=st.sampled_from(["args.yml", "config.yml", "metadata.json"]), content=st.one_of(PLAIN, st.binary(max_size=30)))
@example(file="args.yml", content={"algo": "local", "env": "Bandit2D", "rounds": 10**30})
@example(file="args.yml", content={"algo": [], "seed": True})
def test_folders_to_resume(file, content, refuse, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir(exist_ok=True)
    sound = {"args.yml": {"algo": "local", "env": "Bandit2D", "seed": 1}, "config.yml": {"n_rounds": 1, "rollout_size": 100},
             "metadata.json": CONTENTS["Bandit2D"]}  # fmt: skip
    for name, values in sound.items():
        data = content if name == file else values
        (folder / name).write_bytes(data if isinstance(data, bytes) else json.dumps(data).encode())
    refuse(main, ["--resume", str(folder)])


@fuzz(30)
@given(argv=st.lists(TEXT.map(argument), min_size=1, max_size=3))
def test_commands(argv, refuse):
    if argv[0] not in ("-h", "--help", "--version"):
        assert refuse(fedguide, argv)
    assert not Path("executed").exists()
