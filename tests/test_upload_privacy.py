"""Clipping and noise of what clients upload: exact where it has to be, counted, and the same over every way to train."""

from __future__ import annotations

import functools
import importlib.util
import math
import secrets
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from sb3_fedguide.cli.train import main
from sb3_fedguide.common.privacy_accountant import SENSITIVITY, epsilon
from sb3_fedguide.common.upload_privacy import gaussian_noise
from sb3_fedguide.deployment.serve import serve
from sb3_fedguide.deployment.site import Site
from sb3_fedguide.deployment.transport import RUN, Message
from sb3_fedguide.registry import algorithm
from sb3_fedguide.seeding import Role, seed_sequence
from sb3_fedguide.server.metrics import merge_metrics
from sb3_fedguide.server.payload import N_SAMPLES
from tests.conftest import assert_same_parameters
from tests.loop_engine import Here
from tests.sites import CLIENTS, N_ROUNDS, federation, in_process, make

AVERAGING = ["fedavg", "fedprox", "fedkl", "fedsvrpgm", "fedrl", "fedguide-r"]
#: with which nothing is clipped
FAR = 1e6
PRIVATE: dict[str, Any] = {"noise_multiplier": 0.05, "clipping_norm": 0.5, "normalize": True}


def trained(algo: str, n_rounds: int = 2, **more: Any):
    model = make(algo, "Bandit2D", bc_weight=0.0, **more)
    model.learn(n_rounds * model.rollout_size * model.n_participants)
    return model


def flat(payload: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([payload[name].ravel().astype(np.float64) for name in sorted(payload) if name != N_SAMPLES])


def known(model, index: int) -> np.ndarray:
    return flat({name: array[index] for name, array in model.known_parameters.items()})


@pytest.mark.parametrize("algo", AVERAGING)
def test_without_noise_and_with_a_norm_that_nothing_reaches_everything_is_as_without(algo):
    plain, clipped = trained(algo), trained(algo, clipping_norm=FAR)
    for client in range(plain.n_clients):
        assert_same_parameters(clipped.policy.client_state_dict(client), plain.policy.client_state_dict(client))
    assert (clipped.privacy_state["uploads"] > 0).all() and not clipped.privacy_state["clipped"].any()
    assert not plain.privacy_state and not plain.known_parameters


@pytest.mark.parametrize("algo", ["fedavg", "fedsvrpgm", "fedrl"])
def test_what_is_clipped_keeps_its_direction_and_has_the_norm(algo):
    model = trained(algo, clipping_norm=0.01)
    model.policy.load_client(1, {name: array + 0.3 for name, array in model.averaged_parameters(1).items()})
    clean, sent = flat(model.upload(1)) - known(model, 1), flat(model.outgoing(1)) - known(model, 1)
    assert np.linalg.norm(sent) == pytest.approx(0.01, rel=1e-3)  # float32
    assert sent @ clean / np.linalg.norm(sent) / np.linalg.norm(clean) == pytest.approx(1, abs=1e-4)
    assert model.privacy_state["norm"][1] == pytest.approx(np.linalg.norm(clean))
    assert model.privacy_state["clipped"][1] > 0 and model.upload_metrics()["privacy/clipped"] > 0


def test_noise_has_the_variance_of_the_formula_and_is_another_for_everybody_and_every_upload():
    model = make("fedavg", "Bandit2D", noise_multiplier=0.7, clipping_norm=0.2, policy_kwargs={"net_arch": [48, 48]})
    upload = {name: array[0] + 1.0 for name, array in model.known_parameters.items()}
    upload[N_SAMPLES] = np.array(32, dtype=np.float32)
    length = math.sqrt(sum(array.size for array in upload.values()) - 1)
    sent = [flat(model._privacy.protect(index, upload)) - known(model, 0) - 0.2 / length for index in (0, 0, 1)]
    for noise in sent:
        assert noise.std() == pytest.approx(0.7 * 0.2, rel=0.03) and abs(noise.mean()) < 0.14 * 4 / length
    assert np.abs(np.corrcoef(sent) - np.eye(3)).max() < 4 / length
    assert model.privacy_state["uploads"].tolist() == [2, 1, 0]


def test_the_noise_is_gaussian_and_follows_from_key_and_content():
    noise = gaussian_noise(b"key", b"update", 20_001)
    ordered = np.sort(noise)
    distance = np.abs(norm.cdf(ordered) - (np.arange(len(noise)) + 0.5) / len(noise)).max()
    assert distance < 1.95 / math.sqrt(len(noise))  # Kolmogorov and Smirnov, 0.1 %
    assert (noise == gaussian_noise(b"key", b"update", 20_001)).all()
    others = [gaussian_noise(b"kez", b"update", 20_001), gaussian_noise(b"key", b"updatf", 20_001)]
    assert all(abs(np.corrcoef(noise, other)[0, 1]) < 0.03 for other in others)


def test_the_first_upload_is_compared_with_what_everybody_knows_and_not_with_the_warm_start():
    model = make("fedavg", "Bandit2D", clipping_norm=1e-6)
    public = {name: array.copy() for name, array in model.averaged_parameters(0).items()}
    model.pretrain()
    assert np.abs(flat(model.averaged_parameters(0)) - flat(public)).max() > 1e-4
    model.round = 1
    assert np.abs(flat(model.outgoing(0)) - flat(public)).max() <= 1e-6


def test_who_was_away_counts_the_rounds_in_which_it_uploaded():
    model = trained("fedavg", 5, client_fraction=0.7, **PRIVATE)
    uploads = model.privacy_state["uploads"]
    assert uploads.sum() == 5 * model.n_participants < 5 * model.n_clients
    expected = epsilon(0.05, int(uploads.max()), 1e-5)
    assert model.upload_metrics()["privacy/epsilon"] == model.upload_summary()["epsilon"] == expected


@pytest.mark.parametrize("more", [{"aggregator": "median"}, {"server_step": "exp", "server_momentum": 0.5}, {"mix": 0.5}])
def test_the_server_only_ever_sees_what_has_noise(more, monkeypatch):
    model, seen = make("fedavg", "Bandit2D", **PRIVATE, **more), []
    exchange = model.strategy.exchange
    clean: list[dict[int, np.ndarray]] = []

    def watched(round, uploads):
        clean.append({client: flat(model.averaged_parameters(client)) for client in uploads})
        seen.append({client: flat(payload) for client, payload in uploads.items()})
        return exchange(round, uploads)

    monkeypatch.setattr(model.strategy, "exchange", watched)
    model.learn(3 * model.rollout_size * model.n_clients)
    assert len(seen) == 3
    for ours, theirs in zip(clean, seen, strict=True):
        for client in ours:
            assert (theirs[client] - ours[client]).std() == pytest.approx(0.05 * 0.5, rel=0.3)


def test_who_has_left_uploads_noise_around_what_it_was_sent_so_that_nobody_sees_it():
    model = trained("fedguide-r", **{**PRIVATE, "mix": 1.0})
    model.screening_state["alone"][0] = True
    model.policy.load_client(0, {name: array + 9.0 for name, array in model.averaged_parameters(0).items()})
    first, second = model.outgoing(0), model.outgoing(0)
    for sent in (first, second):
        assert sent[N_SAMPLES] == model.rollout_size and sent.keys() == model.upload_shapes().keys()
        assert (flat(sent) - known(model, 0)).std() == pytest.approx(0.05 * 0.5, rel=0.2)
    assert not np.array_equal(flat(first), flat(second))
    assert {**model.outgoing(1), **first}.keys() == first.keys()


def test_what_nobody_averages_is_not_sent():
    model = trained("fedsvrpgm", average_every=3, **PRIVATE)
    assert not model.privacy_state["uploads"].any() and model.outgoing(0) == {} and model.upload(0)
    model = trained("fedsvrpgm", mix=0.0, **PRIVATE)
    assert model.outgoing(0) == {N_SAMPLES: 0} and not model.privacy_state["uploads"].any()


def test_a_run_that_goes_on_uploads_the_same_and_counts_on():
    whole = trained("fedsvrpgm", 4, **PRIVATE)
    first, second = trained("fedsvrpgm", 2, **PRIVATE), make("fedsvrpgm", "Bandit2D", **PRIVATE)
    second.load_state(first.save_state())
    second.learn(2 * second.rollout_size * second.n_clients, reset_num_timesteps=False)
    for client in range(whole.n_clients):
        assert_same_parameters(second.policy.client_state_dict(client), whole.policy.client_state_dict(client))
    assert (second.privacy_state["uploads"] == 4).all()
    for other in ({**PRIVATE, "noise_multiplier": 0.1}, {**PRIVATE, "clipping_norm": 1.0}):
        with pytest.raises(ValueError, match=r"does not fit: its (noise_multiplier|clipping_norm) is"):
            make("fedsvrpgm", "Bandit2D", **other).load_state(first.save_state())
    with pytest.raises(ValueError, match=r"its noise_multiplier is None, here it is 0\.05"):
        make("fedsvrpgm", "Bandit2D", **PRIVATE).load_state(trained("fedsvrpgm", 1).save_state())
    with pytest.raises(ValueError, match=r"its noise_multiplier is 0\.05, here it is None"):
        make("fedsvrpgm", "Bandit2D", normalize=True).load_state(first.save_state())


def test_of_an_update_that_is_no_number_nothing_is_sent():
    model = make("fedavg", "Bandit2D", **PRIVATE)
    next(iter(model.known_parameters.values()))[0].flat[0] = np.nan
    model.round = 1
    assert np.isnan(flat(model.outgoing(0))).all() and np.isfinite(flat(model.outgoing(1))).all()


def test_a_saved_model_goes_on_counting(tmp_path):
    model = trained("fedavg", **PRIVATE)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=model.get_env())
    assert (loaded.privacy_state["uploads"] == 2).all()
    np.testing.assert_array_equal(flat(loaded.outgoing(1)), flat(model.outgoing(1)))


def test_clients_in_other_processes_upload_the_same():
    plain, other = make("fedguide-r", "Bandit2D", **PRIVATE), make("fedguide-r", "Bandit2D", **PRIVATE)
    Here(2).attach(other)
    for model in (plain, other):
        model.learn(3 * model.rollout_size * model.n_clients)
    for client in range(plain.n_clients):
        assert_same_parameters(other.policy.client_state_dict(client), plain.policy.client_state_dict(client))
    assert plain.privacy_state.keys() == other.privacy_state.keys()
    for name, array in plain.privacy_state.items():
        np.testing.assert_array_equal(other.privacy_state[name], array)


def private_federation(algo: str, folder, fresh: bool = True, **more: Any):
    config, transport = federation(algo, "Bandit2D", folder, fresh=fresh, **PRIVATE, **more)
    transport.make = lambda client: Site(
        make(algo, "Bandit2D", [client], **PRIVATE, **more), N_ROUNDS, folder / f"site_{client}", report=False
    )
    return config, transport


def seeded_keys(monkeypatch) -> None:
    """Let sites draw, in the order in which they are made, the keys of the federation in one process."""
    waiting = [seed_sequence(3, Role.UPLOAD_NOISE, client).generate_state(8).tobytes() for client in CLIENTS]

    def token_bytes(size: int) -> bytes:
        return waiting.pop(0) if waiting else bytes(size)  # those made later take theirs from the disk

    monkeypatch.setattr(secrets, "token_bytes", token_bytes)


@pytest.mark.parametrize("algo", ["fedguide-r", "fedrl"])
def test_sites_learn_what_the_clients_learn_in_one_process(algo, tmp_path, monkeypatch):
    seeded_keys(monkeypatch)
    config, transport = private_federation(algo, tmp_path, fresh=False)
    logs: list[dict[str, float]] = []
    serve(config, transport, tmp_path / "server", lambda round, figures: logs.append(dict(figures)))
    model = in_process(algo, "Bandit2D", **PRIVATE)
    for client in CLIENTS:
        site = transport.site(client).model
        assert_same_parameters(site.policy.client_state_dict(0), model.policy.client_state_dict(client))
        for name, array in model.privacy_state.items():
            np.testing.assert_array_equal(site.privacy_state[name][0], array[client], err_msg=name)
    n_uploads = int(model.privacy_state["uploads"].max())
    spent = [log["privacy/epsilon"] for log in logs if "privacy/epsilon" in log]
    assert spent == [epsilon(0.05, n + 1, 1e-5) for n in range(n_uploads)]


def test_the_seed_does_not_tell_a_sites_noise_and_a_restart_does_not_change_it(tmp_path):
    config, transport = private_federation("fedavg", tmp_path)
    serve(config, transport, tmp_path / "server")
    seeded = in_process("fedavg", "Bandit2D", **PRIVATE).privacy_state["key"]
    keys = np.concatenate([transport.site(client).model.privacy_state["key"] for client in CLIENTS])
    assert not (keys == seeded).any() and len(np.unique(keys)) == keys.size
    again = np.concatenate([transport.site(client).model.privacy_state["key"] for client in CLIENTS])
    np.testing.assert_array_equal(keys, again)


def test_a_site_sends_nothing_beside_its_uploads_that_depends_on_its_data(tmp_path):
    with pytest.raises(ValueError, match="set report: false"):
        Site(make("fedavg", "Bandit2D", [0], **PRIVATE), N_ROUNDS, tmp_path / "site")
    config, transport = private_federation("fedguide-r", tmp_path)
    exchange, facts = transport.send_and_receive, []

    def watched(requests, timeout):
        replies = exchange(requests, timeout)
        facts.extend(reply.facts for reply in replies.values() if reply.kind == "round")
        return replies

    transport.send_and_receive = watched  # type: ignore[method-assign]
    serve(config, transport, tmp_path / "server")
    assert len(facts) == len(CLIENTS) * N_ROUNDS
    public = {"privacy/epsilon", "privacy/noise_multiplier"}
    assert all(own.keys() == {"figures", "evaluations"} and not own["evaluations"] for own in facts)
    assert all(own["figures"].keys() <= public for own in facts)


def test_a_client_with_less_noise_than_the_others_is_refused(tmp_path):
    config, transport = private_federation("fedavg", tmp_path)
    own = transport.make
    weaker = {**PRIVATE, "noise_multiplier": 0.01}

    def make_site(client: int) -> Site:
        if client != 1:
            return own(client)
        return Site(make("fedavg", "Bandit2D", [1], **weaker), N_ROUNDS, tmp_path / "weak", report=False)

    transport.make = make_site
    config = type(config)(**{**vars(config), "start_clients": 2})
    server = serve(config, transport)
    assert server.clients.refused == {1: "settings: its noise_multiplier is 0.01, the server's 0.05"}


def test_the_largest_epsilon_of_a_round_is_logged():
    facts = {0: {"figures": {"privacy/epsilon": 3.0, "x": 1.0}}, 1: {"figures": {"privacy/epsilon": 5.0, "x": 2.0}}}
    assert merge_metrics(facts) == {"privacy/epsilon": 5.0, "x": 1.5}


def exact_delta(value: float, mu: float) -> float:
    """Of the Gaussian mechanism with sensitivity over deviation ``mu`` (Balle and Wang 2018, Theorem 8)."""
    return norm.cdf(mu / 2 - value / mu) - math.exp(value + norm.logcdf(-mu / 2 - value / mu))


@pytest.mark.parametrize(("noise_multiplier", "n_uploads"), [(100.0, 1), (8.0, 1), (8.0, 40), (0.5, 3), (0.003, 40)])
def test_epsilon_is_above_the_exact_one_and_near_it(noise_multiplier, n_uploads):
    """Renyi accounting is an upper bound; the composition of Gaussian mechanisms is one, of a larger ``mu``."""
    mu = SENSITIVITY * math.sqrt(n_uploads) / noise_multiplier
    spent = epsilon(noise_multiplier, n_uploads, 1e-5)
    assert exact_delta(spent, mu) <= 1e-5 < exact_delta(spent / 1.13, mu)


def test_epsilon_of_published_numbers():
    """``sigma = 1`` at sensitivity 1: 4.38 at delta 1e-5 exactly, and Renyi accounting (Balle et al. 2020) says 4.73."""
    assert exact_delta(4.3772, 1.0) == pytest.approx(1e-5, rel=1e-3)
    assert epsilon(SENSITIVITY, 1, 1e-5) == pytest.approx(4.73, abs=0.01)
    assert epsilon(1.0, 0, 1e-5) == 0 and epsilon(0.0, 1, 1e-5) == math.inf
    assert epsilon(8.0, 40, 1e-5) > epsilon(8.0, 39, 1e-5) > epsilon(9.0, 39, 1e-5) > epsilon(9.0, 39, 1e-4)


@pytest.mark.parametrize(
    ("algo", "more", "message"),
    [
        ("fedavg", {"normalize": "shared"}, "normalize='shared' uploads exact observation statistics; use normalize=True"),
        ("fedavg", {"clipping_norm": None}, "in units of clipping_norm, and there is none: give one"),
        ("fedguide-a", {}, "FedGuideA uploads prior.head as well; use FedAvg"),
        ("fedguide-a", {"noise_multiplier": 0.0}, "FedGuideA uploads prior.head as well; use FedAvg"),
        ("fedavg", {"noise_multiplier": -1.0}, "noise_multiplier=-1 must be at least 0"),
        ("fedavg", {"noise_multiplier": math.nan}, "noise_multiplier=nan must be finite"),
        ("fedavg", {"clipping_norm": 0.0}, "clipping_norm=0 must be positive"),
        ("fedavg", {"clipping_norm": math.inf}, "clipping_norm=inf must be finite"),
        ("fedavg", {"delta": 0.0}, r"delta=0 must be in \(0, 0.1\]"),
    ],
)
def test_what_noise_does_not_protect_and_what_makes_no_sense_is_refused(algo, more, message):
    with pytest.raises(ValueError, match=message):
        make(algo, "Bandit2D", **{**PRIVATE, **more})


@pytest.mark.parametrize("noise_multiplier", [0.0, 1.0])
@pytest.mark.parametrize("name", ["mean_reward", "n_samples_reward"])
def test_an_algorithm_of_ones_own_that_uploads_more_is_refused(name, noise_multiplier):
    class Talkative(algorithm("fedavg")):  # type: ignore[misc]
        begins = 0

        def upload(self, index):
            more = {name: np.zeros(1, dtype=np.float32)} if self.round >= self.begins else {}
            return {**super().upload(index), **more}

    env, settings = make("fedavg", "Bandit2D").get_env(), {"clipping_norm": 1.0, "noise_multiplier": noise_multiplier}
    make_own = functools.partial(Talkative, "MlpPolicy", env, rollout_size=32, batch_size=16, **settings)
    with pytest.raises(ValueError, match=f"Talkative uploads {name} as well"):
        make_own()
    Talkative.begins = 1  # so that nobody could know when it was made
    model = make_own()
    model.round = 1
    with pytest.raises(ValueError, match=f"do not protect {name}"):
        model.outgoing(0)


@pytest.mark.parametrize("kind", ["moments", "trunk"])
def test_a_site_that_trains_no_prior_gives_nothing_of_its_data_before_the_first_round(kind, tmp_path):
    site = Site(make("fedavg", "Bandit2D", [0], **PRIVATE), N_ROUNDS, tmp_path / "site", report=False)
    with pytest.raises(ValueError, match=f"FedAvg shares nothing before the first round, and the server asks for {kind}"):
        site.handle(Message(kind, 0, facts={RUN: "1"}))


def test_a_site_that_reports_nothing_keeps_the_norm_of_its_updates(tmp_path):
    config, transport = federation("fedavg", "Bandit2D", tmp_path, clipping_norm=0.01)
    transport.make = lambda client: Site(
        make("fedavg", "Bandit2D", [client], clipping_norm=0.01), N_ROUNDS, tmp_path / f"site_{client}", report=False
    )
    logs: list[dict[str, float]] = []
    serve(config, transport, None, lambda round, metrics: logs.append(dict(metrics)))
    assert logs and not any(key.startswith("privacy/") and key != "privacy/noise_multiplier" for log in logs for key in log)


def test_the_command_line_says_what_is_missing_and_what_was_spent(tmp_path, monkeypatch, capfd):
    run = ["--algo", "fedavg", "--env", "Bandit2D", "--rounds", "2", "-f", str(tmp_path), "--no-eval", "-params"]
    run += ["rollout_size:16", "batch_size:16", "bc_weight:0", "clipping_norm:0.001", "noise_multiplier:20"]
    assert main(run) == 0
    assert f"privacy epsilon {epsilon(20.0, 2, 1e-5):.3g} at delta 1e-05 after 2 uploads, " in capfd.readouterr().out
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda module: None if module == "opacus" else find(module))
    assert main(run) == 2
    error = capfd.readouterr().err
    assert error.endswith("noise_multiplier needs Opacus, which computes epsilon: pip install 'sb3-fedguide[privacy]'\n")
    assert len(error.splitlines()) == 1
