"""Numbers for people: a number of digits that fits their size."""

from __future__ import annotations

import math
from collections.abc import Iterable

#: Digits of the largest number in a table.
SIGNIFICANT = 3


def decimals(values: Iterable[float]) -> int:
    """Decimal places for numbers in one table: 3 for returns up to 1, 2 up to 10, 1 up to 100, none above."""
    largest = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
    return SIGNIFICANT if largest < 1 else max(0, SIGNIFICANT - 1 - math.floor(math.log10(largest)))


def shown(value: float) -> str:
    """A single number, such as ``0.983``, ``-5.23`` or ``812``."""
    return f"{value:.{decimals([value])}f}"
