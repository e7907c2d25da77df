"""Independent random streams, so that a client's draws do not depend on the other clients in its process."""

from __future__ import annotations

import numpy as np


def seed_sequence(seed: int, *key: int) -> np.random.SeedSequence:
    """The seed sequence of one stream.

    :param seed: the federation's seed
    :param key: what the stream is for, usually ``(role, client_id, ...)``; different keys give independent streams
    """
    return np.random.SeedSequence(seed, spawn_key=tuple(int(part) for part in key))


def stream(seed: int, *key: int) -> np.random.Generator:
    """A NumPy generator on the stream ``key`` of ``seed`` (see :func:`seed_sequence`)."""
    return np.random.Generator(np.random.PCG64(seed_sequence(seed, *key)))


def integer_seed(seed: int, *key: int) -> int:
    """A 31-bit integer from the stream ``key`` of ``seed``, for interfaces that take an ``int`` such as ``env.reset``."""
    return int(seed_sequence(seed, *key).generate_state(1)[0] >> 1)
