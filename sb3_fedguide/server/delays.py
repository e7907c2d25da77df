"""Simulated time: the duration of clients' rounds, dropouts, and the server's policy. Needs only NumPy.

In lockstep a client trains at the start of its round, in no time; its upload counts when the simulated time of the round is
over. Until then it is busy: it keeps its whole state, and the upload.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args

import numpy as np

from fed_envs.plain_data import State, freeze, thaw
from sb3_fedguide.seeding import Role, stream
from sb3_fedguide.server.rounds import participants

#: What the server waits for, see :class:`DelaySettings`.
WaitingPolicy = Literal["sync", "deadline", "async"]
POLICIES: tuple[WaitingPolicy, ...] = get_args(WaitingPolicy)

#: The setting that each policy has in addition, and its default in medians.
_OWN = {"deadline": ("deadline", 2.0), "async": ("tick", 1.0)}
_DROPOUT_MEDIANS = 2.0


@dataclass(frozen=True)
class DelaySettings:
    """The duration of clients' rounds, and what the server waits for. Seconds are simulated.

    A round of client ``i`` takes ``median * exp(spread * z_i + jitter * z)`` seconds, with one standard normal ``z_i`` for
    each client and a ``z`` for each of its rounds.

    :param policy: ``"sync"`` waits until every upload has arrived or is known to be lost. ``"deadline"`` waits at most
        ``deadline``; a later upload is lost, and its client begins no other round before it has finished this one.
        ``"async"`` aggregates after every ``tick`` the uploads that have arrived; their clients begin again at once, from
        the new broadcast, and the others continue.
    :param median: seconds of a round of the median client
    :param spread: standard deviation of the logarithm of the clients' speeds
    :param jitter: standard deviation of the logarithm of one client's round times
    :param dropout: probability that a round's upload is lost
    :param timeout: seconds after which the server knows of a lost upload, and the client begins a new round; twice the median
        by default
    :param deadline: twice the median by default; may be infinite. Only with ``"deadline"``
    :param tick: the median by default. Only with ``"async"``
    :raises ValueError: for values out of range, or of another policy
    """

    policy: WaitingPolicy
    median: float = 60.0
    spread: float = 0.5
    jitter: float = 0.2
    dropout: float = 0.0
    timeout: float | None = None
    deadline: float | None = None
    tick: float | None = None

    def __post_init__(self) -> None:
        if self.policy not in POLICIES:
            raise ValueError(f"policy must be {' or '.join(POLICIES)}, not {self.policy!r}")
        for name, value in list(asdict(self).items())[1:]:
            if value is not None and (isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value)):
                raise ValueError(f"{name}={value!r} is not a number")
        if not 0 < self.median <= 1e9:
            raise ValueError(f"median={self.median} must lie in (0, 1e9]: it is the seconds of a client's round")
        for name in ("spread", "jitter"):
            if not 0 <= getattr(self, name) <= 5:
                raise ValueError(
                    f"{name}={getattr(self, name)} must lie in [0, 5]: it is the standard deviation of a logarithm"
                )
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout={self.dropout} must lie in [0, 1): it is the share of uploads that are lost")
        self._default("timeout", _DROPOUT_MEDIANS)
        if not 0 < self.timeout < math.inf:  # type: ignore[operator]
            raise ValueError(f"timeout={self.timeout} must be positive and finite: it ends the wait for a lost upload")
        for policy, (name, medians) in _OWN.items():
            if policy == self.policy:
                self._default(name, medians)
            elif getattr(self, name) is not None:
                raise ValueError(f"{name} belongs to {policy}; leave it out with {self.policy}")
        if self.deadline is not None and not self.deadline > 0:
            raise ValueError(f"deadline={self.deadline} must be positive: it is the seconds of a round")
        if self.tick is not None and not self.median / 1000 <= self.tick < math.inf:
            raise ValueError(
                f"tick={self.tick} must be finite and at least a thousandth of the median of {self.median}: it is the seconds "
                "between two aggregations"
            )

    def _default(self, name: str, medians: float) -> None:
        if getattr(self, name) is None:
            object.__setattr__(self, name, medians * self.median)

    def __str__(self) -> str:
        """The text from which :func:`parse_delays` reads the same settings."""
        values = {name: value for name, value in asdict(self).items() if name != "policy" and value is not None}
        return f"{self.policy}:" + ",".join(f"{name}={float(value)!r}" for name, value in values.items())


def delay_settings(values: Mapping[str, Any]) -> DelaySettings:
    """Settings by name, as in a configuration file.

    :raises ValueError: for an unknown or missing name, or a wrong value
    """
    known = [field.name for field in fields(DelaySettings)]
    for name in values:
        if name not in known:
            raise ValueError(f"delays have no {name!r}; they have {', '.join(known)}")
    if "policy" not in values:
        raise ValueError(f"policy is missing: it is {' or '.join(POLICIES)}")
    return DelaySettings(**values)


def parse_delays(text: str) -> DelaySettings:
    """Settings as one word: ``sync``, or ``async:median=60,spread=0.8,dropout=0.1,tick=30``.

    :raises ValueError: for a text that gives no settings
    """
    policy, _, rest = text.partition(":")
    values: dict[str, Any] = {"policy": policy}
    for item in rest.split(",") if rest else []:
        name, equals, number = item.partition("=")
        if not equals or name in values:
            raise ValueError(f"{item!r} is not NAME=NUMBER" if not equals else f"{name} is given twice")
        try:
            values[name] = float(number)
        except ValueError:
            raise ValueError(f"{name}={number!r} is not a number") from None
    return delay_settings(values)


class Delays:
    """The clock of a simulated federation, and until when each client is busy.

    A round is :meth:`begin` and then :meth:`end`. The seconds of a client's k-th round depend only on the seed, the client
    and k: they are the same under every policy, and with any other clients.

    :param seed: of the federation
    :param clients: ids, in the order of all masks
    """

    def __init__(self, settings: DelaySettings, seed: int, clients: Sequence[int]) -> None:
        self.settings, self.seed, self.clients = settings, seed, list(clients)
        self.restart()

    def restart(self) -> None:
        """Begin at second 0, with nobody busy."""
        n = len(self.clients)
        #: since the beginning
        self.seconds = 0.0
        self.rounds = 0
        #: for each client, ``(n_clients,)``: when it is or was idle again, how many rounds it has begun, in which of the
        #: server's rounds it began its last, whether that is still to end, and whether its upload is lost
        self.idle_at = np.zeros(n)
        self.begun = np.zeros(n, dtype=int)
        self.began_in = np.zeros(n, dtype=int)
        self.training = np.zeros(n, dtype=bool)
        self.lost = np.zeros(n, dtype=bool)
        #: who finished a round, heard or not, in the server's last round
        self.finished = np.zeros(n, dtype=bool)
        #: figures of the last round, by log key
        self.metrics: dict[str, float] = {}

    @property
    def keep_busy(self) -> bool:
        """Whether a client may be busy when the server's round is over."""
        return self.settings.policy == "async" or (self.settings.deadline or math.inf) < math.inf

    @property
    def idle(self) -> np.ndarray:
        """The clients that could begin a round now, ``(n_clients,)`` bool; always at least one."""
        return self.idle_at <= self.seconds

    def draw(self, index: int) -> tuple[float, bool]:
        """Seconds of the next round of the client at position ``index``, and whether its upload will be lost."""
        settings, client = self.settings, self.clients[index]
        speed = stream(self.seed, Role.DELAY, client).standard_normal()
        rng = stream(self.seed, Role.DELAY, client, int(self.begun[index]))
        deviation = settings.spread * speed + settings.jitter * rng.standard_normal()
        return settings.median * math.exp(deviation), bool(rng.random() < settings.dropout)

    def begin(self, round: int, client_fraction: float = 1.0, extra: np.ndarray | None = None) -> np.ndarray:
        """Let a share of the idle clients begin a round.

        :param round: complete rounds, for the draw of the participants
        :param extra: each client's additional work, as a share of its round's, ``(n_clients,)``; none by default
        :return: the clients that begin, ``(n_clients,)`` bool
        """
        present = np.zeros(len(self.clients), dtype=bool)
        present[participants(np.flatnonzero(self.idle).tolist(), self.seed, round, client_fraction)] = True
        for index in np.flatnonzero(present).tolist():
            seconds, self.lost[index] = self.draw(index)
            seconds *= 1.0 if extra is None else 1.0 + float(extra[index])
            assert self.settings.timeout is not None
            self.idle_at[index] = self.seconds + (self.settings.timeout if self.lost[index] else seconds)
        self.begun[present] += 1
        self.began_in[present] = self.rounds
        self.training |= present
        return present

    def end(self) -> np.ndarray:
        """Let the time of the server's round pass.

        :return: the clients whose uploads have arrived and are aggregated, ``(n_clients,)`` bool
        """
        if self.settings.policy == "async":
            self._tick()
        else:
            latest = float(self.idle_at[self.training & (self.began_in == self.rounds)].max())
            deadline = math.inf if self.settings.deadline is None else self.settings.deadline
            self.seconds = min(self.seconds + deadline, latest)
        arrived = self.training & ~self.lost & self.idle
        if self.settings.policy != "async":
            self.lost |= self.training & ~arrived  # the server no longer waits for them
            self.seconds = max(self.seconds, float(self.idle_at.min()))  # until somebody can begin the next round
        self.finished = self.training & self.idle
        self.training &= ~self.finished
        self.metrics = {"federated/simulated_seconds": self.seconds, "federated/arrived": float(arrived.sum())}
        if arrived.any():
            self.metrics["federated/staleness"] = float(np.mean(self.rounds - self.began_in[arrived]))
        self.rounds += 1
        return arrived

    def _tick(self) -> None:
        """One tick, or as many as it takes until somebody is idle."""
        tick = self.settings.tick
        assert tick is not None
        busy = float(self.idle_at.min()) - self.seconds
        self.seconds += tick * max(1.0, math.floor(busy / tick))
        while not self.idle.any():
            self.seconds += tick

    def save_state(self) -> State:
        """Plain data for a checkpoint; uploads that have not arrived are part of their clients' own state."""
        own = {name: value for name, value in vars(self).items() if name not in ("settings", "clients")}
        return {"settings": str(self.settings), **freeze(own)}

    def load_state(self, state: State) -> None:
        """Restore what :meth:`save_state` returned.

        :raises ValueError: for the state of a run with other delays
        """
        if state["settings"] != str(self.settings):
            raise ValueError(f"the run has the delays {state['settings']}, not {self.settings}; resume it with its own")
        for name, value in state.items():
            if name != "settings":
                setattr(self, name, thaw(value))
