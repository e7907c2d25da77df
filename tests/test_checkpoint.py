"""The checkpoint file: what goes in comes out, nothing is unpickled, nothing damaged is used, a write is all or nothing."""

from __future__ import annotations

import errno
import json
import os
import pickle
import zipfile

import numpy as np
import pytest

import sb3_fedguide.common.checkpoint as checkpoint_module
from fed_envs.plain_data import freeze, thaw
from sb3_fedguide import FedAvg
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.checkpoint import (
    CheckpointCallback,
    CheckpointError,
    checkpoints,
    newest_checkpoint,
    read_checkpoint,
    write_checkpoint,
)
from sb3_fedguide.state.array_files import read_arrays, write_arrays
from tests.comparisons import same
from tests.environments import CountingEnv

STATE = {
    "numbers": [1, 0.1, None, True, "text"],
    "arrays": {"a": np.arange(6.0).reshape(2, 3), "none": np.zeros((0, 2), dtype=np.float32), "flag": np.array(True)},
    "list": [np.array([1], dtype=np.uint8), {"deep": np.array(-0.0)}],
    "a/b": np.ones(1),
    "a": {"b": np.zeros(1)},  # the same path as the one before
}


def test_what_goes_in_comes_out(tmp_path):
    path = write_checkpoint(tmp_path, 7, STATE)
    assert path.name == "round_000007.npz" and [file.name for file in tmp_path.iterdir()] == [path.name]
    assert same(read_checkpoint(path), STATE)
    odd = freeze({"client": {3: np.arange(2.0)}, "own": {"__type__": "array", "name": "state.json"}, "inf": float("inf")})
    back = thaw(read_checkpoint(write_checkpoint(tmp_path, 8, odd)))
    assert back["client"][3].tolist() == [0, 1] and back["own"] == {"__type__": "array", "name": "state.json"}
    assert back["inf"] == float("inf")


def test_the_file_is_json_and_plain_arrays(tmp_path):
    with np.load(write_checkpoint(tmp_path, 1, STATE), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    assert not any(array.dtype.hasobject for array in arrays.values())
    assert json.loads(arrays["state.json"].tobytes())["state"]["numbers"] == STATE["numbers"]


def test_states_that_are_no_plain_data_are_refused(tmp_path):
    for value in (object(), {1, 2}, float("nan")):
        with pytest.raises((TypeError, ValueError)):
            write_checkpoint(tmp_path, 1, {"value": value})
    assert checkpoints(tmp_path) == []


def test_the_last_two_stay(tmp_path):
    for round in (8, 9, 10, 100):
        write_checkpoint(tmp_path, round, {"round": round})
    (tmp_path / "round_000200.npz.part").write_bytes(b"")
    (tmp_path / "notes.txt").write_text("mine")
    assert [path.name for path in checkpoints(tmp_path)] == ["round_000010.npz", "round_000100.npz"]
    path, state = newest_checkpoint(tmp_path)
    assert path.name == "round_000100.npz" and state == {"round": 100}
    assert newest_checkpoint(tmp_path / "nowhere") is None


def _truncated(content: bytes) -> bytes:
    return content[: len(content) // 2]


def _flipped(content: bytes) -> bytes:
    middle = content.index(np.arange(6.0).tobytes()) + 20
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


DAMAGES = {
    "empty": lambda content: b"",
    "truncated": _truncated,
    "one byte short": lambda content: content[:-1],
    "one bit": _flipped,
    "text": lambda content: b"not a zip file at all",
    "pickle": lambda content: pickle.dumps({"round": 1}),
    "zeros": lambda content: bytes(len(content)),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_newest_one_falls_back_with_a_warning(tmp_path, damage):
    write_checkpoint(tmp_path, 1, {**STATE, "round": 1})
    newest = write_checkpoint(tmp_path, 2, {**STATE, "round": 2})
    newest.write_bytes(DAMAGES[damage](newest.read_bytes()))
    with pytest.warns(UserWarning, match=r"round_000002\.npz is damaged.*resuming from the one before it, round_000001\.npz"):
        path, state = newest_checkpoint(tmp_path)
    assert path.name == "round_000001.npz" and state["round"] == 1
    path.write_bytes(b"")
    with pytest.raises(ValueError, match=r"no checkpoint can be read: .*round_000002.*round_000001"):
        newest_checkpoint(tmp_path)


@pytest.mark.parametrize("place", range(0, 100, 7))
def test_no_flipped_bit_goes_unnoticed(tmp_path, place):
    path = write_checkpoint(tmp_path, 1, STATE)
    content = bytearray(path.read_bytes())
    position = len(content) * place // 100
    content[position] ^= 0x10
    path.write_bytes(content)
    try:
        state = read_checkpoint(path)
    except ValueError:
        return
    assert same(state, STATE)  # a bit that means nothing, such as one of a date in the zip file


class Bomb:
    def __reduce__(self):
        return os.mkdir, ("exploded",)


def test_a_crafted_file_executes_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write_checkpoint(tmp_path / "checkpoints", 1, STATE)
    crafted = np.array([Bomb()], dtype=object)
    with path.open("wb") as file:
        np.savez(file, **{"state.json": crafted}, allow_pickle=True)
    with pytest.raises(ValueError, match="damaged"):
        read_checkpoint(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("state.json.npy", pickle.dumps(Bomb()))
    with pytest.raises(ValueError, match=r"damaged|no checkpoint"):
        read_checkpoint(path)
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"format": 2, "state": {}}', "format 2 and this version reads 3: resume it with the version of the package"),
        ('{"state": {}}', "not a checkpoint"),
        ('{"format": 3, "state": {"x": {"__type__": "array", "name": "gone"}}}', "not a checkpoint"),
        ("[1", "not a checkpoint"),
        ("[]", "not a checkpoint"),
        (None, "not a checkpoint"),
    ],
)
def test_other_content_is_refused(tmp_path, text, message):
    arrays = {} if text is None else {"state.json": np.frombuffer(text.encode(), dtype=np.uint8)}
    write_arrays(tmp_path / "round_000001.npz", arrays)
    with pytest.raises(ValueError, match=message):
        read_checkpoint(tmp_path / "round_000001.npz")


@pytest.mark.parametrize("failure", ["write", "fsync", "replace"])
def test_a_write_that_fails_leaves_what_was_there(tmp_path, monkeypatch, failure):
    write_checkpoint(tmp_path, 1, STATE)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(*arguments, **keywords):
        raise OSError(errno.ENOSPC, "No space left on device")

    owner, name = {"write": (np, "savez"), "fsync": (os, "fsync"), "replace": (os, "replace")}[failure]
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, full)
        with pytest.raises(OSError, match="No space"):
            write_checkpoint(tmp_path, 2, STATE)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


class Rounds(RoundCallback):
    def __init__(self):
        super().__init__()
        self.after = []

    def _on_round_logged(self) -> bool:
        self.after.append(self.model.round)
        return True


SMALL = {"rollout_size": 16, "batch_size": 8, "n_epochs": 1, "seed": 0, "policy_kwargs": {"net_arch": [4]}}


def test_the_callback_writes_every_few_rounds(tmp_path):
    model, rounds = FedAvg("MlpPolicy", "Bandit2D", **SMALL), Rounds()
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / ".round_000004.npz.x1.part").write_bytes(b"of a process that was killed")
    callback = CheckpointCallback(tmp_path / "c", save_freq=2)
    model.learn(7 * 16 * 4, [callback, rounds])
    assert sorted(path.name for path in (tmp_path / "c").iterdir()) == ["round_000004.npz", "round_000006.npz"]
    assert rounds.after == [1, 2, 3, 4, 5, 6, 7] and callback.saved_round == 6
    modified = checkpoints(tmp_path / "c")[-1].stat().st_mtime_ns
    assert callback.save() and callback.saved_round == 7  # now, and once
    assert callback.save() and [path.name for path in checkpoints(tmp_path / "c")] == ["round_000006.npz", "round_000007.npz"]
    assert checkpoints(tmp_path / "c")[0].stat().st_mtime_ns == modified
    with pytest.raises(ValueError, match="save_freq=0 must be at least 1"):
        CheckpointCallback(tmp_path, 0)


def test_a_disk_that_is_full_does_not_end_the_training(tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    model = FedAvg("MlpPolicy", "Bandit2D", **SMALL)
    monkeypatch.setattr(checkpoint_module, "write_checkpoint", full)
    with pytest.warns(UserWarning, match="no checkpoint after round 2: .*No space left on device"):
        model.learn(3 * 16 * 4, CheckpointCallback(tmp_path, 2))
    assert model.round == 3


class Unplain(CountingEnv):
    def save_state(self):
        return {"arm": object()}


def test_what_cannot_be_saved_is_said_before_the_first_round(tmp_path):
    model = FedAvg("MlpPolicy", [CountingEnv, Unplain], **SMALL)
    message = r"client 1: its environment cannot be part of a checkpoint: arm: a object is no plain data.*--save-freq 0"
    with pytest.raises(CheckpointError, match=message):
        model.learn(10**9, CheckpointCallback(tmp_path))
    assert model.round == 0 and model.num_timesteps == 0


class Hoarder(FedAvg):
    """Keeps what it was sent, and tells nobody."""

    def __init__(self, policy, env, **fedavg):
        self.received = {}
        super().__init__(policy, env, **fedavg)

    def receive(self, index, broadcast):
        super().receive(index, broadcast)
        self.received[index] = dict(broadcast)


class Declared(Hoarder):
    state_attributes = ("received",)


def test_arrays_that_an_algorithm_does_not_declare_are_not_forgotten_silently(tmp_path):
    model = Hoarder("MlpPolicy", "Bandit2D", **SMALL)
    with pytest.warns(UserWarning, match="Hoarder keeps arrays in received.*state_attributes"):
        model.learn(16 * 4, CheckpointCallback(tmp_path, 1))
    model = Declared("MlpPolicy", "Bandit2D", **SMALL)
    model.learn(16 * 4, CheckpointCallback(tmp_path, 1))
    again = Declared("MlpPolicy", "Bandit2D", **SMALL).resume(tmp_path)
    assert again.round == 1 and same(freeze(again.received), freeze(model.received))


def test_states_of_other_federations_are_refused(tmp_path):
    model = FedAvg("MlpPolicy", "Bandit2D", **SMALL)
    model.learn(16 * 4, CheckpointCallback(tmp_path, 1))
    for other, message in (
        (Hoarder("MlpPolicy", "Bandit2D", **SMALL), "its algorithm is 'FedAvg', here it is 'Hoarder'"),
        (FedAvg("MlpPolicy", "Bandit2D", **{**SMALL, "rollout_size": 32}), "its rollout_size is 16, here it is 32"),
        (FedAvg("MlpPolicy", "Bandit2D", clients=[0, 1], **SMALL), "its clients is"),
        (FedAvg("MlpPolicy", "Reacher", **SMALL), "its family is"),
        (FedAvg("MlpPolicy", "Bandit2D", **{**SMALL, "policy_kwargs": {"net_arch": [5]}}), "policies do not fit"),
    ):
        with pytest.raises(ValueError, match=message):
            other.resume(tmp_path)
    with pytest.raises(ValueError, match="there is no checkpoint in"):
        model.resume(tmp_path / "nowhere")
    path = checkpoints(tmp_path)[-1]
    arrays = read_arrays(path)
    content = json.loads(arrays["state.json"].tobytes())
    del content["state"]["model"]["policy"]
    arrays["state.json"] = np.frombuffer(json.dumps(content).encode(), dtype=np.uint8)
    write_arrays(path, arrays)
    with pytest.raises(ValueError, match="does not fit this version or algorithm"):
        FedAvg("MlpPolicy", "Bandit2D", **SMALL).resume(tmp_path)
