"""The members of a federation: clients that joined with the same settings, refused ones and why, those ready to train."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import sb3_fedguide
from fed_envs.plain_data import State, freeze, thaw

if TYPE_CHECKING:
    from sb3_fedguide.deployment.serve import ServerConfig

Facts = dict[str, Any]

#: Facts that identify a run, also after a change of version.
RUN_FACTS = ("algorithm", "seed", "n_rounds", "rollout_size", "settings")
#: Facts that client and server both state; they have to be equal.
SERVER_FACTS = ("version", *RUN_FACTS)
#: Facts that only clients know; they have to be those of most of the clients with which the run began.
CLIENT_FACTS = ("shapes", "trunk")


def server_facts(config: ServerConfig) -> Facts:
    """The server's facts in its ``join`` message."""
    return {
        "algorithm": config.algorithm,
        "version": sb3_fedguide.__version__,
        "seed": config.seed,
        "n_rounds": config.n_rounds,
        "rollout_size": config.rollout_size,
        "settings": config.all_settings,
    }


def difference(theirs: Mapping[str, Any], ours: Mapping[str, Any], names: Iterable[str], whose: str) -> str | None:
    """The first of ``names`` in which two statements differ, in words; ``None`` if they agree.

    :param whose: to whom ``ours`` belongs, such as ``"the server's"``
    """
    for name in names:
        their, our = theirs.get(name), ours.get(name)
        if their == our:
            continue
        if isinstance(their, Mapping) and isinstance(our, Mapping):
            part = difference(their, our, sorted({*map(str, their), *our}), whose)
            return f"{name}: {part}"
        return f"its {name} is {_short(their)}, {whose} {_short(our)}"
    return None


class Clients:
    """The clients by id.

    :param facts: the server's
    """

    def __init__(self, facts: Facts) -> None:
        self.facts = facts
        #: the facts of each client that has joined
        self.joined: dict[int, Facts] = {}
        #: refused clients, and why
        self.refused: dict[int, str] = {}
        #: clients that have completed the offline stage
        self.prepared: set[int] = set()
        #: facts that all clients must share, known when the run has begun
        self.common: Facts | None = None

    def newcomers(self, present: Collection[int]) -> list[int]:
        """The clients to ask; a refused client is asked again when it has been away."""
        self.refused = {client: reason for client, reason in self.refused.items() if client in present}
        return sorted(set(present) - self.joined.keys() - self.refused.keys())

    def join(self, client: int, facts: Facts) -> str | None:
        """Take a client's answer.

        :return: why the client is refused, if it is
        """
        kept = {name: facts.get(name) for name in (*SERVER_FACTS, *CLIENT_FACTS)}
        reason = None if facts.get("client") == client else f"it says that it is client {_short(facts.get('client'))}"
        reason = reason or difference(kept, self.facts, SERVER_FACTS, "the server's")
        if reason is None and self.common is not None:
            reason = difference(kept, self.common, CLIENT_FACTS, "the other clients'")
        if reason is None:
            self.joined[client] = kept
        else:
            self.refused[client] = reason
        return reason

    def agree(self, n_clients: int) -> dict[int, str]:
        """Set the common facts to those of most clients, if at least ``n_clients`` state them; the others are refused.

        :return: the reasons, by client
        """
        if self.common is not None or not self.joined:
            return {}
        said = {client: _text(facts) for client, facts in sorted(self.joined.items())}
        usual, count = Counter(said.values()).most_common(1)[0]
        if count < n_clients:
            return {}
        self.common = json.loads(usual)
        odd = {
            client: difference(self.joined[client], json.loads(usual), CLIENT_FACTS, "most others'") or ""
            for client, text in said.items()
            if text != usual
        }
        for client, reason in odd.items():
            del self.joined[client]
            self.refused[client] = reason
        return odd

    def save_state(self) -> State:
        return freeze({"joined": self.joined, "prepared": sorted(self.prepared), "common": self.common})

    def load_state(self, state: State) -> None:
        """Ask all clients to join again: server and clients may resume with another version."""
        saved = thaw(state)
        self.prepared, self.common = set(saved["prepared"]), saved["common"]


def _text(facts: Facts) -> str:
    return json.dumps({name: facts[name] for name in CLIENT_FACTS}, sort_keys=True)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
