"""The purpose of each random stream of a federation. A stream's key is ``(role, client_id, ...)``."""

from __future__ import annotations

from enum import IntEnum

from fed_envs.seeding import integer_seed, seed_sequence, stream

__all__ = ["EVALUATION_SEED", "Role", "integer_seed", "seed_sequence", "stream"]


#: The seed of evaluation episodes: the same episodes for every method, seed and round.
EVALUATION_SEED = 20_000


class Role(IntEnum):
    """First part of a stream's key. The numbers never change, since the meaning of a seed depends on them."""

    TRAIN_ENV = 0
    EVAL_ENV = 1
    INIT = 2
    ACTION = 3
    MINIBATCH = 4
    PRIOR = 5
    DATA = 6
    BEHAVIOR_CLONING = 7
    TRUNK = 8
    HEAD = 9
    DICE = 10
    SERVER = 11
    PARTICIPATION = 12
    DELAY = 13
    SCREENING = 14
    UPLOAD_NOISE = 15
