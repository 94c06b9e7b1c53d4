"""Chooses how pictures are made, without importing MuJoCo and without risking this process.

OpenGL is fast but needs a library of the system; ray casting needs nothing. A wrong guess is
costly: with ``MUJOCO_GL`` naming a missing library ``import mujoco`` itself fails, and a broken
driver can end the process. So each way is tried in a process of its own first.
"""

from __future__ import annotations

import ctypes.util
import os
import subprocess
import sys
from dataclasses import dataclass

from vla_zenoh.errors import NodeError

VARIABLE = "VLA_ZENOH_RENDERER"
EGL, OSMESA, RAYCAST = "egl", "osmesa", "raycast"
BACKENDS = (EGL, OSMESA, RAYCAST)
AUTO = "auto"
PROBE_LIMIT_S = 60.0

# What PyOpenGL and MuJoCo load for each, and the Debian packages that bring it.
_LIBRARIES = {EGL: ("EGL", "OpenGL"), OSMESA: ("OSMesa",)}
_PACKAGES = {EGL: "libegl1 libopengl0 libgl1-mesa-dri", OSMESA: "libosmesa6"}


@dataclass(frozen=True, slots=True)
class Backend:
    """A way to make pictures.

    Args:
        name: ``egl``, ``osmesa`` or ``raycast``.
        reason: why not a faster one; empty where it is what was wished for.
        install: Debian packages that would bring the faster one; may be empty.
    """

    name: str
    reason: str = ""
    install: str = ""


def choose_backend(wanted: str | None = None) -> Backend:
    """The best way that works here, or the one that is asked for.

    Args:
        wanted: a name of `BACKENDS`, ``auto`` or None; None asks the environment variable
            ``VLA_ZENOH_RENDERER`` and means ``auto`` where that is not set either.

    Raises:
        NodeError: `wanted` is unknown, or is asked for by name and does not work here.
    """
    name = wanted if wanted is not None else os.environ.get(VARIABLE) or AUTO
    if name not in (AUTO, *BACKENDS):
        raise NodeError(f"no renderer called {name!r}; there are: {AUTO}, {', '.join(BACKENDS)}")
    if name == RAYCAST:
        return Backend(RAYCAST)
    if name != AUTO:
        failure = why_not(name)
        if failure:
            raise NodeError(
                f"the renderer {name!r} does not work here: {failure}; "
                f"on Debian: apt-get install {_PACKAGES[name]}"
            )
        return Backend(name)
    failures = []
    for candidate in (EGL, OSMESA):
        failure = why_not(candidate)
        if not failure:
            return Backend(candidate)
        failures.append(f"{candidate}: {failure}")
    return Backend(RAYCAST, "; ".join(failures), _PACKAGES[EGL])


def why_not(name: str) -> str:
    """Why the OpenGL way `name` does not work here; empty when it does."""
    missing = [part for part in _LIBRARIES[name] if ctypes.util.find_library(part) is None]
    if missing:
        return f"the library lib{missing[0]} is not installed"
    command = [sys.executable, "-m", "vla_zenoh.simulation.opengl_probe", name]
    # Whatever the caller's environment says must not decide what the probe tries.
    environment = {key: value for key, value in os.environ.items() if key not in _GL_VARIABLES}
    environment["PYTHONPATH"] = os.pathsep.join(part for part in sys.path if part)
    try:
        done = subprocess.run(
            command,
            env=environment,
            capture_output=True,
            text=True,
            timeout=PROBE_LIMIT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"drawing a test picture took longer than {PROBE_LIMIT_S:g} s"
    if done.returncode == 0:
        return ""
    said = done.stderr.strip().splitlines()
    return said[-1] if said else f"drawing a test picture ended with code {done.returncode}"


_GL_VARIABLES = ("MUJOCO_GL", "PYOPENGL_PLATFORM")
