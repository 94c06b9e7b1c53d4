"""Contract of a robot driver: one class in a Python file drives any arm, without ROS.

    from vla_zenoh.robot import Command, Reading

    class MyArm:
        def __init__(self, address: str) -> None:
            self._arm = its_library.Arm(address)

        def read(self) -> Reading:
            return Reading(position_rad=self._arm.q, velocity_rad_s=self._arm.dq)

        def move(self, command: Command) -> None:
            self._arm.servo_joints(command.position_rad)

The profile has ``robot: {driver: arm}`` and ``arm: {file: my_arm.py, options: {address:
10.0.0.3}}``. The node applies limits, smoothing, watchdogs and brakes before it: the commands that
`move` receives are jerk-limited, and come to rest when the command stream falls silent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from vla_zenoh.types import FloatArray, JointCommand, PoseCommand

Command = PoseCommand | JointCommand
"""Set-point of the robot's controller; ``robot.command`` of the profile selects the kind:

- ``joint``: `position_rad` and `velocity_rad_s`, (n,) in the order of ``robot.arm_joints``;
- ``pose``: of ``robot.tcp_frame`` in ``robot.base_frame``: `position_m` (3,), `quat_xyzw` (4,),
  `twist` (6,) m/s and rad/s along the base axes, for the robot's own Cartesian controller.
"""


@dataclass(frozen=True, slots=True)
class Reading:
    """Newest measurement of the robot.

    A reading with a value that is not a number, or that this arm cannot have, is rejected whole and
    counted; its fault still counts.

    Args:
        position_rad: (n,) of the joints, in the order of ``robot.arm_joints``; m for prismatic
            joints. One that turns without an end may be counted over turns or wrapped anywhere: its
            commands are near to the last reading.
        velocity_rad_s: (n,); None: not measured, computed from differences of the position.
        effort_nm: (n,); None: not measured. Where it is the external torque alone, set
            ``limits.contact.effort_stop_nm`` to have it monitored.
        width_m: opening of the gripper; None: not measured, that of the last command is assumed.
            Only with a gripper that the profile declares (``robot.gripper``).
        moving: the gripper moves, and is sent no other width until it stands.
        holding: the gripper holds an object.
        wrench: (6,) external N and Nm at the TCP, base axes, without the weight of arm and tool,
            monitored by `limits.contact`. None: not measured.
        fault: why the robot does not move (emergency stop, reflex, protective stop). The arm is
            stopped until the fault is gone and an operator has published ``reset``. Report it
            however brief it is, and also where nothing else is new.
        mode: the robot's reason for following no commands although it is healthy (it is guided by
            hand, a recovery runs). The arm is not activated in it; empty: it is ready.
        measured_ns: time of the measurement by `time.monotonic_ns`; None: now. Set it where a
            library caches the newest state: otherwise a dead link looks like an arm at rest.
        idle: no controller holds the last set-point any more (it runs in motion only). The next
            command stream then begins where the arm is measured.
    """

    position_rad: ArrayLike
    velocity_rad_s: ArrayLike | None = None
    effort_nm: ArrayLike | None = None
    width_m: float | None = None
    moving: bool = False
    holding: bool = False
    wrench: ArrayLike | None = None
    fault: str = ""
    mode: str = ""
    measured_ns: int | None = None
    idle: bool = False


@runtime_checkable
class Robot(Protocol):
    """A robot. `read` and `move` are required, the other methods named here are optional.

    One thread calls all of them, ``timing.command_hz`` times a second; a call must return within a
    fraction of that period. Code that waits for the robot needs a thread of its own.

    ``connect()`` runs once before the first reading, and may take long.
    ``grip(width_m, speed_m_s, force_n)`` starts a motion to an absolute opening, and returns.
    ``recover()`` runs when an operator published ``reset``: begin to clear the robot's errors, and
    return. A robot with this method clears no errors by itself.
    ``status()`` returns values for the node's status, name -> number, text or list.
    ``close()`` runs at the end, when the arm stands, also after a ``connect()`` that failed.

    An exception ends the node, after it braked the motion by further calls of `move`, unless those
    raise three times in a row. ``up`` restarts the node, which begins with ``connect()``.
    """

    def read(self) -> Reading | None:
        """The newest state; None: there is no new one."""
        ...

    def move(self, command: Command) -> None:
        """Set the set-point. Between calls the robot has to hold the last one.

        A robot that keeps the velocity too must drop it when no call came for
        ``timing.command_timeout_s``: this loop may be what hangs.
        """
        ...


def numbers(name: str, given: ArrayLike, count: int) -> FloatArray:
    """A copy of `given`, (count,) of float64, which may contain NaN; else a `ValueError`."""
    try:
        array = np.array(given, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is not a list of numbers: {error}") from error
    if array.shape != (count,):
        raise ValueError(f"{name} has shape {array.shape}, wanted ({count},)")
    return array
