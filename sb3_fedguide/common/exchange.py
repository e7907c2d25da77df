"""The exchange of a federation's clients with the server, and the server's side of the method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_fedguide.common.normalization import FederatedNormalizer
from sb3_fedguide.server.methods import COMMON, Method, complete_settings, make_strategy, method_of
from sb3_fedguide.server.payload import OBSERVATIONS
from sb3_fedguide.server.strategy import Payload, Strategy


class Exchange(BaseAlgorithm):
    """Mixin of a federation. A method defines :meth:`upload` and :meth:`receive`; a transport calls :meth:`outgoing` and
    :meth:`take_broadcasts`, which add the parts that all methods share.
    """

    #: whether every client's data stays with it; otherwise the method cannot be divided among processes or machines
    is_federated: ClassVar[bool] = True
    strategy: Strategy | None
    upload_bound: float | None
    normalizer: FederatedNormalizer
    client_ids: list[int]

    def sends_policy(self, round: int) -> bool:
        """Whether the exchange after round ``round`` replaces the clients' policies; the broadcast is then evaluated too."""
        return False

    def _start_server(self) -> None:
        """Make the server's side, unless it came with a saved model."""
        if self.strategy is None:
            self.strategy = self._make_strategy()
            if self.strategy is not None:
                self.strategy.upload_bound = self.upload_bound

    def _make_strategy(self) -> Strategy | None:
        """The server's side of this method; ``None`` if nothing is exchanged."""
        assert self.seed is not None
        return make_strategy(method_of(type(self)), self.server_settings(), len(self.client_ids), self.seed)

    @classmethod
    def registered_method(cls) -> Method:
        """The method from which a server without this model makes its strategy.

        :raises ValueError: for a class that makes its strategy itself
        """
        if cls._make_strategy is not Exchange._make_strategy:
            raise ValueError(
                f"{cls.__name__} makes its strategy itself, which needs the model; state its server's side in "
                "register_algorithm(..., server='module:name'), see docs/extending.md"
            )
        return method_of(cls)

    def server_settings(self) -> dict[str, Any]:
        """The settings that this method's server needs, by the names of the constructor's parameters."""
        method = method_of(type(self))
        return complete_settings(method, {name: getattr(self, name) for name in (*COMMON, *method.defaults)})

    def upload(self, index: int) -> Payload:
        """The method's upload of the client at position ``index``: only float32 arrays."""
        return {}

    def receive(self, index: int, broadcast: Payload) -> None:
        """Apply the method's broadcast to the client at position ``index``."""

    def upload_shapes(self) -> dict[str, list[int]]:
        """Shapes of a client's upload by name, known before the offline stage; arrays that only come later are left out."""
        return {name: list(array.shape) for name, array in self.upload(0).items()}

    def outgoing(self, index: int) -> Payload:
        """The whole upload of the client at position ``index``: :meth:`upload`, and its round's moments if they are shared."""
        return {**self.upload(index), **self.normalizer.round_moments(index)}

    @property
    def protects_uploads(self) -> bool:
        """Whether uploads have noise, so that nothing else may leave the client."""
        return False

    def upload_metrics(self, public: bool = False) -> dict[str, float]:
        """Metrics of this round's uploads, by log key.

        :param public: only metrics that reveal nothing about them
        """
        return {}

    def upload_summary(self) -> dict[str, Any]:
        """Summary of all uploads at the end of a run, as plain data; may be empty."""
        return {}

    def draw_secret_keys(self) -> None:
        """Make the noise of uploads independent of the seed; called if a client is on its own machine."""

    def test_work(self) -> np.ndarray | None:
        """Environment steps of each client's tests since the last call, in rounds, ``(n_clients,)``; ``None`` for none."""
        return None

    def take_broadcasts(self, broadcasts: Mapping[int, Payload]) -> None:
        """Apply all broadcasts of the server.

        :param broadcasts: by the client's position
        """
        for index, broadcast in broadcasts.items():
            self.normalizer.receive(index, broadcast)
        of_method = {
            index: {name: array for name, array in broadcast.items() if not name.startswith(OBSERVATIONS)}
            for index, broadcast in broadcasts.items()
        }
        for index, broadcast in self._accepted(of_method).items():
            self.receive(index, broadcast)

    def _accepted(self, broadcasts: Mapping[int, Payload]) -> Mapping[int, Payload]:
        """The broadcasts that the clients accept, by position."""
        return broadcasts
