"""Small, single-threaded, and apart from the user's own cache."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch as th

from sb3_fedguide.common.federated_ppo import FederatedPPO
from tests.environments import PointEnv

th.set_num_threads(1)


# metaworld holds MuJoCo at 3.3.0: beside another MuJoCo everything else is tested without it
HAS_METAWORLD = find_spec("metaworld") is not None
collect_ignore = [] if HAS_METAWORLD else ["test_metaworld10.py"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if not HAS_METAWORLD:
        for item in items:
            if "MetaWorld10" in item.name:
                item.add_marker(pytest.mark.skip(reason="MetaWorld10 needs metaworld"))


@pytest.fixture(autouse=True)
def private_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results of the offline stage are shared by the tests of one run, whichever worker has them, and by nobody else."""
    run = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        run = run.parent
    monkeypatch.setenv("FEDGUIDE_CACHE", str(run / "fedguide-cache"))
    monkeypatch.setenv("SB3_LOGDIR", str(run / "sb3"))  # else every model that learns leaves a folder in /tmp


@pytest.fixture(scope="session", autouse=True)
def hangups_are_heard() -> None:
    """Under nohup the programs that tests start would ignore SIGHUP, as is right there; our handler they do not inherit."""
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda *_: None)


def ends_first(clients: Iterable[tuple[str, int]]) -> list[Any]:
    """Parameters for pairs of a family and a client: all but a family's first and last client are slow tests."""
    pairs = list(clients)
    ends = {name: (min(k for other, k in pairs if other == name), max(k for other, k in pairs if other == name))
            for name, _ in pairs}  # fmt: skip
    return [pytest.param(name, k, marks=() if k in ends[name] else pytest.mark.slow) for name, k in pairs]


def others_slow(cases: Iterable[Any], default: Callable[..., bool]) -> list[Any]:
    """Parameters of which only those that ``default`` chooses are no slow tests; it gets a tuple's entries one by one."""
    entries = [case if isinstance(case, tuple) else (case,) for case in cases]
    return [pytest.param(*entry, marks=() if default(*entry) else pytest.mark.slow) for entry in entries]


def _point_env(target: float) -> gym.Env:
    return gym.wrappers.RecordEpisodeStatistics(PointEnv(target))


@pytest.fixture
def point_envs() -> Callable[[int], list[Callable[[], gym.Env]]]:
    """Factories of ``n`` clients with different targets."""

    def make(n: int) -> list[Callable[[], gym.Env]]:
        return [lambda k=k: _point_env(-0.5 + 0.3 * k) for k in range(n)]  # type: ignore[misc]

    return make


SMALL = {"rollout_size": 64, "batch_size": 16, "n_epochs": 2, "seed": 3, "policy_kwargs": {"net_arch": [16, 16]}}


@pytest.fixture
def small() -> dict:
    """Constructor arguments of a federation small enough for a test."""
    return dict(SMALL)


def parameters_of(model: FederatedPPO, client: int) -> dict[str, th.Tensor]:
    return model.policy.client_state_dict(model.client_ids.index(client))


def assert_same_parameters(a: dict[str, th.Tensor], b: dict[str, th.Tensor], tolerance: float = 0.0) -> None:
    assert a.keys() == b.keys()
    for name in a:
        difference = (a[name] - b[name]).abs().max().item()
        assert difference <= tolerance, f"{name} differs by {difference}"


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a federation's server, and its authority's."""
    from sb3_fedguide.cli.main import main

    folder = tmp_path_factory.mktemp("deployment") / "certificates"
    assert main(["deploy", "certificates", str(folder), "--host", "fed.example.org", "--host", "10.0.0.1"]) == 0
    return folder


@pytest.fixture(scope="module")
def keys(certificates: Path) -> Path:
    """The folder with two clients' keys beside the certificates."""
    from sb3_fedguide.cli.main import main

    folder = certificates.parent
    for name in ("a", "b"):
        assert main(["deploy", "key", str(folder), name]) == 0
    return folder


@pytest.fixture
def coarse_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small pictures, and no PDFs, whose fonts take long: both again where a test is about them."""
    from sb3_fedguide.benchmark.figures import layout

    monkeypatch.setattr(layout, "DPI", 60)
    monkeypatch.setattr(layout, "FORMATS", ("png",))
