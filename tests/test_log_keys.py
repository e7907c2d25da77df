"""docs/log_keys.md and what the algorithms log are the same keys, and no chart in TensorBoard stays empty."""

from __future__ import annotations

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat

from sb3_fedguide import FedAvg, FedGuide, Local
from sb3_fedguide.common.evaluation import FederatedEvalCallback
from sb3_fedguide.common.participation import simulate_delays
from sb3_fedguide.monitoring.callbacks import TensorBoardCallback
from sb3_fedguide.monitoring.charts import chart_layout
from sb3_fedguide.monitoring.diagnostics import DiagnosticsCallback
from sb3_fedguide.registry import ALGORITHMS, algorithm
from sb3_fedguide.server.delays import parse_delays

PAGE = Path(__file__).parents[1] / "docs" / "log_keys.md"
ROUNDS = 2
PPO = {"rollout_size": 32, "batch_size": 16, "n_epochs": 1, "seed": 0, "policy_kwargs": {"net_arch": [8]}}
OFFLINE = {"dataset_size": 50, "bc_updates": 2, "dice_updates": 2, "dice_width": 8, "dice_batch_size": 16}
GUIDED = {**PPO, "pretraining": OFFLINE}
#: algorithm to constructor arguments: every option that logs a key of its own is on somewhere
SETTINGS: dict[str, list[dict]] = {
    "local": [PPO],
    "fedavg": [{**PPO, "clip_range_vf": 0.2, "noise_multiplier": 0.01, "clipping_norm": 1.0}],
    "fedprox": [PPO],
    "fedkl": [PPO],
    "fedsvrpgm": [PPO],
    "fedrl": [{"rollout_size": 32, "learning_starts": 8, "batch_size": 8, "seed": 0, "policy_kwargs": {"net_arch": [8]}}],
    "fedguide": [GUIDED, {**GUIDED, "prior_loss": "sample", "adapt": "advantage"}],
    "fedguide-p": [GUIDED],
    "pooled": [PPO],
    "fedguide-r": [{**PPO, "screening": 0.5, "normalize": "shared"}],
    "fedguide-a": [{**GUIDED, "average_every": 1}],
}


class Success(gym.Wrapper):
    """Says at each episode's end whether it succeeded, as the environments with goals do."""

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward, terminated, truncated, {**info, "is_success": truncated}


class BrokenClient(FedAvg):
    """FedAvg with a client whose upload the server refuses."""

    def upload(self, index):
        payload = super().upload(index)
        return {name: np.full_like(array, np.nan) for name, array in payload.items()} if index == 1 else payload


class Delayed(FedAvg):
    """FedAvg whose clients take simulated time."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        simulate_delays(self, parse_delays("async"))


class Keys(KVWriter):
    """Remembers which keys were logged to TensorBoard, and which to the terminal alone."""

    def __init__(self) -> None:
        self.shown: set[str] = set()
        self.terminal: set[str] = set()

    def write(self, key_values, key_excluded, step=0):
        for key in key_values:
            hidden = "tensorboard" in (key_excluded[key] or ())
            (self.terminal if hidden else self.shown).add(key)

    def close(self):
        pass


def run(algorithm: type, arguments: dict, envs, folder: Path) -> tuple[Keys, dict]:
    """Two rounds with all callbacks of the command line; the keys, and the layout of the charts."""
    model = algorithm("MlpPolicy", envs if algorithm is Local else "Bandit2D", **arguments)
    keys = Keys()
    model.set_logger(Logger(None, [keys, TensorBoardOutputFormat(str(folder))]))
    pictures = TensorBoardCallback(ROUNDS, picture_freq=ROUNDS if algorithm is FedGuide else 0)
    evaluation = FederatedEvalCallback(ROUNDS, n_episodes=1)
    model.learn(ROUNDS * model.n_clients * model.rollout_size, [evaluation, DiagnosticsCallback(), pictures])
    return keys, chart_layout(model)


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[tuple[str, int], tuple[Keys, dict]]:
    from tests.environments import PointEnv

    envs = [lambda: gym.wrappers.RecordEpisodeStatistics(Success(PointEnv(length=10)))] * 2
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FEDGUIDE_CACHE", str(tmp_path_factory.mktemp("cache")))
        found = {
            (algo, number): run(algorithm(algo), arguments, envs, tmp_path_factory.mktemp(algo))
            for algo, variants in SETTINGS.items()
            for number, arguments in enumerate(variants)
        }
        found["delayed", 0] = run(Delayed, PPO, envs, tmp_path_factory.mktemp("delayed"))
    with pytest.warns(UserWarning, match="rejects the upload of client 1"):
        return {**found, ("broken", 0): run(BrokenClient, PPO, envs, tmp_path_factory.mktemp("broken"))}


def documented() -> dict[str, str]:
    """Key to its explanation: the first cells of the page's tables, names in backticks."""
    rows = re.findall(r"^\| (`[^|]+?`) \| (.+) \|$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {key: meaning for cell, meaning in rows for key in re.findall(r"`([^`]+)`", cell)}


def general(key: str) -> str:
    return re.sub(r"^client_\d+/", "client_<k>/", key)


def test_every_algorithm_is_run():
    assert set(SETTINGS) == {name for name, entry in ALGORITHMS.items() if entry.module.startswith("sb3_fedguide.")}


def test_every_logged_key_is_documented(runs):
    keys = documented()
    for (algo, _), (logged, _) in runs.items():
        missing = {general(key) for key in logged.shown | logged.terminal} - keys.keys()
        assert not missing, f"{algo} logs what {PAGE.name} does not explain: {sorted(missing)}"


def test_every_documented_key_is_logged(runs):
    logged = {general(key) for keys, _ in runs.values() for key in keys.shown | keys.terminal}
    never = documented().keys() - logged
    assert not never, f"{PAGE.name} explains what nothing logs: {sorted(never)}"


def test_the_page_says_what_is_on_the_terminal_only(runs):
    terminal = {key for keys, _ in runs.values() for key in keys.terminal}
    said = {key for key, meaning in documented().items() if "terminal only" in meaning}
    assert said == terminal


def test_every_explanation_says_something():
    short = [key for key, meaning in documented().items() if len(meaning) < 5]
    assert len(documented()) > 60 and not short


@pytest.mark.parametrize("run", [(algo, number) for algo in SETTINGS for number in range(len(SETTINGS[algo]))])
def test_every_chart_has_all_its_curves_and_every_key_of_the_method_is_in_one(runs, run):
    keys, layout = runs[run]
    patterns = [pattern for charts in layout.values() for chart in charts.values() for pattern in chart]
    empty = [pattern for pattern in patterns if not any(re.fullmatch(pattern, key) for key in keys.shown)]
    assert not empty, f"without a curve: {empty}"
    own = {key for key in keys.shown if key.split("/")[0] in ("dice", "prior", "svrpg")} - {"svrpg/reference_ratio_max"}
    outside = {key for key in own if not any(re.fullmatch(pattern, key) for pattern in patterns)}
    assert not outside, f"in no chart: {outside}"


def test_a_chart_is_the_same_in_every_run(runs):
    """TensorBoard draws charts of one title but different patterns beside each other, each with all runs in it."""
    charts: dict[tuple[str, str], list[str]] = {}
    for _, layout in runs.values():
        for category, content in layout.items():
            for title, patterns in content.items():
                assert charts.setdefault((category, title), patterns) == patterns
