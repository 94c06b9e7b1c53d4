"""Measured states: whether they arrive, in time, and whether they can all be true."""

from __future__ import annotations

from typing import Any

from vla_zenoh.control.commander_io import NewStates, StateHistory
from vla_zenoh.control.monitor import Brake, Monitor, PartSnapshot
from vla_zenoh.control.preflight import (
    JOINT_PATIENCE_S,
    joint_state_faults,
    reasons_of_part,
    state_lost,
)
from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import Pose, interpolate, pose_distance, pose_of
from vla_zenoh.profile import Profile
from vla_zenoh.types import JointState, PoseState, Stamped

FALSE_M, FALSE_RAD = 0.01, 0.05
"""Distance of two measurements of one TCP beyond which one of them is false, while it moves."""
FASTER = 4.0
"""A measured TCP may be this many times as fast as an axis of a command: people push arms."""
COMPARED_NS = 50_000_000
"""A pose is compared with joints that were measured this long after it, at most."""


class StateMonitor(Monitor):
    """The measured states of one part.

    A state that is missing or late ends the motion, as does a reported TCP pose that the joints
    contradict. Each state has its own age: that one arrives says nothing about the others.

    Args:
        profile: of the part.
        arm: its kinematics; None: poses and joints cannot be compared.
        poses: that were measured.
        wants_joints: the motion needs the joints as well.

    Attributes:
        actual: the newest measured TCP pose.
    """

    def __init__(
        self,
        profile: Profile,
        arm: Kinematics | None,
        poses: StateHistory[PoseState],
        *,
        wants_joints: bool,
    ) -> None:
        self._profile = profile
        self._arm = arm
        self._poses = poses
        self._wants_joints = wants_joints
        self._contradicts_ns = 0
        """Since when, on the clock of their arrival."""
        self.forget()

    def forget(self) -> None:
        """Forget what was measured."""
        self.actual: Pose | None = None
        self._pose: Stamped[PoseState] | None = None
        self._jumped = ""
        """Why the measured pose may be false, until joints confirm it, or without joints a pose
        near the one before the jump."""
        self._before_jump: Pose | None = None
        self._contradiction = ""
        """Why the measured pose or the joints are false."""

    @property
    def doubt(self) -> str:
        """Why the measured pose must not be moved to, empty if it is trusted."""
        return self._contradiction or self._jumped

    def begin(self) -> None:
        self._jumped = ""

    def update(self, states: NewStates) -> None:
        """Take the newest states; the history of poses has them already."""
        if states.pose is not None:
            actual = pose_of(states.pose.record)
            if self._pose is not None and self.actual is not None:
                elapsed_ns = states.pose.header.stamp_wall_ns - self._pose.header.stamp_wall_ns
                jumped = self._jump(actual, self.actual, elapsed_ns)
                if jumped and not self._jumped:
                    self._before_jump = self.actual
                self._jumped = jumped or self._jumped
                if self._arm is None and self._is_back(actual):
                    self._jumped, self._before_jump = "", None
            self._pose, self.actual = states.pose, actual
        if states.joint is not None:
            self._compare(states.joint)

    def _is_back(self, actual: Pose) -> bool:
        """Whether a pose is where the arm was before the jump: that was a single false one."""
        before = self._before_jump
        return before is not None and not self._too_far(actual, before, 0.0)

    def _jump(self, actual: Pose, before: Pose, elapsed_ns: int) -> str:
        """Why a reported pose cannot follow the one `before`, empty if an arm can move so."""
        elapsed_s = abs(elapsed_ns) / 1e9
        apart = self._too_far(actual, before, elapsed_s)
        if not apart:
            return ""
        return (
            f"the reported TCP pose jumped by {apart} in {elapsed_s:.3f} s, faster than the arm "
            "can move: was its tool frame set?"
        )

    def _too_far(self, pose: Pose, other: Pose, elapsed_s: float) -> str:
        """The distance of two measured poses if no arm moves so far in `elapsed_s`, else empty."""
        apart_m, apart_rad = pose_distance(pose, other)
        limits = self._profile.limits
        most_m = FALSE_M + FASTER * elapsed_s * limits.translation.velocity_m_s
        most_rad = FALSE_RAD + FASTER * elapsed_s * limits.rotation.velocity_rad_s
        if apart_m <= most_m and apart_rad <= most_rad:
            return ""
        return f"{apart_m * 1e3:.1f} mm and {apart_rad:.3f} rad"

    def _compare(self, joint: Stamped[JointState]) -> None:
        """Compare the joints with the TCP pose that the robot reported for their time."""
        stamp_ns = joint.header.stamp_wall_ns
        around = self._poses.around(stamp_ns, COMPARED_NS)
        if self._arm is None or self._pose is None or around is None:
            return
        try:
            joints_rad = self._arm.joints_of(joint.record)
        except RecordError:
            return  # reported by the monitor of the joints
        before, after, share = around
        reported = interpolate(pose_of(before), pose_of(after), share)
        unknown_s = max(stamp_ns - self._pose.header.stamp_wall_ns, 0) / 1e9
        apart = self._too_far(self._arm.forward(joints_rad), reported, unknown_s)
        if not apart:
            self._contradiction = self._jumped = ""
            return
        if not self._contradiction:
            self._contradicts_ns = joint.received_ns
        self._contradiction = (
            f"the measured joints put the TCP {apart} from where the robot reports it: one of the "
            "two is frozen or false, or the tool frame was changed"
        )

    def reasons(self, part: PartSnapshot) -> list[str]:
        reasons = reasons_of_part(self._profile, part.peers, part.pose, part.gripper, part.now_ns)
        pose, joint = part.pose, part.joint
        if pose is None:
            return reasons
        if self._arm is not None:
            reasons += joint_state_faults(self._profile, self._arm, joint, pose, part.now_ns)
        if joint is not None:
            writers = {joint.header.source, pose.header.source}
            if len(writers) > 1:
                reasons.append(f"joints and pose have different writers: {', '.join(writers)}")
        return reasons

    def check(self, part: PartSnapshot) -> Brake | None:
        why = self.lost(part)
        patience_ns = self._profile.timing.state_timeout_s * 1e9
        if not why and part.now_ns - self._contradicts_ns > patience_ns:
            why = self._contradiction
        return Brake(why) if why else None

    def lost(self, part: PartSnapshot) -> str:
        """Which state is missing, late, or stamped in the future; empty if none is."""
        patience_s = self._profile.timing.state_timeout_s
        joint = part.joint if self._wants_joints else None
        states: list[tuple[str, Stamped[Any] | None, float]] = [
            ("pose", part.pose, patience_s),
            ("gripper", part.gripper, patience_s),
            ("joints", joint, patience_s + JOINT_PATIENCE_S),
        ]
        for name, state, most_s in states:
            why = "" if state is None else state_lost(name, state, most_s, part.now_ns)
            if why:
                return why
        return ""
