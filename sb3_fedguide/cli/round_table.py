"""Each round's log on the terminal: first the results of all clients together, then client by client."""

from __future__ import annotations

import re
from typing import Any

from stable_baselines3.common.logger import HumanOutputFormat

from sb3_fedguide.common.digits import shown

#: From this size on SB3's three digits would need an exponent.
LARGE = 1000.0


class RoundTable(HumanOutputFormat):
    """SB3's table, split in two: it sorts by key, and would show a page of clients above the federation's results."""

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Write the tables of one round."""
        for of_client in (False, True):
            keys = [key for key in key_values if bool(re.match(r"client_\d+/", key)) == of_client]
            if any(not {"stdout", "log"} & set(key_excluded[key] or ()) for key in keys):
                values = {key: _readable(key_values[key]) for key in keys}
                super().write(values, {key: key_excluded[key] for key in keys}, step)


def _readable(value: Any) -> Any:
    return shown(value) if isinstance(value, float) and LARGE <= abs(value) < 1e9 else value
