"""Chooses how the simulator's images are rendered: by OpenGL if it works here, else by ray casting.

OpenGL is fast but needs a system library; ray casting needs nothing. With ``MUJOCO_GL`` naming a
missing library ``import mujoco`` itself fails, and a broken driver can crash the process: so this
module does not import MuJoCo, and tries OpenGL in another process.
"""

from __future__ import annotations

import ctypes.util
import os
import subprocess
import sys
from typing import NamedTuple

from vla_zenoh.errors import NodeError

VARIABLE = "VLA_ZENOH_RENDERER"
EGL, RAYCAST, AUTO = "egl", "raycast", "auto"
PROBE_LIMIT_S = 60.0
_LIBRARIES = ("EGL", "OpenGL")
"""Libraries that PyOpenGL and MuJoCo load."""
_PACKAGES = "libegl1 libopengl0 libgl1-mesa-dri"
"""Debian packages that have them; Mesa renders on the CPU where there is no GPU."""
_GL_VARIABLES = ("MUJOCO_GL", "PYOPENGL_PLATFORM")


class Backend(NamedTuple):
    """A way to render, ``egl`` or ``raycast``."""

    name: str
    reason: str = ""  # why OpenGL does not work here; empty if ray casting was requested
    install: str = ""  # Debian packages that OpenGL needs


def choose_backend(wanted: str | None = None) -> Backend:
    """OpenGL if it works on this machine, else ray casting; or the one that is `wanted` by name.

    None is what the environment variable ``VLA_ZENOH_RENDERER`` says, or ``auto``.

    Raises:
        NodeError: `wanted` is unknown, or is asked for by name and does not work here.
    """
    name = wanted if wanted is not None else os.environ.get(VARIABLE) or AUTO
    if name not in (AUTO, EGL, RAYCAST):
        raise NodeError(f"no renderer called {name!r}; there are: {AUTO}, {EGL}, {RAYCAST}")
    if name == RAYCAST:
        return Backend(RAYCAST)
    failure = why_no_opengl()
    if not failure:
        return Backend(EGL)
    if name == EGL:
        raise NodeError(
            f"the renderer {name!r} does not work here: {failure}; "
            f"on Debian: apt-get install {_PACKAGES}"
        )
    return Backend(RAYCAST, f"{EGL}: {failure}", _PACKAGES)


def why_no_opengl() -> str:
    """Why OpenGL does not work here without a window system; empty when it does."""
    missing = [part for part in _LIBRARIES if ctypes.util.find_library(part) is None]
    if missing:
        return f"the library lib{missing[0]} is not installed"
    # The caller's own choice of a platform must not decide what the probe tries.
    environment = {key: value for key, value in os.environ.items() if key not in _GL_VARIABLES}
    environment["PYTHONPATH"] = os.pathsep.join(part for part in sys.path if part)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "vla_zenoh.simulation.render"],
            env=environment,
            capture_output=True,
            text=True,
            timeout=PROBE_LIMIT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"rendering a test image took longer than {PROBE_LIMIT_S:g} s"
    if done.returncode == 0:
        return ""
    errors = done.stderr.strip().splitlines()
    return errors[-1] if errors else f"rendering a test image exited with code {done.returncode}"
