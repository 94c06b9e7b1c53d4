"""The robot's side of gripper orders: whose are obeyed, how old, each once, within the profile."""

from __future__ import annotations

from vla_zenoh.errors import CodecError
from vla_zenoh.profile import GripperProfile
from vla_zenoh.types import GripperCommand, Stamped

OLDEST_NS = 1_000_000_000
"""An order older than this is not carried out: who gave it may be gone, or have stopped the arm,
while it waited on a link that hung or in a process that stood still."""
MAX_SOURCES = 64
"""So many sources are remembered, the newest; each start of a command node is one."""


class GripperGuard:
    """Between the bus and a gripper.

    Orders are rare, so silence says nothing: what came once is never new again, however much later.

    Args:
        profile: of the gripper; no order goes beyond it.

    Attributes:
        bounded: orders that asked for more than the profile allows.
    """

    def __init__(self, profile: GripperProfile) -> None:
        self._profile = profile
        self._newest: dict[str, int] = {}
        self.bounded = 0

    def accept(
        self, order: Stamped[GripperCommand], writer: str, now_ns: int, *, writer_active: bool
    ) -> GripperCommand:
        """The order as it may be carried out.

        Args:
            order: what came.
            writer: source whose commands the arm follows, empty while it follows nobody's.
            now_ns: wall clock, on which the order is stamped.
            leads: that source carries out what it is told, see `ArmGuard.leads`.

        Raises:
            CodecError: ``foreign`` (somebody else moves the arm), ``replayed``, ``stale``, or
                ``outlived`` (who gave it was stopped meanwhile).
        """
        source, seq = order.header.source, order.header.seq
        if writer and source != writer:
            raise CodecError("foreign", f"by {source[:60]!r}, while {writer[:60]!r} moves the arm")
        known = self._newest.get(source, -1)
        if seq <= known:
            raise CodecError("replayed", f"number {seq} came again or late")
        self._newest.pop(source, None)
        self._newest[source] = seq
        if len(self._newest) > MAX_SOURCES:
            del self._newest[next(iter(self._newest))]
        age_ns = now_ns - order.header.stamp_wall_ns
        if age_ns > OLDEST_NS:
            raise CodecError("stale", f"is {age_ns / 1e9:.1f} s old")
        if writer and not writer_active:
            raise CodecError("outlived", "came when who gave it had stopped")
        return self._within(order.record)

    def _within(self, asked: GripperCommand) -> GripperCommand:
        most = self._profile
        given = GripperCommand(
            min(asked.width_m, most.max_width_m),
            min(asked.speed_m_s, most.speed_m_s),
            min(asked.force_n, most.force_n),
        )
        self.bounded += given != asked
        return given
