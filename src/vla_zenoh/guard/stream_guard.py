"""Guard of a command stream on the robot's side, whatever its set-points are.

`vla_zenoh.guard.command_guards` says how poses and joint positions are checked. Everything else is
the same for both and stands here: which samples are accepted, what the arm does between two of
them, and how it brakes when the stream falls silent in motion.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np

from vla_zenoh.guard.reference_governor import (
    BRAKE_MARGIN,
    GovernedPath,
    GovernorLimits,
    Reference,
    ReferenceGovernor,
    Space,
)
from vla_zenoh.types import FloatArray, Header, SingleWriterFilter, Stamped

CLOCK_DRIFT = 1e-3
"""Share by which two clocks may drift apart; real ones drift by a tenth of that."""
ACCELERATE_S = 0.02
"""A command's acceleration is extrapolated this long; its velocity until the stream times out."""
FADING_S = 0.07
"""The acceleration then fades to zero within this time where there is room for it: motion in vain
has to be undone."""
STILL = 1e-4
"""m/s and rad/s: a stream that ends slower than this has ended on purpose."""

Command = TypeVar("Command")


class CommandStream(Generic[Command]):
    """Commands of one writer at a time, on the clock of the receiver.

    The stream has ended when it is silent for `timeout_s`.
    """

    def __init__(self, timeout_s: float) -> None:
        self.newest: Stamped[Command] | None = None
        self._timeout_s = timeout_s
        self._filter = SingleWriterFilter()
        self._base_ns = self._delay_ns = self._ticked_ns = 0
        self._has_new = False

    def objection(self, header: Header, received_ns: int) -> str | None:
        """Why a command is rejected: ``foreign``, ``replayed``, ``late``, or None.

        A late command was under way for longer than the stream may be silent: on a link that gets
        ever slower the arm would continue long after the writer has braked.
        """
        reason = self._filter.objection(header)
        if reason is None and self.newest is not None and self._late(header, received_ns):
            went_back = header.stamp_wall_ns < self.newest.header.stamp_wall_ns
            return None if went_back else "late"  # stamps of a stream go back if a clock was set
        return reason

    def _shortest_ns(self, received_ns: int) -> int:
        passed_ns = 0 if self.newest is None else received_ns - self.newest.received_ns
        return self._delay_ns + int(CLOCK_DRIFT * passed_ns)

    def _late(self, header: Header, received_ns: int) -> bool:
        late_ns = received_ns - header.stamp_wall_ns - self._shortest_ns(received_ns)
        return late_ns >= self._timeout_s * 1e9

    def take(self, command: Stamped[Command]) -> None:
        """Follow `command`, which is put on our clock by its stamp, because arrival times jitter.

        The offset of both clocks is the shortest delay seen: a command that was held up on its way
        is not mistaken for one that is meant later.
        """
        stamp_ns = command.header.stamp_wall_ns
        delay_ns = command.received_ns - stamp_ns
        # Later than a stream may be silent: not a delay, one of the clocks was set.
        if self.newest is not None and not self._late(command.header, command.received_ns):
            delay_ns = min(delay_ns, self._shortest_ns(command.received_ns))
        self._delay_ns = delay_ns
        self._base_ns = stamp_ns + delay_ns
        self._has_new = True
        self.newest = command
        self._filter.accept(command.header)

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
        return newest is not None and now_ns - newest.received_ns <= self._timeout_s * 1e9

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

    def forget(self) -> None:
        """Follow no source, and forget what was received."""
        self.newest = None
        self._filter.reset()


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
        brake: limits of its own stop, `BRAKE_MARGIN` times those of the stream.

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
        self._space, self._dt_s, self._brake = space, dt_s, brake
        self._stream: CommandStream[Reference] = CommandStream(timeout_s)
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
        return self.following or self._governor.moving

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

    def reset(self, here: Any) -> None:
        """Follow no stream, forget the last one, and hold this place: the robot was reset."""
        self.anchor(here)
        self._stream.forget()

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

    def tick(self, now_ns: int) -> Reference:
        """The reference to follow at `now_ns`."""
        governor = self._governor
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
