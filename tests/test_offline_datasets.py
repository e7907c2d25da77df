"""Offline data: what is recorded, how it is cached, and which datasets of others are accepted."""

from __future__ import annotations

import multiprocessing
import os
import shutil
from pathlib import Path

import gymnasium as gym
import minari
import numpy as np
import pytest

import fed_envs
from sb3_fedguide.offline.cache import cached_arrays, content_key, publish_folder, read_arrays, write_arrays
from sb3_fedguide.offline.collect import default_size
from sb3_fedguide.offline.data import OfflineData
from sb3_fedguide.offline.datasets import client_datasets, dataset_folder
from sb3_fedguide.offline.minari_io import read_minari, write_minari

SIZE = 240


def assert_same(a: OfflineData, b: OfflineData) -> None:
    for name, array in a.arrays().items():
        np.testing.assert_array_equal(array, b.arrays()[name], err_msg=name)


def tiny_data(n: int = 7) -> OfflineData:
    """An episode of four rows that terminates, and one that is cut."""
    obs = np.arange(2 * (n + 1), dtype=np.float32).reshape(-1, 2)
    observations, following = obs[:-1].copy(), obs[1:].copy()
    following[3] = 99.0
    return OfflineData(observations, np.zeros((n, 1)), np.ones(n), following, np.arange(n) == 3)


def test_episode_ends_and_returns() -> None:
    data = tiny_data()
    np.testing.assert_array_equal(np.flatnonzero(data.episode_ends), [3, 6])
    returns = data.discounted_returns(0.5, bootstrap=np.full(7, 10.0))
    np.testing.assert_allclose(returns, [1.875, 1.75, 1.5, 1.0, 1.75 + 10 / 8, 1.5 + 10 / 4, 1.0 + 10 / 2])
    np.testing.assert_allclose(data.discounted_returns(0.5)[4:], 2.0)  # mean reward 1 for ever


def test_offline_data_refuses_what_does_not_fit() -> None:
    good = tiny_data().arrays()
    with pytest.raises(ValueError, match="non-finite"):
        OfflineData(**{**good, "rewards": np.full(7, np.nan)})
    with pytest.raises(ValueError, match="same number of rows"):
        OfflineData(**{**good, "rewards": np.ones(6)})
    with pytest.raises(ValueError, match="dimension"):
        OfflineData(**{**good, "actions": np.ones(7)})


def test_what_is_not_finite_is_counted() -> None:
    good = tiny_data().arrays()
    for name in ("observations", "next_observations", "actions", "rewards"):
        broken = good[name].copy()
        broken[[2, 5]] = np.inf
        with pytest.raises(ValueError, match=f"{name} has non-finite entries in 2 of 7 rows, first in row 2"):
            OfflineData(**{**good, name: broken})


def test_episodes_that_begin_where_others_ended_are_told_apart(tmp_path: Path) -> None:
    """As in worlds with one observation, such as Bandit2D, and in those with one start that episodes are cut at."""
    zeros, cut = np.zeros((6, 2)), np.array([1, 0, 1, 1, 0, 1], dtype=bool)
    data = OfflineData(zeros, np.zeros((6, 1)), np.arange(6.0), zeros, np.zeros(6, bool), cut)
    np.testing.assert_array_equal(data.episode_ends, cut)
    space = gym.spaces.Box(-1, 1, (2,)), gym.spaces.Box(-1, 1, (1,))
    write_minari(tmp_path, "cut-v0", data, *space, {})
    again = read_minari(tmp_path / "data")
    assert_same(again, data)
    assert (
        again.content_hash
        == data.content_hash
        != OfflineData(zeros, np.zeros((6, 1)), np.arange(6.0), zeros, cut).content_hash
    )
    one = tiny_data()  # here the observations say it already: one content, with or without
    assert OfflineData(**one.arrays(), truncations=one.episode_ends).content_hash == one.content_hash


def test_actions_outside_their_space_are_refused(tmp_path: Path) -> None:
    data = tiny_data()
    space = gym.spaces.Box(-1, 1, (2,)), gym.spaces.Box(-1, 1, (1,))
    for name, action, wrong in (("far-v0", 7.0, True), ("near-v0", 1.0 + 1e-6, False)):
        actions = data.actions.copy()
        actions[[1, 4]] = action
        write_minari(tmp_path / name, name, OfflineData(**{**data.arrays(), "actions": actions}), *space, {})
        path = str(tmp_path / name)
        if wrong:
            with pytest.raises(ValueError, match=r"data of client 3: .*in 2 of 7 rows, by up to 6: .*clipped"):
                client_datasets(None, dataset=path, clients=[3], env_spaces=space)
        else:
            assert len(client_datasets(None, dataset=path, clients=[3], env_spaces=space)[0]) == 7


@pytest.mark.parametrize("how", ["argument", "variable"])
def test_a_relative_cache_keeps_what_is_made(how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FEDGUIDE_CACHE", "mine")
    client_datasets("Bandit2D", size=20, clients=[0], cache_dir="mine" if how == "argument" else None)
    folder = dataset_folder(fed_envs.load_family("Bandit2D"), 0, 20)
    assert folder.is_relative_to(tmp_path / "mine") and (folder / "rows.npz").is_file()
    with pytest.raises(ValueError, match="--cache-dir"):
        dataset_folder(fed_envs.load_family("Bandit2D"), 0, 20, cache_dir="~nobody-of-this-name/cache")


@pytest.mark.parametrize("family", ["HopperHard", "Reacher"])
def test_a_rollout_is_that_of_the_clients_own_environment(family: str) -> None:
    """Every stored transition is repeated in the client's single environment, from a reset with the copy's own seed."""
    from fed_envs.seeding import integer_seed
    from sb3_fedguide.seeding import Role

    (data,) = client_datasets(family, size=SIZE, seed=5, clients=[2])
    assert len(data) == SIZE
    assert (np.abs(data.actions) < 1.0).all()
    env = fed_envs.load_family(family).make(2)
    obs, _ = env.reset(seed=integer_seed(5, Role.DATA, 2, 0))
    for row in range(SIZE // 8):
        np.testing.assert_array_equal(data.observations[row], obs.astype(np.float32))
        obs, reward, terminated, truncated, _ = env.step(data.actions[row])
        np.testing.assert_array_equal(data.next_observations[row], obs.astype(np.float32))
        assert data.rewards[row] == np.float32(reward)
        assert data.terminations[row] == terminated
        if terminated or truncated:
            break


def test_time_limits_are_no_terminations() -> None:
    (data,) = client_datasets("Reacher", size=8 * 60, clients=[0])
    ends = np.flatnonzero(data.episode_ends)
    assert not data.terminations.any()
    np.testing.assert_array_equal(ends[:3], [49, 59, 109])  # 50 steps, the rest of the copy's share, the next copy's 50


def test_bandit_draws_around_the_clients_own_peak() -> None:
    family = fed_envs.load_family("Bandit2D")
    assert default_size(family) == 1000
    for client, data in zip((1, 2), client_datasets(family, size=400, clients=[1, 2]), strict=True):
        peak = np.asarray(family.client(client).peak)  # type: ignore[attr-defined]
        distance = np.linalg.norm(data.actions - peak, axis=1)
        assert len(data) == 400
        assert distance.max() <= 0.3 + 1e-6
        assert np.mean(distance**2) == pytest.approx(0.3**2 / 2, rel=0.1)  # uniform on the disc, not in the radius
        np.testing.assert_allclose(data.rewards, np.exp(-(distance**2) / (2 * 0.2**2)), atol=1e-4)
        assert data.terminations.all()


def test_a_clients_data_do_not_depend_on_who_else_is_asked_for(tmp_path: Path) -> None:
    together = client_datasets("HopperHard", size=SIZE, seed=1, cache_dir=tmp_path / "a", clients=[0, 3, 5])
    alone = client_datasets("HopperHard", size=SIZE, seed=1, cache_dir=tmp_path / "b", clients=[3])
    assert_same(together[1], alone[0])
    assert not np.array_equal(together[0].actions, together[1].actions)
    other_seed = client_datasets("HopperHard", size=SIZE, seed=2, cache_dir=tmp_path / "b", clients=[3])
    assert not np.array_equal(other_seed[0].actions, alone[0].actions)


def test_cache_is_used_and_read_by_minari(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reports: list[tuple[int, int]] = []
    made = client_datasets(
        "Hopper", size=SIZE, cache_dir=tmp_path, clients=[1, 2], progress=lambda done, total: reports.append((done, total))
    )
    assert reports == [(0, 2), (1, 2), (2, 2)]
    monkeypatch.setattr("sb3_fedguide.offline.datasets.collect", None)  # anything made again would fail now
    for a, b in zip(made, client_datasets("Hopper", size=SIZE, cache_dir=tmp_path, clients=[1, 2]), strict=True):
        assert_same(a, b)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    ids = list(minari.list_local_datasets())
    assert len(ids) == 2
    assert all(name.startswith("fedguide/Hopper/client-") for name in ids)
    assert_same(read_minari(Path(str(minari.load_dataset(ids[0]).storage.data_path))), made[0])


@pytest.mark.parametrize("damage", ["truncated data", "missing metadata", "changed rows", "empty folder"])
def test_a_damaged_entry_is_made_again(tmp_path: Path, damage: str) -> None:
    (made,) = client_datasets("Hopper", size=SIZE, cache_dir=tmp_path, clients=[0])
    folder = dataset_folder(fed_envs.load_family("Hopper"), 0, SIZE, cache_dir=tmp_path)
    if damage == "truncated data":
        file = folder / "data" / "main_data.hdf5"
        file.write_bytes(file.read_bytes()[:-100])
    elif damage == "missing metadata":
        (folder / "data" / "metadata.json").unlink()
    elif damage == "changed rows":
        file = folder / "rows.npz"
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 0xFF
        file.write_bytes(bytes(content))
    else:
        shutil.rmtree(folder)
        folder.mkdir()
    (again,) = client_datasets("Hopper", size=SIZE, cache_dir=tmp_path, clients=[0])
    assert_same(made, again)
    assert_same(made, read_minari(folder / "data"))
    assert not [path for path in folder.parent.iterdir() if path.name.startswith(".")]


def test_key_covers_the_client_and_nothing_of_the_others() -> None:
    family = fed_envs.load_family("Hopper")
    heavier = [{**client.model_dump(), "mass_scale": 2.0} if client.client == 1 else client for client in family.clients]
    changed = fed_envs.Family(**{**family.model_dump(), "clients": heavier})
    assert dataset_folder(changed, 0) == dataset_folder(family, 0)
    assert dataset_folder(changed, 1) != dataset_folder(family, 1)
    keys = {dataset_folder(family, 0, size, seed) for size in (10, 20) for seed in (0, 1)}
    assert len(keys) == 4


def given(path: Path, name: str, obs_dim: int = 11, action_dim: int = 3, n: int = 50, bound: float = 1.0) -> OfflineData:
    rng = np.random.default_rng(obs_dim)
    obs = rng.standard_normal((n + 1, obs_dim)).astype(np.float32)
    data = OfflineData(obs[:-1], rng.uniform(-1, 1, (n, action_dim)), rng.random(n), obs[1:], np.arange(n) % 10 == 9)
    obs_space = gym.spaces.Box(-np.inf, np.inf, (obs_dim,), np.float64)
    write_minari(path / name, name, data, obs_space, gym.spaces.Box(-bound, bound, (action_dim,), np.float32), {})
    return data


def test_any_fitting_minari_dataset_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = given(tmp_path, "mine/hopper-v0")
    another = given(tmp_path, "mine/hopper-v1", n=60)
    assert_same(client_datasets("HopperHard", dataset=str(tmp_path / "mine/hopper-v0"), clients=[4])[0], data)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    first, second = client_datasets("HopperHard", dataset="mine/hopper-v{client}", clients=[0, 1])
    assert_same(first, data)
    assert_same(second, another)
    parts = client_datasets("HopperHard", dataset="mine/hopper-v0", size=25, clients=[0, 1])
    assert [len(part) for part in parts] == [25, 25]
    assert not np.array_equal(parts[0].observations, parts[1].observations)  # each client in its own order of episodes
    assert {tuple(row) for row in parts[0].observations} <= {tuple(row) for row in data.observations}
    spaces = (gym.spaces.Box(-1, 1, (11,)), gym.spaces.Box(-1, 1, (3,)))
    assert_same(client_datasets(None, dataset="mine/hopper-v0", clients=[0], env_spaces=spaces)[0], data)


def test_wrong_or_absent_datasets_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    given(tmp_path, "walker-v0", obs_dim=17)
    given(tmp_path, "wide-v0", bound=2.0)
    with pytest.raises(ValueError, match=r"observation space is Box.*\(17,\).*client's is Box.*\(11,\)"):
        client_datasets("Hopper", dataset="walker-v0")
    with pytest.raises(ValueError, match=r"action space is Box\(-2.*client's is Box\(-1"):
        client_datasets("Hopper", dataset="wide-v0")
    with pytest.raises(ValueError, match="Local datasets: walker-v0, wide-v0"):
        client_datasets("Hopper", dataset="D4RL/hopper/medium-v2")
    with pytest.raises(ValueError, match="at least one row"):
        client_datasets("Hopper", size=0)
    with pytest.raises(ValueError, match="clients 0 to 7"):
        client_datasets("Hopper", size=SIZE, clients=[9])
    with pytest.raises(ValueError, match="bring no offline data"):
        client_datasets(None, clients=[0])


def test_arrays_are_checked_and_never_unpickled(tmp_path: Path) -> None:
    path = tmp_path / "entry.npz"
    write_arrays(path, {"a": np.arange(3.0)})
    np.testing.assert_array_equal(read_arrays(path)["a"], np.arange(3.0))
    np.savez(path, a=np.arange(4.0))  # no checksum
    with pytest.raises(ValueError, match="checksum"):
        read_arrays(path)

    class Payload:
        def __reduce__(self) -> tuple:
            return (os.mkdir, (str(tmp_path / "executed"),))

    np.savez(path, a=np.array([Payload()], dtype=object))
    with pytest.raises(ValueError, match="damaged"):
        read_arrays(path)
    assert not (tmp_path / "executed").exists()
    rebuilt = cached_arrays(path, lambda: {"a": np.zeros(2)})
    assert rebuilt is not None
    np.testing.assert_array_equal(read_arrays(path)["a"], np.zeros(2))
    assert cached_arrays(tmp_path / "absent.npz") is None


def test_an_interrupted_write_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), publish_folder(tmp_path / "entry", lambda path: True) as temporary:
        (temporary / "half").touch()
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
    with publish_folder(tmp_path / "entry", lambda path: True) as temporary:
        (temporary / "whole").touch()
    assert [path.name for path in (tmp_path / "entry").iterdir()] == ["whole"]
    assert content_key(a=1, b=[2]) == content_key(b=[2], a=1) != content_key(a=1, b=[3])


def _make(cache: str) -> str:
    return client_datasets("Hopper", size=SIZE, cache_dir=cache, clients=[0])[0].content_hash


@pytest.mark.slow
def test_two_processes_make_the_same_entry(tmp_path: Path) -> None:
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        first, second = pool.map(_make, [str(tmp_path)] * 2)
    assert first == second == _make(str(tmp_path))
    folder = dataset_folder(fed_envs.load_family("Hopper"), 0, SIZE, cache_dir=tmp_path)
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
