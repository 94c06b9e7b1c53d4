"""Whether pictures of the simulator can be drawn by OpenGL without a screen."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence

from vla_zenoh.doctor.finding import Finding

LIMIT_S = 30
BACKENDS = ("egl", "osmesa")
ADVICE = (
    "sudo apt install libegl1 libopengl0 libgl1-mesa-dri (with an NVIDIA card instead of the last: "
    "its driver's libnvidia-gl); in a container with one: NVIDIA_DRIVER_CAPABILITIES=all"
)

# Another process: with the wrong MUJOCO_GL already the import fails, and drivers may crash.
_PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 2'/><geom size='.5'/></worldbody></mujoco>"
)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 32, 32) as renderer:
    renderer.update_scene(data)
    if not renderer.render().any():
        raise RuntimeError("the picture is black")
    from OpenGL import GL
    print(GL.glGetString(GL.GL_RENDERER).decode())
"""


def try_backend(backend: str) -> tuple[bool, str]:
    """Draws a picture with `backend` in another process.

    Returns:
        Whether it could, and the name of the renderer or the reason.
    """
    environ = {**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
    with tempfile.TemporaryDirectory() as folder:  # MuJoCo writes its log where it runs
        try:
            done = subprocess.run(
                [sys.executable, "-c", _PROBE],
                capture_output=True,
                text=True,
                check=False,
                timeout=LIMIT_S,
                env=environ,
                cwd=folder,
            )
        except subprocess.TimeoutExpired:
            return False, f"nothing drawn within {LIMIT_S} s"
    output = done.stdout if done.returncode == 0 else done.stderr
    last = output.strip().rsplit("\n", 1)[-1] or f"ended with status {done.returncode}"
    return done.returncode == 0, last


def opengl(
    backends: Sequence[str] = BACKENDS,
    probe: Callable[[str], tuple[bool, str]] = try_backend,
) -> Finding:
    """Some backend of MuJoCo draws; where none does the ray caster takes over, slower."""
    reasons = []
    for backend in backends:
        drawn, text = probe(backend)
        if drawn:
            return Finding("OpenGL", "ok", f"{backend} draws with {text}")
        reasons.append(f"{backend}: {text}")
    found = f"none, so pictures are ray cast, which is slower ({'; '.join(reasons)})"
    return Finding("OpenGL", "warn", found, ADVICE)
