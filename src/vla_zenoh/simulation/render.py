"""Renders images of a simulated world from a copy of its poses.

Rendering belongs in a process of its own: it would disturb the control loop. That process makes a
`Renderer` of the same scene and robot as the `World` and gives it `World.qpos`.

OpenGL is fast but needs a system library; ray casting needs nothing. With ``MUJOCO_GL`` naming a
missing library ``import mujoco`` itself fails, and a broken driver can crash the process: so this
module does not import MuJoCo, and `choose_backend` tries OpenGL in another process.
"""

from __future__ import annotations

import ctypes.util
import os
import subprocess
import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import NodeError, ResourceError
from vla_zenoh.simulation.robot_model import RobotModel

VARIABLE = "VLA_ZENOH_RENDERER"
EGL, RAYCAST = "egl", "raycast"
AUTO = "auto"
PROBE_LIMIT_S = 60.0

_LIBRARIES = ("EGL", "OpenGL")
"""Libraries that PyOpenGL and MuJoCo load."""
_PACKAGES = "libegl1 libopengl0 libgl1-mesa-dri"
"""Debian packages that have them; Mesa renders on the CPU where there is no GPU."""
_GL_VARIABLES = ("MUJOCO_GL", "PYOPENGL_PLATFORM")


@dataclass(frozen=True, slots=True)
class Backend:
    """A way to render.

    Args:
        name: ``egl`` or ``raycast``.
        reason: why OpenGL does not work here; empty if ray casting was requested.
        install: Debian packages that OpenGL needs; may be empty.
    """

    name: str
    reason: str = ""
    install: str = ""


def choose_backend(wanted: str | None = None) -> Backend:
    """OpenGL if it works on this machine, else ray casting; or the requested one.

    Args:
        wanted: ``egl``, ``raycast`` or ``auto``; None: the environment variable
            ``VLA_ZENOH_RENDERER``, and ``auto`` where that is not set.

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
            [sys.executable, "-m", "vla_zenoh.simulation.opengl"],
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


class Renderer:
    """Renders the scene and robot of a `World`. Use it from the thread that made it.

    Raises:
        ResourceError: scene, robot or, in its methods, a camera are missing.
        NodeError: the back end does not work here.
    """

    def __init__(
        self, scene: str, robot: RobotModel | Sequence[RobotModel], backend: Backend | None = None
    ) -> None:
        self.backend = choose_backend() if backend is None else backend
        # After the choice: with a bad MUJOCO_GL in the environment the import itself fails.
        import mujoco

        from vla_zenoh.simulation.appearance import AppearanceSwitcher
        from vla_zenoh.simulation.scene import build_model

        self._model = build_model(scene, robot)
        self._data = mujoco.MjData(self._model)
        if self.backend.name == RAYCAST:
            from vla_zenoh.simulation.raycast import RaycastCanvas as Canvas
        else:
            from vla_zenoh.simulation.opengl import OpenGlCanvas as Canvas
        self._canvas = Canvas(self._model)
        self._appearance = AppearanceSwitcher(self._model)
        self._update()

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the scene's and the robot's cameras."""
        return tuple(self._model.camera(i).name for i in range(self._model.ncam))

    def set_qpos(self, vector: NDArray[np.float64]) -> None:
        """Show the poses of `World.qpos` from now on.

        Raises:
            RecordError: the vector is of another scene, or not finite.
        """
        from vla_zenoh.simulation.scene import write_pose_vector

        write_pose_vector(self._model, self._data, vector)
        self._update()

    def vary(self, seed: int | None, vary: Collection[str]) -> None:
        """Take the appearance that a reset with `seed` gives; None: that of the scene file.

        Raises:
            ResourceError: an unknown name in `vary`, or the scene lacks what it varies.
        """
        self._appearance.apply(seed, vary)
        self._canvas.refresh()
        self._update()

    def render(self, camera: str, width: int, height: int) -> NDArray[np.uint8]:
        """Image of `camera`: RGB uint8, (height, width, 3), C-contiguous."""
        return self._canvas.draw(self._data, self._known(camera), width, height)

    def render_depth(self, camera: str, width: int, height: int) -> NDArray[np.float64]:
        """Depth of `camera` along its axis in m, (height, width); infinite where nothing is."""
        return self._canvas.draw_depth(self._data, self._known(camera), width, height)

    def focal_px(self, camera: str, height: int) -> float:
        """Focal length in pixels of an image of this height; the axis goes through its middle."""
        fovy_rad = np.radians(self._model.cam_fovy[self._model.camera(self._known(camera)).id])
        return float(height / 2.0 / np.tan(fovy_rad / 2.0))

    def _known(self, camera: str) -> str:
        if camera not in self.cameras:
            raise ResourceError(f"no camera {camera!r}; there are: {', '.join(self.cameras)}")
        return camera

    def close(self) -> None:
        """Free the graphics context."""
        self._canvas.close()

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _update(self) -> None:
        import mujoco

        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
