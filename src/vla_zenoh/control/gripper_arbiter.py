"""The gripper: absolute widths, the newest wins, one command in flight."""

from __future__ import annotations

from vla_zenoh.profile import GripperProfile
from vla_zenoh.types import GripperCommand, GripperState, Stamped

SETTLE_NS = 60_000_000
"""A command needs this long to show as movement in the state."""


class GripperArbiter:
    """Decides when to send which width.

    A wish within the dead band of what was sent last is no wish. While a command is in flight newer
    wishes replace each other; the last one is sent when the gripper stands, or when the robot has
    not said so for `command_timeout_s`.
    """

    def __init__(self, profile: GripperProfile) -> None:
        self._profile = profile
        self.wanted_m: float | None = None
        self.sent_m: float | None = None
        self._sent_ns = 0
        self._in_flight = False
        self.timeouts = 0

    def restart(self, width_m: float) -> None:
        """Take `width_m` as given, with nothing to send."""
        self.wanted_m = self.sent_m = width_m
        self._in_flight = False

    def want(self, width_m: float) -> None:
        """Ask for an opening; replaces every earlier wish that was not sent."""
        self.wanted_m = min(max(width_m, 0.0), self._profile.max_width_m)

    @property
    def in_flight(self) -> bool:
        """A command was sent and the gripper has not come to rest since."""
        return self._in_flight

    def step(self, now_ns: int, state: Stamped[GripperState] | None) -> GripperCommand | None:
        """What to send now, if anything."""
        if self._in_flight:
            settled = (
                state is not None
                and state.received_ns > self._sent_ns + SETTLE_NS
                and not state.record.moving
            )
            late = now_ns - self._sent_ns > self._profile.command_timeout_s * 1e9
            if settled or late:
                self._in_flight = False
                self.timeouts += int(late and not settled)
        if self._in_flight or self.wanted_m is None:
            return None
        if (
            self.sent_m is not None
            and abs(self.wanted_m - self.sent_m) <= self._profile.dead_band_m
        ):
            return None
        self.sent_m, self._sent_ns, self._in_flight = self.wanted_m, now_ns, True
        return GripperCommand(self.wanted_m, self._profile.speed_m_s, self._profile.force_n)
