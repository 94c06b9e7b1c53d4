"""Pictures of a simulated world, from a copy of its poses.

Drawing belongs in a process of its own: it would disturb the control loop. That process makes a
`Renderer` of the same scene and robot as the `World` and feeds it `World.qpos`.
"""

from __future__ import annotations

from collections.abc import Collection
from types import TracebackType
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import ResourceError
from vla_zenoh.simulation.backend import RAYCAST, Backend, choose_backend
from vla_zenoh.simulation.robot_model import RobotModel

if TYPE_CHECKING:
    import mujoco


class Canvas(Protocol):
    """Something that draws what a camera of a model sees."""

    def draw(self, data: mujoco.MjData, camera: str, width: int, height: int) -> NDArray[np.uint8]:
        """Draw (height, width, 3) RGB; positions in `data` are up to date."""
        ...

    def refresh(self) -> None:
        """Colours, lights or cameras of the model have changed."""
        ...

    def close(self) -> None:
        """Give resources back."""
        ...


class Renderer:
    """Draws a scene with its robot. Use it from the thread that made it.

    Args:
        scene: name or path of the scene, as the world's.
        robot: the robot, as the world's.
        backend: how to draw; None lets `choose_backend` choose.

    Raises:
        ResourceError: scene or robot are missing.
        NodeError: the back end does not work here.
    """

    def __init__(self, scene: str, robot: RobotModel, backend: Backend | None = None) -> None:
        chosen = choose_backend() if backend is None else backend
        # Not before the choice: with a bad MUJOCO_GL in the environment the import itself fails.
        import mujoco

        from vla_zenoh.simulation.appearance import Dresser
        from vla_zenoh.simulation.scene import build_model

        self.backend = chosen
        self._model = build_model(scene, robot)
        self._data = mujoco.MjData(self._model)
        self._canvas = _canvas(chosen.name, self._model)
        self._dresser = Dresser(self._model)
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
        from vla_zenoh.simulation.pose_vector import write_pose_vector

        write_pose_vector(self._model, self._data, vector)
        self._update()

    def vary(self, seed: int | None, vary: Collection[str]) -> None:
        """Look as a reset with `seed` makes the scene look; None: as the scene file says.

        Raises:
            ResourceError: an unknown name in `vary`, or the scene has nothing to vary so.
        """
        from vla_zenoh.simulation.appearance import Appearance, draw_look

        self._dresser.wear(Appearance() if seed is None else draw_look(seed, vary))
        self._canvas.refresh()
        self._update()

    def render(self, camera: str, width: int, height: int) -> NDArray[np.uint8]:
        """Draw what `camera` sees.

        Returns:
            RGB uint8, (height, width, 3), C-contiguous.

        Raises:
            ResourceError: there is no such camera.
        """
        if camera not in self.cameras:
            raise ResourceError(f"no camera {camera!r}; there are: {', '.join(self.cameras)}")
        return self._canvas.draw(self._data, camera, width, height)

    def view(self, camera: str) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """Where `camera` is now: position (3,) m, axes (3, 3) in columns, vertical view in rad.

        The axes are MuJoCo's: x to the right, y up, looking along -z.
        """
        index = self._model.camera(camera).id
        axes = self._data.cam_xmat[index].reshape(3, 3).copy()
        fovy_rad = float(np.radians(self._model.cam_fovy[index]))
        return self._data.cam_xpos[index].copy(), axes, fovy_rad

    def close(self) -> None:
        """Give the graphics context back."""
        self._canvas.close()

    def __enter__(self) -> Renderer:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _update(self) -> None:
        import mujoco

        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)


def _canvas(name: str, model: mujoco.MjModel) -> Canvas:
    if name == RAYCAST:
        from vla_zenoh.simulation.raycast import RaycastCanvas

        return RaycastCanvas(model)
    from vla_zenoh.simulation.opengl import OpenGlCanvas

    return OpenGlCanvas(model, name)
