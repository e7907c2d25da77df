"""The configuration of the server of a real federation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sb3_fedguide.server.methods import complete_settings
from sb3_fedguide.settings.participants import n_participants

#: Seconds for the end of a run without limits.
_FINISH_SECONDS = 600.0


class TooFewClients(RuntimeError):
    """Fewer clients than a round needs; with a folder, the same call goes on from its checkpoint."""


@dataclass(frozen=True)
class ServerConfig:
    """The configuration of a server.

    :param algorithm: command-line name
    :param n_clients: clients of the whole federation; also the number of experts if the settings do not give it
    :param n_rounds: rounds of the run
    :param rollout_size: environment steps of a client in a round
    :param seed: the federation's
    :param settings: the method's hyperparameters on the server, see :mod:`sb3_fedguide.server.methods`; missing
        ones have the constructors' defaults
    :param timeout: seconds that a client may take for a round; ``None`` for no limit
    :param setup_timeout: the same of everything before the first round, where behaviour cloning, priors and DICE are trained
    :param start_clients: number of clients for which the server waits before anything begins; by default all
    :param min_clients: number of replies that a round needs; missing clients are asked again
    :param wait: seconds to wait for too few clients before
        :class:`~sb3_fedguide.deployment.serve.TooFewClients` ends the run; 0 not to wait, ``None`` for no limit. At the
        end, it waits for absent clients at most as long as this and ``timeout``, or ten minutes
    :param poll: seconds between two checks of the present clients
    :raises ValueError: for values that do not fit
    """

    algorithm: str
    n_clients: int
    n_rounds: int
    rollout_size: int
    seed: int
    settings: Mapping[str, Any] = field(default_factory=dict)
    timeout: float | None = None
    setup_timeout: float | None = None
    start_clients: int | None = None
    min_clients: int = 1
    wait: float | None = None
    poll: float = 1.0

    def __post_init__(self) -> None:
        for name in ("n_clients", "n_rounds", "rollout_size", "min_clients"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 1")
        if type(self.seed) is not int or self.seed < 0:
            raise ValueError(f"seed={self.seed!r} must be an integer of at least 0, the clients' own")
        for name in ("timeout", "setup_timeout"):
            if (limit := getattr(self, name)) is not None and not 0 < limit < math.inf:
                raise ValueError(f"{name}={limit} must be a number of seconds above 0, or None for no limit")
        if self.wait is not None and not 0 <= self.wait < math.inf:
            raise ValueError(f"wait={self.wait} must be a number of seconds from 0 on, or None to wait for ever")
        if not 0 <= self.poll < math.inf:
            raise ValueError(f"poll={self.poll} must be a number of seconds from 0 on")
        if not 1 <= self.n_start <= self.n_clients:
            raise ValueError(f"start_clients={self.start_clients} must lie between 1 and n_clients={self.n_clients}")
        present = n_participants(self.all_settings["client_fraction"], self.n_clients)
        if self.min_clients > present:
            raise ValueError(f"min_clients={self.min_clients}, but only {present} clients take part in a round")

    @property
    def n_start(self) -> int:
        return self.n_clients if self.start_clients is None else self.start_clients

    @property
    def finish_timeout(self) -> float:
        """Seconds for which the server waits for absent clients at the end of the run."""
        return min(_FINISH_SECONDS if self.timeout is None else self.timeout, math.inf if self.wait is None else self.wait)

    @property
    def all_settings(self) -> dict[str, Any]:
        """The method's settings with the defaults of those not given."""
        return complete_settings(self.algorithm, self.settings)
