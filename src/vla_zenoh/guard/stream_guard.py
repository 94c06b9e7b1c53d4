"""Guards of command streams on the robot's side: of TCP poses, and of joint positions.

A guard decides which commands are accepted, what the arm does between two of them, and how it
brakes when the stream falls silent in motion.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.control.limits import (
    BEGIN_JOINT,
    BEGIN_M,
    BEGIN_RAD,
    ROTATION_BOX,
    JointMotionLimits,
    MotionLimits,
    motion_limits,
)
from vla_zenoh.control.smoothing import Motion
from vla_zenoh.guard.reference_governor import (
    AT_REST,
    BRAKE_MARGIN,
    GovernedPath,
    GovernorLimits,
    JointSpace,
    PoseSpace,
    Reference,
    ReferenceGovernor,
    Space,
)
from vla_zenoh.kinematics.so3 import Pose, angle_between, norm3, rotation_from_quat
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
    FloatArray,
    Header,
    JointBound,
    JointCommand,
    JointReference,
    PoseCommand,
    SingleWriterFilter,
    Stamped,
)

CLOCK_DRIFT = 1e-3
"""Share by which two clocks may drift apart; real ones drift by a tenth of that."""
ACCELERATE_S = 0.02
"""A command's acceleration is extrapolated this long; its velocity until the stream times out."""
FADING_S = 0.07
"""The acceleration then fades to zero within this time where there is room for it: motion in vain
has to be undone."""
STILL = 1e-4
"""m/s and rad/s: a stream that ends slower than this has ended on purpose."""

JUMP_M, JUMP_RAD = 0.02, 0.1
JUMP_JOINT = JointBound(0.05, JUMP_M)
"""A command may be this far from the reference in force: TCP, or each joint."""
BEGIN_M_S, BEGIN_RAD_S = 0.03, 0.1
"""The first command of a stream may move this fast, TCP or each joint: our streams begin at rest.
One that goes on after the robot has braked by itself would make it jerk."""
TURN_BESIDE = 0.5
"""Share of a rotation limit for each axis, so that the norm of three stays within it, in an offset
from a motion that rotates as well; in a stop it is `ROTATION_BOX`."""

Command = TypeVar("Command")


class CommandStream(Generic[Command]):
    """Commands of one writer at a time, on the clock of the receiver.

    The stream has ended when it is silent for `timeout_s`.
    """

    def __init__(self, timeout_s: float) -> None:
        self.newest: Stamped[Command] | None = None
        self._timeout_ns = timeout_s * 1e9
        self._filter = SingleWriterFilter()
        self._base_ns = self._delay_ns = self._ticked_ns = 0
        self._has_new = False

    def objection(self, header: Header, received_ns: int) -> str | None:
        """Why a command is rejected: ``foreign``, ``replayed``, ``late``, or None.

        A late command was under way for longer than the stream may be silent: on a link that gets
        ever slower the arm would continue long after the writer has braked.
        """
        reason, newest = self._filter.objection(header), self.newest
        if reason is not None or newest is None:
            return reason
        # Stamps of a stream go back if a clock was set.
        went_back = header.stamp_wall_ns < newest.header.stamp_wall_ns
        waited_ns = self._waited_ns(newest, header, received_ns)
        return "late" if waited_ns >= self._timeout_ns and not went_back else None

    def _waited_ns(self, newest: Stamped[Command], header: Header, received_ns: int) -> int:
        """How much longer than the shortest delay a command was under way."""
        shortest_ns = self._delay_ns + int(CLOCK_DRIFT * (received_ns - newest.received_ns))
        return received_ns - header.stamp_wall_ns - shortest_ns

    def take(self, command: Stamped[Command]) -> None:
        """Follow `command`, which is put on our clock by its stamp, because arrival times jitter.

        The offset of both clocks is the shortest delay seen: a command that was held up on its way
        is not mistaken for one that is meant later.
        """
        header, received_ns = command.header, command.received_ns
        self._base_ns = received_ns
        if self.newest is not None:
            waited_ns = self._waited_ns(self.newest, header, received_ns)
            # Later than a stream may be silent: not a delay, one of the clocks was set.
            if 0 < waited_ns < self._timeout_ns:
                self._base_ns -= waited_ns
        self._delay_ns = self._base_ns - header.stamp_wall_ns
        self._has_new = True
        self.newest = command
        self._filter.accept(header)

    def may_step(self, now_ns: int, dt_s: float) -> bool:
        """Whether the set-point of this tick may differ from what the last tick predicted.

        That is after a new command, or if this tick is not `dt_s` later.
        """
        late_s = (now_ns - self._ticked_ns) / 1e9 - dt_s
        has_new, self._has_new, self._ticked_ns = self._has_new, False, now_ns
        return has_new or abs(late_s) > 0.5 * dt_s

    def live(self, now_ns: int) -> bool:
        """Whether there is a command, and the stream has not timed out."""
        newest = self.newest
        return newest is not None and now_ns - newest.received_ns <= self._timeout_ns

    def ahead_s(self, now_ns: int) -> float:
        """How far `now_ns` is past the time the newest command is meant for.

        The stream is a function of time, so a late command meets the path that its predecessors
        predicted. The only bound is the end of the stream, a timeout after the command arrived: a
        bound met before that would stop the reference in one tick.
        """
        return max((now_ns - self._base_ns) / 1e9, 0.0)

    def end(self) -> None:
        """Follow no source; commands received before are still replays."""
        self.newest = None
        self._filter.release()


class Extrapolation(Generic[Reference]):
    """Motion from one command on, within the limits of the stream: the next may be late or lost.

    For as long as the time between the last two commands the acceleration keeps changing as it did.
    Then it stays until the command is `ACCELERATE_S` old, or less if the motion would get too fast
    or reverse. Then it fades to zero, jerk-limited.

    Args:
        space: of the references.
        command, before: where it begins, and the command before it, `gap_s` earlier, if that
            belongs to the same stream.
        brake: limits of the robot's own stop, `BRAKE_MARGIN` times those of the stream.
    """

    def __init__(
        self,
        space: Space[Reference],
        command: Reference,
        before: Reference | None,
        gap_s: float,
        brake: GovernorLimits,
    ) -> None:
        self._space, self._base = space, space.rest(command)
        _, rate, change = space.speed(command)
        velocity_limit, acceleration_limit, jerk_limit = np.array(brake[:3]) / BRAKE_MARGIN
        jerk = np.zeros(len(rate))
        if before is not None and 0.0 < gap_s <= ACCELERATE_S:
            was = space.apart(before, self._base).change
            # At its limit the acceleration does not grow any further.
            later = _cut(space, 2 * change - was, acceleration_limit)
            jerk = _cut(space, (later - change) / gap_s, jerk_limit)
        else:
            gap_s = 0.0
        self._jerk, self._gap_s = jerk, gap_s
        self._first = GovernedPath(np.zeros(len(rate)), rate, change)
        self._limits = velocity_limit, jerk_limit
        self._still = not (rate.any() or change.any() or jerk.any())

    @cached_property
    def _later(self) -> tuple[GovernedPath, FloatArray, FloatArray, FloatArray]:
        """Motion if the next command does not come: start, steady time, fading time, jerk."""
        velocity_limit, jerk_limit = self._limits
        then = _on(self._first, self._jerk, self._gap_s)
        change, speed = np.maximum(np.abs(then.change), 1e-9), np.abs(then.rate)
        reversing = then.rate * then.change < 0
        # Twice the time the acceleration may last before the motion is too fast or reverses.
        room_s = 2 * np.where(reversing, speed, velocity_limit - speed) / change
        fading_s = np.maximum(np.minimum(room_s, FADING_S), change / jerk_limit)
        fading_s *= np.maximum(self._space.sizes(change / fading_s / jerk_limit), 1.0)
        steady_s = np.clip((room_s - fading_s) / 2, 0.0, ACCELERATE_S - self._gap_s)
        steady_s[self._jerk * then.change < 0] = 0.0
        return then, steady_s, fading_s, -then.change / fading_s

    def at(self, ahead_s: float) -> Reference:
        """The reference `ahead_s` after the command."""
        if self._still:
            return self._base
        if ahead_s <= self._gap_s:
            return self._space.beside(self._base, _on(self._first, self._jerk, ahead_s))
        way, steady_s, fading_s, fade = self._later
        left_s = ahead_s - self._gap_s - steady_s
        way = _on(way, 0.0, np.minimum(left_s, 0.0) + steady_s)
        way = _on(way, fade, np.clip(left_s, 0.0, fading_s))
        left_s = np.maximum(left_s - fading_s, 0.0)
        way.change[left_s > 0.0] = 0.0
        return self._space.beside(self._base, _on(way, 0.0, left_s))


def _cut(space: Space[Reference], values: FloatArray, limits: FloatArray) -> FloatArray:
    return values / np.maximum(space.sizes(values / limits), 1.0)


def _on(way: GovernedPath, jerk: FloatArray | float, time_s: FloatArray | float) -> GovernedPath:
    value, rate, change = way
    later = change + jerk * time_s
    return GovernedPath(
        value + (rate + (2 * change + later) * (time_s / 6)) * time_s,
        rate + (change + later) * (0.5 * time_s),
        later,
    )


class StreamGuard(ABC, Generic[Reference]):
    """Follows a command stream, and brakes by itself when that falls silent in motion.

    A subclass says how a measured place becomes a reference at rest, and which commands it admits.

    Args:
        space: of the references.
        here: where the robot stands.
        dt_s: period of the controller.
        timeout_s: silence after which the stream has ended.
        brake: limits of its own stop, `BRAKE_MARGIN` times those of the stream; faster commands
            are rejected.

    Attributes:
        braking: the stream fell silent in motion, and the reference still moves.
        silences: how often that happened.
    """

    def __init__(
        self,
        space: Space[Reference],
        here: Any,
        dt_s: float,
        timeout_s: float,
        brake: GovernorLimits,
    ) -> None:
        self._space, self._dt_s, self._timeout_s, self._brake = space, dt_s, timeout_s, brake
        self._stream = CommandStream[Reference](timeout_s)
        self._governor = ReferenceGovernor(space, self._standing(here), dt_s, brake)
        self._extrapolation: Extrapolation[Reference] | None = None
        self.braking = False
        self.silences = 0

    @abstractmethod
    def _standing(self, here: Any) -> Reference:
        """The reference of a robot that stands at a measured place."""

    @abstractmethod
    def _admit(self, record: Any) -> Reference | str:
        """The reference of a command, or the reason against it."""

    @property
    def motion(self) -> Reference:
        """The reference now."""
        return self._governor.motion

    @property
    def following(self) -> bool:
        return self._stream.newest is not None

    @property
    def moving(self) -> bool:
        """A stream is followed, or the last one is still being brought to rest."""
        return self.following or not self.at_rest

    @property
    def at_rest(self) -> bool:
        """The reference stands where it is led to, and that does not move."""
        return not self._governor.moving

    @property
    def _expected(self) -> Reference:
        """Where the next command should be: on the stream's path, or where the robot stands."""
        return self._governor.target if self.following else self.motion

    def hold(self) -> None:
        """Follow no stream and hold the reference: the arm stopped there by itself."""
        self._rest_at(self.motion)

    def anchor(self, here: Any) -> None:
        """Follow no stream and hold this measured place: the robot was moved by other means.

        Commands received before are still replays.
        """
        self._rest_at(self._standing(here))

    def stop(self) -> None:
        """Follow no stream, and brake to rest as fast as the limits allow."""
        if self.moving and not self.braking:
            self._stream.end()
            self._governor.stop()
            self.braking = self._governor.moving

    def reset(self, here: Any) -> None:
        """Follow no stream, forget the last one, and hold this place: the robot was reset."""
        self.anchor(here)
        self._stream = CommandStream(self._timeout_s)

    def _rest_at(self, motion: Reference) -> None:
        self._stream.end()
        self.braking = False
        self._governor.put(motion)

    def offer(self, command: Stamped[Any], now_ns: int) -> str | None:
        """Accept a command, or return the reason why it is rejected.

        Returns:
            None, ``foreign``, ``replayed``, ``late``, ``braking``, ``jump``, ``too_fast``, or a
            further reason of the subclass.
        """
        objection = self._stream.objection(command.header, command.received_ns)
        if objection is not None or self.braking:
            return objection or "braking"
        motion = self._admit(command.record)
        if isinstance(motion, str):
            return motion
        before = self._stream.newest
        self._stream.take(Stamped(command.header, motion, command.received_ns))
        gap_s = 0.0
        if before is not None:
            gap_s = (command.header.stamp_wall_ns - before.header.stamp_wall_ns) / 1e9
        self._extrapolation = Extrapolation(
            self._space, motion, before and before.record, gap_s, self._brake
        )
        return None

    def tick(self, now_ns: int, dt_s: float | None = None) -> Reference:
        """The reference to follow at `now_ns`, `dt_s` after the last tick; None: one period."""
        governor = self._governor
        if dt_s is not None:
            self._dt_s = dt_s
            governor.set_period(dt_s)
        if self._stream.live(now_ns) and self._extrapolation is not None:
            steady = not self._stream.may_step(now_ns, self._dt_s)
            governor.follow(self._extrapolation.at(self._stream.ahead_s(now_ns)), steady=steady)
            return governor.motion
        if self._stream.newest is not None:
            self._stream.end()
            if float(np.abs(self._space.speed(governor.target).rate).max()) >= STILL:
                self.silences += 1
                self.braking = True
                governor.stop()
        governor.rest()
        self.braking = self.braking and governor.moving
        return governor.motion


class PoseGuard(StreamGuard[Motion]):
    """Guard of a stream of TCP poses; `pose` is where the robot stands."""

    def __init__(self, pose: Pose, dt_s: float, timeout_s: float, brake: MotionLimits) -> None:
        self._limits = brake
        orders = (np.repeat(pair, 3) for pair in zip(*brake, strict=True))
        shares = (np.repeat([1.0, share], 3) for share in (ROTATION_BOX, TURN_BESIDE))
        super().__init__(PoseSpace(), pose, dt_s, timeout_s, GovernorLimits(*orders, *shares))

    def _standing(self, here: Pose) -> Motion:
        position_m = np.array(here.position_m, dtype=np.float64)
        return Motion(Pose(position_m, np.array(here.rotation)), AT_REST, AT_REST)

    def _admit(self, record: PoseCommand) -> Motion | str:
        rotation, expected = rotation_from_quat(record.quat_xyzw), self._expected.pose
        jump_m, jump_rad = (JUMP_M, JUMP_RAD) if self.following else (BEGIN_M, BEGIN_RAD)
        if (
            norm3(record.position_m - expected.position_m) > jump_m
            or angle_between(expected.rotation, rotation) > jump_rad
        ):
            return "jump"
        for values, order in ((record.twist, 0), (record.acceleration, 1)):
            if float(np.abs(values[:3]).max()) > self._limits.translation[order]:
                return "too_fast"
            if float(np.linalg.norm(values[3:])) > self._limits.rotation[order]:
                return "too_fast"
        if not self.following and (
            norm3(record.twist[:3]) > BEGIN_M_S or norm3(record.twist[3:]) > BEGIN_RAD_S
        ):
            return "too_fast"
        return Motion(Pose(record.position_m, rotation), record.twist, record.acceleration)


class JointGuard(StreamGuard[JointReference]):
    """Guard of a stream of joint positions, which `names` has in the order of every (n,) here.

    `position_rad` is where the robot stands, `range_rad` the lower and upper ends of its joints, of
    which those slide that are true in `slides` (n,).
    """

    def __init__(
        self,
        names: Sequence[str],
        position_rad: FloatArray,
        dt_s: float,
        timeout_s: float,
        brake: JointMotionLimits,
        range_rad: tuple[FloatArray, FloatArray],
        slides: NDArray[np.bool_],
    ) -> None:
        self._names, self._limits, self._range_rad = tuple(names), brake, range_rad
        self._jump, self._begin = JUMP_JOINT.of(slides), BEGIN_JOINT.of(slides)
        self._begin_speed = JointBound(BEGIN_RAD_S, BEGIN_M_S).of(slides)
        whole = np.ones(len(position_rad))
        limits = GovernorLimits(*brake, axis=whole, beside=whole)
        super().__init__(JointSpace(), position_rad, dt_s, timeout_s, limits)

    def _standing(self, here: FloatArray) -> JointReference:
        return JointReference.at_rest(here)

    def _admit(self, record: JointCommand) -> JointReference | str:
        """The command in the arm's own order; ``names``, ``out_of_range`` are reasons as well."""
        wanted = JointReference(
            record.position_rad, record.velocity_rad_s, record.acceleration_rad_s2
        )
        if record.names != self._names:
            if sorted(record.names) != sorted(self._names):
                return "names"
            order = [record.names.index(name) for name in self._names]
            wanted = JointReference(*(column[order] for column in wanted))
        here_rad, limits = self.motion.position_rad, self._limits
        speeds_rad_s = np.abs(wanted.velocity_rad_s)
        jump = self._jump if self.following else self._begin
        if (np.abs(wanted.position_rad - self._expected.position_rad) > jump).any():
            return "jump"
        if (speeds_rad_s > limits.velocity_rad_s).any() or (
            np.abs(wanted.acceleration_rad_s2) > limits.acceleration_rad_s2
        ).any():
            return "too_fast"
        if not self.following and (speeds_rad_s > self._begin_speed).any():
            return "too_fast"
        # An arm outside its range may come back, but go no further out.
        lower_rad, upper_rad = self._range_rad
        if (wanted.position_rad < np.minimum(lower_rad, here_rad)).any() or (
            wanted.position_rad > np.maximum(upper_rad, here_rad)
        ).any():
            return "out_of_range"
        return wanted


def pose_brake_limits(profile: Profile) -> MotionLimits:
    """`BRAKE_MARGIN` times the limits of a profile's pose stream."""
    limits = BRAKE_MARGIN * np.array(motion_limits(profile.limits))
    return MotionLimits(*map(tuple, limits.tolist()))
