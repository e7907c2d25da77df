"""What clients share and how far: pooled observation statistics, the server's step, and ways back to one's own policy."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th

from sb3_fedguide import FedAvg, FedGuide, FedGuideA, FedGuideR, FedRL, Local, Pooled
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.newcomers import start_from
from sb3_fedguide.common.normalization import FederatedNormalizer
from sb3_fedguide.server.averaging import Averaging, combine, fedexp_step
from sb3_fedguide.server.moments import Moments, ObservationMoments, merge
from sb3_fedguide.server.payload import N_SAMPLES, OBSERVATION_COUNT, OBSERVATION_MEAN, OBSERVATION_VAR
from tests.conftest import assert_same_parameters, parameters_of


def upload(*values: float, n_samples: float = 1.0) -> dict[str, np.ndarray]:
    return {"w": np.array(values, dtype=np.float32), N_SAMPLES: np.array(n_samples, dtype=np.float32)}


def moments(rows: np.ndarray) -> dict[str, np.ndarray]:
    return {
        OBSERVATION_COUNT: np.array(float(len(rows))),
        OBSERVATION_MEAN: rows.mean(axis=0),
        OBSERVATION_VAR: rows.var(axis=0),
    }


def pooled(rows: np.ndarray) -> Moments:
    """All rows, after the start of SB3's running statistics."""
    start = Moments(1e-4, np.zeros(rows.shape[1]), np.ones(rows.shape[1]))
    return merge([start, Moments(float(len(rows)), rows.mean(axis=0), rows.var(axis=0))])


class Record(RoundCallback):
    """Raw observations that clients normalised by, and what they hold after each exchange."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[np.ndarray] = []
        self.means: list[np.ndarray] = []

    def _on_training_start(self) -> None:
        self.first = self.model._last_obs.copy()

    def _on_local_training_end(self) -> None:
        buffer = self.model.rollout_buffer
        raw = buffer.raw_observations.reshape(
            -1, self.model.n_clients, self.model.n_envs_per_client, buffer.raw_observations.shape[-1]
        )
        last = self.model._last_obs.reshape(1, *raw.shape[1:])
        self.seen.append(np.concatenate([raw[1:], last])[:, self.model.present].copy())

    def _on_round_end(self) -> None:
        self.means.append(self.model.normalizer.obs.mean.copy())


# The server's step


def test_a_step_of_one_is_the_average_bit_for_bit():
    rng = np.random.default_rng(0)
    plain = Averaging(server_step=1.0, server_momentum=0.0)
    for round in range(1, 4):
        uploads = {k: {"w": rng.normal(size=7).astype(np.float32), N_SAMPLES: np.float32(k + 1)} for k in range(3)}
        sent = plain.aggregate(round, uploads)
        np.testing.assert_array_equal(sent[1]["w"], combine(uploads, ["w"], "mean", 0.0)["w"])


def test_server_step_and_momentum_against_their_recursion():
    server = Averaging(server_step=2.0, server_momentum=0.5)
    theta = server.aggregate(1, {0: upload(0.0), 1: upload(2.0)})[0]["w"]
    assert theta == 1.0  # nothing to step from yet
    theta = server.aggregate(2, {0: upload(1.5), 1: upload(2.5)})[0]["w"]  # average 2, change 1
    assert theta == 1 + 2 * 1
    theta = server.aggregate(3, {0: upload(4.0), 1: upload(5.0)})[1]["w"]  # average 4.5, change 1.5, velocity 0.5 + 1.5
    assert theta == 3 + 2 * 2.0 and server.metrics["server_step"] == 2.0
    assert server.latest(0)["w"] == theta


def test_fedexp_step_against_its_formula():
    latest, change = {"w": np.zeros(2, dtype=np.float32)}, {"w": np.array([0.5, 0.5])}
    orthogonal = {0: upload(1.0, 0.0), 1: upload(0.0, 1.0)}
    # sum_i |Delta_i|^2 / (2 N |mean Delta|^2) = 2 / (2 * 2 * 0.5)
    assert fedexp_step(latest, orthogonal, change) == pytest.approx(1.0)
    many = {k: {"w": np.eye(8, dtype=np.float32)[k], N_SAMPLES: np.float32(1)} for k in range(8)}
    mean = {"w": np.full(8, 1 / 8)}
    assert fedexp_step({"w": np.zeros(8, dtype=np.float32)}, many, mean) == pytest.approx(8 / (2 * 8 * (8 / 64)))
    alike = {k: upload(1.0, 1.0) for k in range(3)}
    assert fedexp_step(latest, alike, {"w": np.ones(2)}) == 1.0  # never below the average
    server = Averaging(server_step="exp")
    server.aggregate(1, {k: {"w": np.zeros(8, dtype=np.float32), N_SAMPLES: np.float32(1)} for k in range(8)})
    np.testing.assert_allclose(server.aggregate(2, many)[0]["w"], 4.0 / 8, rtol=1e-6)


def test_uploads_without_samples_count_for_nothing():
    server = Averaging()
    idle = {N_SAMPLES: np.array(0, dtype=np.float32)}
    sent = server.exchange(1, {0: upload(1.0), 1: upload(3.0), 2: idle, 3: upload(2.0)})
    assert server.rejected == {} and sent[2]["w"] == sent[0]["w"] == 2.0
    assert server.exchange(2, {0: idle, 1: idle}) == {0: {}, 1: {}} and server.latest(0)["w"] == 2.0
    median = Averaging(aggregator="median")
    assert median.exchange(1, {0: upload(1.0), 1: upload(5.0), 2: idle, 3: upload(2.0), 4: idle})[4]["w"] == 2.0


@pytest.mark.parametrize("wrong", [
    {"server_step": 0.0}, {"server_step": "fast"}, {"server_momentum": 1.0}, {"mix": 1.5}, {"mix": -0.1}, {"screening": 0.7},
    {"screening": 0.05, "average": "critic"}, {"normalize": "all"},
])  # fmt: skip
def test_values_out_of_range_are_refused(wrong, point_envs):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        FedAvg("MlpPolicy", point_envs(2), **wrong)


@pytest.mark.parametrize("learner", [FedAvg, FedGuideR, FedRL])
def test_a_longer_step_moves_every_method_further(learner, point_envs, small):
    def trained(step: float):
        settings = {**small, **({"learning_starts": 16} if learner is FedRL else {"screening": 0.0})}
        settings["policy_kwargs"] = {"net_arch": [16, 16]}  # made anew: SB3's DDPG writes into it
        settings.pop("n_epochs") if learner is FedRL else None
        return learner("MlpPolicy", point_envs(3), server_step=step, **settings).learn(2 * 3 * 64)

    one, two = trained(1.0), trained(2.0)
    average, first = one.strategy.latest(0), two.strategy.latest(0)
    name = next(name for name in average if name.endswith("0.weight"))
    assert not np.array_equal(average[name], first[name])
    assert np.array_equal(two.policy.client_state_dict(0)[name], first[name])


# Observation statistics


def test_merged_moments_are_those_of_all_rows():
    rng = np.random.default_rng(1)
    parts = [rng.normal(3 * k, 1 + k, (5 + 7 * k, 4)) for k in range(3)]
    together = merge([Moments(float(len(rows)), rows.mean(axis=0), rows.var(axis=0)) for rows in parts])
    rows = np.concatenate(parts)
    assert together.count == len(rows)
    np.testing.assert_allclose(together.mean, rows.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(together.var, rows.var(axis=0), rtol=1e-12)
    with pytest.raises(ValueError, match="at least one client"):
        merge([])


def test_shared_statistics_are_those_of_everything_that_anybody_saw(point_envs, small):
    record = Record()
    model = FedAvg("MlpPolicy", point_envs(3), normalize="shared", n_envs_per_client=2, **small)
    model.learn(3 * 3 * 64, record)
    seen = np.concatenate([record.first.reshape(-1, 3), *[rows.reshape(-1, 3) for rows in record.seen]]).astype(np.float64)
    obs = model.normalizer.obs
    expected = pooled(seen)
    np.testing.assert_allclose(obs.count, expected.count, rtol=1e-12)
    np.testing.assert_allclose(obs.mean, np.broadcast_to(expected.mean, (3, 3)), rtol=1e-9)
    np.testing.assert_allclose(obs.var, np.broadcast_to(expected.var, (3, 3)), rtol=1e-9)
    assert len({row.tobytes() for row in obs.mean}) == 1


def test_who_was_away_has_the_statistics_of_all_when_it_is_back(point_envs, small):
    record = Record()
    model = FedAvg("MlpPolicy", point_envs(4), normalize="shared", client_fraction=0.5, **small)
    model.learn(6 * 2 * 64, record)
    seen = np.concatenate([record.first.reshape(-1, 3), *[rows.reshape(-1, 3) for rows in record.seen]]).astype(np.float64)
    present = np.flatnonzero(model.present)
    np.testing.assert_allclose(model.normalizer.obs.mean[present[0]], pooled(seen).mean, rtol=1e-9)
    np.testing.assert_allclose(model.strategy.strategies[1].count, pooled(seen).count, rtol=1e-12)


def test_the_order_of_uploads_does_not_matter():
    rng = np.random.default_rng(2)
    sent = {k: moments(rng.normal(k, 1 + k, (9, 3))) for k in range(5)}
    results = []
    for order in ([0, 1, 2, 3, 4], [4, 2, 0, 3, 1]):
        server = ObservationMoments()
        results.append(server.aggregate(0, {k: sent[k] for k in order})[0])
    assert all(np.array_equal(results[0][name], results[1][name]) for name in results[0])


def test_of_one_client_shared_statistics_are_its_own(point_envs, small):
    shared, own = (FedAvg("MlpPolicy", point_envs(1), normalize=kind, **small).learn(3 * 64) for kind in ("shared", True))
    np.testing.assert_allclose(shared.normalizer.obs.mean, own.normalizer.obs.mean, atol=1e-6)
    np.testing.assert_allclose(shared.normalizer.obs.var, own.normalizer.obs.var, rtol=1e-5)
    assert_same_parameters(parameters_of(shared, 0), parameters_of(own, 0), 1e-4)


def test_a_robust_aggregator_holds_for_statistics_too():
    rng = np.random.default_rng(3)
    sent = {k: moments(rng.normal(0, 1, (200, 2))) for k in range(7)}
    sent[7] = moments(rng.normal(500, 90, (200, 2)))
    robust = ObservationMoments("median").aggregate(1, sent)[0]
    assert np.abs(robust[OBSERVATION_MEAN]).max() < 0.3 and np.abs(robust[OBSERVATION_VAR] - 1).max() < 0.3


@pytest.mark.parametrize("wrong", [
    {OBSERVATION_VAR: np.array([-1.0, 1.0])}, {OBSERVATION_MEAN: np.array([np.nan, 0.0])},
    {OBSERVATION_MEAN: np.zeros(2, dtype=np.float32)}, {OBSERVATION_COUNT: np.array(-5.0)},
    {OBSERVATION_COUNT: np.array(1e12)}, {OBSERVATION_MEAN: np.array([1e9, 0.0])}, {OBSERVATION_VAR: np.zeros(3)},
])  # fmt: skip
def test_broken_statistics_are_rejected(wrong):
    rng = np.random.default_rng(4)
    sent = {k: moments(rng.normal(1, 1, (50, 2))) for k in range(4)}
    server = ObservationMoments()
    server.exchange(0, sent)
    before = server.latest(0)
    server.exchange(1, {**sent, 2: {**sent[2], **wrong}})
    assert list(server.rejected) == [2]
    assert np.abs(server.latest(0)[OBSERVATION_MEAN] - before[OBSERVATION_MEAN]).max() < 0.5


def test_normalisation_of_a_client_of_its_own_is_as_before(point_envs, small):
    plain = FedAvg("MlpPolicy", point_envs(2), normalize=True, **small).learn(2 * 2 * 64)
    assert not np.array_equal(plain.normalizer.obs.mean[0], plain.normalizer.obs.mean[1])
    assert plain.normalizer.round_moments(0) == {} and "round_obs.mean" not in plain.normalizer.state_dict()


def test_what_is_shared_is_deployed(point_envs, small, tmp_path):
    model = FedAvg("MlpPolicy", point_envs(2), normalize="shared", **small).learn(2 * 2 * 64)
    observation = np.array([[0.3, -0.2, 0.5]], dtype=np.float32)
    expected = model.predict(np.repeat(observation, 2, axis=0), deterministic=True)[0][1]
    np.testing.assert_allclose(model.client(1).predict(observation[0], deterministic=True)[0], expected, atol=1e-6)
    model.export_parameters(tmp_path / "p.npz")
    other = FedAvg("MlpPolicy", point_envs(2), normalize="shared", **small)
    other.import_parameters(tmp_path / "p.npz")
    np.testing.assert_array_equal(other.predict(np.repeat(observation, 2, axis=0), deterministic=True)[0][1], expected)


def test_moments_of_one_round_are_forgotten_by_who_begins_the_next():
    normalizer = FederatedNormalizer(2, 1, 1, 0.99, shared=True)
    normalizer.update_obs(np.array([[[2.0]], [[4.0]]]))
    normalizer.begin_round(np.array([True, False]))
    assert [float(normalizer.round_moments(k)[OBSERVATION_COUNT]) for k in range(2)] == [0.0, 1.0]


def test_only_statistics_leave_a_client_that_is_alone_otherwise(point_envs, small):
    model = Local("MlpPolicy", point_envs(2), normalize="shared", **small).learn(2 * 64)
    assert set(model.outgoing(0)) == {OBSERVATION_COUNT, OBSERVATION_MEAN, OBSERVATION_VAR}


@pytest.mark.parametrize("learner", [FedGuide, FedGuideA])
def test_guided_methods_share_statistics_beside_their_heads(learner):
    offline = {"dataset_size": 60, "dice_updates": 2}
    settings = {"rollout_size": 40, "batch_size": 20, "seed": 3, "n_epochs": 1, "prior_states": 10}
    model = learner("MlpPolicy", "Bandit2D", normalize="shared", pretraining=offline, **settings)
    model.learn(2 * 4 * 40)
    assert model.strategy.rejected == {} and len({row.tobytes() for row in model.normalizer.obs.mean}) == 1


# A share of the average


def test_a_client_takes_its_share(point_envs, small):
    model = FedAvg("MlpPolicy", point_envs(2), mix=0.25, **small)
    sent = []

    class Watch(RoundCallback):
        def _on_local_training_end(self) -> None:
            self.own = parameters_of(self.model, 1)

        def _on_round_end(self) -> None:
            sent.append((self.own, self.model.strategy.latest(1), parameters_of(self.model, 1)))

    model.learn(2 * 2 * 64, Watch())
    for own, average, now in sent:
        for name, array in average.items():
            np.testing.assert_allclose(now[name], 0.75 * own[name].numpy() + 0.25 * array, atol=1e-6)


def test_a_share_that_falls_to_nothing_leaves_everybody_alone(point_envs, small):
    falling = FedAvg("MlpPolicy", point_envs(2), mix=lambda remaining: 2 * remaining, **small)
    shares = []

    class Watch(RoundCallback):
        def _on_round_end(self) -> None:
            shares.append(dict(self.model._shares))

    falling.learn(4 * 2 * 64, Watch())
    assert [share[0] for share in shares] == [1.0, 1.0, 0.5, 0.0]


def test_a_newcomer_takes_all(point_envs, small):
    model = FedAvg("MlpPolicy", point_envs(2), mix=0.1, **small).learn(2 * 64)
    model.has_trained[1] = False
    model.take_broadcasts({0: model.strategy.latest(0), 1: model.strategy.latest(1)})
    average = model.strategy.latest(1)
    assert all(np.array_equal(parameters_of(model, 1)[name], array) for name, array in average.items())
    assert not np.array_equal(parameters_of(model, 0)["log_std"], average["log_std"])


# The upper bound


def test_pooled_is_one_network_on_all_data(point_envs, small):
    model = Pooled("MlpPolicy", point_envs(3), **small).learn(2 * 3 * 64)
    networks = [parameters_of(model, k) for k in range(3)]
    own = [name for name in networks[0] if not th.equal(networks[0][name], networks[1][name])]
    assert own == ["mlp_extractor.policy_net.0.bias", "mlp_extractor.value_net.0.bias"]
    assert model.outgoing(0) == {} and not model.is_federated


def test_of_one_client_pooled_is_ppo(point_envs, small):
    pooled, local = (learner("MlpPolicy", point_envs(1), **small).learn(2 * 64) for learner in (Pooled, Local))
    assert_same_parameters(parameters_of(pooled, 0), parameters_of(local, 0), 1e-6)


def test_pooled_stays_in_one_process(point_envs, small):
    from sb3_fedguide.deployment.site import Site
    from sb3_fedguide.engines.processes import Processes

    with pytest.raises(ValueError, match="client_fraction"):
        Pooled("MlpPolicy", point_envs(2), client_fraction=0.5)
    with pytest.raises(ValueError, match="one process"):
        Processes(2).attach(Pooled("MlpPolicy", point_envs(2), **small))
    with pytest.raises(ValueError, match="one place"):
        Site(Pooled("MlpPolicy", point_envs(1), **small), 2, "nowhere")


# Who comes late


def test_newcomers_start_from_the_mean_policy_and_what_all_have_seen(point_envs, small, tmp_path):
    known = FedAvg("MlpPolicy", point_envs(3), normalize="shared", **small).learn(2 * 3 * 64)
    known.export_parameters(tmp_path / "known.npz")
    late = FedAvg("MlpPolicy", point_envs(2), normalize="shared", **small)
    start_from(late, tmp_path / "known.npz")
    for client in range(2):
        for name, tensor in parameters_of(late, client).items():
            np.testing.assert_allclose(
                tensor, th.stack([parameters_of(known, k)[name] for k in range(3)]).mean(dim=0), atol=1e-6
            )
    np.testing.assert_allclose(late.normalizer.obs.mean[1], known.normalizer.obs.mean[0], rtol=1e-12)
    late.learn(2 * 64)  # the first exchange pools what both begin with, and leaves it as it is
    assert np.abs(late.normalizer.obs.mean[0] - known.normalizer.obs.mean[0]).max() < 0.2
    with pytest.raises(ValueError, match="before they train"):
        start_from(late, tmp_path / "known.npz")
    with pytest.raises(ValueError, match="normalize is True"):
        start_from(FedAvg("MlpPolicy", point_envs(2), **small), tmp_path / "known.npz")
    with pytest.raises(ValueError, match="no parameter file"):
        start_from(FedAvg("MlpPolicy", point_envs(2), **small), tmp_path / "nothing.npz")
