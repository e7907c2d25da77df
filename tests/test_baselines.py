"""FedProx, FedKL and FedSVRPG-M: their terms in closed form, what they reduce to, what crosses the network."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch as th

from sb3_fedguide import FedAvg, FedKL, FedProx, FedSVRPGM, Local
from sb3_fedguide.cli.train import main
from sb3_fedguide.common import federation, gaussian
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.ppo_policy import ACTOR_PREFIXES, CRITIC_PREFIXES
from sb3_fedguide.seeding import stream
from sb3_fedguide.server.strategy import N_SAMPLES
from sb3_fedguide.server.svrpg import DIRECTION, SVRPG
from tests.conftest import assert_same_parameters, others_slow, parameters_of
from tests.environments import PointEnv
from tests.small_runs import minibatch, perturb

METHODS = {"fedprox": FedProx, "fedkl": FedKL, "fedsvrpgm": FedSVRPGM}
#: Settings with which each method is FedAvg.
NEUTRAL = {FedProx: {"mu": 0.0}, FedKL: {"lambda_global": 0.0, "lambda_local": 0.0}, FedSVRPGM: {"beta": 1.0}}


@pytest.mark.parametrize("cls", NEUTRAL)
@pytest.mark.parametrize("shared", [{}, {"average_every": 2, "average": "actor", "normalize": True, "ent_coef": 0.01}])
def test_neutral_settings_are_fedavg_bit_for_bit(point_envs, small, cls, shared):
    federated = cls("MlpPolicy", point_envs(3), **NEUTRAL[cls], **shared, **small).learn(3 * 3 * 64)
    fedavg = FedAvg("MlpPolicy", point_envs(3), **shared, **small).learn(3 * 3 * 64)
    default = cls("MlpPolicy", point_envs(3), **shared, **small).learn(3 * 3 * 64)
    for client in range(3):
        assert_same_parameters(parameters_of(federated, client), parameters_of(fedavg, client))
        plain, changed = parameters_of(fedavg, client), parameters_of(default, client)
        assert not th.equal(plain["action_net.weight"], changed["action_net.weight"]), "the defaults must make a difference"


def test_fedsvrpgm_of_one_client_with_beta_one_is_ppo(point_envs, small):
    """Local itself is compared with SB3's PPO elsewhere."""
    a = FedSVRPGM("MlpPolicy", point_envs(1), beta=1.0, reference_every=2, ent_coef=0.01, **small).learn(5 * 64)
    b = Local("MlpPolicy", point_envs(1), ent_coef=0.01, **small).learn(5 * 64)
    assert_same_parameters(parameters_of(a, 0), parameters_of(b, 0))


def test_fedavg_of_identical_clients_is_ppo(small, monkeypatch):
    """Same environments, same random streams: the average of equals is each of them."""
    monkeypatch.setattr(federation, "stream", lambda seed, role, client: stream(seed, role, 0))
    local = Local("MlpPolicy", [PointEnv], **small)
    fedavg = FedAvg("MlpPolicy", [PointEnv] * 3, **small)
    for model in (local, fedavg):
        model.env._seeds = [7] * model.n_clients
        model.learn(4 * model.n_clients * 64)
    np.testing.assert_array_equal(fedavg.rollout_buffer.observations[:, 0], fedavg.rollout_buffer.observations[:, 2])
    for client in range(3):
        assert_same_parameters(parameters_of(fedavg, client), parameters_of(local, 0))


def test_the_proximal_gradient_is_mu_times_the_distance(point_envs, small):
    model = FedProx("MlpPolicy", point_envs(2), mu=0.3, average_every=10, **small).learn(2 * 2 * 64)
    data = minibatch(model)
    model._prepare_training()
    model.policy.optimizer.zero_grad()
    loss = model._extra_losses(data, None, None)["proximal_loss"]
    loss.sum().backward()
    squares = np.zeros(2)
    assert set(model.anchor) == {name for name, _ in model.policy.named_parameters()}, "actor and critic"
    for name, parameter in model.policy.named_parameters():
        difference = parameter.detach() - th.as_tensor(model.anchor[name])
        assert difference.abs().max() > 0
        th.testing.assert_close(parameter.grad, 0.3 * difference)
        squares += (difference**2).flatten(1).sum(dim=1).numpy()
    np.testing.assert_allclose(loss.detach().numpy(), 0.15 * squares, rtol=1e-5)


@pytest.mark.parametrize("cls", [FedProx, FedKL])
def test_the_anchor_is_the_last_broadcast(point_envs, small, cls):
    model = cls("MlpPolicy", point_envs(2), average_every=2, **small)
    initial = {client: parameters_of(model, client) for client in range(2)}
    model.learn(2 * 64)
    for client in range(2):
        assert_same_parameters({k: th.as_tensor(v[client]) for k, v in model.anchor.items()}, initial[client])
    model.learn(2 * 64, reset_num_timesteps=False)
    broadcast = parameters_of(model, 0)
    model.learn(2 * 64, reset_num_timesteps=False)  # no exchange after the third round
    for client in range(2):
        assert_same_parameters({k: th.as_tensor(v[client]) for k, v in model.anchor.items()}, broadcast)
        assert not th.equal(parameters_of(model, client)["action_net.weight"], broadcast["action_net.weight"])


@pytest.mark.parametrize("cls", [FedProx, FedKL])
def test_a_broadcast_before_any_training_is_an_anchor(point_envs, small, cls):
    model = cls("MlpPolicy", point_envs(2), **small)
    initial, broadcast = parameters_of(model, 1), {name: array + 1 for name, array in model.averaged_parameters(0).items()}
    model.receive(0, broadcast)
    for client, expected in enumerate([{name: th.as_tensor(array) for name, array in broadcast.items()}, initial]):
        assert_same_parameters({name: th.as_tensor(array[client]) for name, array in model.anchor.items()}, expected)


def test_fedprox_stays_nearer_to_the_broadcast(point_envs, small):
    moved = []
    for mu in (0.0, 100.0):
        model = FedProx("MlpPolicy", point_envs(2), mu=mu, average_every=10, **small).learn(2 * 2 * 64)
        parameters = dict(model.policy.named_parameters())
        moved.append(sum(float(((parameters[k].detach().numpy() - v) ** 2).sum()) for k, v in model.anchor.items()))
    assert moved[1] < 0.5 * moved[0]


def test_a_term_covers_what_is_averaged(point_envs, small):
    model = FedProx("MlpPolicy", point_envs(2), average="actor", **small).learn(2 * 64)
    assert all(name.startswith(ACTOR_PREFIXES) for name in model.anchor)


def test_fedkl_terms_equal_torch_distributions(point_envs, small):
    model = FedKL("MlpPolicy", point_envs(2), lambda_global=0.1, lambda_local=0.05, average_every=10, **small)
    model.learn(2 * 2 * 64)
    perturb(model, 0.3)  # as after some rounds
    model._prepare_training()
    old = model.policy.actor(), model.policy.log_std.detach().clone()
    perturb(model, 0.1, seed=1)  # as after some minibatches
    data = minibatch(model)
    mean = model.policy.actor_mean(data.observations)
    losses = model._extra_losses(data, mean, gaussian.log_prob(mean, model.policy.log_std, data.actions))

    bar = model.policy.actor()
    for name, parameter in bar.named_parameters():
        full = name if name.startswith("action_net.") else f"mlp_extractor.{name}"
        parameter.data = th.as_tensor(model.anchor[full])

    def distribution(actor_mean, log_std):
        return th.distributions.Normal(actor_mean, log_std.exp().unsqueeze(1).expand_as(actor_mean))

    current = distribution(mean, model.policy.log_std)
    for name, weight, actor, log_std in (
        ("global_kl_loss", 0.1, bar, th.as_tensor(model.anchor["log_std"])),
        ("local_kl_loss", 0.05, *old),
    ):
        kl = th.distributions.kl_divergence(current, distribution(actor(data.observations), log_std)).sum(-1)
        th.testing.assert_close(losses[name], weight * kl.mean(dim=1), rtol=1e-4, atol=1e-6)
    assert losses["global_kl_loss"][0] > 2.1 * losses["local_kl_loss"][0], "the two policies must differ here"


def test_fedkl_with_an_average_every_round_has_one_anchor(point_envs, small):
    """pi_bar = pi_old, so only the sum of the weights matters."""
    a = FedKL("MlpPolicy", point_envs(2), lambda_global=0.5, lambda_local=0.25, **small).learn(2 * 2 * 64)
    b = FedKL("MlpPolicy", point_envs(2), lambda_global=0.0, lambda_local=0.75, **small).learn(2 * 2 * 64)
    assert_same_parameters(parameters_of(a, 0), parameters_of(b, 0), tolerance=1e-5)


def test_server_averages_parameters_and_directions():
    server = SVRPG(("a",))

    def upload(a, u, n=1.0):
        return {"a": np.array([a], np.float32), DIRECTION + "a": np.array([u], np.float32), N_SAMPLES: np.float32(n)}

    out = server.aggregate(1, {4: upload(1, 3), 7: upload(5, -1)})
    assert out[4] == {"a": 3.0, DIRECTION + "a": 1.0} and out[7] == out[4]
    assert out[4][DIRECTION + "a"] is not out[7][DIRECTION + "a"]
    assert server.metrics == {"drift": 2.0, "direction_norm": 1.0, "direction_agreement": 0.5}
    assert server.latest(9) == out[4], "for clients that were away"
    every_other = SVRPG(("a",), average_every=2)
    assert every_other.aggregate(1, {4: upload(1, 3), 7: upload(5, -1)}) == {4: {}, 7: {}}


@pytest.mark.parametrize("cls", METHODS.values())
@pytest.mark.parametrize("average", ["all", "actor"])
def test_uploads_hold_what_is_documented(point_envs, small, cls, average):
    model = cls("MlpPolicy", point_envs(2), average=average, **small).learn(2 * 64)
    prefixes = ACTOR_PREFIXES + CRITIC_PREFIXES if average == "all" else ACTOR_PREFIXES
    names = [name for name, _ in model.policy.named_parameters()]
    expected = {name for name in names if name.startswith(prefixes)} | {N_SAMPLES}
    if cls is FedSVRPGM:
        expected |= {DIRECTION + name for name in names if name.startswith(ACTOR_PREFIXES)}
    payload = model.upload(1)
    assert set(payload) == expected
    assert all(array.dtype == np.float32 for array in payload.values())
    payload["log_std"] += 1  # a copy, not the client's own
    assert not np.array_equal(payload["log_std"], model.upload(1)["log_std"])


@pytest.mark.parametrize("cls", METHODS.values())
def test_a_saved_model_goes_on_as_if_it_had_not_stopped(small, tmp_path, cls):
    """Four rounds in, between two averages (after the third and the sixth) and between two references."""
    shared = {"average_every": 3} if cls is not FedSVRPGM else {}
    model = cls("MlpPolicy", "Bandit2D", **shared, **small).learn(4 * 4 * 64)
    model.save(tmp_path / "model")
    loaded = cls.load(tmp_path / "model", env="Bandit2D")
    for each in (model, loaded):
        each.learn(3 * 4 * 64, reset_num_timesteps=False)
    for client in range(4):
        assert_same_parameters(parameters_of(model, client), parameters_of(loaded, client))


class WatchMemory(RoundCallback):
    """What each client remembers of broadcasts and earlier policies, at the start, in the middle and the end of rounds."""

    def __init__(self) -> None:
        super().__init__()
        self.rounds: list[tuple] = []

    def memory(self) -> list[dict[str, np.ndarray]]:
        kept = {name: getattr(self.model, name, {}) for name in ("anchor", "reference", "momentum", "directions")}
        return [
            {f"{kind}.{name}": array[index].copy() for kind, arrays in kept.items() for name, array in arrays.items()}
            for index in range(self.model.n_clients)
        ]

    def _on_round_start(self) -> None:
        self.latest = {client: self.model.strategy.latest(client) for client in self.model.client_ids}
        self.start = self.memory()

    def _on_local_training_end(self) -> None:
        self.trained = self.memory()

    def _on_round_end(self) -> None:
        self.rounds.append((self.model.present.copy(), self.latest, self.start, self.trained, self.memory()))


@pytest.mark.parametrize("cls", METHODS.values())
def test_who_was_away_remembers_and_catches_up(point_envs, small, cls):
    model = cls("MlpPolicy", point_envs(4), client_fraction=0.5, **small)
    watch = WatchMemory()
    model.learn(8 * 2 * 64, callback=watch)
    assert len(watch.rounds) == 8
    caught_up = 0
    for (before, *_), (present, latest, start, trained, end) in zip(watch.rounds, watch.rounds[1:], strict=False):
        for client in range(4):
            if not present[client]:
                assert all(np.array_equal(start[client][name], end[client][name]) for name in start[client])
            elif not before[client]:
                caught_up += 1
                for name, array in latest[client].items():
                    kind = "momentum." if name.startswith(DIRECTION) else "anchor."
                    if cls is not FedSVRPGM or kind == "momentum.":
                        np.testing.assert_array_equal(trained[client][kind + name.removeprefix(DIRECTION)], array)
    assert caught_up > 3


def test_who_was_away_takes_its_reference_when_it_is_back(point_envs, small):
    model = FedSVRPGM("MlpPolicy", point_envs(2), reference_every=2, **small).learn(2 * 2 * 64)  # rounds 0 and 1
    old = model.reference["log_std"].copy()
    perturb(model, 0.1)
    model.present, model.round = np.array([True, False]), 2
    model._prepare_training()
    current = model.policy.log_std.detach().numpy().copy()
    np.testing.assert_array_equal(model.reference["log_std"], [current[0], old[1]])
    model.present, model.round = np.array([True, True]), 3
    perturb(model, 0.1)
    model._prepare_training()
    np.testing.assert_array_equal(model.reference["log_std"], [current[0], model.policy.log_std[1].detach().numpy()])


@pytest.mark.parametrize(
    ("cls", "settings"),
    [
        (FedProx, {"mu": -0.1}),
        (FedProx, {"average": "actors"}),
        (FedKL, {"lambda_global": -1.0}),
        (FedKL, {"lambda_local": float("nan")}),
        (FedKL, {"average": "critic"}),
        (FedSVRPGM, {"beta": 1.5}),
        (FedSVRPGM, {"reference_every": 0}),
        (FedSVRPGM, {"average": "critic"}),
    ],
)
def test_unfit_settings_are_refused(point_envs, small, cls, settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        cls("MlpPolicy", point_envs(2), **settings, **small)


@pytest.mark.parametrize("algo", METHODS)
def test_command_line_end_to_end(algo, tmp_path: Path):
    argv = ["--algo", algo, "--env", "Bandit2D", "--rounds", "2", "-f", str(tmp_path), "--verbose", "0"]
    assert (
        main([*argv, "-params", "bc_weight:0.0", "n_envs_per_client:2", "rollout_size:40", "batch_size:20", "n_epochs:1"]) == 0
    )
    folder = tmp_path / algo / "Bandit2D_1"
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["finished"] and summary["rounds_done"] == 2 and summary["bytes_up"] > 0
    model = METHODS[algo].load(folder / "model.zip")
    assert (model.round, model.n_clients) == (2, 4)


@pytest.mark.parametrize("cls", others_slow(METHODS.values(), lambda cls: cls is FedSVRPGM))
def test_every_method_learns_a_bandit(cls, small):
    args = {**small, "rollout_size": 128, "batch_size": 32, "n_epochs": 4, "learning_rate": 3e-3}
    model = cls("MlpPolicy", "Bandit2D", **{**args, "policy_kwargs": {"net_arch": [16], "log_std_init": -1.0}})
    with th.no_grad():  # off the saddle between the four equal peaks, which takes most of the time otherwise
        model.policy.action_net.bias.copy_(th.tensor([0.6, 0.0]))
    model.learn(4 * 128)
    first = model.mean_episode_return()
    model.learn(15 * 4 * 128, reset_num_timesteps=False)
    assert model.mean_episode_return() > 0.45 > 2 * first, (first, model.mean_episode_return())
    actions, _ = model.predict(np.zeros((4, 2)), deterministic=True)
    assert np.linalg.norm(actions - [1.0, 0.0], axis=1).max() < 0.1, actions
