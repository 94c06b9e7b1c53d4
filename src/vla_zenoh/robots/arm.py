"""An arm of a robot node: command stream and gripper commands in, states out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from vla_zenoh.bus.buffers import CallbackRing
from vla_zenoh.bus.node import Node, Publisher, publish_together
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.errors import CodecError
from vla_zenoh.guard.arm_guard import ArmGuard, Measured
from vla_zenoh.guard.gripper_guard import GripperGuard
from vla_zenoh.keys import Kind
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.robots.command_follower import CommandFollower
from vla_zenoh.robots.driver import Measurement, RobotDriver
from vla_zenoh.types import Event, GripperCommand, GripperState

NOT_READY = ("braking", "stalled", "unheeded")
"""States of a healthy robot that is not ready for commands; its gripper state reports them too."""
FAULT_AGAIN_NS = 100_000_000
"""A fault without measurements is published again after this, for late subscribers."""


class Arm:
    """Runs one arm through its driver, tick by tick; its `follower` follows the command streams."""

    def __init__(self, node: Node, driver: RobotDriver) -> None:
        self._node, self._driver, profile = node, driver, driver.profile
        self.follower = CommandFollower(node, driver)
        self._gripper_commands = GripperCommands(node, driver)
        keys = profile.keys
        self._joint_out = node.declare_publisher(keys.state_joint, Kind.STATE)
        self._pose_out = node.declare_publisher(keys.state_pose, Kind.STATE)
        self._gripper_out = node.declare_publisher(keys.state_gripper, Kind.STATE)
        # A little less than the period: readings come at multiples of another one.
        self._period_ns = 0.9e9 / profile.timing.state_hz
        self._seq = self._published_ns = self._mono_ns = 0
        self._gripper = GripperState(profile.robot.gripper.max_width_m, False, False)
        self._published_fault = self._was = ""

    # -- one tick -----------------------------------------------------------------------------
    def step(self, now_ns: int, mono_ns: int, stall_s: float) -> None:
        """Run one tick; see `begin_step`."""
        self.begin_step(now_ns, mono_ns, stall_s)
        self.end_step(mono_ns)

    def begin_step(
        self, now_ns: int, mono_ns: int, stall_s: float, *, reading: bool = True
    ) -> None:
        """Read a real robot, and move it or a simulated one.

        Args:
            now_ns: wall clock, for stamps.
            mono_ns: the same time on the monotonic clock.
            stall_s: how late the tick is.
            reading: False: only move it, to bring the arm to rest.
        """
        self._mono_ns = mono_ns
        self.follower.begin(mono_ns, stall_s)
        if reading and not self._driver.simulated:
            self._read(mono_ns)
        self.follower.update(now_ns, mono_ns, away=self._driver.away, silent=self._silent)
        if self.follower.accepting:
            self._gripper_commands.update(now_ns, self.follower.guard)

    def end_step(self, mono_ns: int) -> None:
        """Read a simulated robot once all its parts have been moved: their commands act at once."""
        if self._driver.simulated:
            self._read(mono_ns)

    def _read(self, mono_ns: int) -> None:
        measurement = self._driver.read(mono_ns)
        if measurement is not None:
            joints, self._gripper = measurement.joints, measurement.gripper or self._gripper
            self.follower.on_measured(
                Measured(measurement.tcp, joints.position_rad, joints.velocity_rad_s)
            )
        self.publish(measurement, mono_ns)

    # -- states out ---------------------------------------------------------------------------
    def publish(self, measurement: Measurement | None, mono_ns: int) -> None:
        """Publish a measurement when it is due; a fault, and its end, at once.

        The gripper state carries the fault, even without a valid measurement.
        """
        fault_changed = self._driver.fault != self._published_fault
        elapsed_ns = mono_ns - self._published_ns
        if measurement is None:
            if fault_changed or (self._driver.fault and elapsed_ns >= FAULT_AGAIN_NS):
                stamp_ns = mono_ns if self._driver.lockstep else self._node.clock.wall_at(mono_ns)
                self._publish(stamp_ns, mono_ns, self._gripper)
            return
        if not fault_changed and elapsed_ns < self._period_ns:
            return
        joints, pose, stamp_ns = measurement.joints, measurement.pose, measurement.stamp_ns
        tcp, held_rad = self.follower.held()
        if tcp is not None:
            pose = replace(
                pose,
                reference_position_m=tcp.position_m,
                reference_quat_xyzw=quat_from_rotation(tcp.rotation),
            )
        if held_rad is not None:
            joints = replace(joints, reference_rad=held_rad)
        states = (self._joint_out, joints), (self._pose_out, pose)
        self._publish(stamp_ns, mono_ns, measurement.gripper, *states)

    def _publish(
        self,
        stamp_ns: int,
        mono_ns: int,
        gripper: GripperState | None,
        *states: tuple[Publisher, Any],
    ) -> None:
        """Publish states of one time, that of the gripper with fault and mode among them."""
        fault, state = self._driver.fault, self.state
        if gripper is not None:
            mode = state if state in NOT_READY else self._driver.gripper_mode
            gripper = replace(gripper, mode=mode, faults=(fault,) if fault else ())
            states = *states, (self._gripper_out, gripper)
        publish_together(stamp_ns, self._seq, *states)
        self._seq += 1
        self._published_ns, self._published_fault = mono_ns, fault

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
        if self.follower.guard.braking:
            return "braking"
        if self.follower.stalled:
            return "stalled"
        return "unheeded" if self.follower.guard.unheeded else "running"

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
                f"the loop stood still for {self.follower.stall_s:.3f} s while it moved the arm; "
                f"the motion is not resumed{self._driver.stalled_hint}"
            )
        timeout_s = self._driver.profile.timing.command_timeout_s
        return {
            "fault": self._driver.fault,
            "silent": self._driver.silent_why,
            "braking": f"no command/{self.follower.guard.mode} for {timeout_s:g} s "
            "while the arm moved",
            "unheeded": "command stream rejected: its first set-point does not match the arm's "
            "current pose, or its beginning was lost",
        }.get(state, "")


class GripperCommands:
    """Gripper commands of the arm's writer, from the bus to the driver."""

    def __init__(self, node: Node, driver: RobotDriver) -> None:
        self._node, self._driver = node, driver
        key = driver.profile.keys.command_gripper
        self._commands = node.subscribe(key, CallbackRing(16, SMALL_BYTES))
        self._guard = GripperGuard(driver.profile.robot.gripper)

    def update(self, now_ns: int, arm: ArmGuard) -> None:
        """Accept or reject the commands that arrived; `now_ns` (wall clock) says their age.

        One whose writer is not that of the arm is rejected.
        """
        for arrival in self._commands.drain():
            command = self._node.decode(GripperCommand, arrival)
            if command is None:
                continue
            if self._driver.no_gripper:
                self._node.reject("no_gripper", f"command/gripper: {self._driver.no_gripper}")
                continue
            try:
                accepted = self._guard.accept(
                    command,
                    arm.writer,
                    0 if self._driver.lockstep else now_ns,  # in lockstep a command has no age
                    writer_active=arm.writer_active,
                )
            except CodecError as error:
                self._node.reject(error.reason, f"command/gripper {error}")
                continue
            self._node.counters["gripper_bounded"] = self._guard.bounded
            self._driver.grip(accepted, now_ns)
