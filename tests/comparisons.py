"""What it means that two states, two trained models, or a model and SB3's are the same."""

from __future__ import annotations

import numpy as np
import torch as th
from stable_baselines3 import PPO

from sb3_fedguide import FederatedPPO
from sb3_fedguide.seeding import Role
from tests.conftest import assert_same_parameters, parameters_of


def same(first, second) -> bool:
    if isinstance(first, np.ndarray):
        equal = isinstance(second, np.ndarray) and first.dtype == second.dtype and first.shape == second.shape
        return equal and first.tobytes() == second.tobytes()
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[name], second[name]) for name in first)
    if isinstance(first, list):
        return len(first) == len(second) and all(map(same, first, second))
    return type(first) is type(second) and first == second


def without_clock(state):
    """A state without seconds, and with the random streams that both have: an engine makes all of them at once."""
    for infos in state["attributes"]["episode_infos"]:
        for info in infos["value"]:
            info.pop("t")
    state["env"].pop("seconds")
    state["attributes"].pop("_streams")
    state.pop("random")  # the processes' own generators, which nothing draws from
    return state


def assert_same_training(plain, other) -> None:
    for role, streams in plain._streams.items():
        assert [s.bit_generator.state for s in streams] == [s.bit_generator.state for s in other._streams[role]]
    assert same(without_clock(plain.save_state()), without_clock(other.save_state()))


def sb3_twin(model: FederatedPPO, env) -> PPO:
    """An ordinary PPO with the same settings and parameters as a federation of one client."""
    twin = PPO(
        "MlpPolicy",
        env,
        n_steps=model.n_steps,
        batch_size=model.batch_size,
        n_epochs=model.n_epochs,
        clip_range=model.clip_range(1.0),
        ent_coef=model.ent_coef,
        clip_range_vf=None if model.clip_range_vf is None else model.clip_range_vf(1.0),
        policy_kwargs={"net_arch": model.policy.net_arch},
        device="cpu",
    )
    twin.policy.load_state_dict(model.policy.client_state_dict(0))
    return twin


def assert_train_equals(model: FederatedPPO, twin: PPO, monkeypatch) -> None:
    """A federation of one client learns from a rollout what an ordinary PPO learns from it in the same order."""
    n_envs = model.n_envs_per_client
    model.learn(model.rollout_size)  # a round, so that the compared rollout is not the first
    twin.policy.load_state_dict(model.policy.client_state_dict(0))
    twin.policy.optimizer.load_state_dict(
        {
            "state": {
                k: {name: (v[0] if v.dim() else v).clone() for name, v in state.items()}
                for k, state in model.policy.optimizer.state_dict()["state"].items()
            },
            "param_groups": twin.policy.optimizer.state_dict()["param_groups"],
        }
    )
    names = [name for name, _ in model.policy.named_parameters()]
    assert names == [name for name, _ in twin.policy.named_parameters()], "optimiser state is matched by position"
    model._last_obs = model.env.reset()
    model._last_episode_starts = np.ones(n_envs, dtype=bool)
    callback = model._init_callback(None)
    model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
    ours, theirs = model.rollout_buffer, twin.rollout_buffer
    theirs.reset()
    for step in range(model.n_steps):
        theirs.add(
            ours.observations[step, 0],
            ours.actions[step, 0],
            ours.rewards[step, 0],
            ours.episode_starts[step, 0],
            th.as_tensor(ours.values[step, 0]),
            th.as_tensor(ours.log_probs[step, 0]),
        )
    theirs.advantages[:], theirs.returns[:] = ours.advantages[:, 0], ours.returns[:, 0]
    orders = [np.random.default_rng(epoch).permutation(model.rollout_size) for epoch in range(model.n_epochs)]
    replay = iter(orders)
    monkeypatch.setattr(np.random, "permutation", lambda n: next(replay))

    class Replay:
        def __init__(self):
            self.orders = iter(orders)

        def permutation(self, n):
            return next(self.orders)

    model._streams[Role.MINIBATCH] = [Replay()]  # type: ignore[list-item]
    twin._logger, twin._current_progress_remaining = model.logger, model._current_progress_remaining
    model.train()
    twin.train()
    assert_same_parameters(parameters_of(model, 0), twin.policy.state_dict(), tolerance=1e-6)
