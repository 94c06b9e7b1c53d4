"""Contract of a robot driver: the members of `vla_zenoh.robot.Robot`, with checked records."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.bus.clock import FixedRate, Tick
from vla_zenoh.errors import NodeError
from vla_zenoh.guard.arm_guard import Measured
from vla_zenoh.kinematics.so3 import Pose, quat_from_rotation
from vla_zenoh.policy.meaning import toward
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
    FloatArray,
    GripperCommand,
    GripperState,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
)
from vla_zenoh.types.records import JointReference, PoseReference

if TYPE_CHECKING:
    from vla_zenoh.bus.node import Node
    from vla_zenoh.kinematics.kinematics import Kinematics

STREAMING = "streaming"
"""State in the commands for a driver: the guard has already checked the writer's."""


class Measurement(NamedTuple):
    """Checked state of a robot at one time."""

    stamp_ns: int  # wall clock
    joints: JointState
    tcp: Pose  # in the base frame
    pose: PoseState  # the same with twist and wrench; a simulation adds its reference
    gripper: GripperState | None  # the node sets its mode and faults; None: unknown


class DriverStatus(NamedTuple):
    """A driver's part of the node's status; see `vla_zenoh.types.NodeStatus` for the fields."""

    detail: Mapping[str, Any]
    ages_s: Mapping[str, float] = {}
    rates_hz: Mapping[str, float] = {}
    latency_ms: Mapping[str, tuple[float, float]] = {}


class RobotDriver(ABC):
    """One kind of robot as `RobotNode` drives it; a subclass needs `read` and `move`.

    One thread, the node's loop, calls everything. A call must return within a fraction of
    `period_s`. An exception ends the node after it braked the arm by further calls of `move`.

    Attributes:
        name: of the node.
        profile: the effective profile.
        period_s: of the loop.
        modes: command streams that the robot follows, ``pose`` or ``joint``.
        has_arm: False: the node serves other devices of the robot and moves nothing.
        simulated: `read` steps a simulation by one period, towards the reference of the last
            `move`, which is called at every tick. A real robot is read first, and moved only while
            a stream is followed or braked: unless it is `idle` it holds its last set-point.
        lockstep: time is simulated as well; `serve_lockstep` replaces the loop.
        switch_interval_s: how long another thread may hold the interpreter.
        loop: name of the loop's rate in the status.
        fault: why the robot does not move; empty: no fault.
        measured_ns: monotonic time of the newest valid measurement, None before the first.
        gripper_mode: mode of the gripper state while the arm is ready.
        no_gripper: why gripper commands are rejected; empty: the robot has a gripper.
        away: reason to reject commands, one word, while the robot cannot be moved.
        idle: no controller of the robot holds the last set-point any more.
        recovers: `recover` does something.
        silent_why, stalled_hint: sentences for the events of these states.
        report: the node, once it is on the bus: gets counters, events and rejections.
    """

    name = ""
    has_arm, simulated, lockstep = True, False, False
    switch_interval_s = 5e-4
    loop = "loop"
    fault = ""
    measured_ns: int | None = None
    gripper_mode = "ready"
    no_gripper = ""
    away = ""
    idle = False
    recovers = False
    silent_why = stalled_hint = ""

    def __init__(self, profile: Profile) -> None:
        self.profile = profile
        self.period_s = 1.0 / profile.timing.command_hz
        self.modes: tuple[str, ...] = (profile.robot.command,)
        self.report: Node

    # -- required -----------------------------------------------------------------------------
    @abstractmethod
    def read(self, mono_ns: int) -> Measurement | None:
        """The newest state at this tick; None: nothing new, or nothing valid."""

    @abstractmethod
    def move(self, reference: PoseReference | JointReference, now_ns: int) -> None:
        """Set the set-point of the robot's controller; `now_ns` is its time on the wall clock."""

    # -- optional -----------------------------------------------------------------------------
    @property
    def parts(self) -> Mapping[str, RobotDriver]:
        """Driver of each part, by name; of a robot with one arm this driver, by an empty name."""
        return {"": self}

    def attach(self, node: Node, arm: Any) -> None:
        """Called when the node is on the bus, with the (first) `Arm` that moves this driver."""
        self.report = node

    def connect(self) -> None:
        """Connect to the robot before the loop starts; it may take long."""

    def grip(self, command: GripperCommand, now_ns: int) -> None:
        """Start a gripper motion."""

    def recover(self) -> None:
        """Begin to clear the robot's errors: an operator requested it with ``reset``."""

    def poll(self, mono_ns: int) -> None:
        """Begin a tick: handle other inputs than commands."""

    def status(self) -> DriverStatus:
        """Collect the driver's part of the status."""
        return DriverStatus({})

    def status_changed(self) -> bool:
        """Whether the status should be published before it is due."""
        return False

    def serve_lockstep(self, node: Any, stop: threading.Event) -> None:
        """Run the ticks of the `RobotNode` when simulated time advances, until `stop` is set."""
        raise NodeError("this driver has no simulated time")

    def close(self) -> None:
        """Disconnect; the arm stands."""

    def pace(self) -> Callable[[], Tick]:
        """Clock of the loop: sleeps until the next tick."""
        return FixedRate(self.profile.timing.command_hz).wait

    # -- geometry -----------------------------------------------------------------------------
    def state_now(self) -> Measured | None:
        """State at this moment, where a driver knows more than its last measurement."""
        return None

    @cached_property
    def kinematics(self) -> Kinematics:
        from vla_zenoh.kinematics.kinematics import make_kinematics  # a simulation has its own

        return make_kinematics(self.profile)

    @property
    def joint_range_rad(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limit of the joints, (n,) each in the order of the profile."""
        arm = self.kinematics
        return arm.lower_rad[self._order], arm.upper_rad[self._order]

    @property
    def joint_velocity_rad_s(self) -> FloatArray:
        """Limits (n,) of the joints' velocity by the description, in the same order."""
        return self.kinematics.velocity_rad_s[self._order]

    @property
    def slides(self) -> NDArray[np.bool_]:
        """(n,) joints that slide, in the same order."""
        return self.kinematics.slides[self._order]

    @property
    def _order(self) -> list[int]:
        return [self.kinematics.arm_joints.index(name) for name in self.profile.robot.arm_joints]

    def forward(self, position_rad: FloatArray) -> Pose:
        """TCP pose with the joints at `position_rad` (n,), in the order of the profile."""
        names = self.profile.robot.arm_joints
        return self.kinematics.forward(self.kinematics.ordered(names, position_rad))

    @cached_property
    def home_quat(self) -> tuple[float, float, float, float]:
        """Orientation of the TCP at home, x, y, z, w."""
        from vla_zenoh.kinematics.kinematics import home_orientation

        return home_orientation(self.profile, self.kinematics)

    @property
    def turned_rad(self) -> FloatArray | float:
        """(n,) whole turns by which our count of endless joints is more than the robot's numbers.

        As of its last reading: what the robot is sent is near to what it reports, counted or not.
        """
        return 0.0

    def command_of(self, reference: PoseReference | JointReference) -> PoseCommand | JointCommand:
        """A reference as a command record, in the robot's own numbers.

        Of the two signs of its quaternion it has that nearer to the home orientation, as measured
        poses have: of a tool that points down w is about zero, and its sign is that of rounding.
        """
        if isinstance(reference, JointReference):
            own = reference._replace(position_rad=reference.position_rad - self.turned_rad)
            return JointCommand(self.profile.robot.arm_joints, *own, STREAMING)
        position_m, rotation, twist, acceleration = reference
        quat_xyzw = np.array(toward(quat_from_rotation(rotation), self.home_quat))
        return PoseCommand(
            position_m, quat_xyzw, twist, acceleration, position_m, quat_xyzw, STREAMING
        )
