"""Guards of one arm, commanded by TCP poses or joint positions, and of its gripper."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.control.limits import ROTATION_BOX, JointMotionLimits, joint_motion_limits
from vla_zenoh.control.states import OBEYING
from vla_zenoh.errors import CodecError
from vla_zenoh.guard.reference_governor import BRAKE_MARGIN
from vla_zenoh.guard.stream_guard import (
    ACCELERATE_S,
    JointGuard,
    PoseGuard,
    pose_brake_limits,
)
from vla_zenoh.kinematics.so3 import Pose, pose_distance
from vla_zenoh.profile import GripperProfile, Profile
from vla_zenoh.types import (
    STANDING,
    FloatArray,
    GripperCommand,
    JointBound,
    JointCommand,
    PoseCommand,
    Stamped,
)
from vla_zenoh.types.records import JointReference, PoseReference
from vla_zenoh.types.stream import SingleWriterFilter

UNHEEDED = frozenset({"jump", "too_fast", "out_of_range", "names", "moving", "other_mode"})
"""Reasons for which a stream is rejected although no other is followed: its writer must know."""
UNHEEDED_NS = 200_000_000
"""The arm reports this for this long after the last such rejection."""
ACTIVE_STATES = frozenset(state.value for state in OBEYING)
"""States in which a command node drives the arm; in any other it brakes or stands."""
ARM_SETTLES_NS = 500_000_000
"""After the last command the arm comes to rest within this time."""
MOVED_M, MOVED_RAD = 0.005, 0.02
MOVED_JOINT = JointBound(MOVED_RAD, MOVED_M)
"""An arm at rest that moves further than this, TCP or any joint, is moved by something else; its
elbow may move while the TCP stays."""

OLDEST_NS = 1_000_000_000
"""An older command is rejected: its source may have died or stopped the arm while the command
waited on a stuck link or in a suspended process."""
MAX_SOURCES = 64
"""Sources whose last sequence number is remembered; each start of a command node is one."""

CommandKind = Literal["pose", "joint"]


class Measured(NamedTuple):
    """Measured state of the arm: pose of the TCP, and position and velocity (n,) of the joints."""

    pose: Pose
    position_rad: FloatArray
    velocity_rad_s: FloatArray

    def at(self, kind: CommandKind) -> Any:
        """The pose or the joint positions."""
        return self.pose if kind == "pose" else self.position_rad


class ArmGuard:
    """Follows one of two streams; the other may begin once none is followed and the arm stands.

    The new stream begins where the arm is measured, not at the last reference, so the change itself
    moves nothing. At first the stream that the profile commands holds the arm where it stands.

    Args:
        profile: of the robot.
        measure: reads the state of the arm.
        joint_range_rad: lower and upper ends of the joint ranges, (n,) each.
        joint_velocity_rad_s: (n,) that the robot allows, whatever the profile says.
        slides: (n,) joints that slide.
        dt_s: period of the controller.
    """

    def __init__(
        self,
        profile: Profile,
        measure: Callable[[], Measured],
        joint_range_rad: tuple[FloatArray, FloatArray],
        joint_velocity_rad_s: FloatArray,
        slides: NDArray[np.bool_],
        dt_s: float,
    ) -> None:
        robot, timeout_s, here = profile.robot, profile.timing.command_timeout_s, measure()
        velocity, acceleration, jerk = joint_motion_limits(profile, BRAKE_MARGIN)
        velocity = np.minimum(velocity, BRAKE_MARGIN * joint_velocity_rad_s)
        brake = JointMotionLimits(velocity, acceleration, jerk)
        self._guards: dict[CommandKind, PoseGuard | JointGuard] = {
            "pose": PoseGuard(here.pose, dt_s, timeout_s, pose_brake_limits(profile)),
            "joint": JointGuard(
                robot.arm_joints, here.position_rad, dt_s, timeout_s, brake, joint_range_rad, slides
            ),
        }
        self._measure, self._standing = measure, STANDING.of(slides)
        self._writer = self._state = ""
        self._unheeded_until_ns = self._now_ns = 0
        self.kind: CommandKind = robot.command

    @property
    def _active(self) -> PoseGuard | JointGuard:
        return self._guards[self.kind]

    @property
    def following(self) -> bool:
        return self._active.following

    @property
    def moving(self) -> bool:
        """A stream is followed, or the last one is still being brought to rest."""
        return self._active.moving

    @property
    def at_rest(self) -> bool:
        """The reference stands, and the followed stream, if there is one, does too."""
        return self._active.at_rest

    @property
    def writer(self) -> str:
        """Source of the stream that is being followed, empty if none is."""
        return self._writer if self.following else ""

    @property
    def writer_active(self) -> bool:
        """The followed source is active; after a stop, for example, it only brakes."""
        return self.following and self._state in ACTIVE_STATES

    @property
    def braking(self) -> bool:
        return self._active.braking

    @property
    def unheeded(self) -> bool:
        """No stream is followed, and that of an active source is rejected.

        Its writer cannot see that from the arm, which may well stand when a motion begins.
        """
        if self.following or self.braking:
            return False
        return 0 < self._unheeded_until_ns - self._now_ns <= UNHEEDED_NS

    @property
    def silences(self) -> int:
        """Number of times a stream fell silent in motion."""
        return sum(guard.silences for guard in self._guards.values())

    @property
    def reference(self) -> PoseReference | JointReference:
        """The set-point now."""
        motion = self._active.motion
        if isinstance(motion, JointReference):
            return motion
        return PoseReference(*motion.pose, motion.twist, motion.acceleration)

    def offer(
        self, command: Stamped[PoseCommand] | Stamped[JointCommand], now_ns: int
    ) -> str | None:
        """Accept a command, or return the reason why it is rejected.

        That is ``inactive`` (no stream begins in a state in which its writer brakes or stands),
        ``other_mode`` (the other stream is followed), ``moving`` (the arm moves, so its control law
        cannot be exchanged), or what `StreamGuard.offer` returns.
        """
        kind: CommandKind = "joint" if isinstance(command.record, JointCommand) else "pose"
        state = command.record.state
        if not (self.following or self.braking or state in ACTIVE_STATES):
            # The end of a stream to a robot node that was restarted, or that had been silent.
            return "inactive"
        reason = self._change(kind) or self._guards[kind].offer(command, now_ns)
        if reason is None:
            self.kind, self._writer, self._state = kind, command.header.source, state
        elif reason in UNHEEDED and state in ACTIVE_STATES and not (self.following or self.braking):
            self._unheeded_until_ns = now_ns + UNHEEDED_NS
        return reason

    def _change(self, kind: CommandKind) -> str | None:
        """Prepare the guard of `kind` for a stream, or the reason against a change."""
        if kind == self.kind:
            return None
        if self.following or self.braking:
            return "other_mode"
        measured = self._measure()
        if (np.abs(measured.velocity_rad_s) > self._standing).any():
            return "moving"
        self._guards[kind].anchor(measured.at(kind))
        return None

    def tick(self, now_ns: int, dt_s: float | None = None) -> PoseReference | JointReference:
        """The reference to follow at `now_ns`, `dt_s` after the last tick; None: one period."""
        self._now_ns = now_ns
        self._active.tick(now_ns, dt_s)
        return self.reference

    def anchor(self) -> None:
        """Follow no stream and hold the measured place: the arm was moved by other means.

        Commands received before are still replays.
        """
        measured = self._measure()
        for kind, guard in self._guards.items():
            guard.anchor(measured.at(kind))

    def hold(self) -> None:
        """Follow no stream and hold the reference: the arm stopped there by itself."""
        self._active.hold()

    def stop(self) -> None:
        """Follow no stream, and brake to rest."""
        self._active.stop()

    def reset(self) -> None:
        """Follow no stream, forget the last, and hold the measured place: the robot was reset."""
        measured = self._measure()
        for kind, guard in self._guards.items():
            guard.reset(measured.at(kind))


class HeldReference:
    """Whether the robot's own controller still holds the last command it was sent.

    A controller keeps holding it, some distance from the measured arm, and the next stream must
    begin there. It no longer counts once something else moves the arm. Times are of the monotonic
    clock; of the joints, those slide that are true in `slides` (n,).
    """

    def __init__(self, slides: NDArray[np.bool_]) -> None:
        self._most = MOVED_JOINT.of(slides)
        self._sent_ns: int | None = None
        self._settled: Measured | None = None

    @property
    def held(self) -> bool:
        return self._sent_ns is not None

    def on_sent(self, now_ns: int) -> None:
        self._sent_ns, self._settled = now_ns, None

    def invalidate(self) -> None:
        """Note that the fate of the last commands is unknown: no states are received."""
        self._sent_ns = self._settled = None

    def update(self, measured: Measured, now_ns: int) -> bool:
        """Whether `held` is still true; call it while nothing is sent."""
        if self._sent_ns is None or now_ns - self._sent_ns < ARM_SETTLES_NS:
            return self.held
        if self._settled is None:
            self._settled = measured
        apart_m, apart_rad = pose_distance(self._settled.pose, measured.pose)
        ways = np.abs(measured.position_rad - self._settled.position_rad)
        if apart_m > MOVED_M or apart_rad > MOVED_RAD or (ways > self._most).any():
            self.invalidate()
        return self.held


class GripperGuard:
    """Checks commands between the bus and a gripper, and clamps them to the limits of its profile.

    Gripper commands are rare, so silence of their writer means nothing: a replay is rejected
    however much later it comes. `bounded` counts the commands that were clamped.
    """

    def __init__(self, profile: GripperProfile) -> None:
        self._profile = profile
        self._filter = SingleWriterFilter(sources=MAX_SOURCES)
        self.bounded = 0

    def accept(
        self, order: Stamped[GripperCommand], writer: str, now_ns: int, *, writer_active: bool
    ) -> GripperCommand:
        """The command to execute, within the limits of the profile.

        Args:
            order: as received.
            writer: source of the command stream that the arm follows, empty if it follows none.
            now_ns: wall clock, as in the header.
            writer_active: that source is active, see `ArmGuard.writer_active`.

        Raises:
            CodecError: ``foreign`` (another source moves the arm), ``replayed``, ``stale``, or
                ``outlived`` (its source was stopped in the meantime).
        """
        self._filter.check(order.header, writer=writer)
        self._filter.accept(order.header)
        age_ns = now_ns - order.header.stamp_wall_ns
        if age_ns > OLDEST_NS:
            raise CodecError("stale", f"is {age_ns / 1e9:.1f} s old")
        if writer and not writer_active:
            raise CodecError("outlived", "its source has been stopped")
        command, limits = order.record, self._profile
        clamped = GripperCommand(
            min(command.width_m, limits.max_width_m),
            min(command.speed_m_s, limits.speed_m_s),
            min(command.force_n, limits.force_n),
        )
        self.bounded += clamped != command
        return clamped


def max_braking_time_s(profile: Profile) -> float:
    """Longest time from the last command until the arm stands.

    The robot's side may follow a stream that is `BRAKE_MARGIN` times faster than the profile's
    limits, and still accelerating.
    """
    if profile.robot.command == "joint":
        limits = joint_motion_limits(profile, BRAKE_MARGIN)
        stops_s = [_stop_s(*axis, share=1.0) for axis in zip(*limits, strict=True)]
    else:
        translation, rotation = pose_brake_limits(profile)
        stops_s = [_stop_s(*translation, share=1.0), _stop_s(*rotation, share=ROTATION_BOX)]
    return profile.timing.command_timeout_s + float(max(stops_s))


def _stop_s(velocity: float, acceleration: float, jerk: float, share: float) -> float:
    """Stopping time of one axis at both limits, with this share of acceleration and jerk.

    First the acceleration is extrapolated and fades; then the axis slows down by a trapezoid of
    acceleration, which takes longer than the triangle of a short stop.
    """
    most, change = share * acceleration, share * jerk
    fades_s = acceleration / change
    reached = velocity + acceleration * (ACCELERATE_S + 0.5 * fades_s)
    return fades_s + reached / most + most / change
