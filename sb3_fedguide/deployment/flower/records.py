"""Messages as Flower carries them: arrays by name, and a JSON text. Nothing is ever pickled."""

from __future__ import annotations

import json
import re

import numpy as np
from flwr.app import Array, ArrayRecord, ConfigRecord, RecordDict

from sb3_fedguide.deployment.transport import Failure, Message

_PAYLOAD, _REST = "payload", "message"
_REASON = re.compile(r"error: \w{1,80}")


def to_records(content: Message | Failure) -> RecordDict:
    """The Flower record of a request or reply."""
    if isinstance(content, Failure):
        return RecordDict({_REST: ConfigRecord({"text": json.dumps({"failure": content.reason})})})
    # np.ascontiguousarray would give a number one dimension
    arrays = {name: Array(np.asarray(array, order="C")) for name, array in content.payload.items()}
    text = json.dumps({"kind": content.kind, "round": content.round, "facts": content.facts})
    return RecordDict({_PAYLOAD: ArrayRecord(arrays), _REST: ConfigRecord({"text": text})})


def from_records(records: RecordDict) -> Message | Failure:
    """The inverse of :func:`to_records`, for records of untrusted senders.

    :raises ValueError: for anything else
    """
    try:
        rest = json.loads(str(records.config_records[_REST]["text"]))
        if "failure" in rest:
            # A client that fails sends the name of a type; no other text of a client is passed on.
            reason = rest["failure"]
            return Failure(reason if _REASON.fullmatch(reason) else "error: unknown")
        arrays = {name: array.numpy() for name, array in records.array_records[_PAYLOAD].items()}
        message = Message(rest["kind"], rest["round"], arrays, rest["facts"])
        if not isinstance(message.round, int) or not isinstance(message.facts, dict):
            raise TypeError("round or facts")
    except Exception as error:  # foreign bytes fail in json, NumPy, Flower and here, each in its own way
        raise ValueError(f"not a valid message: {type(error).__name__}") from None
    return message
