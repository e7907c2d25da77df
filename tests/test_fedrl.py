"""FedRL: the server averages, targets follow, replay stays at home; its tabular analogue has the known fixed point."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG

from fed_envs.bandit2d import PEAKS
from sb3_fedguide import FederatedDDPG, FedRL
from sb3_fedguide.cli.train import main
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.seeding import Role
from sb3_fedguide.server.averaging import Averaging
from sb3_fedguide.server.strategy import N_SAMPLES
from tests.conftest import assert_same_parameters, parameters_of
from tests.small_runs import SMALL


class Spy(RoundCallback):
    """The clients' parameters between local training and exchange."""

    def _on_local_training_end(self):
        self.before = [self.model.policy.client_state_dict(index) for index in range(self.model.n_clients)]


@pytest.mark.parametrize("average", ["all", "actor", "critic"])
def test_averaging_and_targets(point_envs, average):
    model, spy = FedRL("MlpPolicy", point_envs(3), average=average, **SMALL), Spy()
    model.learn(3 * model.rollout_size, callback=spy)
    after = [model.policy.client_state_dict(index) for index in range(3)]
    for name in after[0]:
        network, rest = name.split(".", 1)
        source = network.removesuffix("_target")
        for client in range(3):
            if average in ("all", source):
                mean = th.stack([state[f"{source}.{rest}"] for state in spy.before]).double().mean(dim=0).float()
                assert not th.equal(spy.before[client][name], mean)
                np.testing.assert_allclose(after[client][name].numpy(), mean.numpy(), rtol=1e-6, atol=1e-8)
            else:
                assert th.equal(after[client][name], spy.before[client][name])
    buffer = model.replay_buffer
    assert buffer.size() == 64 and not np.array_equal(buffer.observations[:64, 0], buffer.observations[:64, 1])


def test_between_averages_targets_are_left_alone(point_envs):
    model, spy = FedRL("MlpPolicy", point_envs(2), average_every=2, **SMALL), Spy()
    model.learn(2 * model.rollout_size, callback=spy)
    for client in range(2):
        assert_same_parameters(model.policy.client_state_dict(client), spy.before[client])


def test_only_networks_leave_a_client(point_envs):
    model = FedRL("MlpPolicy", point_envs(2), **SMALL)
    assert model.upload(0) == {}  # there is nothing to average before the first round
    model.round = 1
    names = set(model.upload(0)) - {N_SAMPLES}
    assert names == {name for name, _ in model.policy.named_parameters() if "target" not in name}


@pytest.mark.parametrize("bc_weight", [0.3, 1.0])
def test_behaviour_cloning(bc_weight):
    options = {**SMALL, "pretraining": {"dataset_size": 200, "bc_updates": 300, "bc_batch_size": 64, "bc_learning_rate": 3e-3}}
    model = FedRL("MlpPolicy", "Bandit2D", bc_weight=bc_weight, **options)
    random = model.policy.client_state_dict(2)
    model.pretrain()
    if bc_weight == 1.0:
        cloned, _ = model.predict(np.zeros((4, model.observation_space.shape[0]), dtype=np.float32))
        np.testing.assert_allclose(cloned, PEAKS, atol=0.15)  # in the environment's units, not in [-1, 1]
    else:
        full = FedRL("MlpPolicy", "Bandit2D", bc_weight=1.0, **options)
        full.pretrain()
        expected = {
            name: 0.7 * random[name] + 0.3 * tensor if name.startswith("actor") else random[name]
            for name, tensor in full.policy.client_state_dict(2).items()
        }
        assert_same_parameters(model.policy.client_state_dict(2), expected, tolerance=1e-6)
    for name, parameter in model.policy.actor.named_parameters():
        assert th.equal(parameter, model.policy.actor_target.get_parameter(name))


@pytest.mark.parametrize("normalize", [False, True])
def test_client_is_an_ordinary_ddpg_with_the_same_actions(point_envs, normalize, tmp_path):
    model = FedRL("MlpPolicy", point_envs(3), normalize=normalize, average_every=2, **SMALL)
    model.learn(3 * 3 * model.rollout_size)
    obs = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32) * 3
    ours, _ = model.predict(obs)
    assert len(np.unique(ours.round(4))) > 6
    for client in range(3):
        single = model.client(client)
        assert type(single) is DDPG
        rows = slice(2 * client, 2 * client + 2)
        np.testing.assert_allclose(single.predict(obs[rows])[0], ours[rows], atol=1e-6)
        state = single.policy.state_dict()
        assert all(th.equal(state[name], tensor) for name, tensor in model.policy.client_state_dict(client).items())
    single.save(tmp_path / "client")
    loaded = DDPG.load(tmp_path / "client", env=point_envs(3)[2]())
    np.testing.assert_allclose(loaded.predict(obs[4:])[0], ours[4:], atol=1e-6)
    loaded.learn(40)  # and it can be trained further
    assert loaded._n_updates
    model.export(2, tmp_path / "client.pt2")
    exported = th.export.load(tmp_path / "client.pt2").module()(th.as_tensor(obs[3:]))
    np.testing.assert_allclose(exported.numpy()[1:], ours[4:], atol=1e-6)


def test_actions_are_in_the_environments_units(tmp_path):
    model = FederatedDDPG("MlpPolicy", "Bandit2D", **SMALL)
    with th.no_grad():
        model.policy.actor.mu[-2].bias[:] = 20.0
    obs = np.zeros((4, 2), dtype=np.float32)
    np.testing.assert_allclose(model.predict(obs)[0], 1.5)
    model.export(1, tmp_path / "client.pt2")
    exported = th.export.load(tmp_path / "client.pt2").module()(th.as_tensor(obs))
    np.testing.assert_allclose(exported.numpy(), 1.5)


@pytest.mark.parametrize("normalize", [False, True])
def test_save_load_and_resume(point_envs, normalize, tmp_path):
    model = FedRL("MlpPolicy", point_envs(2), normalize=normalize, average_every=2, **SMALL)
    model.learn(3 * 2 * model.rollout_size)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "replay")
    loaded = FedRL.load(tmp_path / "model", env=point_envs(2))
    obs = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    np.testing.assert_array_equal(model.predict(obs)[0], loaded.predict(obs)[0])
    assert loaded.average_every == 2 and loaded.strategy.average_every == 2
    for client in range(2):
        assert_same_parameters(parameters_of(model, client), parameters_of(loaded, client))
    moments = (loaded.critic.optimizer.state_dict()["state"], model.critic.optimizer.state_dict()["state"])
    assert len(moments[0]) and all(th.equal(moments[0][key]["exp_avg"], moments[1][key]["exp_avg"]) for key in moments[1])
    updates = loaded._n_updates
    loaded.learn(2 * loaded.rollout_size, reset_num_timesteps=False)
    assert loaded.round == 4 and loaded.num_timesteps == 4 * 2 * 64
    assert loaded._n_updates == updates + 32, "an empty replay buffer is filled first"
    again = FedRL.load(tmp_path / "model", env=point_envs(2))
    again.load_replay_buffer(tmp_path / "replay")
    again.learn(2 * again.rollout_size, reset_num_timesteps=False)
    assert again._n_updates == updates + 64


def test_learning_improves_every_client(point_envs):
    options = {**SMALL, "rollout_size": 200, "learning_starts": 200, "batch_size": 32, "gamma": 0.9, "learning_rate": 2e-3}
    model = FederatedDDPG("MlpPolicy", point_envs(2), **options)
    model.learn(2 * 200)
    before = [np.mean([info["r"] for info in infos]) for infos in model.episode_infos]
    model.learn(5 * 2 * 200)
    after = [np.mean([info["r"] for info in list(infos)[-10:]]) for infos in model.episode_infos]
    assert all(b < -10 for b in before), before
    assert all(a > -6 for a in after), after


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_envs_per_client": 3}, "must divide rollout_size"),
        ({"train_freq": 3}, "train_freq=3"),
        ({"gradient_steps": 0}, "gradient_steps=0"),
        ({"buffer_size": 32}, "buffer_size=32 must be larger than learning_starts=32"),
        ({"tau": 0.0}, "tau=0"),
        ({"noise_sigma": -0.1}, "noise_sigma"),
        ({"bc_weight": 1.5}, "bc_weight"),
        ({"average": "none"}, "average='none'"),
        ({"average_every": 0}, "average_every=0"),
        ({"policy_kwargs": {"n_critics": 2}}, "n_critics=2"),
    ],
)
def test_unfit_settings_are_refused(point_envs, arguments, message):
    with pytest.raises(ValueError, match=message):
        FedRL("MlpPolicy", point_envs(2), **{**SMALL, **arguments})


def test_command_line_on_bandit2d(tmp_path):
    quick = ["pretraining.dataset_size:50", "pretraining.bc_updates:20", "rollout_size:40", "learning_starts:50"]
    argv = ["--algo", "fedrl", "--env", "Bandit2D", "--rounds", "3", "--verbose", "0", "-f", str(tmp_path), "-params", *quick]
    assert main(argv) == 0
    folder = tmp_path / "fedrl" / "Bandit2D_1"
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["finished"] and summary["timesteps"] == 3 * 4 * 40
    assert len(summary["deployed"]["client_returns"]) == len(summary["broadcast"]["client_returns"]) == 4
    loaded = FedRL.load(folder / "model.zip", env="Bandit2D")
    uploaded = sum(array.nbytes for array in loaded.upload(0).values())
    assert summary["bytes_up"] == 3 * 4 * uploaded
    with (folder / "evaluations.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["policy"] for row in rows} == {"deployed", "broadcast"}
    assert loaded._n_updates == 3 * 40 - 50


def test_command_line_on_reacher_hard(tmp_path):
    argv = ["--algo", "fedrl", "--env", "ReacherHard", "--rounds", "1", "--eval-episodes", "1", "--verbose", "0"]
    argv += ["-f", str(tmp_path), "-params", "bc_weight:0", "rollout_size:60", "learning_starts:50"]
    assert main(argv) == 0
    summary = json.loads((tmp_path / "fedrl" / "ReacherHard_1" / "summary.json").read_text())
    assert summary["finished"] and np.isfinite(summary["deployed"]["average"])


@pytest.mark.parametrize("learning_rate", [1.0, 0.3])
def test_qavg_converges_to_the_fixed_point_of_the_averaged_environment(learning_rate):
    """QAvg, the tabular FedRL (Jin et al. 2022), with the server of FedRL.

    Chain of three states whose last one ends it, for a reward of 1 on entry. Action 0 stays; action 1 moves on with
    probability p, which is 0.9 in one environment and 0.3 in the other. Of the averaged environment, with p = 0.6,
    V(1) = p / (1 - (1 - p) gamma) and V(0) = p gamma V(1) / (1 - (1 - p) gamma).
    """
    gamma, moves = 0.9, np.array([0.9, 0.3])
    transitions = np.zeros((2, 2, 2, 3))  # environment, state, action, next state
    for state in range(2):
        transitions[:, state, 0, state] = 1.0
        transitions[:, state, 1, state], transitions[:, state, 1, state + 1] = 1 - moves, moves
    reward = np.array([0.0, 0.0, 1.0])  # on entry
    tables = {client: np.zeros((2, 2)) for client in range(2)}

    def sweep(q: np.ndarray, transition: np.ndarray) -> np.ndarray:
        values = np.append(q.max(axis=1), 0.0)
        return q + learning_rate * (transition @ (reward + gamma * values) - q)

    def optimum(p: float) -> np.ndarray:
        last = p / (1 - (1 - p) * gamma)
        first = p * gamma * last / (1 - (1 - p) * gamma)
        return np.array([[gamma * first, first], [gamma * last, last]])

    server = Averaging()
    for round in range(1, 400):
        local = {client: sweep(tables[client], transitions[client]) for client in range(2)}
        uploads = {client: {"q": q.astype(np.float32), N_SAMPLES: np.array(1.0)} for client, q in local.items()}
        tables = {client: payload["q"].astype(float) for client, payload in server.aggregate(round, uploads).items()}
    for client in range(2):
        np.testing.assert_allclose(tables[client], optimum(0.6), atol=1e-5)
    mean_of_optima = (optimum(0.9) + optimum(0.3)) / 2
    assert np.abs(mean_of_optima - optimum(0.6)).max() > 0.01, "the average of what each learns alone is something else"


def everything_of(model: FedRL, client: int) -> dict[str, np.ndarray]:
    """All training state of one client as arrays, copied."""
    state = dict(parameters_of(model, client))
    for network in ("actor", "critic"):
        for key, moments in getattr(model, network).optimizer.state_dict()["state"].items():
            state.update({f"{network} {key} {name}": value[client] for name, value in moments.items()})
    buffer, normalizer = model.replay_buffer, model.normalizer
    state.update(observations=buffer.observations[:, client], rewards=buffer.rewards[:, client], size=buffer.sizes[client])
    state.update(mean=normalizer.obs.mean[client], count=normalizer.obs.count[client], ret=normalizer.ret.var[client])
    for role in (Role.ACTION, Role.MINIBATCH):
        state[role.name] = model.streams(role)[client].bit_generator.state["state"]["state"]
    state.update(noise=model.noise.state[client], steps=model.client_steps[client])
    return {name: np.array(value.numpy() if isinstance(value, th.Tensor) else value) for name, value in state.items()}


def test_absent_clients_keep_all_of_their_state(point_envs):
    states = []

    class Watch(RoundCallback):
        def _on_round_start(self):
            self.start = [everything_of(self.model, client) for client in range(4)]

        def _on_local_training_end(self):
            states.append(self.model.present.copy())
            for client in range(4):
                after = everything_of(self.model, client)  # moments exist after the first gradient step
                changed = {name for name, value in self.start[client].items() if not np.array_equal(value, after[name])}
                assert not changed or self.model.present[client], changed
                if self.model.present[client]:
                    assert {"actor.mu.0.weight", "critic_target.qf0.0.weight", "steps", "size", "noise", "mean"} <= changed

    model = FedRL("MlpPolicy", point_envs(4), client_fraction=0.5, normalize=True, **SMALL)
    model.learn(6 * 2 * 64, callback=Watch())
    assert all(present.sum() == 2 for present in states) and len(states) == 6
    assert len({tuple(present) for present in states}) > 1
    assert model.client_steps.sum() == model.num_timesteps == 6 * 2 * 64
    np.testing.assert_array_equal(model.client_steps, model.replay_buffer.sizes)


def test_partial_participation_is_the_same_learning(point_envs):
    """With the clients that take part fixed, they learn what a full federation of theirs does."""
    factories = point_envs(3)
    part = FederatedDDPG("MlpPolicy", factories, client_fraction=0.67, **SMALL)
    part.learn(64 * 2)
    chosen = np.flatnonzero(part.present).tolist()
    full = FederatedDDPG("MlpPolicy", factories, clients=chosen, **SMALL)
    full.learn(64 * 2)
    assert len(chosen) == 2 and part._n_updates == full._n_updates == 32
    for client in chosen:
        assert_same_parameters(parameters_of(part, client), parameters_of(full, client), tolerance=1e-6)
