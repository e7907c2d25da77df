"""How methods look: the same colour, line and marker in every figure, for colour-blind readers and in print too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sb3_fedguide.registry import ALGORITHMS

#: M. Okabe and K. Ito, Color universal design, 2008; without their yellow, which is too light for lines on paper.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE, GREY = "#0072B2", "#D55E00", "#CC79A7", "#8A8A8A"

#: Where a method is drawn a second time, with the results of another label.
_VARIANT_LINES = ("-", "-.", (0, (3, 1, 1, 1, 1, 1)))
#: For a user's own algorithms, in the order of their registration.
_OWN_COLORS = (GREEN, PURPLE, SKY, ORANGE, GREY, VERMILLION, BLUE, BLACK)
_OWN_MARKERS = ("<", ">", "1", "2", "3", "4", "+", "x")


@dataclass(frozen=True)
class Style:
    """How one method is drawn.

    :param line: matplotlib's line style
    :param hatch: of bars, for those that share their colour with another method
    :param hollow: whether markers are not filled
    """

    color: str
    line: Any
    marker: str
    hatch: str = ""
    hollow: bool = False

    def line_keywords(self) -> dict[str, Any]:
        """For ``Axes.plot``."""
        face = "white" if self.hollow else self.color
        return {"color": self.color, "linestyle": self.line, "marker": self.marker, "markerfacecolor": face}

    def bar_keywords(self) -> dict[str, Any]:
        """For ``Axes.barh``."""
        return {"color": self.color, "hatch": self.hatch, "edgecolor": "white", "linewidth": 0}


STYLES = {
    "local": Style(BLACK, "-", "o"),
    "pooled": Style(GREY, "--", "X", "///"),
    "fedavg": Style(ORANGE, "-", "s"),
    "fedprox": Style(ORANGE, "--", "D", "///"),
    "fedkl": Style(SKY, "-", "^"),
    "fedsvrpgm": Style(SKY, "--", "v", "///"),
    "fedrl": Style(PURPLE, "-", "P"),
    "fedguide": Style(BLUE, "-", "*"),
    "fedguide-p": Style(BLUE, "--", "p", "///"),
    "fedguide-a": Style(GREEN, "-", "h"),
    "fedguide-r": Style(VERMILLION, "-", "d"),
}


def style(method: str, variant: int = 0) -> Style:
    """How ``method`` is drawn; with ``variant`` 1 and 2 the same colour with another line, from 3 on another colour as well.

    A user's own algorithm gets a dotted line, and its colour and marker by its place among the registered ones.
    """
    if method in STYLES:
        found = STYLES[method]
    else:
        own = [name for name in ALGORITHMS if name not in STYLES]
        place = own.index(method) if method in own else len(own)
        n = len(_OWN_COLORS)
        found = Style(_OWN_COLORS[place % n], ":", _OWN_MARKERS[(place + place // n) % n], "xx")
    if not variant:
        return found
    line = _VARIANT_LINES[1 + (variant - 1) % 2]
    if variant > 2:
        place = (variant - 3) % len(_OWN_COLORS)
        return Style(_OWN_COLORS[place], line, _OWN_MARKERS[place], found.hatch + "..", hollow=True)
    return Style(found.color, line, found.marker, found.hatch + "..", hollow=True)
