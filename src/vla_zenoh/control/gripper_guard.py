"""The robot's side of gripper orders: whose are obeyed, each once, and never beyond the profile."""

from __future__ import annotations

from vla_zenoh.errors import CodecError
from vla_zenoh.profile import GripperProfile
from vla_zenoh.types import GripperCommand, Stamped

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

    def take(self, order: Stamped[GripperCommand], writer: str) -> GripperCommand:
        """The order as it may be carried out.

        Args:
            order: what came.
            writer: source whose commands the arm follows, empty while it follows nobody's.

        Raises:
            CodecError: ``foreign`` (somebody else moves the arm) or ``replayed``.
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
