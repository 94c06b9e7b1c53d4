"""Guard of one arm that is commanded by TCP poses or by joint positions, one stream at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from vla_zenoh.control.smoothing import ROTATION_BOX
from vla_zenoh.control.states import OBEYING
from vla_zenoh.guard.joint_guard import JointGuard, joint_guard_limits, joint_motion_limits
from vla_zenoh.guard.pose_guard import PoseGuard, guard_limits
from vla_zenoh.guard.reference_governor import BRAKE_MARGIN
from vla_zenoh.guard.stream_guard import ACCELERATE_S
from vla_zenoh.kinematics.so3 import Pose, pose_distance
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, JointCommand, PoseCommand, Stamped
from vla_zenoh.types.commands import JointReference, PoseReference

STANDING_RAD_S = 0.02
"""An arm of which no joint is faster stands: its law may be exchanged."""

UNHEEDED = frozenset({"jump", "too_fast", "out_of_range", "names", "moving", "other_mode"})
"""Why a stream is not followed although nobody else's is: who writes it has to hear of it."""
UNHEEDED_NS = 200_000_000
"""For so long it is said after the last such refusal."""
LEADING = frozenset(state.value for state in OBEYING)
"""Who commands in another state brakes or stands already, and waits for nothing."""

Mode = Literal["pose", "joint"]


class Measured(NamedTuple):
    """Where the arm is.

    Args:
        pose: of the TCP.
        position_rad: (n,).
        velocity_rad_s: (n,).
    """

    pose: Pose
    position_rad: FloatArray
    velocity_rad_s: FloatArray


class ArmGuard:
    """Follows one stream; the other may begin when nobody is followed and the arm stands.

    It begins where the arm was measured, not where the last reference was: the change itself moves
    nothing.

    Args:
        poses: guard of the pose stream.
        joints: guard of the joint stream.
        measure: where the arm is now.
        mode: which of them holds the arm at first.
    """

    def __init__(
        self,
        poses: PoseGuard,
        joints: JointGuard,
        measure: Callable[[], Measured],
        mode: Mode = "pose",
    ) -> None:
        self._poses, self._joints = poses, joints
        self._measure = measure
        self._writer = self._state = ""
        self._unheeded_until_ns = 0
        self._now_ns = 0
        self.mode: Mode = mode

    @property
    def _in_charge(self) -> PoseGuard | JointGuard:
        return self._poses if self.mode == "pose" else self._joints

    @property
    def following(self) -> bool:
        """A command stream is being followed."""
        return self._in_charge.following

    @property
    def moving(self) -> bool:
        """A stream is being followed, or what was followed last is still brought to rest."""
        return self._in_charge.moving

    @property
    def writer(self) -> str:
        """Source of the stream that is being followed, empty where none is."""
        return self._writer if self.following else ""

    @property
    def writer_active(self) -> bool:
        """Who is followed carries out what it is told; after a stop, for one, it only brakes."""
        return self.following and self._state in LEADING

    @property
    def braking(self) -> bool:
        """The stream fell silent in motion."""
        return self._in_charge.braking

    @property
    def unheeded(self) -> bool:
        """Somebody leads an arm that follows nobody, and is not obeyed.

        Who writes that stream cannot see it by the arm, which may stand when a motion begins.
        """
        if self.following or self.braking:
            return False
        return 0 < self._unheeded_until_ns - self._now_ns <= UNHEEDED_NS

    @property
    def silences(self) -> int:
        """How often a stream fell silent in motion."""
        return self._poses.silences + self._joints.silences

    @property
    def reference(self) -> PoseReference | JointReference:
        """What the arm holds now."""
        if self.mode == "joint":
            return self._joints.motion
        motion = self._poses.motion
        return PoseReference(
            motion.pose.position_m, motion.pose.rotation, motion.twist, motion.acceleration
        )

    def offer_pose(self, command: Stamped[PoseCommand], now_ns: int) -> str | None:
        """Take a pose, or say in one word why not.

        Returns:
            None, ``other_mode`` (joints are followed), ``moving`` (the arm does, so that its law
            cannot be exchanged), or what `PoseGuard.offer` says.
        """
        reason = self._offer_pose(command, now_ns)
        self._note(reason, command.record.state, now_ns)
        return reason

    def _offer_pose(self, command: Stamped[PoseCommand], now_ns: int) -> str | None:
        if self.mode != "pose":
            if self.following or self.braking:
                return "other_mode"
            measured = self._measure()
            if _moves(measured):
                return "moving"
            self._poses.anchor(measured.pose)
        reason = self._poses.offer(command, now_ns)
        if reason is None:
            self.mode, self._writer = "pose", command.header.source
            self._state = command.record.state
        return reason

    def offer_joint(self, command: Stamped[JointCommand], now_ns: int) -> str | None:
        """Take joint positions, or say in one word why not.

        Returns:
            None, ``other_mode`` (poses are followed), ``moving``, or what `JointGuard.offer` says.
        """
        reason = self._offer_joint(command, now_ns)
        self._note(reason, command.record.state, now_ns)
        return reason

    def _offer_joint(self, command: Stamped[JointCommand], now_ns: int) -> str | None:
        if self.mode != "joint":
            if self.following or self.braking:
                return "other_mode"
            measured = self._measure()
            if _moves(measured):
                return "moving"
            self._joints.anchor(measured.position_rad)
        reason = self._joints.offer(command, now_ns)
        if reason is None:
            self.mode, self._writer = "joint", command.header.source
            self._state = command.record.state
        return reason

    def _note(self, reason: str | None, state: str, now_ns: int) -> None:
        # While somebody is followed a stranger's word changes nothing.
        if reason in UNHEEDED and state in LEADING and not (self.following or self.braking):
            self._unheeded_until_ns = now_ns + UNHEEDED_NS

    def tick(self, now_ns: int) -> PoseReference | JointReference:
        """What the arm has to hold at `now_ns`."""
        self._now_ns = now_ns
        self._in_charge.tick(now_ns)
        return self.reference

    def anchor(self) -> None:
        """Somebody else moved the arm; follow nobody and stand. Commands heard stay heard."""
        measured = self._measure()
        self._poses.anchor(measured.pose)
        self._joints.anchor(measured.position_rad)

    def hold(self) -> None:
        """Follow nobody and stand where the reference is: the arm stopped there by itself."""
        self._in_charge.hold()

    def reset(self) -> None:
        """The robot was put elsewhere; follow nobody and stand there."""
        measured = self._measure()
        self._poses.reset(measured.pose)
        self._joints.reset(measured.position_rad)


def make_arm_guard(
    profile: Profile,
    measure: Callable[[], Measured],
    joint_range_rad: tuple[FloatArray, FloatArray],
    dt_s: float,
) -> ArmGuard:
    """The guard of a profile's robot, standing where the arm stands.

    Args:
        profile: limits, timing, and which stream holds the arm at first.
        measure: where the arm is now.
        joint_range_rad: lower and upper ends of the joints, (n,) each.
        dt_s: time between two ticks.
    """
    here = measure()
    return ArmGuard(
        PoseGuard(here.pose, dt_s, guard_limits(profile)),
        JointGuard(
            profile.robot.arm_joints,
            here.position_rad,
            dt_s,
            joint_guard_limits(profile, *joint_range_rad),
        ),
        measure,
        profile.robot.command,
    )


def _moves(measured: Measured) -> bool:
    return float(np.abs(measured.velocity_rad_s).max()) > STANDING_RAD_S


SETTLE_NS = 500_000_000
"""After the last command the arm comes to rest within this time."""
MOVED_M, MOVED_RAD = 0.005, 0.02
"""An arm at rest that is moved by more than this, TCP or any joint, is moved by somebody else: its
elbow may be, while the TCP stays."""


class HeldReference:
    """Remembers whether the last command sent still counts.

    A controller goes on holding what it was sent last, some way from where the arm is measured; the
    next stream has to begin there. When somebody else moves the arm that is no longer so. Times are
    of the monotonic clock.
    """

    def __init__(self) -> None:
        self._sent_ns: int | None = None
        self._settled: Measured | None = None

    @property
    def held(self) -> bool:
        """What was sent last is what the controller holds."""
        return self._sent_ns is not None

    def on_sent(self, now_ns: int) -> None:
        """A command was sent."""
        self._sent_ns, self._settled = now_ns, None

    def invalidate(self) -> None:
        """Nobody knows what became of the last commands: the robot is not heard."""
        self._sent_ns = self._settled = None

    def update(self, measured: Measured, now_ns: int) -> bool:
        """Whether `held` still; call it while nothing is sent."""
        if self._sent_ns is None or now_ns - self._sent_ns < SETTLE_NS:
            return self.held
        if self._settled is None:
            self._settled = measured
        apart_m, apart_rad = pose_distance(self._settled.pose, measured.pose)
        turned_rad = float(np.abs(measured.position_rad - self._settled.position_rad).max())
        if apart_m > MOVED_M or max(apart_rad, turned_rad) > MOVED_RAD:
            self.invalidate()
        return self.held


def max_braking_time_s(profile: Profile) -> float:
    """From the last command until the arm stands, whatever motion the robot's side followed.

    That may be faster than the profile's limits, by `BRAKE_MARGIN`, and still be gaining speed.
    """
    if profile.robot.command == "joint":
        limits = joint_motion_limits(profile, BRAKE_MARGIN)
        stops_s = [_stop_s(*map(float, axis), share=1.0) for axis in zip(*limits, strict=True)]
    else:
        brake = guard_limits(profile).brake
        stops_s = [
            _stop_s(*brake.translation, share=1.0),
            _stop_s(*brake.rotation, share=ROTATION_BOX),
        ]
    return profile.timing.command_timeout_s + max(stops_s)


def _stop_s(velocity: float, acceleration: float, jerk: float, share: float) -> float:
    """Of one axis that moves at both limits, by this share of acceleration and jerk.

    The acceleration fades first, and is believed for a while before; then the axis slows down: by a
    trapezoid of acceleration, than which the triangle of a short stop is shorter.
    """
    most, change = share * acceleration, share * jerk
    fades_s = acceleration / change
    reached = velocity + acceleration * (ACCELERATE_S + 0.5 * fades_s)
    return fades_s + reached / most + most / change
