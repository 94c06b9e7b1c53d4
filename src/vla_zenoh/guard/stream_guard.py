"""What the guards of poses and of joints have in common: whom they follow, and how.

See `vla_zenoh.guard.pose_guard`.
"""

from __future__ import annotations

from typing import Generic

import numpy as np

from vla_zenoh.guard.command_stream import CommandStream
from vla_zenoh.guard.extrapolation import Extrapolation
from vla_zenoh.guard.reference_governor import GovernorLimits, Reference, ReferenceGovernor, Space
from vla_zenoh.types import Header, Stamped

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
