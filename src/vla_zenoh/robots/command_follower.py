"""Follows a command stream: subscribes to it, guards it, and moves the driver along it.

When the stream falls silent in motion, the guard brakes the arm. Then a real robot is sent nothing
more: its controller holds the last set-point, until the driver reports that it is idle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample
from vla_zenoh.bus.node import Node
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.guard.arm_guard import SETTLE_NS, ArmGuard, HeldReference, Measured, make_arm_guard
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, JointCommand, PoseCommand
from vla_zenoh.types.commands import JointReference, PoseReference

BUFFER = 64
STALLED_NS = 500_000_000
"""After a stall commands are rejected and the robot is not ready for this long: what was sent
during the stall is still arriving, and its writer has to notice and brake."""


class FollowingRobot(Protocol):
    """The part of a `vla_zenoh.robots.driver.RobotDriver` that a follower uses."""

    modes: tuple[str, ...]
    period_s: float
    simulated: bool
    lockstep: bool
    idle: bool

    @property
    def joint_range_rad(self) -> tuple[FloatArray, FloatArray]: ...
    def state_now(self) -> Measured | None: ...
    def forward(self, position_rad: FloatArray) -> Pose: ...
    def move(self, reference: PoseReference | JointReference, now_ns: int) -> None: ...


class CommandFollower:
    """Moves a robot along the command streams of its profile.

    Args:
        node: on the bus; its counters get the rejections.
        driver: of the robot.
        profile: of the robot's part; None: the node's profile.

    Attributes:
        stall_s: duration of the last stall.
        stalls: number of stalls of the loop while it moved the arm.
        accepting: False after `stop_accepting`.
    """

    def __init__(self, node: Node, driver: FollowingRobot, profile: Profile | None = None) -> None:
        self._node, self._driver = node, driver
        self._profile = profile or node.profile
        keys = self._profile.keys
        subscribed = {"pose": keys.command_pose, "joint": keys.command_joint}
        self._streams = [
            (mode, node.subscribe(subscribed[mode], CallbackRing(BUFFER, SMALL_BYTES)))
            for mode in driver.modes
        ]
        self._guard: ArmGuard | None = None
        self._measured: Measured | None = None
        self._hold = HeldReference()
        self._timeout_s = self._profile.timing.command_timeout_s
        self._stalled_until_ns = 0
        self._resting = False
        """The robot must be sent its last set-point at rest: it may have kept a velocity."""
        self.stall_s, self.stalls = 0.0, 0
        self.accepting = True
        if (state := driver.state_now()) is not None:
            self.on_measured(state)

    # -- one tick -----------------------------------------------------------------------------
    def on_measured(self, measured: Measured) -> None:
        """Update the state of the arm; needed once before a stream can be followed."""
        self._measured = measured
        if self._guard is None:
            profile, driver = self._profile, self._driver
            self._guard = make_arm_guard(
                profile, self._state_now, driver.joint_range_rad, driver.period_s
            )

    def _state_now(self) -> Measured:
        state = self._driver.state_now() or self._measured
        assert state is not None
        return state

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
        if self._guard is not None and self.moving:
            self._guard.hold()
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
        guard = self._guard
        if self._driver.idle and not self.moving:
            self._hold.invalidate()
            self._resting = False
        reason = away or ("stalled" if self.stalled else "")
        for mode, buffer in self._streams:
            for arrival in buffer.drain():
                if guard is None or not self.accepting:
                    continue
                if reason:
                    self._reject(mode, reason)
                elif mode == "joint":
                    self._offer(mode, JointCommand, guard.offer_joint, arrival, mono_ns)
                else:
                    self._offer(mode, PoseCommand, guard.offer_pose, arrival, mono_ns)
        if guard is not None and self._measured is not None:
            self._lead(guard, self._measured, now_ns, mono_ns, away)
        if silent or away:
            self._hold.invalidate()

    def _offer(
        self,
        mode: str,
        kind: type,
        offer: Callable[..., str | None],
        arrival: ReceivedSample,
        mono_ns: int,
    ) -> None:
        guard = self._guard
        assert guard is not None
        if not (guard.following or guard.braking or self.holds):
            guard.anchor()  # no controller holds our set-point: begin where the arm is
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

    def _lead(
        self, guard: ArmGuard, measured: Measured, now_ns: int, mono_ns: int, away: str
    ) -> None:
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

    # -- control ------------------------------------------------------------------------------
    def stop_accepting(self) -> None:
        """Ignore all further commands: the guard brakes a motion when its stream times out."""
        self.accepting = False

    def restart(self) -> None:
        """The simulated robot was reset to another pose: follow no stream and stay there."""
        if self._guard is not None:
            self._guard.reset()

    # -- state --------------------------------------------------------------------------------
    @property
    def following(self) -> bool:
        """A command stream is being followed."""
        return self._guard is not None and self._guard.following

    @property
    def braking(self) -> bool:
        """The stream fell silent in motion."""
        return self._guard is not None and self._guard.braking

    @property
    def stalled(self) -> bool:
        """The loop stalled a moment ago, while it moved the arm."""
        return self._stalled_until_ns > 0

    @property
    def unheeded(self) -> bool:
        """Commands arrive and are rejected while no stream is followed; see `ArmGuard.unheeded`."""
        return self._guard is not None and self._guard.unheeded

    @property
    def moving(self) -> bool:
        """A stream is followed, or the last one is being brought to rest."""
        return self._guard is not None and self._guard.moving

    @property
    def mode(self) -> str:
        """Stream that is or was followed last: ``pose`` or ``joint``."""
        return self._profile.robot.command if self._guard is None else self._guard.mode

    @property
    def writer(self) -> str:
        """Source of the command stream that is followed; empty: none."""
        return "" if self._guard is None else self._guard.writer

    @property
    def writer_active(self) -> bool:
        """See `ArmGuard.writer_active`."""
        return self._guard is not None and self._guard.writer_active

    @property
    def silences(self) -> int:
        """How often a stream fell silent in motion."""
        return 0 if self._guard is None else self._guard.silences

    @property
    def holds(self) -> bool:
        """The robot's controller holds the last set-point."""
        return self._hold.held or self._driver.simulated

    @property
    def reference(self) -> PoseReference | JointReference | None:
        """Set-point of the guard, None before the first measurement."""
        return None if self._guard is None else self._guard.reference

    def held(self) -> tuple[Pose | None, FloatArray | None]:
        """Set-point that a real robot's controller holds: TCP pose, (n,) joints in joint mode.

        None where it is unknown: nothing was sent, or the arm was moved by other means.
        """
        reference = self.reference
        if reference is None or not self._hold.held or self._driver.simulated:
            return None, None
        if isinstance(reference, JointReference):
            return self._driver.forward(reference.position_rad), reference.position_rad
        return Pose(reference.position_m, reference.rotation), None
