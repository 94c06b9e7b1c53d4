"""An arm of a robot node: command stream and gripper commands in, states out."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample
from vla_zenoh.bus.node import Node, Publisher, publish_together
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.control.preflight import STOP_LATCHED
from vla_zenoh.errors import CodecError
from vla_zenoh.guard.arm_guard import (
    ARM_SETTLES_NS,
    OLDEST_NS,
    ArmGuard,
    GripperGuard,
    HeldReference,
    Measured,
)
from vla_zenoh.keys import Kind
from vla_zenoh.kinematics.so3 import Pose, pose_distance, quat_from_rotation
from vla_zenoh.robots.driver import Measurement, RobotDriver
from vla_zenoh.types import (
    Event,
    FloatArray,
    GripperCommand,
    GripperState,
    JointCommand,
    JointReference,
    PoseCommand,
)

BUFFER = 64
STALLED_NS = 500_000_000
"""After a stall commands are rejected and the robot is not ready for this long: what was sent
during the stall is still arriving, and its writer has to notice and brake."""
NOT_READY = (STOP_LATCHED, "braking", "stalled", "unheeded")
"""States of a healthy robot that is not ready for commands; its gripper state reports them too."""
FAULT_AGAIN_NS = 100_000_000
"""A fault without measurements is published again after this, for late subscribers."""


class Arm:
    """Runs one arm through its driver, tick by tick: guards its command streams, moves the driver.

    When a stream falls silent in motion, the guard brakes the arm. Then a real robot is sent
    nothing more: its controller holds the last set-point, until the driver reports that it is idle.

    Attributes:
        guard: of the streams; it follows none before the first measurement.
        stall_s: duration of the last stall.
        stalls: number of stalls of the loop while it moved the arm.
        stop_latched: an emergency stop was heard: all commands are ignored.
        accepting: False: all further commands are ignored, and the guard brakes a motion when its
            stream times out.
    """

    def __init__(self, node: Node, driver: RobotDriver) -> None:
        self._node, self._driver, profile = node, driver, driver.profile
        keys = profile.keys
        subscribed = {"pose": keys.command_pose, "joint": keys.command_joint}
        self._streams = [
            (mode, node.subscribe(subscribed[mode], CallbackRing(BUFFER, SMALL_BYTES)))
            for mode in driver.modes
        ]
        self._waiting: dict[str, list[ReceivedSample]] = {mode: [] for mode in driver.modes}
        nowhere = np.zeros(len(profile.robot.arm_joints))
        self._unknown = Measured(Pose(np.zeros(3), np.eye(3)), nowhere, nowhere)
        self._measured = driver.state_now()
        joints = driver.joint_range_rad, driver.joint_velocity_rad_s, driver.slides
        self.guard = ArmGuard(profile, self._state_now, *joints, driver.period_s)
        self._hold = HeldReference(driver.slides)
        self._timeout_s = profile.timing.command_timeout_s
        self._stalled_until_ns = 0
        self._resting = False
        """The robot must be sent its last set-point at rest: it may have kept a velocity."""
        self.stall_s, self.stalls = 0.0, 0
        self.accepting, self.stop_latched = True, False
        self._was_silent = False
        """No state was heard for longer than it may be silent, in the last tick."""
        self._gripper_commands = GripperCommands(node, driver)
        self._joint_out = node.declare_publisher(keys.state_joint, Kind.STATE)
        self._pose_out = node.declare_publisher(keys.state_pose, Kind.STATE)
        self._gripper_out = node.declare_publisher(keys.state_gripper, Kind.STATE)
        # Less than the period: readings come at multiples of another one. A simulated robot is read
        # at this rate as it is, give or take a tick.
        share = 0.5 if driver.simulated else 0.9
        self._period_ns = share * 1e9 / profile.timing.state_hz
        self._seq = self._published_ns = self._mono_ns = 0
        self._gripper = GripperState(None, moving=False, holding=False)
        self._published_fault = self._was = ""

    # -- one tick -----------------------------------------------------------------------------
    def begin_step(
        self, now_ns: int, mono_ns: int, stall_s: float, *, reading: bool = True
    ) -> None:
        """Read a real robot, and move it or a simulated one, in a tick that is `stall_s` late.

        `now_ns` (wall clock, for stamps) and `mono_ns` (monotonic) are one time. Without `reading`
        it only moves the robot, to bring the arm to rest.
        """
        self._mono_ns = mono_ns
        if stall_s > self._timeout_s:
            self._hold_after_stall(mono_ns, stall_s)
        elif mono_ns >= self._stalled_until_ns:
            self._stalled_until_ns = 0
        if reading and not self._driver.simulated:
            self._read(mono_ns)
        self._follow(now_ns, mono_ns)
        if self.stop_latched:
            self._gripper_commands.drop()
        elif self.accepting:
            self._gripper_commands.update(now_ns, self.guard, silent=self._was_silent)

    def latch_stop(self) -> None:
        """Brake, and ignore all commands until `stop_latched` is cleared."""
        self.stop_latched = True
        self.guard.stop()

    def end_step(self, mono_ns: int) -> None:
        """Read a simulated robot once all its parts have been moved: their commands act at once."""
        if self._driver.simulated:
            self._read(mono_ns)

    def _read(self, mono_ns: int) -> None:
        measurement = self._driver.read(mono_ns)
        if measurement is not None:
            joints, self._gripper = measurement.joints, measurement.gripper or self._gripper
            first = self._measured is None
            self._measured = Measured(measurement.tcp, joints.position_rad, joints.velocity_rad_s)
            if first or (self._was_silent and self._is_elsewhere(measurement.tcp)):
                self.guard.anchor()
        self.publish(measurement, mono_ns)

    def _is_elsewhere(self, tcp: Pose) -> bool:
        """Whether the robot is not where it was led: another one, or it was started again."""
        apart_m, apart_rad = pose_distance(tcp, self._reference_pose())
        limits = self._driver.profile.limits
        return apart_m > limits.tracking_m or apart_rad > limits.tracking_rad

    def _state_now(self) -> Measured:
        return self._driver.state_now() or self._measured or self._unknown

    def _hold_after_stall(self, mono_ns: int, stall_s: float) -> None:
        """Hold the robot at its last set-point; motion resumes from there, at rest."""
        brief = stall_s * 1e9 <= ARM_SETTLES_NS
        if not brief:
            self._hold.invalidate()  # the arm may have been moved by other means meanwhile
        if self.guard.moving:
            self.guard.hold()
            self._resting = brief
            self._stalled_until_ns, self.stall_s = mono_ns + STALLED_NS, stall_s
            self.stalls += 1
        for mode, buffer in self._streams:
            for _ in buffer.drain():
                self._reject(mode, "stalled")

    def _follow(self, now_ns: int, mono_ns: int) -> None:
        """Accept or reject the commands that arrived, and move the robot."""
        if self._driver.idle and not self.guard.moving:
            self._hold.invalidate()
            self._resting = False
        away = self._driver.away
        reason = away or ("stalled" if self.stalled else "")
        for mode, buffer in self._streams:
            for arrival in self._arrived(mode, buffer, mono_ns):
                if self._measured is None or self.stop_latched or not self.accepting:
                    continue
                if reason:
                    self._reject(mode, reason)
                else:
                    self._offer(mode, arrival, now_ns, mono_ns)
        if self._measured is not None:
            self._lead(self._measured, now_ns, mono_ns, away)
        self._was_silent = self._silent
        if away or self._was_silent:
            self._hold.invalidate()

    def _arrived(self, mode: str, buffer: CallbackRing, mono_ns: int) -> list[ReceivedSample]:
        """Commands that arrived by `mono_ns`.

        A simulation that is late gets those after it in later ticks, else it would follow them in
        steps.
        """
        arrivals = self._waiting[mode] + buffer.drain()
        late = self._driver.simulated and not self._driver.lockstep
        count = sum(arrival.mono_ns <= mono_ns for arrival in arrivals) if late else len(arrivals)
        self._waiting[mode] = arrivals[count:]
        return arrivals[:count]

    def _offer(self, mode: str, arrival: ReceivedSample, now_ns: int, mono_ns: int) -> None:
        guard = self.guard
        if not (guard.following or guard.braking or self.holds):
            guard.anchor()  # no controller holds our set-point: begin where the arm is
        kind: Any = JointCommand if mode == "joint" else PoseCommand
        command = self._node.decode(kind, arrival)
        if command is None:
            return
        age_ns = now_ns - command.header.stamp_wall_ns
        if age_ns > OLDEST_NS and not guard.following and not self._driver.lockstep:
            self._reject(mode, "stale", f" by {command.header.source[:60]!r}")
            return
        # Silence is measured on the clock of the ticks.
        received_ns = mono_ns if self._driver.lockstep else arrival.mono_ns
        rejected = guard.offer(replace(command, received_ns=received_ns), mono_ns)
        if rejected:
            self._reject(mode, rejected, f" by {command.header.source[:60]!r}")

    def _reject(self, mode: str, reason: str, by: str = "") -> None:
        self._node.reject(f"{mode}_{reason}", f"command/{mode}{by}: {reason}")

    def _lead(self, measured: Measured, now_ns: int, mono_ns: int, away: str) -> None:
        guard = self.guard
        if self._driver.simulated:
            self._driver.move(guard.tick(mono_ns, self._driver.period_s), now_ns)
            return
        if self._was_silent and guard.at_rest:
            guard.hold()  # whoever is heard next is not sent where another one stood
        was_moving = guard.moving or self._resting
        self._resting = False
        if away and was_moving:
            guard.anchor()  # the next stream must not begin where the arm never went
            was_moving = guard.moving
        reference = guard.tick(mono_ns)
        if was_moving or guard.moving:
            self._hold.on_sent(mono_ns)
            self._driver.move(reference, now_ns)
        else:
            self._hold.update(measured, mono_ns)

    # -- states out ---------------------------------------------------------------------------
    def publish(self, measurement: Measurement | None, mono_ns: int) -> None:
        """Publish a measurement when it is due; a fault, and its end, at once.

        The gripper state carries the fault, even without a valid measurement.
        """
        driver, gripper = self._driver, self._gripper
        elapsed_ns, again_ns = mono_ns - self._published_ns, self._period_ns
        if measurement is None:
            again_ns = FAULT_AGAIN_NS if driver.fault else math.inf
        if driver.fault == self._published_fault and elapsed_ns < again_ns:
            return
        states: list[tuple[Publisher, Any]] = []
        if measurement is None:
            stamp_ns = mono_ns if driver.lockstep else self._node.clock.wall_at(mono_ns)
        else:
            stamp_ns, joints, _, pose, gripper = measurement
            tcp, held_rad = self._held()
            if tcp is not None:
                pose = replace(
                    pose,
                    reference_position_m=tcp.position_m,
                    reference_quat_xyzw=quat_from_rotation(tcp.rotation),
                )
            if held_rad is not None:
                joints = replace(joints, reference_rad=held_rad)
            states += (self._joint_out, joints), (self._pose_out, pose)
        if gripper is not None:
            mode = self.state if self.state in NOT_READY else driver.gripper_mode
            mode = STOP_LATCHED if self.stop_latched else mode
            faults = (driver.fault,) if driver.fault else ()
            states.append((self._gripper_out, replace(gripper, mode=mode, faults=faults)))
        publish_together(stamp_ns, self._seq, *states)
        self._seq += 1
        self._published_ns, self._published_fault = mono_ns, driver.fault

    # -- state --------------------------------------------------------------------------------
    @property
    def _silent(self) -> bool:
        measured_ns = self._driver.measured_ns
        if self._driver.simulated or measured_ns is None:
            return False
        age_s = (self._mono_ns - measured_ns) / 1e9
        return age_s > self._driver.profile.timing.state_timeout_s

    @property
    def state(self) -> str:
        """State of the arm, one word."""
        if self._driver.fault:
            return "fault"
        if self._driver.measured_ns is None:
            return "waiting"
        if self._silent:
            return "silent"
        if self.stop_latched:
            return STOP_LATCHED
        if self.guard.braking:
            return "braking"
        if self.stalled:
            return "stalled"
        return "unheeded" if self.guard.unheeded else "running"

    def changed(self) -> bool:
        """Whether the state changed since the last call; a transition is emitted as an event."""
        if self._driver.simulated and self._published_ns != self._mono_ns:
            return False  # ticks are frequent: checked only when a state is published
        state, was = self.state, self._was
        if state == was:
            return False
        self._was = state
        if was:
            level = "info" if state == "running" else "warning"
            part, why = self._driver.profile.part, self._why(state)
            why = f"{part}: {why}".rstrip(": ") if part else why
            self._node.emit(Event(level, "transition", f"{was}->{state}", why))
        return True

    def _why(self, state: str) -> str:
        if state == "stalled":
            return (
                f"the loop stood still for {self.stall_s:.3f} s while it moved the arm; "
                f"the motion is not resumed{self._driver.stalled_hint}"
            )
        timeout_s = self._driver.profile.timing.command_timeout_s
        return {
            "fault": self._driver.fault,
            STOP_LATCHED: "emergency stop; latched until a reset",
            "silent": self._driver.silent_why,
            "braking": f"no command/{self.guard.kind} for {timeout_s:g} s while the arm moved",
            "unheeded": "command stream rejected: its first set-point does not match the arm's "
            "current pose, or its beginning was lost",
        }.get(state, "")

    @property
    def stalled(self) -> bool:
        """The loop stalled a moment ago, while it moved the arm."""
        return self._stalled_until_ns > 0

    @property
    def holds(self) -> bool:
        """The robot's controller holds the last set-point."""
        return self._hold.held or self._driver.simulated

    def _held(self) -> tuple[Pose | None, FloatArray | None]:
        """Set-point that a real robot's controller holds: TCP pose, (n,) joints in joint mode.

        None where it is unknown: nothing was sent, or the arm was moved by other means.
        """
        if not self._hold.held or self._driver.simulated:
            return None, None
        reference = self.guard.reference
        joints_rad = reference.position_rad if isinstance(reference, JointReference) else None
        return self._reference_pose(), joints_rad

    def _reference_pose(self) -> Pose:
        """The TCP's pose at the set-point."""
        reference = self.guard.reference
        if isinstance(reference, JointReference):
            return self._driver.forward(reference.position_rad)
        return Pose(reference.position_m, reference.rotation)


class GripperCommands:
    """Gripper commands of the arm's writer, from the bus to the driver."""

    def __init__(self, node: Node, driver: RobotDriver) -> None:
        self._node, self._driver, key = node, driver, driver.profile.keys.command_gripper
        self._commands = node.subscribe(key, CallbackRing(16, SMALL_BYTES))
        gripper = driver.profile.robot.gripper
        self._guard = None if gripper is None else GripperGuard(gripper)

    def drop(self) -> None:
        """Ignore the commands that arrived."""
        self._commands.drain()

    def update(self, now_ns: int, arm: ArmGuard, *, silent: bool = False) -> None:
        """Accept or reject the commands that arrived; `now_ns` (wall clock) says their age.

        One whose writer is not that of the arm is rejected, and all to a robot that is `silent`:
        whoever is heard next must not get them.
        """
        for arrival in self._commands.drain():
            command = self._node.decode(GripperCommand, arrival)
            if command is None:
                continue
            guard, why = self._guard, self._driver.profile.robot.no_gripper
            if guard is None or (why := self._driver.no_gripper):
                self._node.reject("no_gripper", f"command/gripper: {why}")
                continue
            if silent:
                self._node.reject("robot_silent", f"command/gripper: {self._driver.silent_why}")
                continue
            try:
                accepted = guard.accept(
                    command,
                    arm.writer,
                    0 if self._driver.lockstep else now_ns,  # in lockstep a command has no age
                    writer_active=arm.writer_active,
                )
            except CodecError as error:
                self._node.reject(error.reason, f"command/gripper {error}")
                continue
            self._node.counters["gripper_bounded"] = guard.bounded
            self._driver.grip(accepted, now_ns)
