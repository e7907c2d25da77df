"""The server's checks of uploads: what is rejected and why, what becomes of it, and that honest clients pass."""

from __future__ import annotations

import json
import re
import warnings

import numpy as np
import pytest
import torch as th

from fed_envs.faults import ClientError
from sb3_fedguide import FedAvg, FedGuide, FedKL, FedRL, FedSVRPGM
from sb3_fedguide.cli.recorder import CostCallback
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.priors import GaussianPrior, active_experts, mixture_log_prob
from sb3_fedguide.registry import algorithm
from sb3_fedguide.server.averaging import Averaging, combine, weighted_average
from sb3_fedguide.server.ot_moe import COST_ROW, EXPERTS, HEAD, MIXTURE_ROW, OTMoE
from sb3_fedguide.server.strategy import N_SAMPLES, Composite
from sb3_fedguide.server.svrpg import DIRECTION, SVRPG
from sb3_fedguide.server.validation import UPLOAD_BOUND, check_uploads, group_norms, norm_limit
from tests.conftest import others_slow

SMALL = {"rollout_size": 40, "batch_size": 20, "n_envs_per_client": 2, "seed": 3}
TINY_OFFLINE = {
    "dataset_size": 60,
    "bc_updates": 2,
    "prior_updates": 2,
    "dice_updates": 2,
    "prior_batch_size": 16,
    "dice_width": 8,
}


def weights(value: float, n_samples: float = 10.0) -> dict[str, np.ndarray]:
    return {"a": np.full((2, 3), value, np.float32), "b": np.float32(value), N_SAMPLES: np.array(n_samples, np.float32)}


def five() -> dict[int, dict[str, np.ndarray]]:
    return {client: weights(1 + 0.1 * client) for client in range(5)}


BROKEN = {
    "nan": ({"a": np.full((2, 3), np.nan, np.float32)}, "a has values that are not finite"),
    "inf": ({"b": np.float32(np.inf)}, "b has values that are not finite"),
    "float64": ({"a": np.ones((2, 3))}, "a has the type float64, not float32"),
    "objects": ({"a": np.array([["x", None, 1]], dtype=object)}, "a has the type object, not float32"),
    "list": ({"a": [[1.0, 2.0, 3.0]]}, "a is a list, not an array"),
    "shape": ({"a": np.ones((3, 2), np.float32)}, r"a has the shape \(3, 2\), those of the others \(2, 3\)"),
    "broadcastable": ({"a": np.ones((1, 3), np.float32)}, r"a has the shape \(1, 3\), those of the others \(2, 3\)"),
    "missing": ({"a": None}, "a is missing"),
    "more": ({"c": np.float32(0)}, "c is not expected"),
    "huge": ({"a": np.full((2, 3), 1e6, np.float32)}, "the norm of its parameters is 2.45e.06, over the limit of"),
    "largest float": ({"a": np.full((2, 3), 3e38, np.float32)}, "the norm of its parameters"),
    "no samples": ({N_SAMPLES: np.float32(0)}, "n_samples is not a positive number"),
    "negative samples": ({N_SAMPLES: np.float32(-5)}, "n_samples is not a positive number"),
    "samples by the array": ({N_SAMPLES: np.ones(3, np.float32)}, "n_samples is not a positive number"),
    "claims many samples": ({N_SAMPLES: np.float32(1e6)}, "the norm of its n_samples is 1e.06, over the limit of"),
}


@pytest.mark.parametrize("fault", BROKEN)
@pytest.mark.parametrize("liar", [0, 2, 4])
def test_what_is_wrong_with_an_upload_is_said_of_it_alone(fault, liar):
    changes, reason = BROKEN[fault]
    uploads = five()
    uploads[liar] = {name: array for name, array in {**uploads[liar], **changes}.items() if array is not None}
    reasons = check_uploads(uploads, {})
    assert list(reasons) == [liar]
    assert re.search(reason, reasons[liar])


def test_an_upload_that_is_no_mapping_is_rejected():
    assert check_uploads({**five(), 1: [1.0]}, {}) == {1: "it is a list, not named arrays"}
    assert "not a string" in check_uploads({**five(), 1: {3: np.float32(1)}}, {})[1]


def test_two_of_five_are_found_whatever_they_send():
    uploads = five()
    uploads[1], uploads[3] = weights(1e6), {"else": np.float32(1)}
    assert sorted(check_uploads(uploads, {})) == [1, 3]
    uploads[1] = weights(np.nan)
    assert sorted(check_uploads(uploads, {})) == [1, 3]


def test_the_limit_is_what_the_documentation_says():
    assert norm_limit([1.0, 2.0, 4.0, 100.0], 10) == pytest.approx(3 + 10 * 1.5)  # deviations 2, 1, 1, 97; the floor is 1.5
    assert norm_limit([1.0, 2.0, 9.0, 10.0, 100.0], 10) == pytest.approx(9 + 10 * 7)  # deviations 8, 7, 0, 1, 91
    assert norm_limit([0.0, 0.0, 0.0, 5.0], 10) == pytest.approx(5 + 10 * 2.5), "who has not learned yet sets no limit"
    assert norm_limit([0.0, 0.0], 10) == np.inf
    rng = np.random.default_rng(0)
    for _ in range(200):
        norms = rng.exponential(size=rng.integers(3, 9)) ** rng.uniform(0, 3)
        ratio = norm_limit(list(norms), UPLOAD_BOUND) / np.median(norms)
        assert 1 + UPLOAD_BOUND / 2 - 1e-9 <= ratio <= 1 + UPLOAD_BOUND + 1e-9


def test_norms_are_of_the_change_where_something_was_sent():
    upload = {"a": np.float32([3, 4]), "b": np.float32(12), DIRECTION + "a": np.float32([2.0, 0])}
    reference = {"a": np.float32([3, 0]), "b": np.float32(9), DIRECTION + "a": np.float32([2.0, 0])}
    assert group_norms(upload, reference, (DIRECTION,)) == {"parameters": 5.0, DIRECTION: 2.0}
    uploads = {client: weights(100.0 + 0.01 * client) for client in range(5)}
    sent = {client: {"a": np.full((2, 3), 100.0), "b": np.array(100.0)} for client in range(5)}
    sent[4] = {"a": np.full((2, 3), 99.0), "b": np.array(99.0)}
    assert check_uploads(uploads, {}) == {}
    assert list(check_uploads(uploads, sent)) == [4], "it has changed by 1.04, the others by up to 0.03"


@pytest.mark.parametrize("lie", [-100.0, 90.0, 103.0])
def test_before_anything_was_sent_uploads_are_compared_with_their_median(lie):
    uploads = {client: weights(100.0 + 0.01 * client) for client in range(4)} | {4: weights(lie)}
    assert list(check_uploads(uploads, {})) == [4]


def test_a_small_array_has_a_norm_of_its_own_where_the_strategy_says_so():
    rng = np.random.default_rng(0)
    uploads = {client: {"large": rng.normal(size=1000).astype(np.float32), "small.x": np.float32(0.1)} for client in range(4)}
    uploads[2]["small.x"] = np.float32(50.0)
    assert check_uploads(uploads, {}) == {}
    assert "its small" in check_uploads(uploads, {}, ("small.",))[2]
    strategy = Composite([OTMoE(2), SVRPG()])
    assert strategy.norm_groups == (HEAD, COST_ROW, DIRECTION)


def test_two_clients_have_no_majority_and_only_broken_ones_are_rejected():
    uploads = {0: weights(1.0), 1: weights(1e6)}
    assert check_uploads(uploads, {}) == {}
    assert list(check_uploads({**uploads, 1: weights(np.inf)}, {})) == [1]


def test_a_rejected_upload_moves_nothing_and_its_client_receives_nothing():
    uploads, strategy, honest = five(), Averaging(), Averaging()
    uploads[2]["a"][0, 0] = np.nan
    broadcasts = strategy.exchange(1, uploads)
    expected = honest.exchange(1, {client: upload for client, upload in uploads.items() if client != 2})
    assert list(broadcasts) == [0, 1, 3, 4] and strategy.metrics == {**honest.metrics, "rejected": 1.0}
    np.testing.assert_array_equal(broadcasts[0]["a"], expected[0]["a"])
    assert list(strategy.rejected) == [2] and honest.rejected == {} and honest.metrics["rejected"] == 0.0
    np.testing.assert_array_equal(strategy.catch_up(2)["a"], broadcasts[0]["a"])
    assert list(strategy.exchange(2, five())) == [0, 1, 2, 3, 4] and strategy.rejected == {}


def test_without_a_bound_nothing_is_checked():
    strategy = Averaging()
    strategy.upload_bound = None
    uploads = five()
    uploads[2]["a"][0, 0] = np.nan
    assert np.isnan(strategy.exchange(1, uploads)[0]["a"]).any() and "rejected" not in strategy.metrics


def test_all_uploads_rejected_is_a_round_without_exchange():
    strategy = Averaging()
    kept = strategy.exchange(1, five())[0]["a"]
    assert strategy.exchange(2, {client: weights(np.nan) for client in range(5)}) == {}
    assert strategy.metrics == {"rejected": 5.0} and len(strategy.rejected) == 5
    np.testing.assert_array_equal(strategy.catch_up(3)["a"], kept)
    with pytest.raises(ClientError, match=r"clients 0, 1: the server cannot begin.*client 1, prior.head has values"):
        OTMoE(2).exchange(0, {client: {HEAD: np.full((1, 2), np.nan, np.float32)} for client in range(2)})


def heads(n: int = 5) -> dict[int, dict[str, np.ndarray]]:
    rng = np.random.default_rng(0)
    return {client: {HEAD: rng.normal(size=(2, 3)).astype(np.float32)} for client in range(n)}


def test_a_rejected_head_counts_as_absent_and_keeps_its_row():
    strategy, without = OTMoE(3, cost="param"), OTMoE(3, cost="param")
    for server in (strategy, without):
        server.exchange(0, heads())
    row = strategy.rows[4].copy()
    lie = {**heads(), 4: {HEAD: np.full((2, 3), 1e6, np.float32)}}
    broadcasts = strategy.exchange(1, lie)
    expected = without.exchange(1, {client: upload for client, upload in heads().items() if client != 4})
    assert list(broadcasts) == [0, 1, 2, 3] and strategy.plan.shape == (4, 3)
    np.testing.assert_array_equal(strategy.experts, without.experts)
    np.testing.assert_array_equal(broadcasts[0][MIXTURE_ROW], expected[0][MIXTURE_ROW])
    np.testing.assert_array_equal(strategy.rows[4], row)


def test_who_is_rejected_in_the_setup_begins_with_the_experts_and_equal_weights():
    strategy = OTMoE(3, cost="score")
    wrong = {**heads(), 4: {HEAD: np.full((2, 3), np.inf, np.float32)}}
    first = strategy.exchange(0, wrong)
    np.testing.assert_array_equal(first[4][EXPERTS], first[0][EXPERTS])
    assert strategy.needs_setup
    rows = {client: {**upload, COST_ROW: np.ones(3, np.float32)} for client, upload in wrong.items()}
    second = strategy.exchange(0, rows)
    assert not strategy.needs_setup and list(strategy.rejected) == [4]
    np.testing.assert_allclose(second[4][MIXTURE_ROW], 1 / 3)
    assert 4 not in strategy.rows and 4 not in strategy.exchange(1, rows)


def test_the_server_keeps_only_what_later_uploads_are_compared_with():
    """Experts go to everybody and come back from nobody: a copy for every client would be most of the server's memory."""
    transport, averaging = OTMoE(2), Averaging()
    while transport.needs_setup or not transport.sent:
        heads = {client: {HEAD: np.full((1, 3), client, dtype=np.float32)} for client in range(4)}
        rows = (
            {client: {COST_ROW: np.ones(2, dtype=np.float32)} for client in range(4)} if transport.experts is not None else {}
        )
        transport.exchange(0, {client: {**heads[client], **rows.get(client, {})} for client in range(4)})
    assert not any(transport.sent.values())
    averaging.exchange(1, {k: {"w": np.full(2, k, dtype=np.float32), N_SAMPLES: np.float32(1)} for k in range(4)})
    assert [list(payload) for payload in averaging.sent.values()] == [["w"]] * 4


@pytest.mark.parametrize("n", [1, 2, 5, 8])
def test_aggregators_against_their_definitions(n):
    rng = np.random.default_rng(n)
    uploads = {k: {"x": rng.normal(size=(4, 3)).astype(np.float32), N_SAMPLES: np.float32(1 + k)} for k in range(n)}
    stacked = np.stack([upload["x"] for upload in uploads.values()])
    np.testing.assert_allclose(combine(uploads, ["x"], "median", 0.25)["x"], np.median(stacked, axis=0), rtol=1e-6)
    for fraction in (0.0, 0.2, 0.25, 0.49):
        cut = int(fraction * n)
        expected = np.sort(stacked, axis=0)[cut : n - cut].mean(axis=0)
        np.testing.assert_allclose(combine(uploads, ["x"], "trimmed_mean", fraction)["x"], expected, rtol=1e-5, atol=1e-7)
    counts = [1 + k for k in range(n)]
    mean = weighted_average(list(uploads.values()), counts, ["x"])["x"]
    np.testing.assert_array_equal(combine(uploads, ["x"], "mean", 0.25)["x"], mean)
    np.testing.assert_allclose(mean, np.average(stacked, axis=0, weights=counts), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("aggregator", ["median", "trimmed_mean"])
def test_two_of_eight_cannot_carry_a_coordinate_out_of_the_others_range(aggregator):
    rng = np.random.default_rng(0)
    honest = {k: {"x": rng.normal(size=50).astype(np.float32), N_SAMPLES: np.float32(1)} for k in range(6)}
    lies = {k: {"x": np.full(50, 1e30, np.float32), N_SAMPLES: np.float32(1e9)} for k in (6, 7)}
    combined = combine({**honest, **lies}, ["x"], aggregator, 0.25)["x"]
    stacked = np.stack([upload["x"] for upload in honest.values()])
    assert (combined <= stacked.max(axis=0)).all() and (combined >= stacked.min(axis=0)).all()


@pytest.mark.parametrize("settings", [{"aggregator": "mode"}, {"trim_fraction": 0.5}, {"trim_fraction": -0.1}])
def test_unfit_aggregators_are_refused(settings, point_envs):
    with pytest.raises(ValueError, match=next(iter(settings))):
        FedAvg("MlpPolicy", point_envs(2), **settings, **SMALL)
    with pytest.raises(ValueError, match=next(iter(settings))):
        Averaging(**settings)


@pytest.mark.parametrize("bound", [0.0, -1.0, np.inf, np.nan])
def test_unfit_bounds_are_refused(bound, point_envs):
    with pytest.raises(ValueError, match="upload_bound"):
        FedAvg("MlpPolicy", point_envs(2), upload_bound=bound, **SMALL)


@pytest.mark.parametrize("learner", [FedAvg, FedKL, FedSVRPGM, FedRL])
@pytest.mark.parametrize("aggregator", ["median", "trimmed_mean"])
def test_algorithms_send_what_their_aggregator_says(learner, aggregator, point_envs):
    settings = {"learning_starts": 20, "buffer_size": 100} if learner is FedRL else {"n_epochs": 1}
    model = learner("MlpPolicy", point_envs(5), aggregator=aggregator, trim_fraction=0.3, **settings, **SMALL)

    class Watch(RoundCallback):
        def _on_local_training_end(self):
            self.trained = {name: p.detach().numpy().copy() for name, p in self.model.policy.named_parameters()}

    watch = Watch()
    model.learn(2 * 5 * 40, watch)
    for name, parameter in model.policy.named_parameters():
        ordered = np.sort(watch.trained[name].astype(np.float64), axis=0)
        expected = ordered[2] if aggregator == "median" else ordered[1:4].mean(axis=0)
        if name.startswith(model.averaged_prefixes):
            np.testing.assert_allclose(parameter[0].detach().numpy(), expected, rtol=1e-5, atol=1e-7)


def lie(model, liar: int, value: float) -> None:
    """Let one client replace what it uploads."""
    honest = model.upload

    def upload(index):
        payload = honest(index)
        lies = {name: np.full_like(array, value) for name, array in payload.items() if name != N_SAMPLES}
        return {**payload, **lies} if index == liar else payload

    model.upload = upload


class Starts(RoundCallback):
    """The clients' parameters at the start of each round."""

    def __init__(self):
        super().__init__()
        self.states = []

    def _on_round_start(self):
        self.states.append([self.model.policy.client_state_dict(index) for index in range(self.model.n_clients)])


def same(a, b) -> bool:
    return all(th.equal(tensor, b[name]) for name, tensor in a.items())


@pytest.mark.parametrize("value", [np.nan, 1e6])
def test_a_lying_client_is_named_counted_and_does_not_move_the_others(value, point_envs, tmp_path):
    from stable_baselines3.common.logger import configure

    model = FedAvg("MlpPolicy", point_envs(4), n_epochs=1, **SMALL)
    model.set_logger(configure(str(tmp_path), ["json"]))
    lie(model, 2, value)
    starts = Starts()
    with pytest.warns(UserWarning, match=r"round [123]: the server rejects the upload of client 2: ") as caught:
        model.learn(3 * 4 * 40, starts)
    assert sum("rejects" in str(warning.message) for warning in caught) == 3
    rows = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    assert [row["federated/rejected"] for row in rows] == [1, 1, 1] and [row["client_2/rejected"] for row in rows] == [1, 1, 1]
    assert not any("client_1/rejected" in row for row in rows)
    # like an absent client, it has what the others have when the next round begins
    for states in starts.states[1:]:
        assert same(states[2], states[0]) and same(states[3], states[0])
    final = [model.policy.client_state_dict(index) for index in range(4)]
    assert same(final[3], final[0]) and not same(final[2], final[0]), "it has not received the last average yet"
    without = FedAvg("MlpPolicy", point_envs(4), clients=[0, 1, 3], n_epochs=1, **SMALL)
    without.learn(3 * 3 * 40)
    for name, tensor in without.policy.client_state_dict(0).items():
        th.testing.assert_close(final[0][name], tensor, rtol=1e-4, atol=1e-5)


def test_one_wrong_upload_does_not_exclude_a_client_for_good(point_envs):
    model = FedAvg("MlpPolicy", point_envs(4), n_epochs=1, **SMALL)
    honest, rejected = model.upload, []
    model.upload = lambda index: {
        name: array * (np.nan if (index, model.round) == (2, 1) else 1) for name, array in honest(index).items()
    }

    class Watch(RoundCallback):
        def _on_round_end(self):
            rejected.append(list(self.model.strategy.rejected))

    with pytest.warns(UserWarning, match="rejects"):
        model.learn(4 * 4 * 40, Watch())
    assert rejected == [[2], [], [], []]


def test_nothing_is_sent_between_two_averages(point_envs):
    model = FedAvg("MlpPolicy", point_envs(4), n_epochs=1, average_every=3, **SMALL)
    sent = []
    exchange = model.strategy.exchange
    model.strategy.exchange = lambda round, uploads: (sent.append((round, bool(uploads[0]))), exchange(round, uploads))[1]
    model.learn(6 * 4 * 40)
    assert sent == [(round, round % 3 == 0) for round in range(1, 7)]


@pytest.mark.parametrize("value", [np.nan, 1e6])
def test_fedguide_goes_on_beside_a_lying_client(value):
    settings = {"pretraining": TINY_OFFLINE, "prior_states": 20, "adapt": "advantage", "n_epochs": 1}
    model = FedGuide("MlpPolicy", "Bandit2D", **settings, **SMALL)
    lie(model, 1, value)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.learn(3 * 4 * 40)
    assert list(model.strategy.rejected) == [1] and list(model.strategy.rows) == [0, 2, 3]
    assert np.isfinite(model.strategy.experts).all() and np.abs(model.strategy.experts).max() < 1e5
    np.testing.assert_allclose(model.mixture_rows[1], 1 / 4)
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())


def test_a_head_that_is_no_density_is_left_out_of_mixtures():
    prior, rng = GaussianPrior(2, 2), np.random.default_rng(0)
    good = prior.fit_head(np.zeros((50, 2)), rng.normal(size=(50, 2)), rng)
    experts = np.stack([good, -good, good + 0.1 * np.float32([[0, 0, 1], [0, 0, 0]])])
    np.testing.assert_array_equal(prior.describes_density(experts), [True, False, True])
    obs, actions = th.zeros(5, 2), th.as_tensor(rng.normal(size=(5, 2)), dtype=th.float32)
    mixed = mixture_log_prob(prior, experts, np.float32([0.2, 0.5, 0.3]), obs, actions)
    th.testing.assert_close(mixed, mixture_log_prob(prior, experts[[0, 2]], np.float32([0.4, 0.6]), obs, actions))
    active, weights = active_experts(np.array([0.2, 0.5, 0.3]), 3, usable=np.array([True, False, True]))
    np.testing.assert_array_equal(active, [0, 2])
    np.testing.assert_allclose(weights, [0.4, 0.6])


HONEST = [("fedavg", 1.0), ("fedkl", 0.5), ("fedsvrpgm", 1.0), ("fedrl", 1.0), ("fedrl", 0.5)]
HONEST += [("fedguide-p", 0.5), ("fedguide-a", 1.0)]


QUICK = [("fedsvrpgm", 1.0), ("fedrl", 1.0), ("fedguide-a", 1.0)]


@pytest.mark.parametrize(("name", "fraction"), others_slow(HONEST, lambda *case: case in QUICK))
def test_honest_clients_stay_far_below_the_limit(name, fraction):
    """Half of the bound would do for clients whose worlds and rewards differ as widely as ReacherHard's."""
    settings = {"learning_starts": 40} if name == "fedrl" else {"n_epochs": 2}
    settings |= {"client_fraction": fraction, "normalize": True, "upload_bound": UPLOAD_BOUND / 2}
    if name.startswith("fedguide"):
        settings |= {"prior_states": 20, "adapt": "advantage"}
    if name == "fedguide-a":
        settings["average_every"] = 2
    model = algorithm(name)("MlpPolicy", "ReacherHard", pretraining=TINY_OFFLINE, **settings, **SMALL)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*rejects")
        model.learn(4 * model.n_participants * 40)
    assert model.round == 4 and model.strategy.metrics["rejected"] == 0


def test_a_run_counts_rejected_uploads_by_client(point_envs):
    model, costs = FedAvg("MlpPolicy", point_envs(4), n_epochs=1, **SMALL), CostCallback()
    lie(model, 2, np.nan)
    with pytest.warns(UserWarning, match="rejects the upload of client 2"):
        model.learn(3 * 4 * 40, costs)
    assert costs.rejected == {2: 3}
