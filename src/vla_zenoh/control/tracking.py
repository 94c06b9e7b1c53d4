"""Tracking: how far the arm is from its command, and whether it counts as blocked."""

from __future__ import annotations

from vla_zenoh.control.contact import Contact
from vla_zenoh.control.monitor import Brake, Monitor, PartSnapshot
from vla_zenoh.control.preflight import SAME_TCP_M, SAME_TCP_RAD
from vla_zenoh.control.state_monitor import StateMonitor
from vla_zenoh.kinematics.so3 import Pose, pose_distance
from vla_zenoh.profile import Limits


class TrackingMonitor(Monitor):
    """Distance of the measured TCP from its command, within ``limits.tracking_m`` and ``_rad``.

    A blocked arm retreats, unless it is in no contact (its state is stuck, or it was slowed down)
    or its measured pose is in doubt.

    Args:
        limits: of the profile.
        contact: the external load.
        states: the measured ones.

    Attributes:
        apart_m, apart_rad: the distance as of the last `measure`, zero while nothing is streamed.
    """

    def __init__(self, limits: Limits, contact: Contact, states: StateMonitor) -> None:
        self._limits = limits
        self._contact = contact
        self._states = states
        self.apart_m = self.apart_rad = 0.0
        self._excused = (0.0, 0.0)
        """Distance of an arm that was blocked when it was activated: it may
        come back, and stray by what two measurements of one TCP may differ."""

    def excuse(self, held: Pose, actual: Pose) -> bool:
        """Start an activation; returns whether the arm is far from its controller's set-point.

        Such an arm does not count as blocked while the distance shrinks.
        """
        apart_m, apart_rad = pose_distance(held, actual)
        blocked = apart_m > self._limits.tracking_m or apart_rad > self._limits.tracking_rad
        self._excused = (apart_m, apart_rad) if blocked else (0.0, 0.0)
        return blocked

    def measure(self, commanded: Pose | None, actual: Pose) -> None:
        """Update the distance; `commanded` is None while nothing is streamed."""
        self.apart_m = self.apart_rad = 0.0
        if commanded is not None:
            self.apart_m, self.apart_rad = pose_distance(commanded, actual)

    def check(self, part: PartSnapshot) -> Brake | None:
        if part.commanded is None or not part.published:
            return None
        why = self._blocked()
        if not why:
            return None
        doubt = self._states.doubt
        if doubt:
            return Brake(f"{doubt}; {why}")
        return Brake(why, retreats=not (self._contact.known and self._contact.quiet))

    def _blocked(self) -> str:
        """Why the arm counts as blocked, empty while it follows."""
        limits = self._limits
        excused_m, excused_rad = self._excused
        for apart, limit, excused, same, unit in (
            (self.apart_m, limits.tracking_m, excused_m, SAME_TCP_M, "m"),
            (self.apart_rad, limits.tracking_rad, excused_rad, SAME_TCP_RAD, "rad"),
        ):
            allowed = max(limit, excused + same if excused else 0.0)
            if apart > allowed:
                return (
                    f"the arm does not follow: {apart:.3f} {unit} from its command, "
                    f"at most {allowed:.3g} {unit} (is it blocked?)"
                )
        # The allowance of an arm that comes back only shrinks.
        self._excused = min(excused_m, self.apart_m), min(excused_rad, self.apart_rad)
        return ""


class FollowMonitor(Monitor):
    """A motion that waits for its joints and will not reach its goal."""

    def check(self, part: PartSnapshot) -> Brake | None:
        return Brake(part.stuck) if part.stuck else None
