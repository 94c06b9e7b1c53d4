"""Monitors of an arm: each may refuse its activation, slow it down, or make it brake.

A new limit on what is measured is a class of its own, one of the monitors of a `CommandedPart`;
where goals may be is `Limits.tcp_box` and the barriers of `reachability.py`. In every tick in which
the arm obeys they are asked in order: the first that finds a reason ends the activation, and the
least of their slowdowns bounds the speed. Before an activation all of them are asked for reasons
against it.
"""

from __future__ import annotations

from typing import NamedTuple

from vla_zenoh.control.commander_io import make_event
from vla_zenoh.control.limits import LimitHit, Slowdown
from vla_zenoh.control.policy_check import Lease
from vla_zenoh.control.preflight import PeerSnapshot
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.types import Event, FloatArray, GripperState, JointState, PoseState, Stamped


class PartSnapshot(NamedTuple):
    """What the monitors of one part look at in a tick.

    Args:
        now_ns: on the clock of the states' ``received_ns``.
        peers: the other nodes.
        worker: the one that has the lease, or asks for it.
        lease: None before an activation.
        pose, gripper, joint: newest states; None: none was received.
        measured_rad: (n,) measured joints; None: no kinematics, or no joints of this arm.
        commanded: the TCP pose streamed last; None: nothing is streamed.
        commanded_rad: (n,) joints streamed last; None: poses are.
        joints_asked: the goals are joints, so singularities do not matter.
        published: what is streamed reaches the robot.
        stuck: why the motion cannot reach its goal; empty while it can.
    """

    now_ns: int
    peers: PeerSnapshot
    worker: str
    lease: Lease | None
    pose: Stamped[PoseState] | None
    gripper: Stamped[GripperState] | None
    joint: Stamped[JointState] | None
    measured_rad: FloatArray | None
    commanded: Pose | None
    commanded_rad: FloatArray | None
    joints_asked: bool
    published: bool
    stuck: str


class Brake(NamedTuple):
    """Why an arm ends its activation and brakes.

    Args:
        why: a sentence.
        event: the limit that acted, if it was one.
        retreats: the arm moves back from there once it stands.
        late: something did not come in time, which a busy computer may explain.
    """

    why: str
    event: Event | None = None
    retreats: bool = False
    late: bool = True


class Monitor:
    """One monitor of an arm; by default it has no objection and does not slow it down."""

    @property
    def slowdown(self) -> Slowdown | None:
        """Why the arm moves slower than at full speed, as of the last `check`; None: full speed."""
        return None

    def begin(self) -> None:
        """Start an activation."""

    def reasons(self, part: PartSnapshot) -> list[str]:
        """Sentences against an activation; all monitors' are reported at once."""
        return []

    def check(self, part: PartSnapshot) -> Brake | None:
        """Why the arm has to brake now; None: it may go on. Asked while it obeys."""
        return None


def too_near(hit: LimitHit) -> Brake:
    """The brake at a bound of the measured arm."""
    why = (
        f"the measured arm is too near to a bound: {hit.name}{hit.at} is {hit.value:.3g}, "
        f"the limit is {hit.limit:.3g}{hit.way_out}"
    )
    event = make_event("warning", "limit", hit.name, f"braked{hit.at}", hit.value, hit.limit)
    return Brake(why, event, late=False)
