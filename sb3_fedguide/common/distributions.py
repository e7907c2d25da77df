"""Distributions over actions from an actor's outputs: one family for each kind of action space."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from torch.nn import functional

from sb3_fedguide.common import gaussian


class ActionDistribution(ABC):
    """Distributions over actions with a leading client dimension.

    An actor's outputs for a state are ``(n_clients, batch, n_outputs)``: a Gaussian's means, or logits.
    ``log_std`` is ``(n_clients, action_dim)``, and ``None`` for families without one. Actions are
    ``(n_clients, batch, action_dim)``.

    :param space: the environments' action space
    """

    #: whether the policy has a ``log_std`` beside its network
    has_log_std: ClassVar[bool] = False
    n_outputs: int
    action_dim: int

    def __init__(self, space: spaces.Space) -> None:
        self.space = space

    @abstractmethod
    def decide(self, outputs: th.Tensor) -> th.Tensor:
        """The most probable actions; for outputs plus noise, a sample."""

    @abstractmethod
    def noise(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """The noise that makes a sample of outputs, float32, before its multiplication by the standard deviation (if any)."""

    @abstractmethod
    def noise_like(self, outputs: th.Tensor) -> th.Tensor:
        """As :meth:`noise`, from PyTorch's own generator."""

    def executed(self, actions: np.ndarray) -> np.ndarray:
        """Actions ``(..., action_dim)`` in the form that environments take, row by row."""
        return actions.astype(self.space.dtype, copy=False).reshape(-1, *self.space.shape)  # type: ignore[misc]

    @abstractmethod
    def log_prob(self, outputs: th.Tensor, log_std: th.Tensor | None, actions: th.Tensor) -> th.Tensor:
        """Log-probability or log-density of raw (unclipped) actions, ``(n_clients, batch)``."""

    @abstractmethod
    def entropy(self, outputs: th.Tensor, log_std: th.Tensor | None) -> th.Tensor:
        """Mean over the batch in nats, ``(n_clients,)``."""

    @abstractmethod
    def kl_divergence(
        self, outputs_p: th.Tensor, log_std_p: th.Tensor | None, outputs_q: th.Tensor, log_std_q: th.Tensor | None
    ) -> th.Tensor:
        """Exact ``KL(p || q)`` per state, ``(n_clients, batch)``."""


class Gaussian(ActionDistribution):
    """Diagonal Gaussians for a flat ``Box``, with a ``log_std`` that does not depend on the state."""

    has_log_std = True

    def __init__(self, space: spaces.Box) -> None:
        super().__init__(space)
        self.n_outputs = self.action_dim = space.shape[0]
        self.low, self.high = space.low, space.high

    def decide(self, outputs: th.Tensor) -> th.Tensor:
        return outputs

    def noise(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        return rng.standard_normal(shape, dtype=np.float32)

    def noise_like(self, outputs: th.Tensor) -> th.Tensor:
        return th.randn_like(outputs)

    def executed(self, actions: np.ndarray) -> np.ndarray:
        return np.minimum(np.maximum(actions, self.low), self.high).reshape(-1, self.action_dim)  # np.clip is slower

    def log_prob(self, outputs: th.Tensor, log_std: th.Tensor | None, actions: th.Tensor) -> th.Tensor:
        assert log_std is not None
        return gaussian.log_prob(outputs, log_std, actions)

    def entropy(self, outputs: th.Tensor, log_std: th.Tensor | None) -> th.Tensor:
        assert log_std is not None
        return gaussian.entropy(log_std)

    def kl_divergence(
        self, outputs_p: th.Tensor, log_std_p: th.Tensor | None, outputs_q: th.Tensor, log_std_q: th.Tensor | None
    ) -> th.Tensor:
        assert log_std_p is not None and log_std_q is not None
        return gaussian.kl_divergence(outputs_p, log_std_p, outputs_q, log_std_q)


class Categorical(ActionDistribution):
    """Independent choices, one for ``Discrete`` and several for ``MultiDiscrete``; the outputs are all logits in a row."""

    def __init__(self, space: spaces.Discrete | spaces.MultiDiscrete) -> None:
        super().__init__(space)
        self.sizes = [int(space.n)] if isinstance(space, spaces.Discrete) else space.nvec.tolist()
        self.n_outputs, self.action_dim = sum(self.sizes), len(self.sizes)

    def decide(self, outputs: th.Tensor) -> th.Tensor:
        return th.stack([logits.argmax(dim=-1) for logits in outputs.split(self.sizes, dim=-1)], dim=-1)

    def noise(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        return rng.gumbel(size=shape).astype(np.float32)  # the largest of logits + Gumbel noise is a sample

    def noise_like(self, outputs: th.Tensor) -> th.Tensor:
        return -th.empty_like(outputs).exponential_().log()

    def _log_probs(self, outputs: th.Tensor) -> list[th.Tensor]:
        return [logits.log_softmax(dim=-1) for logits in outputs.split(self.sizes, dim=-1)]

    def log_prob(self, outputs: th.Tensor, log_std: th.Tensor | None, actions: th.Tensor) -> th.Tensor:
        chosen = actions.long().split(1, dim=-1)
        found = [log_p.gather(-1, choice) for log_p, choice in zip(self._log_probs(outputs), chosen, strict=True)]
        return th.cat(found, dim=-1).sum(dim=-1)

    def entropy(self, outputs: th.Tensor, log_std: th.Tensor | None) -> th.Tensor:
        return -th.cat([log_p.exp() * log_p for log_p in self._log_probs(outputs)], dim=-1).sum(dim=-1).mean(dim=1)

    def kl_divergence(
        self, outputs_p: th.Tensor, log_std_p: th.Tensor | None, outputs_q: th.Tensor, log_std_q: th.Tensor | None
    ) -> th.Tensor:
        pairs = zip(self._log_probs(outputs_p), self._log_probs(outputs_q), strict=True)
        return th.cat([log_p.exp() * (log_p - log_q) for log_p, log_q in pairs], dim=-1).sum(dim=-1)


class Bernoulli(ActionDistribution):
    """Independent switches for ``MultiBinary``; the outputs are the logits of each being on."""

    def __init__(self, space: spaces.MultiBinary) -> None:
        super().__init__(space)
        self.n_outputs = self.action_dim = int(space.n)  # type: ignore[arg-type]

    def decide(self, outputs: th.Tensor) -> th.Tensor:
        return (outputs > 0).to(th.int8)

    def noise(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        return rng.logistic(size=shape).astype(np.float32)  # P(logit + logistic noise > 0) is the logit's probability

    def noise_like(self, outputs: th.Tensor) -> th.Tensor:
        return th.rand_like(outputs).logit(eps=1e-7)

    def log_prob(self, outputs: th.Tensor, log_std: th.Tensor | None, actions: th.Tensor) -> th.Tensor:
        return -functional.binary_cross_entropy_with_logits(outputs, actions.to(outputs.dtype), reduction="none").sum(dim=-1)

    def entropy(self, outputs: th.Tensor, log_std: th.Tensor | None) -> th.Tensor:
        return -self._expected_log_prob(outputs, outputs).mean(dim=1)

    def kl_divergence(
        self, outputs_p: th.Tensor, log_std_p: th.Tensor | None, outputs_q: th.Tensor, log_std_q: th.Tensor | None
    ) -> th.Tensor:
        return self._expected_log_prob(outputs_p, outputs_p) - self._expected_log_prob(outputs_p, outputs_q)

    @staticmethod
    def _expected_log_prob(outputs_p: th.Tensor, outputs_q: th.Tensor) -> th.Tensor:
        """``E_p log q`` per state, ``(n_clients, batch)``."""
        on, off = functional.logsigmoid(outputs_q), functional.logsigmoid(-outputs_q)
        return (outputs_p.sigmoid() * on + (-outputs_p).sigmoid() * off).sum(dim=-1)


def action_distribution(space: spaces.Space) -> ActionDistribution:
    """The family of an action space: those of SB3's PPO.

    :raises ValueError: for any other space, with the remedy
    """
    if isinstance(space, spaces.Box) and len(space.shape) == 1:
        return Gaussian(space)
    if isinstance(space, spaces.Discrete) and space.start == 0:
        return Categorical(space)
    if isinstance(space, spaces.MultiDiscrete) and len(space.shape) == 1 and not space.start.any():
        return Categorical(space)
    if isinstance(space, spaces.MultiBinary) and len(space.shape) == 1:
        return Bernoulli(space)
    raise ValueError(
        f"actions must be a one-dimensional Box, MultiDiscrete or MultiBinary space or a Discrete one, counted from 0, but "
        f"the action space is {space}; convert it with gymnasium.wrappers.TransformAction"
    )


def check_continuous(space: spaces.Space, what: str, instead: str) -> None:
    """:param what: the part that needs continuous actions
    :param instead: the remedy if they are not
    :raises ValueError: for actions that are not a flat ``Box``
    """
    if not isinstance(action_distribution(space), Gaussian):
        raise ValueError(f"{what} needs continuous actions (Box), but the action space is {space}; {instead}")
