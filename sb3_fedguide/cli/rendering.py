"""Check that pictures of environments can be drawn here, before any training or evaluation for them."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fed_envs import Family

REMEDY = "set MUJOCO_GL=osmesa (Debian: libosmesa6) or MUJOCO_GL=egl"


def check_rendering(family: Family, flag: str) -> None:
    """:raises ValueError: if nothing can be drawn; ``flag`` is the flag that requests it"""
    env = family.make(family.clients[0].client)
    modes = env.metadata.get("render_modes", [])
    env.close()
    if "rgb_array" not in modes:
        raise ValueError(f"{flag}: {family.name} cannot be drawn")
    if family.world == "bandit2d":
        return
    display = sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"))
    if not display:  # MuJoCo's default would end the process
        raise ValueError(f"{flag}: there is no display; {REMEDY}")
