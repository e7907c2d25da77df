"""The clients that take part in a round."""

from __future__ import annotations

import numpy as np

from sb3_fedguide.seeding import Role, stream


def draw_participants(seed: int, round: int, n_clients: int, n_present: int) -> np.ndarray:
    """The participants of a round, ``(n_clients,)`` bool, drawn without replacement from the server's stream of that round."""
    present = np.zeros(n_clients, dtype=bool)
    present[stream(seed, Role.PARTICIPATION, round).choice(n_clients, n_present, replace=False)] = True
    return present
