"""``--delays``: one word, or a YAML file."""

from __future__ import annotations

from pathlib import Path

from sb3_fedguide.server.delays import DelaySettings, delay_settings, parse_delays

__all__ = ["DelaySettings", "read_delays"]


def read_delays(given: str) -> DelaySettings:
    """Read a text as in :func:`parse_delays`, or a mapping of the same names in a ``.yml`` or ``.yaml`` file.

    :raises ValueError: for anything else
    """
    try:
        if Path(given).suffix not in (".yml", ".yaml"):
            return parse_delays(given)
        from sb3_fedguide.settings.config import read_yaml

        values = read_yaml(Path(given))
        if not isinstance(values, dict):
            raise ValueError(f"{given} is not a mapping such as 'policy: async'")
        return delay_settings(values)
    except ValueError as error:
        raise ValueError(f"--delays {given}: {error}") from None
