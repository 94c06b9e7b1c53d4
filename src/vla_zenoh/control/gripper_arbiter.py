"""Gripper commands: absolute widths, the newest one wins, one command in flight."""

from __future__ import annotations

from vla_zenoh.profile import GripperProfile
from vla_zenoh.types import GripperCommand, GripperState, Stamped

SAME_WIDTH_M = 0.005
"""A gripper this near to the width sent last has reached it."""
SETTLE_NS = 60_000_000
"""Time until a command shows as movement in the state."""


class GripperArbiter:
    """Decides when to send which width.

    A request within the dead band of the width sent last is ignored. While a command is in flight,
    newer requests replace each other; the last one is sent when the gripper stands, or after
    `command_timeout_s`.
    """

    def __init__(self, profile: GripperProfile) -> None:
        self._profile = profile
        self.requested_m: float | None = None
        self.sent_m: float | None = None
        self._sent_ns = 0
        self.in_flight = False
        """A command was sent and the gripper has not come to rest since."""
        self.timeouts = 0

    def restart(self, width_m: float) -> None:
        """Start at `width_m`, with nothing to send."""
        self.requested_m = self.sent_m = width_m
        self.in_flight = False

    def keep(self, gripper: GripperState) -> float:
        """Restart at the width sent last while the gripper follows it, else at its width.

        Another width would end a grasp.
        """
        width_m = min(max(gripper.width_m, 0.0), self._profile.max_width_m)
        sent_m = self.sent_m
        if sent_m is not None:
            grasps = gripper.holding and sent_m < gripper.width_m
            if grasps or abs(sent_m - gripper.width_m) < SAME_WIDTH_M:
                width_m = sent_m
        self.restart(width_m)
        return width_m

    def request(self, width_m: float) -> None:
        """Request a width; replaces an earlier one that was not sent."""
        self.requested_m = min(max(width_m, 0.0), self._profile.max_width_m)

    def step(self, now_ns: int, state: Stamped[GripperState] | None) -> GripperCommand | None:
        """The command to send now, None without one."""
        if self.in_flight:
            settled = (
                state is not None
                and state.received_ns > self._sent_ns + SETTLE_NS
                and not state.record.moving
            )
            late = now_ns - self._sent_ns > self._profile.command_timeout_s * 1e9
            if settled or late:
                self.in_flight = False
                self.timeouts += int(late and not settled)
        if self.in_flight or self.requested_m is None:
            return None
        if (
            self.sent_m is not None
            and abs(self.requested_m - self.sent_m) <= self._profile.dead_band_m
        ):
            return None
        self.sent_m, self._sent_ns, self.in_flight = self.requested_m, now_ns, True
        return GripperCommand(self.requested_m, self._profile.speed_m_s, self._profile.force_n)
