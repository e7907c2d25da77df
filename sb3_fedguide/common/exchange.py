"""What a federation's clients send to the server and take from it, and the server's side that belongs to the method."""

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
    """Mixin of a federation. A method defines :meth:`upload` and :meth:`receive`; whatever carries payloads calls
    :meth:`outgoing` and :meth:`take_broadcasts`, which add what every method has.
    """

    #: whether every client's data may stay where it is; what is not federated cannot be divided among processes or machines
    is_federated: ClassVar[bool] = True
    strategy: Strategy | None
    upload_bound: float | None
    normalizer: FederatedNormalizer
    client_ids: list[int]

    def sends_policy(self, round: int) -> bool:
        """Whether the exchange after round ``round`` replaces the clients' policies; what it sent is evaluated as well."""
        return False

    def _start_server(self) -> None:
        """Make the server's side, unless it came with a saved model."""
        if self.strategy is None:
            self.strategy = self._make_strategy()
            if self.strategy is not None:
                self.strategy.upload_bound = self.upload_bound

    def _make_strategy(self) -> Strategy | None:
        """The server's side of this method; ``None`` where nothing is exchanged."""
        assert self.seed is not None
        return make_strategy(method_of(type(self)), self.server_settings(), len(self.client_ids), self.seed)

    @classmethod
    def registered_method(cls) -> Method:
        """The server's side by which a server without this model makes its strategy.

        :raises ValueError: for a class that makes its strategy itself
        """
        if cls._make_strategy is not Exchange._make_strategy:
            raise ValueError(
                f"{cls.__name__} makes its strategy itself, which needs the model; state its server's side in "
                "register_algorithm(..., server='module:name'), see docs/extending.md"
            )
        return method_of(cls)

    def server_settings(self) -> dict[str, Any]:
        """What the server of this method has to know, by the names of the constructor's parameters."""
        method = method_of(type(self))
        return complete_settings(method, {name: getattr(self, name) for name in (*COMMON, *method.defaults)})

    def upload(self, index: int) -> Payload:
        """What the client at position ``index`` sends of its method: float32 arrays and nothing else."""
        return {}

    def receive(self, index: int, broadcast: Payload) -> None:
        """Take what the server sent of this method to the client at position ``index``."""

    def upload_shapes(self) -> dict[str, list[int]]:
        """Shapes of what a client uploads by name, known before the offline stage; what only comes later is left out."""
        return {name: list(array.shape) for name, array in self.upload(0).items()}

    def outgoing(self, index: int) -> Payload:
        """All that the client at position ``index`` sends: :meth:`upload`, and its round's moments where they are shared."""
        return {**self.upload(index), **self.normalizer.round_moments(index)}

    @property
    def protects_uploads(self) -> bool:
        """Whether what a client uploads has noise, so that nothing else of it may leave the client."""
        return False

    def upload_metrics(self, public: bool = False) -> dict[str, float]:
        """What is to be logged of this round's uploads, by log key.

        :param public: only what tells nothing of them
        """
        return {}

    def upload_summary(self) -> dict[str, Any]:
        """What is to be said of all uploads at the end of a run, as plain data; nothing where there is nothing to say."""
        return {}

    def draw_secret_keys(self) -> None:
        """Let the noise of uploads be unknown to whoever knows the seed; called where a client is on a machine of its own."""

    def test_work(self) -> np.ndarray | None:
        """Environment steps of each client's tests since it was last asked, in rounds, ``(n_clients,)``; ``None`` for none."""
        return None

    def take_broadcasts(self, broadcasts: Mapping[int, Payload]) -> None:
        """Take all that the server sent.

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
        """What the clients take of what they were sent, by position."""
        return broadcasts
