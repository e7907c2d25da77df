"""The user's own modules, which register environments and algorithms."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence


def import_packages(modules: Sequence[str]) -> None:
    """Import the user's modules, from the current folder too.

    :raises ValueError: for one that cannot be imported
    """
    if modules and "" not in sys.path:
        sys.path.insert(0, "")
    for module in modules:
        try:
            importlib.import_module(module)
        except Exception as error:  # any error of the user's module
            raise ValueError(f"--gym-packages {module}: {type(error).__name__}: {error}") from None
