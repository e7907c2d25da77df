"""What a program returns to its caller, beside 0."""

from __future__ import annotations

EXIT_FAILED, EXIT_USAGE = 1, 2
