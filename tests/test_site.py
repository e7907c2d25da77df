"""Sites that answer messages learn what the same clients learn in one process, whatever is lost on the way."""

from __future__ import annotations

import dataclasses
import json
import shutil
from typing import Any

import numpy as np
import pytest

import sb3_fedguide
from sb3_fedguide import FedAvg, FederatedEvalCallback
from sb3_fedguide.deployment.serve import TooFewClients, serve
from sb3_fedguide.deployment.site import PARAMETERS, Site, make_site
from sb3_fedguide.deployment.transport import RUN, Message
from sb3_fedguide.registry import ALGORITHMS, algorithm
from tests.conftest import assert_same_parameters, others_slow
from tests.loop_transport import timeout
from tests.sites import CLIENTS, COMMON, N_ROUNDS, assert_equal, family, federation, in_process, make

OWN_EXCHANGES = ("fedavg", "fedsvrpgm", "fedrl", "fedguide-a", "fedguide-r")
FEDERATED = [name for name in ALGORITHMS if algorithm(name).is_federated]


@pytest.mark.parametrize("algo", others_slow(FEDERATED, lambda algo: algo in OWN_EXCHANGES))
def test_three_sites_learn_what_three_clients_learn_in_one_process(algo, tmp_path):
    config, transport = federation(algo, "Bandit2D", tmp_path, fresh=True)
    server = serve(config, transport, tmp_path / "server")
    assert server.round == N_ROUNDS
    assert_equal(transport, in_process(algo, "Bandit2D"))


def test_the_server_counts_the_clients_tests_as_environment_steps(tmp_path):
    """Those of a round are known with the next one; after the last average nothing is tested."""
    config, transport = federation("fedguide-r", "Bandit2D", tmp_path, fresh=True)
    server = serve(config, transport, tmp_path / "server")
    model = in_process("fedguide-r", "Bandit2D")
    assert server.timesteps[-1] == model.environment_steps == model.num_timesteps + model.test_steps
    assert model.test_steps > 0 and server.test_steps == {
        client: transport.site(client).model.test_steps for client in CLIENTS
    }


def test_off_policy_clients_in_a_simulator_with_some_absent(tmp_path):
    more = {"client_fraction": 0.7, "learning_rate": linear}
    config, transport = federation("fedrl", "Hopper", tmp_path, **more)
    serve(config, transport, tmp_path / "server")
    assert_equal(transport, in_process("fedrl", "Hopper", **more))


def linear(remaining: float) -> float:
    """A schedule of the learning rate."""
    return 1e-3 * remaining


def test_the_trunk_is_that_of_one_process_and_schedules_follow_the_rounds(tmp_path):
    """In a simulator, with some absent from each round, and with nothing that one side had from the other's cache."""
    more = {"client_fraction": 0.7, "learning_rate": linear}
    config, transport = federation("fedguide-a", "Hopper", tmp_path, cache_dir=tmp_path / "cache", fresh=True, **more)
    server = serve(config, transport, tmp_path / "server")
    model = in_process("fedguide-a", "Hopper", **more)
    assert_equal(transport, model)
    prior = model.prior.state_dict()
    assert server.trunk.n_averages == 3 and not list((tmp_path / "cache" / "pretraining").glob("trunk/*"))
    for name, array in server.trunk.trunk.items():
        np.testing.assert_array_equal(array, prior[f"trunk.{name}"].numpy())
    for site in map(transport.site, CLIENTS):
        assert all((tensor == prior[name]).all() for name, tensor in site.model.prior.state_dict().items())
        assert site.model._current_progress_remaining == 1 - site.model.round / N_ROUNDS
    kinds = [(kind, round) for client, kind, round in transport.sent if client == 0 and kind in ("moments", "trunk", "setup")]
    assert kinds == [("moments", 0), ("trunk", 1), ("trunk", 2), ("trunk", 3), ("setup", 0), ("setup", 1), ("setup", 2)]


def test_evaluations_are_those_of_one_process(tmp_path):
    config, transport = federation("fedavg", "Bandit2D", tmp_path)
    serve(config, transport, tmp_path / "server")
    model = make("fedavg", "Bandit2D")
    callback = FederatedEvalCallback(N_ROUNDS, eval_freq=2, n_episodes=2, csv_path=tmp_path / "evaluations.csv")
    model.learn(N_ROUNDS * model.rollout_size * model.n_clients, callback)
    theirs, ours = ((tmp_path / name).read_text().splitlines() for name in ("evaluations.csv", "server/evaluations.csv"))
    assert sorted(theirs) == sorted(ours) and len(theirs) == 1 + 3 * (3 + 2)


def test_a_lost_reply_is_given_again_without_training_again(tmp_path, monkeypatch):
    played = []
    play = FedAvg.play_round

    def counting(model, *arguments, **keywords):
        played.append(model.client_ids[0])
        return play(model, *arguments, **keywords)

    monkeypatch.setattr(FedAvg, "play_round", counting)
    config, transport = federation("fedavg", "Bandit2D", tmp_path, fresh=True)
    transport.faults = {(1, "round", 2): timeout, (2, "setup", 0): timeout, (0, "join", 0): timeout}
    serve(dataclasses.replace(config, min_clients=3, wait=None), transport, tmp_path / "server")
    assert sorted(played) == [0, 0, 0, 1, 1, 1, 2, 2, 2] and transport.sent.count((1, "round", 2)) == 2
    assert_equal(transport, in_process("fedavg", "Bandit2D"))


def test_a_lost_reply_counts_as_absence_where_the_others_go_on(tmp_path):
    config, transport = federation("fedavg", "Bandit2D", tmp_path)
    transport.faults = {(1, "round", 2): timeout}
    rows = []
    serve(config, transport, tmp_path / "server", lambda round, figures: rows.append(figures))
    assert [row["federated/participants"] for row in rows if "federated/participants" in row] == [3, 2, 3]
    policies = [transport.site(client).model.policy.client_state_dict(0) for client in CLIENTS]
    for policy in policies[1:]:
        assert_same_parameters(policy, policies[0])
    assert all(transport.site(client).model.round == 3 for client in CLIENTS)


def test_a_client_that_breaks_goes_on_from_its_disk_and_says_nothing(tmp_path, monkeypatch, caplog):
    secret, play = "the goal is at 0.1234", FedAvg.play_round

    def breaks(model, *arguments, **keywords):
        if model.client_ids == [1] and model.round == 1 and not broken:
            broken.append(play(model, *arguments, **keywords))  # in the middle: it has trained, and nothing is saved
            raise ValueError(secret)
        return play(model, *arguments, **keywords)

    broken: list[bool] = []
    monkeypatch.setattr(FedAvg, "play_round", breaks)
    config, transport = federation("fedavg", "Bandit2D", tmp_path)
    serve(dataclasses.replace(config, min_clients=3, wait=None), transport, tmp_path / "server")
    assert broken and "client 1 is left out (error: ValueError)" in caplog.text and secret not in caplog.text
    assert not any(secret.encode() in path.read_bytes() for path in (tmp_path / "server").rglob("*.*"))
    assert_equal(transport, in_process("fedavg", "Bandit2D"))


def test_a_site_of_which_the_disk_is_gone_is_prepared_again(tmp_path):
    config, transport = federation("fedguide", "Bandit2D", tmp_path, fresh=True)

    def wipe(client: int, message: Message) -> None:
        if (client, message.kind, message.round) == (1, "round", 2):
            shutil.rmtree(tmp_path / "site_1")

    transport.watch = wipe
    server = serve(config, transport, tmp_path / "server")
    assert transport.sent.count((1, "setup", 0)) == 2 and server.round == 3
    np.testing.assert_array_equal(transport.site(1).model.experts[0], transport.site(0).model.experts[0])


def request(kind: str, round: int, **facts: Any) -> Message:
    return Message(kind, round, {}, {RUN: "run", "broadcast": 0, "after": 0, **facts})  # type: ignore[arg-type]


def test_what_a_site_refuses(tmp_path):
    with pytest.raises(ValueError, match=r"a site holds one client.*clients=\[k\]"):
        Site(make("local", "Bandit2D"), N_ROUNDS, tmp_path)
    site = Site(make("local", "Bandit2D", [1]), N_ROUNDS, tmp_path / "1", eval_freq=None)
    assert site.handle(request("round", 1)).facts == {"unprepared": True} and not (tmp_path / "1").exists()
    site.handle(request("setup", 0))
    with pytest.raises(ValueError, match="another run of the server"):
        site.handle(request("round", 1, run="other"))
    reply = site.handle(request("round", 1))
    assert reply.payload == {} and reply.facts["evaluations"] == [] and "client_1/ep_rew_mean" in reply.facts["figures"]
    for other, rounds in ((make("local", "Bandit2D", [2]), N_ROUNDS), (make("local", "Bandit2D", [1]), 4),
                          (make("local", "Bandit2D", [1], seed=4), N_ROUNDS), (make("fedavg", "Bandit2D", [1]), N_ROUNDS),
                          (make("local", "Bandit2D", [1], client_fraction=0.5), N_ROUNDS)):  # fmt: skip
        with pytest.raises(ValueError, match=r"another run|does not fit"):
            Site(other, rounds, tmp_path / "1")
    again = Site(make("local", "Bandit2D", [1]), N_ROUNDS, tmp_path / "1", eval_freq=None)
    assert again.handle(request("round", 1)) == reply and again.n_answered == 2
    again.model.play_round = None  # type: ignore[method-assign, assignment]
    with pytest.raises(TypeError):
        again.handle(request("round", 2))
    with pytest.raises(RuntimeError, match="make a new Site, which resumes from disk"):
        again.handle(request("round", 2))


def test_what_came_already_is_not_taken_again(tmp_path):
    """A broadcast is sent until it is confirmed; whoever has trained since must not go back to it."""
    site = Site(make("fedavg", "Bandit2D", [1]), N_ROUNDS, tmp_path, eval_freq=None)
    site.handle(request("setup", 0))
    average = {name: np.zeros_like(tensor) for name, tensor in site.model.policy.client_state_dict(0).items()}
    first = site.handle(dataclasses.replace(request("round", 1, broadcast=1), payload=average))
    kept = Site(make("fedavg", "Bandit2D", [1]), N_ROUNDS, tmp_path, eval_freq=None)
    second = kept.handle(dataclasses.replace(request("finish", 3, broadcast=1), payload=average))
    assert second.payload == {}
    for name, array in kept.model.policy.client_state_dict(0).items():
        np.testing.assert_array_equal(array, first.payload[name])
    assert any(array.any() for name, array in first.payload.items() if name != "n_samples")
    kept.handle(dataclasses.replace(request("finish", 4, broadcast=2), payload=average))
    assert not any(tensor.any() for tensor in kept.model.policy.client_state_dict(0).values())


def test_a_server_that_has_gone_back_is_refused_before_anything_is_trained(tmp_path):
    site = Site(make("fedavg", "Bandit2D", [1]), 5, tmp_path, eval_freq=None)
    site.handle(request("setup", 0))
    average = {name: np.zeros_like(tensor) for name, tensor in site.model.policy.client_state_dict(0).items()}
    site.handle(request("round", 1))
    last = site.handle(dataclasses.replace(request("round", 3, broadcast=2), payload=average))
    parameters = {name: tensor.clone() for name, tensor in site.model.policy.client_state_dict(0).items()}
    remedy = "gone back to an older checkpoint: .* restore the clients' folders with it, or begin a new run"
    for again in (site, Site(make("fedavg", "Bandit2D", [1]), 5, tmp_path, eval_freq=None)):
        for kind, round in (("round", 2), ("round", 1), ("setup", 1)):
            with pytest.raises(ValueError, match=remedy):
                again.handle(request(kind, round, broadcast=2))
        with pytest.raises(ValueError, match=remedy):
            again.handle(dataclasses.replace(request("round", 4, broadcast=1), payload=average))
        assert again.handle(request("setup", 0)).facts == {} and again.model.round == 3 and again.n_answered == 3
        assert_same_parameters(again.model.policy.client_state_dict(0), parameters)
        assert again.handle(request("round", 3)).facts == last.facts
    again.handle(dataclasses.replace(request("round", 4, broadcast=2), payload=average))  # it still goes on


def test_a_server_that_is_restored_from_an_older_copy_moves_nobody(tmp_path):
    config, transport = federation("fedavg", "Bandit2D", tmp_path, fresh=True)

    def copy_it(round: int, figures: Any) -> None:
        if round == 2:  # the checkpoint of round 1 is the last
            shutil.copytree(tmp_path / "server", tmp_path / "copy")

    serve(config, transport, tmp_path / "server", copy_it)
    with pytest.raises(TooFewClients):
        serve(config, transport, tmp_path / "copy")
    assert_equal(transport, in_process("fedavg", "Bandit2D"))


def test_another_version_goes_on_from_a_clients_disk(tmp_path, monkeypatch):
    site = Site(make("fedavg", "Bandit2D", [1]), N_ROUNDS, tmp_path, eval_freq=None)
    site.handle(request("setup", 0))
    monkeypatch.setattr(sb3_fedguide, "__version__", "99.0")
    again = Site(make("fedavg", "Bandit2D", [1]), N_ROUNDS, tmp_path, eval_freq=None)
    assert again.prepared and again.handle(request("join", 0)).facts["version"] == "99.0"


def test_a_client_that_missed_some_of_the_trunk_goes_on_with_the_others_learning_rate(tmp_path):
    diffusion = {**COMMON["pretraining"], "prior": "diffusion"}

    def site() -> Site:
        return Site(make("fedguide", "Bandit2D", [1], pretraining=diffusion), N_ROUNDS, tmp_path, eval_freq=None)

    moments = {"moments.mean": np.zeros(2), "moments.std": np.ones(2)}
    schedule = {"n_updates": 7, "average_every": 3}
    site().handle(request("moments", 0))
    site().handle(dataclasses.replace(request("trunk", 1, n_done=0, **schedule), payload=moments))
    last = site()
    assert last._trunk is not None and last._trunk.n_done == 3
    upload = last.handle(dataclasses.replace(request("trunk", 3, n_done=6, **schedule), payload=moments)).payload
    assert last._trunk.n_done == 7 and all(array.dtype == np.float32 for array in upload.values())


class Killed(BaseException):
    """As if the server's process had ended."""


def test_a_server_that_is_killed_in_mid_round_goes_on_to_the_same_parameters(tmp_path):
    config, transport = federation("fedguide-a", "Bandit2D", tmp_path, fresh=True)

    def kill(client: int, message: Message) -> None:
        if (client, message.kind, message.round) == (1, "round", 2):
            transport.watch = lambda client, message: None
            raise Killed

    transport.watch = kill
    with pytest.raises(Killed):
        serve(config, transport, tmp_path / "server")
    assert serve(config, transport, tmp_path / "server").round == N_ROUNDS
    assert_equal(transport, in_process("fedguide-a", "Bandit2D"))
    with pytest.raises(ValueError, match="another run of the server"):
        transport.site(0).handle(request("join", 0, run="other"))


def test_what_is_not_to_be_told_stays(tmp_path):
    site = Site(make("fedavg", "Bandit2D", [1]), N_ROUNDS, tmp_path, eval_freq=1, report=False)
    site.handle(request("setup", 0))
    assert site.handle(request("round", 1)).facts == {"figures": {}, "evaluations": []}


def test_what_a_client_learned_is_left_as_plain_arrays(tmp_path):
    config, transport = federation("fedavg", "Bandit2D", tmp_path)
    serve(config, transport, tmp_path / "server")
    model = make("fedavg", "Bandit2D", [2])
    model.import_parameters(tmp_path / "site_2" / PARAMETERS)
    assert_same_parameters(model.policy.client_state_dict(0), in_process("fedavg", "Bandit2D").policy.client_state_dict(2))


CONFIG = {
    "algo": "fedavg", "env": "Bandit2D", "client": 2, "seed": 5, "n_rounds": 4, "eval_freq": 0,
    "params": {"rollout_size": 64, "n_envs_per_client": 4, "policy_kwargs.net_arch": [8], "bc_weight": 0.0},
}  # fmt: skip


def test_a_site_from_a_clients_own_configuration(tmp_path):
    site = make_site(CONFIG, tmp_path / "site")
    assert (site.client_id, site.model.seed, site.n_rounds, site.model.rollout_size) == (2, 5, 4, 64)
    facts = site.handle(request("join", 0)).facts
    assert facts["algorithm"] == "fedavg" and facts["shapes"]["observations"] == [2] and facts["trunk"] is None
    assert json.loads(json.dumps(facts)) == facts
    family("Bandit2D").dump(tmp_path / "own.json")
    more = {"metadata": str(tmp_path / "own.json"), "env": None, "conf": "paper", "algo": "fedguide"}
    site = make_site({**CONFIG, **more}, tmp_path / "other")
    assert site.facts()["shapes"]["prior.head"] == [2, 3] and site.model.policy_kwargs["net_arch"] == [8]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algo": None}, "does not say algo"),
        ({"client": None}, "does not say client"),
        ({"seed": None}, "does not say seed"),
        ({"env": None}, "one of env"),
        ({"metadata": "x.json"}, "one of env"),
        ({"env": None, "metadata": "nowhere.json"}, "no metadata file nowhere.json"),
        ({"algo": "fedbest"}, "unknown algorithm 'fedbest'"),
        ({"env": "Hoper"}, "unknown environment 'Hoper'.*Did you mean 'Hopper'"),
        ({"client": 4}, "clients 0 to 3, not 4"),
        ({"client": "2"}, "client: .*'2'"),
        ({"seed": -1}, "seed: .*-1"),
        ({"n_rounds": 0}, "n_rounds"),
        ({"clients": [1]}, "unknown key in .*'clients'. Did you mean 'client'"),
        ({"params": {"rolout_size": 64}}, "unknown hyperparameter 'rolout_size'.*Did you mean 'rollout_size'"),
        ({"params": {"n_rounds": 3}}, "n_rounds twice"),
        ({"conf": "nowhere.yml"}, "no configuration 'nowhere.yml'"),
        ({"packages": ["no_such_module"]}, "no_such_module"),
    ],
)
def test_a_wrong_configuration_is_refused_with_a_remedy(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        make_site({**CONFIG, **changes}, tmp_path / "site")
    assert not (tmp_path / "site").exists()
