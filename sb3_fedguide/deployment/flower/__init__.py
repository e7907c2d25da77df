"""Deployment over Flower: a server that needs no simulator, and clients whose data stay on their own machines.

Flower reports what it does to its makers, and installs what an app asks for, unless it is told otherwise before it is
imported.
"""

from __future__ import annotations

import os

SILENT = {
    "FLWR_TELEMETRY_ENABLED": "0",
    "FLWR_DISABLE_UPDATE_CHECK": "1",
    "FLWR_DISABLE_RUNTIME_DEPENDENCY_INSTALLATION": "1",
}
os.environ.update(SILENT)
os.environ.setdefault("FLWR_LOG_LEVEL", "WARNING")
