"""Partial participation: an optimiser that does not change clients that are absent from a round."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th

from sb3_fedguide.server.delays import Delays, DelaySettings
from sb3_fedguide.server.participants import draw_participants
from sb3_fedguide.settings.participants import n_participants

if TYPE_CHECKING:
    from sb3_fedguide.common.federation import Federation

__all__ = ["ParticipationAdam", "draw_participants", "n_participants", "simulate_delays"]


def simulate_delays(model: Federation, settings: DelaySettings) -> None:
    """Let the clients' rounds take simulated time; call it before the model is trained or loads parameters.

    A busy client neither trains nor receives. ``num_timesteps`` counts every round as if no client were busy, so that the
    number of rounds is the same as without delays.

    :raises ValueError: for a model that has trained, or has been through its offline stage
    """
    if model.pretrained or model.round > 0:
        raise ValueError("delays must begin before training: call simulate_delays() on a new model")
    assert model.seed is not None
    model.delays = Delays(settings, model.seed, model.client_ids)
    model.steps_at_once = model.n_participants * model.n_envs_per_client
    if model.delays.keep_busy:
        model._setup_model()  # with an optimiser that skips busy clients


class ParticipationAdam(th.optim.Optimizer):
    """Adam on stacked parameters that steps only some clients: each counts its own steps, and absent clients keep all state.

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
        #: ``(n_clients,)`` bool: clients that step; all if ``None``
        self.present: np.ndarray | None = None

    def make_state(self) -> None:
        """Make zero moments and step counts for the parameters that have none yet."""
        for group in self.param_groups:
            for parameter in group["params"]:
                state = self.state[parameter]
                if not state:
                    state["step"] = th.zeros(len(parameter), dtype=th.float64)
                    state["exp_avg"], state["exp_avg_sq"] = th.zeros_like(parameter), th.zeros_like(parameter)

    @th.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:  # type: ignore[override]
        """One step of the clients that are present.

        :raises ValueError: for a closure, which Adam does not need
        """
        if closure is not None:
            raise ValueError("ParticipationAdam takes no closure; compute the gradients before step()")
        self.make_state()
        for group in self.param_groups:
            beta1, beta2 = group["betas"]
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                state = self.state[parameter]
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
