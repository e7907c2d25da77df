"""Partial participation: who takes part in a round, and an optimiser that leaves the others untouched."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch as th

from sb3_fedguide.common.seeding import Role, stream


def n_participants(client_fraction: float, n_clients: int) -> int:
    """Clients in each round: the fraction of all, rounded, and at least one."""
    return max(1, round(client_fraction * n_clients))


def draw_participants(seed: int, round: int, n_clients: int, n_present: int) -> np.ndarray:
    """Who takes part in a round, ``(n_clients,)`` bool, drawn without replacement from the server's stream of that round."""
    present = np.zeros(n_clients, dtype=bool)
    present[stream(seed, Role.PARTICIPATION, round).choice(n_clients, n_present, replace=False)] = True
    return present


class ParticipationAdam(th.optim.Optimizer):
    """Adam on stacked parameters that steps some clients only: each counts its own steps, and the absent keep all state.

    ``torch.optim.Adam`` moves on zero gradients and has one step count for all clients. With all present the two are equal.

    :param params: each ``(n_clients, ...)``
    :param lr: learning rate
    :param betas: decay of the moments
    :param eps: added to the denominator
    """

    def __init__(
        self,
        params: Iterable[th.nn.Parameter],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})
        #: ``(n_clients,)`` bool: who steps; all if ``None``
        self.present: np.ndarray | None = None

    @th.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:  # type: ignore[override]
        """One step of the clients that are present.

        :raises ValueError: for a closure, which Adam does not need
        """
        if closure is not None:
            raise ValueError("ParticipationAdam takes no closure; compute the gradients before step()")
        for group in self.param_groups:
            beta1, beta2 = group["betas"]
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                state = self.state[parameter]
                if not state:
                    state["step"] = th.zeros(len(parameter), dtype=th.float64)
                    state["exp_avg"], state["exp_avg_sq"] = th.zeros_like(parameter), th.zeros_like(parameter)
                rows = np.arange(len(parameter)) if self.present is None else np.flatnonzero(self.present)
                chosen = th.as_tensor(rows)
                state["step"][chosen] += 1
                steps = state["step"][chosen].reshape(-1, *([1] * (parameter.dim() - 1)))
                step_size = (group["lr"] / (1 - beta1**steps)).to(parameter)
                correction = (1 - beta2**steps).sqrt().to(parameter)
                chosen, grad = chosen.to(parameter.device), parameter.grad[chosen.to(parameter.device)]
                exp_avg = state["exp_avg"][chosen].lerp_(grad, 1 - beta1)
                exp_avg_sq = state["exp_avg_sq"][chosen].mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
                denominator = (exp_avg_sq.sqrt() / correction).add_(group["eps"])
                parameter[chosen] = parameter[chosen] - step_size * exp_avg / denominator
                state["exp_avg"][chosen], state["exp_avg_sq"][chosen] = exp_avg, exp_avg_sq
