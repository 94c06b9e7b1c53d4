"""The arm of a profile, as a calibration needs it: its poses by its states, and its links."""

from __future__ import annotations

from typing import Literal

import pinocchio as pin

from vla_zenoh.errors import nearest
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import pose_of
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, JointState, PoseState
from vla_zenoh_calibrate.errors import CalibrationError
from vla_zenoh_calibrate.hand_eye import Eye
from vla_zenoh_calibrate.view import inverse, placed

States = Literal["joint", "pose"]


class Arm:
    """Poses of the TCP in the base by measured states, and where links are beside both.

    Args:
        profile: of one arm.
        states: ``joint``: joint states through the description; ``pose``: what the robot says.
    """

    def __init__(self, profile: Profile, states: States) -> None:
        self._kinematics = make_kinematics(profile)
        self.kind: type[JointState] | type[PoseState] = (
            JointState if states == "joint" else PoseState
        )
        self.tcp, self.base = profile.robot.tcp_frame, profile.robot.base_frame
        self.key = profile.keys.state_joint if states == "joint" else profile.keys.state_pose

    def pose(self, state: JointState | PoseState) -> FloatArray:
        """Pose (4, 4) of the TCP in the base."""
        if isinstance(state, PoseState):
            measured = pose_of(state)
        else:
            measured = self._kinematics.forward(self._kinematics.joints_of(state))
        return placed(measured.rotation, measured.position_m)

    def link(self, name: str, eye: Eye) -> FloatArray:
        """Pose (4, 4) of a link in the TCP, or for a camera that does not move in the base.

        Raises:
            CalibrationError: there is no such link, or it moves against them.
        """
        links = self._kinematics.described.links
        if name not in links:
            raise CalibrationError(
                f"{name!r} is no link of {self._kinematics.urdf.name}{nearest(name, links)}"
            )
        fixed = [one for one in links if self._joint(one) == self._joint(self._beside(eye))]
        if name not in fixed:
            raise CalibrationError(
                f"link {name} moves against {self._beside(eye)}, so that a camera {eye} cannot be "
                f"fixed to it; these do not: {', '.join(fixed)}"
            )
        place = self._kinematics.base_placement if eye == "to-hand" else self._placement(self.tcp)
        ours = inverse(placed(place.rotation, place.translation))
        theirs = self._placement(name)
        return ours @ placed(theirs.rotation, theirs.translation)

    def _beside(self, eye: Eye) -> str:
        return self.tcp if eye == "in-hand" else self.base

    def _frame(self, name: str) -> pin.Frame:
        model = self._kinematics.model
        return model.frames[model.getFrameId(name, pin.FrameType.BODY)]

    def _joint(self, name: str) -> int:
        return self._frame(name).parentJoint

    def _placement(self, name: str) -> pin.SE3:
        """In the joint that moves it; where none does in the root."""
        return self._frame(name).placement
