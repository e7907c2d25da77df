"""Checks of a user's names against the known ones."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def nearest(name: str, known: Iterable[str]) -> str:
    """``" Did you mean 'x'?"``, or nothing if nothing is near."""
    by_lower = {candidate.lower().lstrip("-"): candidate for candidate in known}
    match = difflib.get_close_matches(str(name).lower().lstrip("-"), by_lower, n=1, cutoff=0.6)
    return f" Did you mean {by_lower[match[0]]!r}?" if match else ""


def check_names(given: Iterable[str], known: Iterable[str], what: str) -> None:
    """:raises ValueError: for an unknown name, with the nearest known one"""
    known = list(known)
    for name in given:
        if name not in known:
            raise ValueError(f"unknown {what} {name!r}.{nearest(name, known)} Known: {', '.join(sorted(known))}")
