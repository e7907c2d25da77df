"""Small, single-threaded, and apart from the user's own cache."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_fedguide.common.federated_ppo import FederatedPPO

th.set_num_threads(1)


@pytest.fixture(autouse=True)
def private_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results of the offline stage are shared by the tests of one run and by nobody else."""
    monkeypatch.setenv("FEDGUIDE_CACHE", str(tmp_path_factory.getbasetemp() / "fedguide-cache"))


class PointEnv(gym.Env[np.ndarray, np.ndarray]):
    """A point that is paid for staying near its client's target; cheap and with both ways for an episode to end."""

    def __init__(self, target: float = 0.5, length: int = 20) -> None:
        self.observation_space = gym.spaces.Box(-10.0, 10.0, (3,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.target, self.length = target, length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position, self.steps = self.np_random.normal(size=2) * 0.5, 0
        return self._observation(), {}

    def step(self, action):
        self.position = self.position + 0.2 * np.clip(action, -1, 1) + 0.02 * self.np_random.normal(size=2)
        self.steps += 1
        reward = -float(np.square(self.position - self.target).sum())
        terminated = bool(np.abs(self.position).max() > 2.5)
        return self._observation(), reward, terminated, self.steps >= self.length and not terminated, {}

    def _observation(self) -> np.ndarray:
        return np.array([*self.position, self.steps / self.length], dtype=np.float32)


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
