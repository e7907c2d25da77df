"""The server's part of a round, and strategies that are made without a model."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest

from sb3_fedguide import FedAvg, FedGuideA, registry
from sb3_fedguide.registry import ALGORITHMS, algorithm, register_algorithm
from sb3_fedguide.server import methods
from sb3_fedguide.server.averaging import Averaging
from sb3_fedguide.server.methods import Method, complete_settings, find_method, make_strategy, method_of
from sb3_fedguide.server.ot_moe import OTMoE
from sb3_fedguide.server.participants import draw_participants
from sb3_fedguide.server.rounds import Coordinator, participants
from sb3_fedguide.server.svrpg import SVRPG
from sb3_fedguide.settings.ranges import Range
from sb3_fedguide.settings.schema import hyperparameters
from sb3_fedguide.settings.signatures import types_of
from tests.loop_transport import NAME, upload

# --- rounds ---------------------------------------------------------------------------------------------------------------


def test_who_misses_what_others_receive_catches_up_once():
    rounds = Coordinator(Averaging(average_every=2))
    assert rounds.exchange(1, {0: upload(1), 1: upload(3)}, absent=[2]) == {0: {}, 1: {}} and rounds.outdated == set()
    broadcasts = rounds.exchange(2, {0: upload(1), 1: upload(3)}, absent=[2])
    np.testing.assert_array_equal(broadcasts[0][NAME], [2, 2, 2])
    assert rounds.outdated == {2} and (rounds.bytes_up, rounds.bytes_down) == (4 * 16, 2 * 12)
    np.testing.assert_array_equal(rounds.catch_up(2)[NAME], [2, 2, 2])
    assert rounds.outdated == set() and rounds.bytes_down == 3 * 12
    assert rounds.metrics["federated/bytes_total"] == 4 * 16 + 2 * 12 and rounds.metrics["federated/bytes_down"] == 24


def test_what_comes_before_the_first_round_is_counted_apart():
    rounds = Coordinator(Averaging())
    rounds.count(1000, 3000, offline=True)
    rounds.exchange(0, {0: upload(1), 1: upload(3)})
    before = 1000 + 2 * 16
    assert rounds.offline_bytes_up == rounds.bytes_up == before
    rounds.exchange(1, {0: upload(1), 1: upload(3)})
    assert (rounds.bytes_up - rounds.offline_bytes_up, rounds.bytes_down - rounds.offline_bytes_down) == (2 * 16, 2 * 12)
    assert rounds.metrics["federated/bytes_offline"] == before + rounds.offline_bytes_down
    again, earlier = Coordinator(None), Coordinator(None)
    again.bytes_counted, earlier.bytes_counted = rounds.bytes_counted, rounds.bytes_counted[:2]
    assert again.bytes_counted == rounds.bytes_counted and earlier.bytes_counted == [*rounds.bytes_counted[:2], 0, 0]


def test_who_is_rejected_is_outdated():
    rounds = Coordinator(Averaging())
    assert sorted(rounds.exchange(1, {0: upload(1), 1: upload(np.nan), 2: "nothing"})) == [0]
    assert rounds.outdated == {1, 2} == rounds.rejected.keys() and rounds.metrics["federated/rejected"] == 2


def test_participants_are_those_of_a_federation_in_process():
    drawn = [participants([0, 1, 2, 3], 7, round, 0.5) for round in range(20)]
    assert drawn == [np.flatnonzero(draw_participants(7, round, 4, 2)).tolist() for round in range(20)]
    assert participants([2, 5, 9], 7, 0, 1.0) == [2, 5, 9] and set(participants([2, 5, 9], 7, 0, 0.4)) <= {2, 5, 9}


# --- strategies without models --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_server_has_the_settings_of_its_model_with_their_types_and_defaults(name):
    settings, parameters = complete_settings(name, {}), hyperparameters(algorithm(name))
    assert settings == {key: parameters[key][1] for key in settings}
    types = types_of(find_method(name).arguments)
    assert {key: types[key] for key in settings} == {key: parameters[key][0] for key in settings}
    assert method_of(algorithm(name)) is find_method(name)


def test_one_definition_for_models_and_servers():
    model = FedGuideA("MlpPolicy", "Bandit2D", seed=4, eta=0.2, average_every=3, upload_bound=None, rollout_size=64)
    own, served = model.strategy, make_strategy("fedguide-a", model.server_settings(), 4, 4)
    assert json.dumps(model.server_settings()) and served.upload_bound is None
    for one, other in zip(own.strategies, served.strategies, strict=True):
        assert type(one) is type(other)
        assert {**vars(one), "rng": 0} == {**vars(other), "rng": 0}
    assert own.strategies[0].rng.random() == served.strategies[0].rng.random() and served.strategies[0].n_experts == 4
    fedavg = FedAvg("MlpPolicy", "Bandit2D", average="critic", average_until=7, seed=0, rollout_size=64)
    assert vars(make_strategy("fedavg", fedavg.server_settings(), 4, 0)) == vars(fedavg.strategy)
    kinds = {name: make_strategy(name, {}, 3, 0) for name in ALGORITHMS}
    assert kinds["local"] is None and isinstance(kinds["fedsvrpgm"], SVRPG) and isinstance(kinds["fedguide-p"], OTMoE)
    assert kinds["fedrl"].prefixes == ("actor.", "critic.") and kinds["fedguide"].n_experts == 3


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("fedavg", {"averge": "all"}, "no setting 'averge'"),
        ("fedavg", {"average": "everything"}, "average='everything' must be one of"),
        ("fedrl", {"average_every": 0}, "average_every=0"),
        ("fedguide-a", {"average_every": 0}, "average_every=0"),
        ("fedguide", {"eta": -1.0}, "eta=-1 must"),
        ("fedavg", {"client_fraction": 0.0}, "client_fraction=0 must"),
        ("fedavg", {"upload_bound": -1.0}, "upload_bound=-1 must"),
        ("fedavg", {"normalize": "sharde"}, "normalize='sharde' must be"),
        ("fedbest", {}, "unknown algorithm 'fedbest'"),
    ],
)
def test_wrong_settings_are_refused(name, settings, message):
    with pytest.raises(ValueError, match=message):
        make_strategy(name, settings, 3, 0)


@dataclass
class Mine:
    eta: Annotated[float, Range(1)] = 2.0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"eta": -1.0}, "eta=-1 must be positive"),
        ({"average": "actr"}, "average='actr' must be one of"),
        ({"noise_multiplier": -1.0}, "noise_multiplier=-1 must"),
        ({"beta": 2.0}, "beta=2 must be between 0 and 1"),
        ({"client_fraction": 2.0}, "client_fraction=2 must"),
    ],
)
def test_a_method_of_ones_own_checks_settings_by_name(settings, message):
    own = {"eta": 0.05, "average": "all", "noise_multiplier": 0.0, "beta": 0.5, "k": 1}
    with pytest.raises(ValueError, match=message):
        make_strategy(Method(double, own), settings, 3, 0)
    assert make_strategy(Method(double, own), {"beta": "auto", "k": 2}, 3, 0).prefixes == ("x",) * 6
    with pytest.raises(ValueError, match=r"eta=0\.5 must be at least 1"):  # its own range goes first, the others stay
        make_strategy(Method.of(double, Mine, ["eta"]), {"eta": 0.5}, 3, 0)
    with pytest.raises(ValueError, match="client_fraction=2 must"):
        make_strategy(Method.of(double, Mine, ["eta"]), {"client_fraction": 2.0}, 3, 0)


class Half(FedAvg):
    def receive(self, index, broadcast):
        pass


class Own(FedAvg):
    def _make_strategy(self):
        return Averaging(self.averaged_prefixes)


def double(settings, n_clients, seed):
    return Averaging(("x",) * settings["k"] * n_clients)


OWN_METHOD = Method(double, {"k": 1})


def test_algorithms_of_ones_own(monkeypatch):
    monkeypatch.setattr(registry, "ALGORITHMS", known := dict(ALGORITHMS))
    monkeypatch.setattr(methods, "ALGORITHMS", known)
    register_algorithm("half", f"{__name__}:Half")
    register_algorithm("own", f"{__name__}:Own")
    assert make_strategy("half", {"average_every": 3}, 3, 0).average_every == 3  # its base class's server
    with pytest.raises(ValueError, match=r"Own makes its strategy itself.*register_algorithm\(\.\.\., server="):
        make_strategy("own", {}, 3, 0)
    register_algorithm("own, deployed", f"{__name__}:Own", server=f"{__name__}:OWN_METHOD")
    assert make_strategy("own, deployed", {"k": 2}, 3, 0).prefixes == ("x",) * 6
    with pytest.raises(ValueError, match="is taken by"):
        register_algorithm("own", f"{__name__}:Half")
    with pytest.raises(ValueError, match="server='here' must be 'module:name'"):
        register_algorithm("other", f"{__name__}:Half", server="here")
    register_algorithm("wrong", f"{__name__}:Half", server=f"{__name__}:double")
    with pytest.raises(ValueError, match="must name a sb3_fedguide"):
        make_strategy("wrong", {}, 3, 0)
