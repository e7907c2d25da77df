"""Simulated seconds that a test chooses."""

from __future__ import annotations

import math

from sb3_fedguide.server.delays import Delays, DelaySettings

NEVER = math.inf


class Scripted(Delays):
    """Clients whose rounds take as long as a list says; an infinite one is a lost upload."""

    def __init__(self, settings: DelaySettings, seconds: list[list[float]]) -> None:
        super().__init__(settings, 0, range(len(seconds)))
        self.script = seconds

    def draw(self, index: int) -> tuple[float, bool]:
        seconds = self.script[index][self.begun[index]]
        return seconds, seconds == NEVER
