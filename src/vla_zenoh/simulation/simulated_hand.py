"""The simulated gripper: two fingers, the actuator that drives them, and what it reports."""

from __future__ import annotations

import mujoco

from vla_zenoh.simulation.gripper_servo import GripperServo
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.simulation.scene import GRIPPER, PREFIX, STEP_S
from vla_zenoh.types import GripperState

MAX_FORCE_N = 70.0


class SimulatedHand:
    """Fingers of a robot in a model.

    Args:
        model: with the robot in it.
        data: its state.
        robot: whose fingers they are.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, robot: RobotModel) -> None:
        self._model, self._data = model, data
        fingers = [model.joint(PREFIX + name) for name in robot.finger_joints]
        self._q = [int(joint.qposadr[0]) for joint in fingers]
        self._dofs = [int(joint.dofadr[0]) for joint in fingers]
        self._open_m = [float(joint.range[1]) for joint in fingers]
        self._actuator = int(model.actuator(PREFIX + GRIPPER).id)
        self._servo = GripperServo(sum(self._open_m), STEP_S, MAX_FORCE_N)

    def open(self) -> None:
        """Stand open, as after a reset."""
        self._data.qpos[self._q] = self._open_m
        self._servo.reset(self._servo.max_width_m)
        self._bound_force()

    def stand(self) -> None:
        """Stay at the width at which the fingers are."""
        self._servo.reset(self._opening()[0])
        self._bound_force()

    def command(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """Go to `width_m` at `speed_m_s`, pressing with at most `force_n`.

        Raises:
            RecordError: speed or force are not above zero.
        """
        self._servo.command(width_m, speed_m_s, force_n)
        self._bound_force()

    def drive(self) -> None:
        """Tell the actuator where to go in this tick."""
        self._data.ctrl[self._actuator] = self._servo.step(*self._opening())

    def state(self) -> GripperState:
        """Opening between the fingers, and whether they move or hold something."""
        width_m, _ = self._opening()
        return GripperState(width_m, moving=self._servo.moving, holding=self._servo.holding)

    @property
    def force_n(self) -> float:
        """What either finger presses with, inwards positive."""
        return -float(self._data.actuator_force[self._actuator])

    def _opening(self) -> tuple[float, float]:
        left, right = self._q
        left_dof, right_dof = self._dofs
        q, v = self._data.qpos, self._data.qvel
        return float(q[left] + q[right]), float(v[left_dof] + v[right_dof])

    def _bound_force(self) -> None:
        limit_n = self._servo.force_n
        self._model.actuator_forcerange[self._actuator] = (-limit_n, limit_n)
