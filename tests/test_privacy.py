"""What leaves a client is what docs/privacy.md says, key by key and shape by shape."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from sb3_fedguide.offline import trunk as trunk_module
from sb3_fedguide.offline.datasets import client_datasets
from sb3_fedguide.registry import ALGORITHMS, algorithm
from sb3_fedguide.server.strategy import Strategy

PAGE = (Path(__file__).parents[1] / "docs" / "privacy.md").read_text(encoding="utf-8")
HIDDEN = 12
SMALL = {"rollout_size": 40, "batch_size": 20, "seed": 3}
#: without behaviour cloning and few updates, with a trunk narrow enough to tell its sizes apart
OFFLINE = {"dataset_size": 40, "prior_updates": 4, "prior_average_every": 2, "dice_updates": 2, "prior_width": 16}

Shapes = dict[str, tuple[int, ...]]


def rows(heading: str) -> list[list[str]]:
    """Cells of all table rows of a section, without the rows of titles."""
    section = PAGE.split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def documented_parts(heading: str, sizes: Mapping[str, int]) -> dict[str, Shapes]:
    """Part to key to shape."""
    parts: dict[str, Shapes] = {}
    for cells in rows(heading):
        if len(cells) == 3 and cells[0] not in ("part", "---") and cells[0] != "direction":
            part, key, shape = cells[0], cells[1].strip("`"), cells[2].strip("`")
            parts.setdefault(part, {})[key] = tuple(
                eval(expression, {"__builtins__": {}}, dict(sizes)) for expression in re.split(r",\s*", shape) if expression
            )
    return parts


def documented_uploads() -> dict[str, list[list[str]]]:
    """Algorithm to the parts of each column."""
    table = [cells for cells in rows("Uploads in training") if len(cells) == 5 and cells[0] not in ("`--algo`", "---")]
    return {name.strip("`"): [[part for part in cell.split(", ") if part] for cell in columns] for name, *columns in table}


def expected_shapes(parts: dict[str, Shapes], names: list[str]) -> Shapes:
    if "direction" in names:
        parts = {**parts, "direction": {f"direction.{key}": shape for key, shape in parts["actor"].items()}}
    return {key: shape for name in names for key, shape in parts[name].items()}


@pytest.fixture
def uploads(monkeypatch):
    """Every upload that reaches a server, with its round."""
    seen: list[tuple[int, int, dict[str, np.ndarray]]] = []
    original = Strategy.exchange

    def exchange(self, round, payloads):
        seen.extend((round, client, payload) for client, payload in payloads.items())
        return original(self, round, payloads)

    monkeypatch.setattr(Strategy, "exchange", exchange)
    return seen


@pytest.fixture
def offline_uploads(monkeypatch):
    """Moments and trunks that clients send in the offline stage."""
    seen: dict[str, list[dict[str, np.ndarray]]] = {"moments": [], "trunk": []}
    merge, average = trunk_module.merge_moments, trunk_module.weighted_average
    monkeypatch.setattr(trunk_module, "merge_moments", lambda sent: (seen["moments"].extend(sent), merge(sent))[1])
    weigh = lambda sent, *rest: (seen["trunk"].extend(sent), average(sent, *rest))[1]  # noqa: E731
    monkeypatch.setattr(trunk_module, "weighted_average", weigh)
    return seen


def test_the_table_names_every_algorithm():
    ours = [name for name in ALGORITHMS if algorithm(name).__module__.startswith("sb3_fedguide.")]  # others may be registered
    assert list(documented_uploads()) == ours


def network() -> dict:
    return {"policy_kwargs": {"net_arch": [HIDDEN, HIDDEN]}}  # made anew: SB3 writes into it


def trained(name: str, tmp_path, **settings):
    if name == "fedrl":
        settings = {"learning_starts": 20, "buffer_size": 100, **settings}
    else:
        settings = {"n_epochs": 1, **settings}
    if algorithm(name).uses_prior:
        settings = {"prior_states": 8, "adapt": "advantage", "n_experts": 5, **settings}
    if name == "fedguide-a":
        settings["average_every"] = 2
    model = algorithm(name)("MlpPolicy", "Reacher", pretraining=OFFLINE, cache_dir=tmp_path, **settings, **SMALL, **network())
    model.learn(2 * model.n_clients * model.rollout_size)
    return model


def sizes_of(model) -> dict[str, int]:
    sizes = {"o": model.observation_space.shape[0], "a": model.action_space.shape[0], "h": HIDDEN, "M": 5}
    prior = getattr(model, "prior", None)
    return {
        **sizes,
        "p": 0 if prior is None else prior.n_features,
        "e": 0 if prior is None else prior.trunk.encoder[0].out_features,
    }


@pytest.mark.parametrize("name", list(ALGORITHMS))
def test_what_is_uploaded_is_what_the_page_says(name, uploads, offline_uploads, tmp_path):
    model = trained(name, tmp_path)
    sizes = sizes_of(model)
    parts, columns = documented_parts("Uploads in training", sizes), documented_uploads()[name]
    exchanges = [uploads[start : start + model.n_clients] for start in range(0, len(uploads), model.n_clients)]
    setup = [column for column in columns[:2] if column]
    expected = [*setup, columns[2], [*columns[2], *columns[3]]] if columns[2] else []
    assert [part[0][0] for part in exchanges] == [0] * len(setup) + [1, 2] * bool(expected)
    for exchange, names in zip(exchanges, expected, strict=True):
        for _, _, payload in exchange:
            assert {key: np.shape(array) for key, array in payload.items()} == expected_shapes(parts, names)
            assert {array.dtype for array in payload.values()} == {np.dtype(np.float32)}

    offline = documented_parts("Uploads in the offline stage", sizes)
    for part, sent in offline_uploads.items():
        assert len(sent) == (model.n_clients * (1 if part == "moments" else 2) if model.uses_prior else 0)
        for payload in sent:
            assert {key: np.shape(array) for key, array in payload.items()} == offline[part]
    if model.uses_prior:
        n_values = sum(int(np.prod(shape)) for shape in offline["moments"].values())
        n_values += 2 * sum(int(np.prod(shape)) for shape in offline["trunk"].values())
        assert model.pretraining_bytes[0] == 4 * n_values * model.n_clients


def test_shared_statistics_are_a_part_of_their_own(uploads, tmp_path):
    model = trained("fedguide-r", tmp_path, normalize="shared")
    parts = documented_parts("Uploads in training", sizes_of(model))
    for round, _, payload in uploads:
        expected = expected_shapes(parts, ["actor", "critic", "samples", "statistics"] if round else ["statistics"])
        assert {key: np.shape(array) for key, array in payload.items()} == expected
        kinds = {key: array.dtype for key, array in payload.items()}
        assert all(kind == (np.float64 if key.startswith("observations.") else np.float32) for key, kind in kinds.items())
    model.screening_state["alone"][0] = True
    assert {key: float(array) for key, array in model.upload(0).items()} == {"n_samples": 0.0}


def test_the_options_that_the_page_mentions(uploads, tmp_path):
    trained("fedguide", tmp_path, cost="param")
    assert {tuple(payload) for _, _, payload in uploads} == {("prior.head",)}
    assert [round for round, client, _ in uploads if client == 0] == [0, 1, 2]
    uploads.clear()
    model = trained("fedavg", tmp_path, average="critic")
    critic = expected_shapes(documented_parts("Uploads in training", sizes_of(model)), ["critic", "samples"])
    assert all({key: np.shape(array) for key, array in payload.items()} == critic for _, _, payload in uploads)


def test_a_bandits_head_is_the_moments_of_its_actions_as_the_page_says(tmp_path):
    model = algorithm("fedguide")("MlpPolicy", "Bandit2D", pretraining=OFFLINE, cache_dir=tmp_path, n_epochs=1, **SMALL)
    model.pretrain()
    assert model.upload(0)["prior.head"].shape == (2, 3)
    mean, covariance = model.prior.mean_and_covariance(model.heads[0])
    data = client_datasets(model.family, OFFLINE["dataset_size"], model.seed, tmp_path, None, [0])[0]
    np.testing.assert_allclose(mean, data.actions.mean(axis=0), atol=1e-4)
    np.testing.assert_allclose(covariance, np.cov(data.actions.T, bias=True), atol=1e-4)
