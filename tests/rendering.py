"""MuJoCo's pictures without a display."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

_NO_OPENGL = 77
_PROBE = f"""
import sys
try:
    import mujoco
except Exception as error:
    print(error)
    sys.exit({_NO_OPENGL})
"""
_PICTURES = """
import numpy as np, fed_envs
env = fed_envs.load_family({name!r}).make(1, render_mode="rgb_array", width=160, height=120)
env.reset(seed=0)
first = env.render()
for _ in range(20):
    env.step(env.action_space.high)
assert first.shape == (120, 160, 3) and first.dtype == np.uint8 and first.std() > 5
assert (env.render() != first).any()
env.close()
"""


def run_with_osmesa(code: str) -> None:
    """Run a script in a process of its own, since MuJoCo chooses its OpenGL when it is imported; skip without OSMesa."""
    environment = {**os.environ, "MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": "osmesa"}
    result = subprocess.run(
        [sys.executable, "-c", f"{_PROBE}\n{code}\nprint('rendered')"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if result.returncode == _NO_OPENGL:
        pytest.skip(f"no display-less OpenGL here (Debian: libosmesa6): {result.stdout.strip()}")
    assert result.stdout.strip() == "rendered", result.stderr


def check_pictures(name: str) -> None:
    """A family's pictures have the size that is asked for, show something, and change with the simulation."""
    run_with_osmesa(_PICTURES.format(name=name))
