"""The contract between a robot and vla-zenoh: a class in one file moves any arm, without ROS.

    from vla_zenoh.robot import Command, Reading

    class MyArm:
        def __init__(self, address: str) -> None:
            self._arm = its_library.Arm(address)

        def read(self) -> Reading:
            return Reading(position_rad=self._arm.q, velocity_rad_s=self._arm.dq)

        def move(self, command: Command) -> None:
            self._arm.servo_joints(command.position_rad)

The profile says ``robot: {driver: arm}`` and ``arm: {file: my_arm.py, options: {address:
10.0.0.3}}``. Limits, smoothing, watchdogs and brakes are before it: what `move` is given is
jerk-limited, and comes to rest by itself when those who command fall silent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from vla_zenoh.types import FloatArray, JointCommand, PoseCommand

Command = PoseCommand | JointCommand
"""Where the arm has to be now. ``robot.command`` of the profile says which of them it is:

- ``joint``: `position_rad` and `velocity_rad_s`, (n,) in the order of ``robot.arm_joints``;
- ``pose``: of ``robot.tcp_frame`` in ``robot.base_frame``: `position_m` (3,), `quat_xyzw` (4,),
  `twist` (6,) m/s and rad/s along the base axes, for a Cartesian controller of the robot's own.
"""


@dataclass(frozen=True, slots=True)
class Reading:
    """What the robot measured last.

    It is taken whole, or, where anything in it is no number or nothing this arm can be, refused,
    counted and told; but its fault counts all the same.

    Args:
        position_rad: (n,) of the joints, in the order of ``robot.arm_joints``; m where they slide.
        velocity_rad_s: (n,); None: the robot does not say, they are made of differences.
        effort_nm: (n,); None likewise: zero. Where it is the external torque alone, give
            ``limits.contact.effort_stop_nm``, so that it is looked at.
        width_m: of the gripper, None where there is none or it does not say: what was asked for
            last is believed.
        moving: the gripper moves.
        holding: it holds something.
        wrench: (6,) N and Nm from outside at the TCP, base axes, without the weight of arm and
            tool; `limits.contact` looks at it. None: not measured.
        fault: why the robot does not move (emergency stop, reflex, protective stop); the arm is
            then stopped until it is gone and a person has put ``reset``. Say it however briefly it
            lasts, and also where nothing else is new.
        measured_ns: on the clock of `time.monotonic_ns`; None: just now. Say it where a library
            keeps the newest state for you: else an arm that fell silent looks like one that stands.
    """

    position_rad: ArrayLike
    velocity_rad_s: ArrayLike | None = None
    effort_nm: ArrayLike | None = None
    width_m: float | None = None
    moving: bool = False
    holding: bool = False
    wrench: ArrayLike | None = None
    fault: str = ""
    measured_ns: int | None = None


@runtime_checkable
class Robot(Protocol):
    """A robot. Only `read` and `move` are needed; the others are called if they are there.

    All is called by one thread, ``timing.command_hz`` times a second, and must return within a
    fraction of that: what waits for the robot has a thread of its own.

    ``connect()`` runs once before the first reading, and may take as long as it needs.
    ``grip(width_m, speed_m_s, force_n)`` asks for an absolute opening; it returns at once.
    ``close()`` runs at the end, when the arm stands, also where ``connect()`` failed.

    What any of them raises ends the node, after the motion was braked by further calls of `move`,
    unless that raises three times in a row; under ``up`` it is started again, and begins with
    ``connect()``.
    """

    def read(self) -> Reading | None:
        """The newest state; None: there is none yet."""
        ...

    def move(self, command: Command) -> None:
        """Be there now. While this is not called the robot has to hold what it was given last."""
        ...


def numbers(name: str, given: ArrayLike, count: int) -> FloatArray:
    """`given` as (count,) float64, which may hold NaN.

    Raises:
        ValueError: it is something else.
    """
    try:
        array = np.asarray(given, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is no list of numbers: {error}") from error
    if array.shape != (count,):
        raise ValueError(f"{name} has shape {array.shape}, wanted ({count},)")
    return array
