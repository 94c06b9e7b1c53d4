"""Guard of gripper commands on the robot's side: source, age, order, limits of the profile."""

from __future__ import annotations

from vla_zenoh.errors import CodecError
from vla_zenoh.profile import GripperProfile
from vla_zenoh.types import GripperCommand, Stamped
from vla_zenoh.types.stream import SingleWriterFilter

OLDEST_NS = 1_000_000_000
"""An older command is rejected: its source may have died or stopped the arm while the command
waited on a stuck link or in a suspended process."""
MAX_SOURCES = 64
"""Sources whose last sequence number is remembered; each start of a command node is one."""


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
