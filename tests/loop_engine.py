"""An engine without processes."""

from __future__ import annotations

from sb3_fedguide.engines.engine import Engine
from sb3_fedguide.engines.worker import Worker


class Here(Engine):
    """The workers of the real engines, in this process."""

    def _start(self, blobs):
        self.workers = [Worker(blob) for blob in blobs]
        self.asked = []

    def _train(self, rounds):
        self.asked.append(sorted(rounds))
        return {k: self.workers[k].train(round) for k, round in rounds.items()}

    def _end(self):
        self.workers = []
