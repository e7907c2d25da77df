"""Disks that are full or read-only, and caches that are damaged, foreign or shared: a clear error or a correct result."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import resource
import shutil
import sys
import traceback
from pathlib import Path

import numpy as np
import pytest

import fed_envs
from fed_envs.files import atomic_file
from sb3_fedguide import Local
from sb3_fedguide.cli.train import main
from sb3_fedguide.common.ppo_policy import StackedActor
from sb3_fedguide.offline import pretraining
from sb3_fedguide.offline.cache import cached_arrays, check_cache_folder, keep_arrays
from sb3_fedguide.offline.datasets import client_datasets, dataset_folder
from sb3_fedguide.offline.pretraining import Pretraining
from sb3_fedguide.settings.pretraining import PretrainingConfig
from sb3_fedguide.state.array_files import read_arrays, write_arrays

TINY = PretrainingConfig(
    dataset_size=40, prior="diffusion", prior_updates=2, prior_width=8, dice_updates=2, dice_width=8, bc_updates=2
)  # fmt: skip
BANDIT = fed_envs.load_family("Bandit2D")


def stage(cache: Path) -> Pretraining:
    return Pretraining("Bandit2D", [0, 2], TINY, seed=3, cache_dir=cache)


def results(cache: Path) -> dict[str, np.ndarray]:
    """Everything that an offline stage gives, by name."""
    from torch import nn

    from sb3_fedguide.state.stacked import stack_module

    made = stage(cache)
    fitted, dice = made.prior(), made.dice()
    actor = StackedActor(stack_module(nn.Sequential(nn.Linear(2, 4), nn.Tanh()), 2), stack_module(nn.Linear(4, 2), 2))
    for parameter in actor.parameters():
        parameter.data.fill_(0.1)
    cloned = made.behavior_cloning(actor)
    arrays = {f"data/{k}/{name}": array for k, data in enumerate(made.datasets()) for name, array in data.arrays().items()}
    arrays |= {f"dice/{name}": tensor.numpy() for name, tensor in dice.state_dict().items()}
    arrays |= {f"trunk/{name}": tensor.numpy() for name, tensor in fitted.prior.state_dict().items()}
    arrays |= {f"cloned/{name}": tensor.numpy() for name, tensor in cloned.items()}
    return {**arrays, "heads": fitted.heads, "moments": fitted.moments}


def assert_same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    assert one.keys() == other.keys()
    for name, array in one.items():
        np.testing.assert_array_equal(array, other[name], err_msg=name)


@pytest.fixture(scope="module")
def kept(tmp_path_factory) -> Path:
    """A cache that nothing is wrong with, to be copied."""
    return tmp_path_factory.mktemp("kept")


@pytest.fixture(scope="module")
def reference(kept) -> dict[str, np.ndarray]:
    return results(kept)


def entries(cache: Path) -> list[Path]:
    return sorted(path for path in cache.rglob("*") if path.is_file())


class FullDisk:
    """Lets so many bytes through, and then has no space left; counts in every file that is written by the atomic writer."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, room: int) -> None:
        self.room = room
        real = os.fdopen

        def fdopen(descriptor, mode="r", *args, **kwargs):
            file = real(descriptor, mode, *args, **kwargs)
            if "w" not in mode:
                return file
            write = file.write

            def limited(data):
                self.room -= len(data)
                if self.room < 0:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                return write(data)

            return _Writer(file, limited)

        monkeypatch.setattr(os, "fdopen", fdopen)


class _Writer:
    def __init__(self, file, write) -> None:
        self.file, self.write = file, write

    def __getattr__(self, name):
        return getattr(self.file, name)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.file.close()


@pytest.mark.parametrize("room", [0, 100, 3000])
def test_a_full_disk_leaves_the_old_file_and_no_half_of_the_new(room, tmp_path, monkeypatch):
    path = tmp_path / "entry.npz"
    write_arrays(path, {"a": np.arange(3.0)})
    with monkeypatch.context() as context:
        FullDisk(context, room)
        with pytest.raises(OSError, match="No space left"):
            write_arrays(path, {"a": np.arange(1000.0)})
        with pytest.raises(OSError, match="No space left"), atomic_file(tmp_path / "text") as file:
            file.write("x" * 5000)
    np.testing.assert_array_equal(read_arrays(path)["a"], np.arange(3.0))
    assert entries(tmp_path) == [path]


def test_files_are_readable_for_those_whom_the_umask_allows(tmp_path):
    before = os.umask(0o027)
    try:
        with atomic_file(tmp_path / "text") as file:
            file.write("x")
        client_datasets(BANDIT, 40, 0, tmp_path, clients=[1])
    finally:
        os.umask(before)
    assert (tmp_path / "text").stat().st_mode & 0o777 == 0o640
    assert dataset_folder(BANDIT, 1, 40, 0, tmp_path).stat().st_mode & 0o777 == 0o750


@pytest.mark.parametrize("room", [0, 2000, 20_000])
def test_the_offline_stage_is_right_when_its_cache_cannot_be_written(room, reference, tmp_path, monkeypatch, caplog):
    with monkeypatch.context() as context:
        FullDisk(context, room)
        assert_same(results(tmp_path), reference)
    assert "could not be kept (No space left on device)" in caplog.text and "--cache-dir" in caplog.text
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".")]
    for path in entries(tmp_path):
        if path.suffix == ".npz":
            read_arrays(path)  # whatever is there is whole
    caplog.clear()
    assert_same(results(tmp_path), reference)
    assert_same(results(tmp_path), reference)
    assert caplog.text == ""


def in_a_process_with_small_files(limit: int, function) -> tuple[int, str]:
    """The exit code and what stood on stderr. The system itself refuses the rest of a file, wherever it is being written."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        code = 99
        try:
            os.close(read)
            sys.stderr = os.fdopen(write, "w")
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            code = function()
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(code)
    os.close(write)
    with os.fdopen(read) as file:
        text = file.read()
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), text


@pytest.mark.parametrize("limit", [1000, 3000, 12_000])
def test_the_cache_of_a_real_file_size_limit(limit, reference, tmp_path):
    def compare() -> int:
        assert_same(results(tmp_path), reference)
        return 0

    assert in_a_process_with_small_files(limit, compare) == (0, "")
    assert all(path.stat().st_size <= limit for path in entries(tmp_path))
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".")]
    assert_same(results(tmp_path), reference)


@pytest.mark.parametrize("damage", ["cut", "empty", "flipped", "folder", "foreign", "renamed", "compressed"])
def test_a_damaged_entry_of_every_piece_is_made_again(damage, reference, kept, tmp_path, caplog):
    shutil.copytree(kept, tmp_path, dirs_exist_ok=True)
    before = {path: path.read_bytes() for path in entries(tmp_path)}
    pieces = [path for path in before if path.parent.parent.name == "pretraining" or path.name == "rows.npz"]
    assert len(pieces) == 1 + 3 * 2 + 4  # the trunk; bc, dice and prior of two clients; and all four clients' data
    for path in pieces:
        content = before[path]
        if damage == "folder":
            path.unlink()
            path.mkdir()
            (path / "file").touch()
        elif damage == "foreign":
            write_arrays(path, {"another": np.zeros(3)})
        elif damage == "renamed":  # sound in itself, but not what stands here
            arrays = read_arrays(path)
            first, *_ = sorted(arrays)
            write_arrays(path, {**arrays, first: np.zeros((*arrays[first].shape, 2))})
        elif damage == "compressed":
            np.savez_compressed(path, **np.load(path))
        else:
            middle = len(content) // 2
            flipped = content[:middle] + bytes([content[middle] ^ 0xFF]) + content[middle + 1 :]
            path.write_bytes({"cut": content[:-30], "empty": b"", "flipped": flipped}[damage])
    caplog.clear()
    assert_same(results(tmp_path), reference)
    assert caplog.text.count("again") >= len(pieces)
    if damage == "folder":  # nothing of somebody else's is removed
        assert all((path / "file").exists() for path in pieces if path.name != "rows.npz")
    else:
        caplog.clear()
        assert_same(results(tmp_path), reference)
        assert caplog.text == ""


def test_an_entry_of_another_version_is_not_taken(reference, tmp_path, monkeypatch):
    results(tmp_path)
    before = set(entries(tmp_path))
    with monkeypatch.context() as context:
        context.setattr(pretraining, "VERSION", pretraining.VERSION + 1)
        results(tmp_path)
    made = set(entries(tmp_path)) - before
    assert {path.parent.name for path in made} == {"trunk", "bc", "dice", "prior"} and len(made) == 7
    monkeypatch.setattr("sb3_fedguide.offline.collect.DATA_VERSION", -1)
    client_datasets(BANDIT, 40, 3, tmp_path, clients=[0])
    assert len(set(entries(tmp_path)) - before - made) == 3


def test_a_missing_cache_is_made_and_a_read_only_one_is_read(reference, tmp_path, monkeypatch, caplog):
    cache = tmp_path / "a" / "b"
    assert_same(results(cache), reference)
    (only_part,) = (cache / "pretraining" / "trunk").iterdir()
    only_part.unlink()

    def refuse(*args, **kwargs):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr("tempfile.mkstemp", refuse)
    monkeypatch.setattr("tempfile.mkdtemp", refuse)
    caplog.clear()
    assert_same(results(cache), reference)
    assert caplog.text.count("could not be kept (Permission denied)") == 1 and only_part.name in caplog.text


def _build(cache: Path, barrier, output: Path) -> None:
    barrier.wait()
    np.savez(output, **results(cache))


def test_processes_that_build_the_same_entries_at_once(reference, tmp_path, tmp_path_factory):
    context = multiprocessing.get_context("fork")
    outputs = [tmp_path_factory.mktemp("outputs") / f"{number}.npz" for number in range(4)]
    barrier = context.Barrier(len(outputs))
    processes = [context.Process(target=_build, args=(tmp_path, barrier, output)) for output in outputs]
    for process in processes:
        process.start()
    for process, output in zip(processes, outputs, strict=True):
        process.join()
        assert process.exitcode == 0
        assert_same(dict(np.load(output)), reference)
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".")]
    assert len(list((tmp_path / "pretraining").rglob("*.npz"))) == 7
    assert len(list((tmp_path / "datasets").rglob("rows.npz"))) == 4
    assert_same(results(tmp_path), reference)


def _write_often(path: str, number: int) -> None:
    for _ in range(60):
        write_arrays(Path(path), {"a": np.full(20_000, float(number))})


def test_readers_beside_writers_see_one_whole_entry(tmp_path):
    path = tmp_path / "entry.npz"
    write_arrays(path, {"a": np.zeros(20_000)})
    context = multiprocessing.get_context("fork")
    writers = [context.Process(target=_write_often, args=(str(path), number)) for number in (1, 2)]
    for writer in writers:
        writer.start()
    seen = set()
    while any(writer.is_alive() for writer in writers):
        array = read_arrays(path)["a"]
        assert (array == array[0]).all()
        seen.add(float(array[0]))
    for writer in writers:
        writer.join()
        assert writer.exitcode == 0
    assert seen & {1.0, 2.0} and entries(tmp_path) == [path]


def test_a_cache_folder_that_cannot_be_is_refused_before_anything_is_written(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").touch()
    (tmp_path / "sealed").mkdir()
    command = ["--env", "Bandit2D", "-f", str(tmp_path / "logs"), "--cache-dir"]
    assert main([*command, str(tmp_path / "file" / "cache")]) == 2
    assert "file is a file; give another one with --cache-dir or $FEDGUIDE_CACHE" in capsys.readouterr().err
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "sealed")  # the tests may run as root
    assert main([*command, str(tmp_path / "sealed" / "cache")]) == 2
    assert "cannot be made in" in capsys.readouterr().err
    check_cache_folder(tmp_path / "sealed")  # its entries can be read
    assert main(["--env", "Bandit2D", "-f", str(tmp_path / "sealed")]) == 2
    assert "cannot be written to" in capsys.readouterr().err
    assert not (tmp_path / "logs").exists() and not list((tmp_path / "sealed").iterdir())
    monkeypatch.undo()
    assert cached_arrays(tmp_path / "file" / "entry.npz", lambda: {"a": np.zeros(1)}) is not None  # a warning, no error
    keep_arrays(tmp_path / "file" / "entry.npz", {"a": np.zeros(1)})
    assert entries(tmp_path) == [tmp_path / "file"]


QUICK = ["--algo", "local", "--env", "Bandit2D", "--rounds", "2", "--verbose", "0", "--eval-episodes", "2"]
SMALL = ["-params", "bc_weight:0", "rollout_size:20", "batch_size:10", "n_envs_per_client:1"]


def test_a_model_is_saved_whole_or_not_at_all(tmp_path):
    model = Local("MlpPolicy", "Bandit2D", rollout_size=20, batch_size=10)
    path = tmp_path / "new" / "model.zip"
    for save, target in ((model.save, path.with_suffix("")), (model.export_parameters, path.with_suffix(".npz"))):
        save(target)
        before = {file: file.read_bytes() for file in entries(tmp_path)}
        code, error = in_a_process_with_small_files(2000, lambda save=save, target=target: save(target))
        assert code == 99 and "File too large" in error
        assert {file: file.read_bytes() for file in entries(tmp_path)} == before
    assert set(before) == {path, path.with_suffix(".npz")}
    Local.load(path.with_suffix(""), env="Bandit2D")


@pytest.mark.parametrize("limit", [30, 500, 3000])
def test_a_run_on_a_disk_that_fills_up_says_so(limit, tmp_path):
    code, error = in_a_process_with_small_files(limit, lambda: main([*QUICK, "-f", str(tmp_path), *SMALL]))
    assert code == 1, error
    (line,) = error.splitlines()
    assert line.startswith("train.py: error: ") and "File too large" in line and line.endswith("earlier files stay")
    folder = tmp_path / "local" / "Bandit2D_1"
    assert not [path for path in folder.rglob("*") if path.name.startswith(".")]
    if (folder / "metadata.json").exists():
        fed_envs.load_family(folder / "metadata.json")
    if (folder / "versions.json").exists():
        json.loads((folder / "versions.json").read_text())


def test_a_log_folder_that_becomes_read_only_says_so(tmp_path, monkeypatch, capsys):
    def refuse(*args, **kwargs):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(tmp_path / "logs"))

    monkeypatch.setattr(Path, "mkdir", refuse)
    assert main([*QUICK, "-f", str(tmp_path / "logs"), *SMALL]) == 1
    assert capsys.readouterr().err == f"train.py: error: {tmp_path / 'logs'}: Read-only file system; earlier files stay\n"
