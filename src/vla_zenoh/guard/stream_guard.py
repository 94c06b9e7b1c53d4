"""Guard of a stream of set-points: one writer, newest first, extrapolated between commands."""

from __future__ import annotations

from functools import cached_property
from typing import Generic, TypeVar

import numpy as np

from vla_zenoh.guard.reference_governor import (
    BRAKE_MARGIN,
    GovernedPath,
    GovernorLimits,
    Reference,
    ReferenceGovernor,
    Space,
)
from vla_zenoh.types import FloatArray, Header, Stamped

CLOCK_DRIFT = 1e-3
"""Share by which two clocks may drift apart; a real one does by a tenth of that."""
ACCELERATE_S = 0.02
"""For how long a command's acceleration is believed; its velocity is until the stream times out."""

Command = TypeVar("Command")


class CommandStream(Generic[Command]):
    """The commands of one writer at a time.

    Args:
        timeout_s: silence after which the stream has ended.
    """

    def __init__(self, timeout_s: float) -> None:
        self.newest: Stamped[Command] | None = None
        self._timeout_s = timeout_s
        self._source: str | None = None
        self._last_seq = -1
        self._base_ns = 0
        self._delay_ns = 0
        self._ticked_ns = 0
        self._anew = False

    def objection(self, header: Header, received_ns: int) -> str | None:
        """Why a command is not taken: ``foreign``, ``replayed``, ``late``, or nothing.

        Late is what was longer on its way than the stream may be silent: who followed a link that
        gets slower and slower would go on long after its writer has braked.
        """
        if self.newest is not None and header.source != self._source:
            return "foreign"
        if header.source == self._source and header.seq <= self._last_seq:
            return "replayed"
        if self.newest is not None and self._late(header, received_ns):
            went_back = header.stamp_wall_ns < self.newest.header.stamp_wall_ns
            return None if went_back else "late"  # stamps of a stream go back when a clock was set
        return None

    def _shortest_ns(self, received_ns: int) -> int:
        passed_ns = 0 if self.newest is None else received_ns - self.newest.received_ns
        return self._delay_ns + int(CLOCK_DRIFT * passed_ns)

    def _late(self, header: Header, received_ns: int) -> bool:
        late_ns = received_ns - header.stamp_wall_ns - self._shortest_ns(received_ns)
        return late_ns >= self._timeout_s * 1e9

    def take(self, command: Stamped[Command]) -> None:
        """Follow `command`: it is put on our clock by its stamp, because arrival times jitter.

        The difference of both clocks is the shortest delay seen: a command that was held up on its
        way is not taken for one that is meant later.
        """
        stamp_ns = command.header.stamp_wall_ns
        delay_ns = command.received_ns - stamp_ns
        # Later than a stream may be silent: not a hold-up, one of the clocks was set.
        if self.newest is not None and not self._late(command.header, command.received_ns):
            delay_ns = min(delay_ns, self._shortest_ns(command.received_ns))
        self._delay_ns = delay_ns
        self._base_ns = stamp_ns + delay_ns
        self._anew = True
        self.newest, self._source, self._last_seq = (
            command,
            command.header.source,
            command.header.seq,
        )

    def may_step(self, now_ns: int, dt_s: float) -> bool:
        """Whether this tick may be told something else than the one before foretold.

        That is after a new command, or where this tick is not `dt_s` later.
        """
        late_s = (now_ns - self._ticked_ns) / 1e9 - dt_s
        anew, self._anew, self._ticked_ns = self._anew, False, now_ns
        return anew or abs(late_s) > 0.5 * dt_s

    def live(self, now_ns: int) -> Command | None:
        """The newest command, None where there is none or the stream has fallen silent."""
        if self.newest is None or now_ns - self.newest.received_ns > self._timeout_s * 1e9:
            return None
        return self.newest.record

    def ahead_s(self, now_ns: int) -> float:
        """How far `now_ns` is past the time the newest command is meant for.

        The stream is a function of time, so a late command meets the path its predecessors
        foretold. Nothing bounds it but the end of the stream, which comes a time-out after the
        command did: a bound that is met before that, as by the last command where it was held up
        on its way, would stop the reference in one tick.
        """
        return max((now_ns - self._base_ns) / 1e9, 0.0)

    def end(self) -> None:
        """Follow nobody; what was heard already is not new when it comes again."""
        self.newest = None

    def forget(self) -> None:
        """Follow nobody, and know nobody."""
        self.newest, self._source, self._last_seq = None, None, -1


FADING_S = 0.07
"""For so long a command's acceleration then fades, where there is room for it: what is done in vain
has to be undone."""


class Extrapolation(Generic[Reference]):
    """A motion from one command on, within the limits of the stream.

    For as long as there were between this command and the one before it the acceleration goes on
    changing as it did; then it stays until the command is `ACCELERATE_S` old, or less where the
    motion would get too fast or turn round; then it fades to zero, jerk-limited.

    Args:
        space: where motions lie.
        command: from which it begins.
        before: the command before that one, where it belongs to the same stream.
        gap_s: between these two.
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
            # Who accelerates as much as it may will not do so more and more.
            later = _cut(space, 2 * change - was, acceleration_limit)
            jerk = _cut(space, (later - change) / gap_s, jerk_limit)
        else:
            gap_s = 0.0
        self._jerk, self._gap_s = jerk, gap_s
        self._first = GovernedPath(np.zeros(len(rate)), rate, change)
        self._limits = velocity_limit, jerk_limit

    @cached_property
    def _later(self) -> tuple[GovernedPath, FloatArray, FloatArray, FloatArray]:
        """What comes when the next command does not: from where, how long steady, fading, how."""
        velocity_limit, jerk_limit = self._limits
        then = _on(self._first, self._jerk, self._gap_s)
        change, speed = np.maximum(np.abs(then.change), 1e-9), np.abs(then.rate)
        turning = then.rate * then.change < 0
        # Twice the time for which the acceleration may last before the motion is too fast or turns.
        room_s = 2 * np.where(turning, speed, velocity_limit - speed) / change
        fading_s = np.maximum(np.minimum(room_s, FADING_S), change / jerk_limit)
        steady_s = np.clip((room_s - fading_s) / 2, 0.0, ACCELERATE_S - self._gap_s)
        steady_s[self._jerk * then.change < 0] = 0.0
        return then, steady_s, fading_s, -then.change / fading_s

    def at(self, ahead_s: float) -> Reference:
        """The motion `ahead_s` after the command."""
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


STILL = 1e-4
"""m/s and rad/s: a stream that ends slower than this has ended on purpose."""


class StreamGuard(Generic[Reference]):
    """Follows a stream of commands, and stops by itself when that falls silent in motion.

    Args:
        space: where its references lie.
        motion: reference at first: where the robot stands.
        dt_s: tick of the controller.
        timeout_s: silence after which the stream has ended.
        brake: of its own stop, twice the stream's.
    """

    def __init__(
        self,
        space: Space[Reference],
        motion: Reference,
        dt_s: float,
        timeout_s: float,
        brake: GovernorLimits,
    ) -> None:
        self._space, self._dt_s, self._brake = space, dt_s, brake
        self._stream: CommandStream[Reference] = CommandStream(timeout_s)
        self._governor = ReferenceGovernor(space, motion, dt_s, brake)
        self._extrapolation: Extrapolation[Reference] | None = None
        self.braking = False
        """The stream fell silent in motion, and the reference still moves."""
        self.silences = 0

    @property
    def motion(self) -> Reference:
        """The reference now."""
        return self._governor.motion

    @property
    def following(self) -> bool:
        """A command stream is being followed."""
        return self._stream.newest is not None

    @property
    def moving(self) -> bool:
        """A stream is being followed, or what was followed last is still brought to rest."""
        return self.following or self._governor.moving

    def hold(self) -> None:
        """Follow nobody and stand where the reference is: the arm stopped there by itself."""
        self._put(self.motion)

    def _put(self, motion: Reference) -> None:
        self._stream.end()
        self.braking = False
        self._governor.put(motion)

    def _objection(self, header: Header, received_ns: int) -> str | None:
        objection = self._stream.objection(header, received_ns)
        return "braking" if objection is None and self.braking else objection

    @property
    def _expected(self) -> Reference:
        """Where a command is expected: where what was told leads, or where the robot stands."""
        return self._governor.told if self.following else self.motion

    def _take(self, command: Stamped[Reference]) -> None:
        before = self._stream.newest
        self._stream.take(command)
        gap_s = 0.0
        if before is not None:
            gap_s = (command.header.stamp_wall_ns - before.header.stamp_wall_ns) / 1e9
        self._extrapolation = Extrapolation(
            self._space, command.record, before and before.record, gap_s, self._brake
        )

    def tick(self, now_ns: int) -> Reference:
        """The reference to follow at `now_ns`."""
        governor = self._governor
        if self._stream.live(now_ns) is not None and self._extrapolation is not None:
            steady = not self._stream.may_step(now_ns, self._dt_s)
            governor.follow(self._extrapolation.at(self._stream.ahead_s(now_ns)), steady=steady)
            return governor.motion
        if self._stream.newest is not None:
            self._stream.end()
            if float(np.abs(self._space.speed(governor.told).rate).max()) >= STILL:
                self.silences += 1
                self.braking = True
                governor.stop()
        governor.rest()
        self.braking = self.braking and governor.moving
        return governor.motion
