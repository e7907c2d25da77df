"""FedSVRPG-M: the direction in closed form, its reductions, its references, and what it is for: less variance."""

from __future__ import annotations

import numpy as np
import torch as th

from sb3_fedguide import FedSVRPGM
from sb3_fedguide.algorithms.fedsvrpgm import variance_reduced
from sb3_fedguide.common import gaussian
from sb3_fedguide.common.ppo_policy import ACTOR_PREFIXES
from sb3_fedguide.server.svrpg import DIRECTION
from tests.conftest import parameters_of
from tests.small_runs import minibatch, perturb


def test_the_direction_in_closed_form():
    g, reference, momentum = (th.randn(2, 3, generator=th.Generator().manual_seed(k)) for k in range(3))
    assert th.equal(variance_reduced(g, g, momentum, 0.2), 0.2 * g + 0.8 * momentum)
    assert th.equal(variance_reduced(g, reference, momentum, 1.0), g)
    th.testing.assert_close(variance_reduced(g, reference, momentum, 0.3), g + 0.7 * (momentum - reference))


def ppo_gradients(model, data):
    """Descent gradients of the PPO loss in ``parameter.grad``, as ``train`` leaves them before its hook; clip range 0.2."""
    model.policy.optimizer.zero_grad()
    mean = model.policy.actor_mean(data.observations)
    log_prob = gaussian.log_prob(mean, model.policy.log_std, data.actions)
    advantages = data.advantages - data.advantages.mean(dim=1, keepdim=True)
    advantages = advantages / (data.advantages.std(dim=1, keepdim=True) + 1e-8)
    ratio = th.exp(log_prob - data.old_log_prob)
    loss = -th.min(advantages * ratio, advantages * ratio.clamp(0.8, 1.2)).mean(dim=1)
    loss = loss - model.ent_coef * gaussian.entropy(model.policy.log_std)
    loss = loss + 0.5 * ((data.returns - model.policy.values(data.observations)) ** 2).mean(dim=1)
    loss.sum().backward()
    return {name: parameter.grad.clone() for name, parameter in model.policy.named_parameters()}


def test_transform_where_the_reference_is_the_current_policy(point_envs, small):
    model = FedSVRPGM("MlpPolicy", point_envs(2), beta=0.2, ent_coef=0.01, reference_every=1, **small).learn(2 * 2 * 64)
    model._prepare_training()  # the reference becomes the current policy
    data = minibatch(model)
    before = ppo_gradients(model, data)
    model._transform_gradients(data)
    for name, parameter in model.policy.named_parameters():
        if name.startswith(ACTOR_PREFIXES):
            assert np.abs(model.momentum[name]).max() > 0
            expected = 0.2 * before[name] - 0.8 * th.as_tensor(model.momentum[name])
            th.testing.assert_close(parameter.grad, expected, rtol=0, atol=1e-7)
        else:
            assert th.equal(parameter.grad, before[name]), "the critic keeps its gradient"


def test_transform_with_a_distant_reference_uses_the_same_surrogate_there(point_envs, small):
    """The reference gradient is what train() would compute if the policy were the reference, clipping included."""
    model = FedSVRPGM("MlpPolicy", point_envs(2), beta=0.4, ent_coef=0.01, reference_every=10, **small).learn(2 * 2 * 64)
    perturb(model, 0.1)
    model.reference["action_net.bias"] += 0.3
    model.reference["log_std"] -= 0.2
    model._prepare_training()
    data = minibatch(model)
    at_theta = ppo_gradients(model, data)
    theta = {name: parameter.detach().clone() for name, parameter in model.policy.named_parameters()}
    with th.no_grad():
        for name, array in model.reference.items():
            model.policy.get_parameter(name).copy_(th.as_tensor(array))
    at_reference = ppo_gradients(model, data)
    mean = model.policy.actor_mean(data.observations)
    ratio = th.exp(gaussian.log_prob(mean, model.policy.log_std, data.actions) - data.old_log_prob)
    assert ((ratio - 1).abs() > 0.2).float().mean() > 0.1, "some ratios must be clipped for this to test anything"
    with th.no_grad():
        for name, parameter in model.policy.named_parameters():
            parameter.copy_(theta[name])
    ppo_gradients(model, data)
    model._transform_gradients(data)
    for name in model.reference:
        u = -0.4 * at_theta[name] + 0.6 * (th.as_tensor(model.momentum[name]) - at_theta[name] + at_reference[name])
        th.testing.assert_close(model.policy.get_parameter(name).grad, -u, rtol=1e-4, atol=1e-6)


def test_reference_is_the_policy_at_the_start_of_every_so_many_rounds(point_envs, small):
    model = FedSVRPGM("MlpPolicy", point_envs(2), reference_every=2, **small)
    starts = []
    for round in range(5):
        starts.append(parameters_of(model, 1))
        model.learn(2 * 64, reset_num_timesteps=False)
        expected = starts[2 * (round // 2)]
        for name, array in model.reference.items():
            np.testing.assert_array_equal(array[1], expected[name].numpy())
    assert not th.equal(starts[0]["action_net.weight"], starts[2]["action_net.weight"])


def test_upload_is_the_mean_direction_and_the_broadcast_its_mean_over_clients(point_envs, small, monkeypatch):
    model = FedSVRPGM("MlpPolicy", point_envs(3), **small).learn(3 * 64)
    seen: dict[str, list[th.Tensor]] = {}
    transform = FedSVRPGM._transform_gradients

    def record(self, data):
        transform(self, data)
        for name in self.momentum:
            seen.setdefault(name, []).append(-self.policy.get_parameter(name).grad.clone())

    monkeypatch.setattr(FedSVRPGM, "_transform_gradients", record)
    model.learn(3 * 64, reset_num_timesteps=False)
    for name, directions in seen.items():
        means = th.stack(directions).mean(dim=0).numpy()
        for client in range(3):
            np.testing.assert_allclose(model.upload(client)[DIRECTION + name], means[client], atol=1e-6)
            np.testing.assert_allclose(model.momentum[name][client], means.mean(axis=0), atol=1e-6)


def test_on_a_bandit_directions_vary_less_than_gradients(small, monkeypatch):
    args = {**small, "rollout_size": 512, "batch_size": 32, "n_epochs": 2, "learning_rate": 3e-4}
    model = FedSVRPGM("MlpPolicy", "Bandit2D", beta=0.2, reference_every=5, **args).learn(4 * 4 * 512)
    gradients, directions = [], []
    transform = FedSVRPGM._transform_gradients

    def flat(self):
        parts = [self.policy.get_parameter(name).grad.flatten(1) for name in self.momentum]
        return th.cat(parts, dim=1).numpy().copy()

    def record(self, data):
        gradients.append(flat(self))
        transform(self, data)
        directions.append(flat(self))

    monkeypatch.setattr(FedSVRPGM, "_transform_gradients", record)
    model.learn(4 * 512, reset_num_timesteps=False)  # the fifth round: the reference is four rounds old
    assert model.round == 5
    noise = [np.var(np.stack(samples), axis=0).sum(axis=1) for samples in (gradients, directions)]  # per client
    assert (noise[1] < 0.5 * noise[0]).all(), noise
