"""The recipe for MLflow in docs/log_keys.md runs as it is printed."""

from __future__ import annotations

import math
import runpy
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

DOCS = Path(__file__).resolve().parent.parent / "docs"
RECIPE = DOCS / "examples" / "mlflow_output.py"


def test_the_page_prints_the_recipe() -> None:
    assert RECIPE.read_text().partition('"""\n\n')[2].strip() in (DOCS / "log_keys.md").read_text()


def test_every_scalar_of_every_round_is_handed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the three functions of mlflow that it calls; the real one below, where it is installed."""
    logged: list[tuple[int, dict[str, float]]] = []
    fake = SimpleNamespace(
        start_run=nullcontext, log_params=dict, log_metrics=lambda numbers, step: logged.append((step, numbers))
    )
    monkeypatch.setitem(sys.modules, "mlflow", fake)
    runpy.run_path(str(RECIPE))
    assert [step for step, _ in logged] == [800, 1600, 2400]
    assert {"rollout/ep_rew_mean", "train/value_loss", "client_3/ep_rew_mean"} <= logged[-1][1].keys()
    assert all(isinstance(value, float) and not math.isnan(value) for value in logged[-1][1].values())


@pytest.mark.slow
def test_mlflow_takes_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    mlflow.set_tracking_uri((tmp_path / "mlruns").as_uri())
    runpy.run_path(str(RECIPE))
    (run,) = mlflow.search_runs(output_format="list")
    history = mlflow.MlflowClient().get_metric_history(run.info.run_id, "client_3/ep_rew_mean")
    assert [entry.step for entry in history] == [800, 1600, 2400] and run.data.params["env"] == "Bandit2D"
