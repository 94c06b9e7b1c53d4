"""Follows a command stream: subscribes to it, guards it, and moves the driver along it.

When the stream falls silent in motion, the guard brakes the arm. Then a real robot is sent nothing
more: its controller holds the last set-point, until the driver reports that it is idle.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample
from vla_zenoh.bus.node import Node
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.guard.arm_guard import SETTLE_NS, HeldReference, Measured, make_arm_guard
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.robots.driver import RobotDriver
from vla_zenoh.types import FloatArray, JointCommand, PoseCommand
from vla_zenoh.types.commands import JointReference

BUFFER = 64
STALLED_NS = 500_000_000
"""After a stall commands are rejected and the robot is not ready for this long: what was sent
during the stall is still arriving, and its writer has to notice and brake."""


class CommandFollower:
    """Moves a robot along the command streams of its profile.

    Args:
        node: on the bus; its counters get the rejections.
        driver: of the robot.

    Attributes:
        guard: of the streams; it follows none before the first measurement.
        stall_s: duration of the last stall.
        stalls: number of stalls of the loop while it moved the arm.
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
        nowhere = np.zeros(len(profile.robot.arm_joints))
        self._unknown = Measured(Pose(np.zeros(3), np.eye(3)), nowhere, nowhere)
        self._measured = driver.state_now()
        self.guard = make_arm_guard(
            profile, self._state_now, driver.joint_range_rad, driver.period_s
        )
        self._hold = HeldReference()
        self._timeout_s = profile.timing.command_timeout_s
        self._stalled_until_ns = 0
        self._resting = False
        """The robot must be sent its last set-point at rest: it may have kept a velocity."""
        self.stall_s, self.stalls = 0.0, 0
        self.accepting = True

    # -- one tick -----------------------------------------------------------------------------
    def on_measured(self, measured: Measured) -> None:
        """Update the state of the arm; needed once before a stream can be followed."""
        first = self._measured is None
        self._measured = measured
        if first:
            self.guard.anchor()

    def _state_now(self) -> Measured:
        return self._driver.state_now() or self._measured or self._unknown

    def begin(self, mono_ns: int, stall_s: float) -> None:
        """Begin a tick.

        Args:
            mono_ns: on the monotonic clock.
            stall_s: how late the tick is. After a long stall the robot is held at its last
                set-point, and motion resumes from there, at rest.
        """
        if stall_s <= self._timeout_s:
            if mono_ns >= self._stalled_until_ns:
                self._stalled_until_ns = 0
            return
        brief = stall_s * 1e9 <= SETTLE_NS
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

    def update(self, now_ns: int, mono_ns: int, *, away: str = "", silent: bool = False) -> None:
        """Accept or reject the commands that arrived, and move the robot.

        Args:
            now_ns: wall clock.
            mono_ns: the same time on the monotonic clock.
            away: reason to reject commands, one word, while the robot cannot be moved.
            silent: the robot's state is not known.
        """
        if self._driver.idle and not self.guard.moving:
            self._hold.invalidate()
            self._resting = False
        reason = away or ("stalled" if self.stalled else "")
        for mode, buffer in self._streams:
            for arrival in buffer.drain():
                if self._measured is None or not self.accepting:
                    continue
                if reason:
                    self._reject(mode, reason)
                else:
                    self._offer(mode, arrival, mono_ns)
        if self._measured is not None:
            self._lead(self._measured, now_ns, mono_ns, away)
        if silent or away:
            self._hold.invalidate()

    def _offer(self, mode: str, arrival: ReceivedSample, mono_ns: int) -> None:
        guard = self.guard
        if not (guard.following or guard.braking or self.holds):
            guard.anchor()  # no controller holds our set-point: begin where the arm is
        kind: Any = JointCommand if mode == "joint" else PoseCommand
        offer = guard.offer_joint if mode == "joint" else guard.offer_pose
        command = self._node.decode(kind, arrival)
        if command is None:
            return
        # Silence is measured on the clock of the ticks.
        received_ns = mono_ns if self._driver.lockstep else arrival.mono_ns
        rejected = offer(replace(command, received_ns=received_ns), mono_ns)
        if rejected:
            self._reject(mode, rejected, f" by {command.header.source[:60]!r}")

    def _reject(self, mode: str, reason: str, by: str = "") -> None:
        self._node.reject(f"{mode}_{reason}", f"command/{mode}{by}: {reason}")

    def _lead(self, measured: Measured, now_ns: int, mono_ns: int, away: str) -> None:
        guard = self.guard
        if self._driver.simulated:
            self._driver.move(guard.tick(mono_ns), now_ns)
            return
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

    @property
    def stalled(self) -> bool:
        """The loop stalled a moment ago, while it moved the arm."""
        return self._stalled_until_ns > 0

    @property
    def holds(self) -> bool:
        """The robot's controller holds the last set-point."""
        return self._hold.held or self._driver.simulated

    def held(self) -> tuple[Pose | None, FloatArray | None]:
        """Set-point that a real robot's controller holds: TCP pose, (n,) joints in joint mode.

        None where it is unknown: nothing was sent, or the arm was moved by other means.
        """
        if not self._hold.held or self._driver.simulated:
            return None, None
        reference = self.guard.reference
        if isinstance(reference, JointReference):
            return self._driver.forward(reference.position_rad), reference.position_rad
        return Pose(reference.position_m, reference.rotation), None
