"""``policy_kwargs`` as plain data."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import pydantic

ACTIVATIONS = {"tanh": "Tanh", "relu": "ReLU", "elu": "ELU", "leaky_relu": "LeakyReLU", "silu": "SiLU"}

Activation = Literal["tanh", "relu", "elu", "leaky_relu", "silu"]
Layers = Annotated[list[Annotated[int, pydantic.Field(gt=0, le=8192)]], pydantic.Field(max_length=16)]


class NetworkConfig(pydantic.BaseModel):
    """Common settings of the networks of stochastic and of deterministic policies."""

    model_config = pydantic.ConfigDict(extra="forbid", strict=True)

    #: names of the two networks in ``net_arch``
    networks: ClassVar[tuple[str, str]]
    activation_fn: Activation

    @pydantic.field_validator("net_arch", mode="after", check_fields=False)
    @classmethod
    def _both_networks(cls, value: Any) -> Any:
        if isinstance(value, dict) and set(value) != set(cls.networks):
            raise ValueError(f"needs both {' and '.join(cls.networks)}")
        return value

    def to_kwargs(self) -> dict[str, Any]:
        """Keyword arguments of SB3's policy."""
        from torch import nn

        kwargs = self.model_dump(exclude_none=True)
        kwargs["activation_fn"] = getattr(nn, ACTIVATIONS[self.activation_fn])
        return kwargs


class StochasticNetworkConfig(NetworkConfig):
    """Networks of PPO's policy.

    :param net_arch: hidden layers of actor and critic, ``[64, 64]`` or ``{pi: [64, 64], vf: [64, 64]}``
    :param activation_fn: by name
    :param log_std_init: initial log standard deviation
    :param ortho_init: orthogonal initialisation
    """

    networks = ("pi", "vf")
    net_arch: Layers | dict[Literal["pi", "vf"], Layers] | None = None
    activation_fn: Activation = "tanh"
    log_std_init: pydantic.FiniteFloat = 0.0
    ortho_init: bool = True


class DeterministicNetworkConfig(NetworkConfig):
    """Networks of DDPG's policy.

    :param net_arch: hidden layers of actor and critic, ``[64, 64]`` or ``{pi: [64, 64], qf: [64, 64]}``
    :param activation_fn: by name
    """

    networks = ("pi", "qf")
    net_arch: Layers | dict[Literal["pi", "qf"], Layers] | None = None
    activation_fn: Activation = "relu"
