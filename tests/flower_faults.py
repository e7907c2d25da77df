"""One of the ``packages`` of a client under test: it does wrong what ``$FEDGUIDE_FAULTS`` says, a JSON file.

The file maps a message, such as ``"round 2"``, to ``["raise", text]``, ``["nan"]``, ``["shape"]``, ``["wait"]`` or
``["stall"]``. With ``wait`` it begins when there is a file ``.go`` beside. With ``stall`` it waits for its end when the round
is trained and before anything of it is on the disk, and says so with a file ``.stalled`` beside.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from sb3_fedguide.deployment import site
from sb3_fedguide.deployment.transport import Message

FILE = Path(os.environ["FEDGUIDE_FAULTS"])
STALLED = FILE.with_suffix(".stalled")

_handle, _write_checkpoint = site.Site.handle, site.write_checkpoint


def _handle_wrongly(self: site.Site, message: Message) -> Message:
    faults = json.loads(FILE.read_text()) if FILE.exists() else {}
    fault, *details = faults.get(f"{message.kind} {message.round}", [None])
    if fault == "raise":
        raise ValueError(details[0])
    while fault == "wait" and not FILE.with_suffix(".go").exists():
        time.sleep(0.1)
    if fault == "stall":
        site.write_checkpoint = _stall
    reply = _handle(self, message)
    if fault == "nan":
        return replace(reply, payload={name: np.full_like(array, np.nan) for name, array in reply.payload.items()})
    if fault == "shape":
        return replace(reply, payload={**reply.payload, "log_std": np.zeros((2, 3), np.float32)})
    return reply


def _stall(*arguments: object) -> None:
    STALLED.touch()
    time.sleep(3600)


site.Site.handle = _handle_wrongly  # type: ignore[method-assign]
