"""Renders images of a simulated world from a copy of its poses, `World.qpos`.

Rendering belongs in a process of its own: it would disturb the control loop.

``python -m vla_zenoh.simulation.render`` renders one small test image by OpenGL and exits with 0
when it is right; `vla_zenoh.simulation.backend` runs that, since a broken driver can crash it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Collection, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import NodeError, RecordError, ResourceError, in_words
from vla_zenoh.simulation.backend import RAYCAST, Backend, choose_backend
from vla_zenoh.simulation.raycast import RaycastCanvas
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.simulation.scene import POSES, AppearanceSwitcher, build_model

MAX_GEOMS = 1000
PROBE_SIZE = 16
PROBE_SCENE = """
<mujoco>
  <visual><headlight ambient="1 1 1"/></visual>
  <worldbody>
    <camera name="eye" pos="0 0 1"/>
    <geom type="box" size="2 2 0.1" rgba="1 0 0 1"/>
  </worldbody>
</mujoco>
"""


class Renderer:
    """Renders the scene and robot of a `World`. Use it from the thread that made it.

    Raises:
        ResourceError: scene, robot or, in its methods, a camera are missing.
        NodeError: the back end does not work here.
    """

    def __init__(
        self, scene: str, robots: Sequence[RobotModel], backend: Backend | None = None
    ) -> None:
        self.backend = choose_backend() if backend is None else backend
        self._model = build_model(scene, robots)
        self._data = mujoco.MjData(self._model)
        canvas = RaycastCanvas if self.backend.name == RAYCAST else OpenGlCanvas
        self._canvas = canvas(self._model)
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
        size = mujoco.mj_stateSize(self._model, POSES)
        if vector.shape != (size,):
            why = f"a pose vector of this scene has shape ({size},), got {vector.shape}"
            raise RecordError(why)
        if not np.isfinite(vector).all():
            raise RecordError("the pose vector is not finite")
        mujoco.mj_setState(self._model, self._data, vector, POSES)
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
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)


class OpenGlCanvas:
    """Off-screen OpenGL context of one model; use it from the thread that made it.

    Raises:
        NodeError: OpenGL does not work this way here.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        other = os.environ.get("PYOPENGL_PLATFORM")
        if other not in (None, "", "egl"):
            why = f"this process already renders with PYOPENGL_PLATFORM={other}"
            raise NodeError(f"{why}; EGL needs a process of its own")
        try:
            # MuJoCo's own Renderer takes its context from MUJOCO_GL as it was at `import mujoco`.
            from mujoco.egl import GLContext

            self._context = GLContext(64, 64)
            self._context.make_current()
            self._gl = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except Exception as error:  # drivers raise exceptions of many types here
            raise NodeError(f"no OpenGL through EGL: {in_words(error)}") from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._gl)
        self._scene = mujoco.MjvScene(model, MAX_GEOMS)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = False  # each costs several times the rest of the frame
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        self._shown = mujoco.MjvOption(), mujoco.MjvPerturb(), self._camera, everything
        self._size = (0, 0)

    def draw(self, data: mujoco.MjData, camera: str, width: int, height: int) -> NDArray[np.uint8]:
        """Image of `camera`, (height, width, 3) RGB."""
        viewport = self._render(data, camera, width, height)
        rgb = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_readPixels(rgb, None, viewport, self._gl)
        return np.ascontiguousarray(rgb[::-1])  # OpenGL's first row is the lowest

    def draw_depth(
        self, data: mujoco.MjData, camera: str, width: int, height: int
    ) -> NDArray[np.float64]:
        """Distance along the optical axis in m, (height, width); infinite where nothing is."""
        viewport = self._render(data, camera, width, height)
        buffer = np.empty((height, width), np.float32)
        mujoco.mjr_readPixels(None, buffer, viewport, self._gl)
        # As MuJoCo's projection wrote it, between the clipping planes of the scene.
        extent, visual = self._model.stat.extent, self._model.vis.map
        near_m, far_m = visual.znear * extent, visual.zfar * extent
        share = buffer[::-1].astype(np.float64)
        if self._gl.readDepthMap == mujoco.mjtDepthMap.mjDEPTH_ZERONEAR:
            share = 1.0 - share
        with np.errstate(divide="ignore"):
            depth_m = near_m * far_m / (near_m + share * (far_m - near_m))
        return np.where(share <= 0.0, np.inf, depth_m)

    def _render(self, data: mujoco.MjData, camera: str, width: int, height: int) -> mujoco.MjrRect:
        if self._size != (width, height):
            mujoco.mjr_resizeOffscreen(width, height, self._gl)
            self._size = (width, height)
        self._camera.fixedcamid = self._model.camera(camera).id
        mujoco.mjv_updateScene(self._model, data, *self._shown, self._scene)
        viewport = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(viewport, self._scene, self._gl)
        return viewport

    def refresh(self) -> None:
        """Nothing to do: every image reads the model."""

    def close(self) -> None:
        """Free the context."""
        self._gl.free()
        self._context.free()


def main() -> None:
    """Exit with 0 when a red box is rendered red, else print the reason on stderr."""
    model = mujoco.MjModel.from_xml_string(PROBE_SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    canvas = OpenGlCanvas(model)
    image = canvas.draw(data, "eye", PROBE_SIZE, PROBE_SIZE)
    red, green, _ = image[PROBE_SIZE // 2, PROBE_SIZE // 2].tolist()
    canvas.close()
    if not red > 2 * green:
        sys.exit(f"the test image has the wrong colour: {red}, {green}")


if __name__ == "__main__":
    main()
