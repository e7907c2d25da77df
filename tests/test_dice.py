"""The DICE value: conjugates against their definition, fixed points against closed forms, independence of the clients."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th

from sb3_fedguide.offline.conjugates import CONJUGATES, KL_MAX, conjugate
from sb3_fedguide.offline.data import OfflineData
from sb3_fedguide.offline.dice import DiceValue, calibrate, train_dice


def generator(name: str, w: np.ndarray) -> np.ndarray:
    """f(w) as in the literature, the definition that the conjugates are tested against."""
    entropy = np.where(w > 0, w * np.log(np.maximum(w, 1e-300)), 0.0) - w + 1.0
    square = 0.5 * (w - 1.0) ** 2
    return {"kl": entropy, "chi2": square, "soft_chi": np.where(w < 1.0, entropy, square)}[name]


@pytest.mark.parametrize("name", CONJUGATES)
def test_conjugate_is_the_supremum_and_its_derivative_the_ratio(name: str) -> None:
    w = np.concatenate([np.linspace(0.0, 2.0, 20_001), np.geomspace(2.0, np.exp(KL_MAX), 200_001)])
    y = th.linspace(-4.0, 12.0, 33, dtype=th.float64, requires_grad=True)
    conjugated = CONJUGATES[name](y)
    (ratio,) = th.autograd.grad(conjugated.sum(), y)
    for i, value in enumerate(y.detach().numpy()):
        objective = value * w - generator(name, w)
        best = int(objective.argmax())
        assert conjugated[i].item() == pytest.approx(objective[best], rel=1e-6, abs=1e-6)
        assert ratio[i].item() == pytest.approx(w[best], rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("name", CONJUGATES)
def test_gradients_are_finite_far_out_and_never_negative(name: str) -> None:
    y = th.tensor([-1e3, -90.0, -1.0, 0.0, 1.0, 90.0, 1e3], requires_grad=True)
    (ratio,) = th.autograd.grad(CONJUGATES[name](y).sum(), y)
    assert th.isfinite(CONJUGATES[name](y)).all()
    assert th.isfinite(ratio).all()
    assert (ratio >= 0).all()
    assert (ratio.diff() >= 0).all()


def test_conjugate_refuses_unknown_generators() -> None:
    with pytest.raises(ValueError, match="choose one of soft_chi, kl, chi2"):
        conjugate("hellinger")


CHAIN_REWARDS = np.array([[0.0, 1.0], [0.5, -0.5], [1.0, 0.0]])
CHAIN_PROBABILITIES = np.array([0.7, 0.3])  # of the two actions in the data, the same in every state
GAMMA, OMEGA = 0.8, 0.5


def chain_data(n: int = 4000) -> OfflineData:
    """Three states in a line, one-hot; both actions lead to the next state, the last one terminates."""
    rng = np.random.default_rng(0)
    states = np.tile(np.arange(3), n // 3)
    # Exact frequencies: the closed form is then that of the data and not of their limit.
    actions = np.repeat(rng.permutation(len(states) // 3) >= 0.7 * (len(states) // 3), 3).astype(int)
    one_hot = np.eye(3, dtype=np.float32)
    following = np.minimum(states + 1, 2)
    return OfflineData(
        one_hot[states],
        (2.0 * actions[:, None] - 1.0).astype(np.float32),
        CHAIN_REWARDS[states, actions],
        one_hot[following],
        states == 2,
    )


def chain_fixed_point(name: str, coefficient: float) -> np.ndarray:
    """Backward induction; V(s) solves E_a[w((Q(s, a) - V) / omega)] = coefficient by bisection."""
    values, following = np.zeros(3), 0.0
    for state in (2, 1, 0):
        q = CHAIN_REWARDS[state] + GAMMA * following * (state != 2)
        low, high = q.min() - 20.0, q.max() + 20.0
        for _ in range(80):
            middle = 0.5 * (low + high)
            y = th.tensor((q - middle) / OMEGA, requires_grad=True)
            (ratio,) = th.autograd.grad(CONJUGATES[name](y).sum(), y)
            low, high = (middle, high) if float(CHAIN_PROBABILITIES @ ratio.numpy()) > coefficient else (low, middle)
        values[state] = following = middle
    return values


def train_on_chain(name: str, v_coef: float | str = 1.0) -> np.ndarray:
    value = train_dice(
        [chain_data()], [np.random.default_rng(1)], n_updates=1500, batch_size=64, width=32, omega=OMEGA,
        learning_rate=3e-3, gamma=GAMMA, tau=0.05, f=name, v_coef=v_coef,  # type: ignore[arg-type]
    )  # fmt: skip
    return value.client_values(0, np.eye(3, dtype=np.float32))


def test_kl_fixed_point_is_the_log_mean_exp() -> None:
    last = OMEGA * np.log(CHAIN_PROBABILITIES @ np.exp(CHAIN_REWARDS[2] / OMEGA))
    middle = OMEGA * np.log(CHAIN_PROBABILITIES @ np.exp((CHAIN_REWARDS[1] + GAMMA * last) / OMEGA))
    expected = chain_fixed_point("kl", 1.0)
    np.testing.assert_allclose(expected[1:], [middle, last], atol=1e-6)
    np.testing.assert_allclose(train_on_chain("kl"), expected, atol=0.05)


@pytest.mark.parametrize("name", ["soft_chi", pytest.param("chi2", marks=pytest.mark.slow)])
def test_fixed_point_on_a_chain(name: str) -> None:
    np.testing.assert_allclose(train_on_chain(name), chain_fixed_point(name, 1.0), atol=0.05)


def test_printed_coefficient_shifts_the_value_as_predicted() -> None:
    expected = chain_fixed_point("kl", 1.0 - GAMMA)
    shift = OMEGA * np.log(1.0 / (1.0 - GAMMA))  # per backup
    np.testing.assert_allclose(
        expected - chain_fixed_point("kl", 1.0), shift * np.array([1 + GAMMA + GAMMA**2, 1 + GAMMA, 1.0]), atol=1e-6
    )
    np.testing.assert_allclose(train_on_chain("kl", "1-gamma"), expected, atol=0.1)


def test_time_limits_are_bootstrapped_and_terminations_are_not() -> None:
    """One state, reward 1 for ever, cut into records of one step: V = 1 / (1 - gamma), or 1 if the cut is a termination."""
    ones = np.ones((256, 1), dtype=np.float32)
    actions = np.where(np.arange(256) % 2, 1.0, -1.0)[:, None]
    values = []
    for terminated in (False, True):
        data = OfflineData(ones, actions, np.ones(256), ones, np.full(256, terminated))
        value = train_dice(
            [data], [np.random.default_rng(0)], n_updates=600, batch_size=32, width=16, learning_rate=1e-2, gamma=0.5, tau=0.05
        )
        values.append(value.client_values(0, ones[:1])[0])
    np.testing.assert_allclose(values, [2.0, 1.0], atol=0.05)


def random_data(seed: int, n: int, scale: float) -> OfflineData:
    rng = np.random.default_rng(seed)
    obs = scale * rng.standard_normal((n + 1, 5)).astype(np.float32)
    return OfflineData(obs[:-1], rng.uniform(-1, 1, (n, 3)), scale * rng.standard_normal(n), obs[1:], rng.random(n) < 0.05)


@pytest.mark.parametrize(("batch_size", "width"), [(64, 64), (37, 64), (37, 20)])
def test_a_client_learns_the_same_bits_with_and_without_neighbours(batch_size: int, width: int) -> None:
    datasets = [random_data(k, n, scale) for k, (n, scale) in enumerate([(300, 1.0), (500, 10.0), (200, 0.1)])]

    def train(which: list[int]) -> DiceValue:
        return train_dice(
            [datasets[k] for k in which],
            [np.random.default_rng(k) for k in which],
            n_updates=60,
            batch_size=batch_size,
            width=width,
        )

    together = train([0, 1, 2])
    for k in range(3):
        alone = train([k])
        for name, tensor in alone.state_dict().items():
            assert th.equal(tensor[0], together.state_dict()[name][k]), (k, name)
    swapped = train([2, 0])
    assert th.equal(swapped.net.weight_1[1], together.net.weight_1[0])


def test_values_of_the_stack_are_those_of_the_clients_and_frozen() -> None:
    datasets = [random_data(k, 100, 1.0) for k in range(2)]
    value = train_dice(datasets, [np.random.default_rng(k) for k in range(2)], n_updates=5, batch_size=16, width=16)
    assert not any(parameter.requires_grad for parameter in value.parameters())
    obs = th.as_tensor(np.stack([data.observations for data in datasets]))
    stacked = value(obs)
    assert stacked.shape == (2, 100)
    for k in range(2):
        np.testing.assert_allclose(value.client_values(k, datasets[k].observations), stacked[k].numpy(), rtol=1e-5)


def test_calibration_recovers_scale_and_offset() -> None:
    values = np.random.default_rng(0).standard_normal(200)
    assert calibrate(values, 3.0 * values - 7.0) == pytest.approx((3.0, -7.0))
    assert calibrate(np.full(10, 2.0), np.full(10, 5.0)) == pytest.approx((1.0, 3.0))
    returns = values + np.random.default_rng(1).standard_normal(200)
    slope, offset = calibrate(0.1 * values + 50.0, returns)
    assert np.var(returns - (slope * (0.1 * values + 50.0) + offset)) <= np.var(returns)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"omega": 0.0}, "omega > 0"),
        ({"gamma": 1.0}, "gamma < 1"),
        ({"batch_size": 0}, "at least 1"),
        ({"f": "unknown"}, "unknown generator"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        train_dice([random_data(0, 10, 1.0)], [np.random.default_rng(0)], **settings)


def test_datasets_that_do_not_fit_together_are_refused() -> None:
    other = OfflineData(np.zeros((2, 4)), np.zeros((2, 3)), np.zeros(2), np.zeros((2, 4)), np.zeros(2))
    with pytest.raises(ValueError, match="same observation and action lengths"):
        train_dice([random_data(0, 10, 1.0), other], [np.random.default_rng(0)] * 2)
    with pytest.raises(ValueError, match="one dataset and one generator per client"):
        train_dice([other], [])
