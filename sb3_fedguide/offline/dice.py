"""The DICE value function of the offline data, for all clients in lockstep (paper, Eq. 4 to 6).

With ``y = (min(Q1, Q2)_target(s, a) - V(s)) / omega``::

    L_V = E_D[v_coef * V(s) + omega * f*(y)]
    L_Q = sum_j E_D[(r + gamma * (1 - terminated) * V(s') - Q_j(s, a))^2]

V is trained first and the targets of Q follow by an exponential moving average. The optimality condition of V is
``E[w(y) | s] = v_coef``. With ``v_coef = 1`` V is a soft maximum of Q over the data's actions; the printed ``1 - gamma``
shifts V by ``omega * log(1 / (1 - gamma)) / (1 - gamma)`` for ``kl`` and stays selectable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_fedguide.offline.conjugates import conjugate
from sb3_fedguide.offline.data import OfflineData
from sb3_fedguide.offline.groups import client_groups, train_together
from sb3_fedguide.offline.progress import StepProgress
from sb3_fedguide.settings.pretraining import DEFAULTS

__all__ = ["DiceValue", "calibrate", "train_dice"]

_MIN_STD = 1e-3
_BLOCK = 250  # updates whose minibatches are drawn at once, and between two reports of progress


class StackedMlp(nn.Module):
    """``n_networks`` networks with two hidden ReLU layers and one output.

    Weights are kept as ``(n_networks, in, out)``: their gradients then arrive in the parameters' own memory layout, which
    saves the optimiser a transposing copy of every weight.
    """

    def __init__(self, n_networks: int, inputs: int, width: int) -> None:
        super().__init__()
        self.weight_0 = nn.Parameter(th.zeros(n_networks, inputs, width))
        self.bias_0 = nn.Parameter(th.zeros(n_networks, 1, width))
        self.weight_1 = nn.Parameter(th.zeros(n_networks, width, width))
        self.bias_1 = nn.Parameter(th.zeros(n_networks, 1, width))
        self.weight_2 = nn.Parameter(th.zeros(n_networks, 1, width))
        self.bias_2 = nn.Parameter(th.zeros(n_networks, 1))

    def forward(self, x: th.Tensor) -> th.Tensor:
        """``(n_networks, batch, inputs)`` to ``(n_networks, batch)``."""
        x = th.baddbmm(self.bias_0, x, self.weight_0).relu_()
        x = th.baddbmm(self.bias_1, x, self.weight_1).relu_()
        # A batched product with one output column rounds differently for one network than for several.
        return (x * self.weight_2).sum(dim=-1) + self.bias_2

    def client(self, index: int, x: th.Tensor) -> th.Tensor:
        """One network alone: ``(batch, inputs)`` to ``(batch,)``."""
        x = F.relu(th.addmm(self.bias_0[index], x, self.weight_0[index]))
        x = F.relu(th.addmm(self.bias_1[index], x, self.weight_1[index]))
        return x @ self.weight_2[index, 0] + self.bias_2[index]

    @th.no_grad()
    def initialize(self, index: int, rng: np.random.Generator) -> None:
        """PyTorch's default initialisation of linear layers for one network."""
        for layer in range(3):
            weight, bias = self.get_parameter(f"weight_{layer}")[index], self.get_parameter(f"bias_{layer}")[index]
            bound = 1.0 / np.sqrt(weight.shape[1] if layer == 2 else weight.shape[0])
            for parameter in (weight, bias):
                parameter.copy_(th.from_numpy(rng.uniform(-bound, bound, tuple(parameter.shape))))

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Groups for Adam: the fused kernel where it treats all networks alike.

        It works in vectors of up to 16 numbers and rounds a remainder differently, so what a parameter learns would depend
        on its network's position in the stack wherever a network's part is not a multiple of that.
        """
        fused = [parameter for parameter in self.parameters() if parameter[0].numel() % 16 == 0]
        others = [parameter for parameter in self.parameters() if parameter[0].numel() % 16 != 0]
        groups: list[dict[str, Any]] = [{"params": fused, "fused": True}, {"params": others, "foreach": True}]
        return [group for group in groups if group["params"]]


class DiceValue(nn.Module):
    """State values of N clients, ``V_k(s) = offset_k + scale_k * net_k((s - mean_k) / std_k)``, in the reward's own scale.

    :param n_clients: number N of clients
    :param obs_dim: length of an observation
    :param width: units of each of the two hidden ReLU layers
    """

    obs_mean: th.Tensor
    obs_std: th.Tensor
    offset: th.Tensor
    scale: th.Tensor

    def __init__(self, n_clients: int, obs_dim: int, width: int = DEFAULTS.dice_width) -> None:
        super().__init__()
        self.n_clients, self.obs_dim, self.width = n_clients, obs_dim, width
        self.net = StackedMlp(n_clients, obs_dim, width)
        self.register_buffer("obs_mean", th.zeros(n_clients, 1, obs_dim))
        self.register_buffer("obs_std", th.ones(n_clients, 1, obs_dim))
        self.register_buffer("offset", th.zeros(n_clients, 1))
        self.register_buffer("scale", th.ones(n_clients, 1))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Values ``(N, batch)`` of raw observations ``(N, batch, obs_dim)``."""
        return self.standardized((observations - self.obs_mean) / self.obs_std)

    value = forward

    def standardized(self, observations: th.Tensor) -> th.Tensor:
        """Values ``(N, batch)`` of observations that are standardised already."""
        return self.offset + self.scale * self.net(observations)

    def client_values(self, index: int, observations: np.ndarray) -> np.ndarray:
        """Values ``(n,)`` of client number ``index`` (its position in the stack) for raw observations ``(n, obs_dim)``."""
        x = (th.as_tensor(observations, dtype=th.float32) - self.obs_mean[index]) / self.obs_std[index]
        with th.no_grad():
            return (self.offset[index] + self.scale[index] * self.net.client(index, x)).numpy()

    @classmethod
    def stack(cls, clients: Sequence[DiceValue]) -> DiceValue:
        """The values of several clients as one module, frozen."""
        states = [client.state_dict() for client in clients]
        stacked = cls(sum(client.n_clients for client in clients), clients[0].obs_dim, clients[0].width)
        stacked.load_state_dict({name: th.cat([state[name] for state in states]) for name in states[0]})
        return stacked.requires_grad_(False)


def train_dice(
    datasets: Sequence[OfflineData],
    rngs: Sequence[np.random.Generator],
    n_updates: int = DEFAULTS.dice_updates,
    batch_size: int = DEFAULTS.dice_batch_size,
    width: int = DEFAULTS.dice_width,
    omega: float = DEFAULTS.dice_omega,
    learning_rate: float = DEFAULTS.dice_learning_rate,
    gamma: float = DEFAULTS.gamma,
    tau: float = DEFAULTS.dice_tau,
    f: str = DEFAULTS.dice_f,
    v_coef: float | Literal["1-gamma"] = DEFAULTS.dice_v_coef,
    progress: StepProgress | None = None,
) -> DiceValue:
    """Train V and the twin Q of every client on its own data; a client's result does not depend on the others.

    The networks' outputs are scaled and shifted by the deviation and mean of the data's discounted returns. That is a
    change of parameters and not of the objective: V starts at the level of the data instead of at zero, from where the
    Bellman iteration would need some ``1 / (tau * (1 - gamma))`` updates to arrive.

    :param datasets: one per client; observation and action lengths must agree
    :param rngs: one per client: draws the initial weights and the minibatches
    :param batch_size: rows per client and update
    :param tau: weight of the new parameters in the targets' moving average
    :param f: the divergence's generator, see :mod:`sb3_fedguide.offline.conjugates`
    :param v_coef: coefficient of V in its loss, or ``"1-gamma"``
    :return: the frozen value functions
    :raises ValueError: for settings out of range or datasets that do not fit together
    """
    _check(datasets, rngs, n_updates, batch_size, omega, gamma, tau)
    f_conjugate = conjugate(f)
    v_weight = 1.0 - gamma if v_coef == "1-gamma" else float(v_coef)

    def job(group: range) -> Callable[[StepProgress | None], DiceValue]:
        rows, streams = [datasets[k] for k in group], [rngs[k] for k in group]
        return lambda report: _train_group(
            rows, streams, n_updates, batch_size, width, omega, learning_rate, gamma, tau, f_conjugate, v_weight, report
        )

    return DiceValue.stack(train_together([job(group) for group in client_groups(len(datasets))], progress))


def _train_group(
    datasets: Sequence[OfflineData],
    rngs: Sequence[np.random.Generator],
    n_updates: int,
    batch_size: int,
    width: int,
    omega: float,
    learning_rate: float,
    gamma: float,
    tau: float,
    f_conjugate: Callable[[th.Tensor], th.Tensor],
    v_weight: float,
    progress: StepProgress | None,
) -> DiceValue:
    """What :func:`train_dice` says, for clients that are updated in lockstep."""
    n_clients, obs_dim, action_dim = len(datasets), datasets[0].observations.shape[1], datasets[0].actions.shape[1]

    value = DiceValue(n_clients, obs_dim, width)
    for k, data in enumerate(datasets):
        mean, var = data.moments()
        returns = data.discounted_returns(gamma)
        value.obs_mean[k, 0] = th.as_tensor(mean, dtype=th.float32)
        value.obs_std[k, 0] = th.as_tensor(np.maximum(np.sqrt(var), _MIN_STD), dtype=th.float32)
        value.offset[k] = float(returns.mean())
        value.scale[k] = max(float(returns.std()), _MIN_STD)
    # The two Qs of a client are neighbours in one stack of 2 N networks.
    q_net, q_target = (StackedMlp(2 * n_clients, obs_dim + action_dim, width) for _ in range(2))
    for k, rng in enumerate(rngs):
        value.net.initialize(k, rng)
        q_net.initialize(2 * k, rng)
        q_net.initialize(2 * k + 1, rng)
    q_target.load_state_dict(q_net.state_dict())
    q_target.requires_grad_(False)

    rows = _Rows(datasets, value)
    offset, scale = value.offset.unsqueeze(1), value.scale.unsqueeze(1)  # (N, 1, 1): over the two Qs and the batch

    def q_values(net: StackedMlp, twice: th.Tensor) -> th.Tensor:
        return offset + scale * net(twice).view(n_clients, 2, batch_size)

    q_parameters: list[th.Tensor] = list(q_net.parameters())
    target_parameters: list[th.Tensor] = list(q_target.parameters())
    v_optimizer = th.optim.Adam(value.net.parameter_groups(), lr=learning_rate)
    q_optimizer = th.optim.Adam(q_net.parameter_groups(), lr=learning_rate)
    # The squared errors are divided by the return's scale twice and L_V once, which Adam does not see but its epsilon does.
    for start in range(0, n_updates, _BLOCK):
        block = min(_BLOCK, n_updates - start)
        for index in rows.draw(rngs, block, batch_size):
            state, state_action, next_state, reward, discount = rows.batch(index, gamma)
            twice = state_action.unsqueeze(1).expand(-1, 2, -1, -1).reshape(2 * n_clients, batch_size, -1)
            with th.no_grad():
                q_min = q_values(q_target, twice).amin(dim=1)
            v = value.standardized(state)
            # Eq. 6, first line
            v_loss = (v_weight * v + omega * f_conjugate((q_min - v) / omega)) / value.scale
            v_optimizer.zero_grad(set_to_none=True)
            v_loss.mean(dim=1).sum().backward()
            v_optimizer.step()

            with th.no_grad():
                q_goal = reward + discount * value.standardized(next_state)
            q_error = (q_values(q_net, twice) - q_goal.unsqueeze(1)) / scale
            q_optimizer.zero_grad(set_to_none=True)
            q_error.square().mean(dim=2).sum().backward()  # Eq. 6, second line
            q_optimizer.step()
            with th.no_grad():
                th._foreach_lerp_(target_parameters, q_parameters, tau)
        if progress is not None:
            progress(start + block, n_updates)
    return value


class _Rows:
    """All clients' rows in one table, standardised, so that one gather makes everybody's minibatch."""

    def __init__(self, datasets: Sequence[OfflineData], value: DiceValue) -> None:
        self.sizes = [len(data) for data in datasets]
        self.starts = np.cumsum([0, *self.sizes[:-1]])
        mean, std = value.obs_mean.squeeze(1).numpy(), value.obs_std.squeeze(1).numpy()
        table = []
        for k, data in enumerate(datasets):
            action_mean = data.actions.mean(axis=0, dtype=np.float64).astype(np.float32)
            action_std = np.maximum(data.actions.std(axis=0, dtype=np.float64), _MIN_STD).astype(np.float32)
            table.append(
                np.column_stack(
                    [
                        (data.observations - mean[k]) / std[k],
                        (data.actions - action_mean) / action_std,
                        (data.next_observations - mean[k]) / std[k],
                        data.rewards,
                        ~data.terminations,
                    ]
                ).astype(np.float32)
            )
        self.table = th.from_numpy(np.concatenate(table))
        self.obs_dim = mean.shape[1]

    def draw(self, rngs: Sequence[np.random.Generator], block: int, batch_size: int) -> th.Tensor:
        """Row numbers of ``block`` minibatches, ``(block, N * batch_size)``; every client draws from its own stream."""
        index = [
            start + rng.integers(0, size, (block, batch_size))
            for rng, size, start in zip(rngs, self.sizes, self.starts, strict=True)
        ]
        return th.from_numpy(np.stack(index, axis=1).reshape(block, -1))

    def batch(self, index: th.Tensor, gamma: float) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
        """State, state-action and next state ``(N, batch, .)``, reward and discount ``(N, batch)``."""
        batch = self.table.index_select(0, index).view(len(self.sizes), -1, self.table.shape[1])
        state_action, next_state = batch[..., : -self.obs_dim - 2], batch[..., -self.obs_dim - 2 : -2]
        return batch[..., : self.obs_dim], state_action, next_state, batch[..., -2], gamma * batch[..., -1]


def calibrate(values: np.ndarray, returns: np.ndarray) -> tuple[float, float]:
    """Least squares fit ``returns ~ a * values + b`` over one client's rows: ``(a, b)``; ``a = 1`` for constant values.

    :param values: ``V(s)``, ``(n,)``
    :param returns: observed returns of the same states, ``(n,)``
    """
    values, returns = np.asarray(values, dtype=np.float64), np.asarray(returns, dtype=np.float64)
    variance = values.var()
    if variance <= 1e-12 * max(1.0, float(np.square(values).mean())):
        return 1.0, float(returns.mean() - values.mean())
    slope = float(((values - values.mean()) * (returns - returns.mean())).mean() / variance)
    return slope, float(returns.mean() - slope * values.mean())


def _check(
    datasets: Sequence[OfflineData],
    rngs: Sequence[np.random.Generator],
    n_updates: int,
    batch_size: int,
    omega: float,
    gamma: float,
    tau: float,
) -> None:
    if not datasets or len(datasets) != len(rngs):
        raise ValueError(f"DICE needs one dataset and one generator per client, got {len(datasets)} and {len(rngs)}")
    shapes = {(data.observations.shape[1], data.actions.shape[1]) for data in datasets}
    if len(shapes) != 1:
        raise ValueError(f"DICE needs clients with the same observation and action lengths, got {sorted(shapes)}")
    if n_updates < 1 or batch_size < 1:
        raise ValueError(f"n_updates and batch_size must be at least 1, got {n_updates} and {batch_size}")
    if not omega > 0.0 or not 0.0 <= gamma < 1.0 or not 0.0 < tau <= 1.0:
        raise ValueError(f"DICE needs omega > 0, 0 <= gamma < 1 and 0 < tau <= 1, got {omega}, {gamma} and {tau}")
