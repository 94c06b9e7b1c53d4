"""The way back of an arm that was blocked: what it is commanded is led back to where it is.

A controller presses with what lies between command and arm, and with what its integral action has
piled up. So after the brake the command goes

1. from where the brake ended, inside of the obstacle, to where the arm was measured then, once: an
   arm that somebody pushes about is not run after;
2. to where the arm was when it was noticed, and on along the way on which it came there, `STEP_M`
   at a time, until nothing presses any more, but `RELIEF_M` at most.

Where the robot tells no wrench nobody knows whether anything presses: then it goes all of
`RELIEF_M`, at once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vla_zenoh.control.commander_io import Outputs
from vla_zenoh.control.contact import Contact
from vla_zenoh.kinematics.so3 import Pose, norm3, pose_distance
from vla_zenoh.profile import Limits
from vla_zenoh.types import FloatArray

STEP_M = 0.005
RELIEF_M = 0.02
SETTLE_NS = 50_000_000
"""After each step it is looked at for so long before the next one."""
SPARE_NS = 4_000_000_000
"""What a retreat may take beyond the time of its way."""
SPACE_M = 0.002
"""Distance of the places of a trail."""
PLACES = 60
RAD_AS_M = 0.05
"""A turn by 1 rad counts like this way."""
STRAY_M, STRAY_RAD = 0.01, 0.05
"""An arm that stands further than it was found blocked, and the brake, and this, is not there."""


class CommandTrail:
    """The way on which the arm came: measured poses, `SPACE_M` apart, newest last.

    What was gone there and back again is left out, so it never turns round.
    """

    def __init__(self) -> None:
        self._poses: list[Pose] = []
        self._places: list[FloatArray] = []

    def go(self, pose: Pose) -> None:
        """The arm is here now."""
        place = _place(pose)
        if self._places and np.linalg.norm(self._places[-1] - place) < SPACE_M:
            return
        if self._places:
            apart = np.linalg.norm(np.array(self._places) - place, axis=1)
            if apart[-1] > 10 * SPACE_M:
                self.forget()  # it was not watched meanwhile
            elif (apart < SPACE_M).any():
                keep = int(np.flatnonzero(apart < SPACE_M)[0]) + 1
                del self._poses[keep:], self._places[keep:]
                return
        self._poses.append(pose)
        self._places.append(place)
        del self._poses[:-PLACES], self._places[:-PLACES]

    def forget(self) -> None:
        """Begin anew."""
        self._poses.clear()
        self._places.clear()

    def back(self, way_m: float) -> list[Pose]:
        """Poses of the last `way_m`, newest first, without the very last: there it is."""
        found: list[Pose] = []
        gone_m = 0.0
        for index in range(len(self._poses) - 2, -1, -1):
            gone_m += float(np.linalg.norm(self._places[index] - self._places[index + 1]))
            if gone_m > way_m + SPACE_M / 2:
                break
            found.append(self._poses[index])
        return found


def _place(pose: Pose) -> FloatArray:
    # The Frobenius norm of a difference of rotations is sqrt(2) times their small angle.
    return np.concatenate([pose.position_m, pose.rotation.ravel() * (RAD_AS_M / np.sqrt(2))])


class _Begun(NamedTuple):
    commanded: Pose
    measured: Pose


class Retreat:
    """See the module. It says where to head for; who asks moves the arm.

    Args:
        limits: how fast, and how far an arm may be from its command.
        contact: what presses.
    """

    def __init__(self, limits: Limits, contact: Contact) -> None:
        self._limits, self._contact = limits, contact
        self.speed = min(1.0, limits.contact.retreat_m_s / limits.translation.velocity_m_s)
        """Share of the speed limits that it has."""
        self._trail = CommandTrail()
        self._measured: Pose | None = None
        self._begun: _Begun | None = None
        self._target: Pose | None = None
        self._ahead: list[Pose] = []
        self._until_ns = self._rest_ns = 0

    @property
    def busy(self) -> bool:
        """It is under way, or waits for the brake to end."""
        return self._begun is not None

    def see(self, measured: Pose) -> None:
        """The arm was measured here."""
        self._measured = measured
        if not self.busy:
            self._trail.go(measured)

    def begin(self, commanded: Pose) -> None:
        """The arm is blocked, or something presses against it; the brake begins.

        Args:
            commanded: where the command is.
        """
        if self._measured is not None:
            self._begun = _Begun(commanded, self._measured)
            self._target = None

    def end(self) -> None:
        """Whatever it was doing, it does it no more: the arm brakes and stands."""
        self._begun = self._target = None

    def turn(self, commanded: Pose, now_ns: int, out: Outputs, *, at_rest: bool) -> Pose | None:
        """Where to head for in this tick; None: brake, or stand.

        Args:
            commanded: where the command is.
            now_ns: time of this tick.
            out: what it did is told.
            at_rest: what was commanded last is reached.
        """
        begun, measured = self._begun, self._measured
        if begun is None or measured is None:
            return None
        if not at_rest:
            self._rest_ns = now_ns
            if self._target is not None and now_ns > self._until_ns:
                self._finish(out, "it took too long")
                return None
            return self._target
        if self._target is None:
            return self._set_out(begun, commanded, measured, now_ns, out)
        if now_ns - self._rest_ns < SETTLE_NS:
            return self._target
        told = self._contact.told
        if told and self._contact.quiet:
            self._finish(out, "it stands")
        elif not self._ahead or now_ns > self._until_ns:
            self._finish(out, "something still presses" if told else "it stands")
        else:
            self._step_back(STEP_M if told else RELIEF_M)
        return self._target

    def _set_out(
        self, begun: _Begun, commanded: Pose, measured: Pose, now_ns: int, out: Outputs
    ) -> Pose | None:
        if self._contact.told and self._contact.quiet:
            self._finish(out, "no further than the brake, nothing presses any more")
            return None
        apart_m, apart_rad = pose_distance(commanded, measured)
        braked_m, braked_rad = pose_distance(begun.commanded, commanded)
        most_m = self._limits.tracking_m + braked_m + STRAY_M
        most_rad = self._limits.tracking_rad + braked_rad + STRAY_RAD
        if apart_m > most_m or apart_rad > most_rad:
            self.end()
            where = f"{apart_m:.3f} m and {apart_rad:.2f} rad from its command"
            out.tell("warning", "notice", "retreat", f"the arm is not led back: it is {where}")
            return None
        on_m = norm3(measured.position_m - begun.measured.position_m)
        # Where it was pushed back since, by a person, it does not come again.
        into = _place(commanded) - _place(measured)
        self._ahead = [
            pose
            for pose in (begun.measured, *self._trail.back(RELIEF_M))
            if (_place(pose) - _place(measured)) @ into <= 0
        ]
        speed_m_s = self.speed * self._limits.translation.velocity_m_s
        speed_rad_s = self.speed * self._limits.rotation.velocity_rad_s
        way_s = (apart_m + on_m + RELIEF_M) / speed_m_s + apart_rad / speed_rad_s
        self._until_ns = now_ns + round(2e9 * way_s) + SPARE_NS
        self._rest_ns = now_ns
        self._target = measured
        return measured

    def _step_back(self, step_m: float) -> None:
        assert self._target is not None
        start = _place(self._target)
        while self._ahead:
            self._target = self._ahead.pop(0)
            if np.linalg.norm(_place(self._target) - start) >= step_m:
                break

    def _finish(self, out: Outputs, why: str) -> None:
        felt_n = self._contact.force_n
        felt = "" if felt_n is None else f", external force {felt_n:.1f} N"
        out.tell("info", "notice", "retreat", f"the arm was led back: {why}{felt}")
        self.end()
