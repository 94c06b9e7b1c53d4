"""Profiles: one YAML file describes a robot, its computers and its limits."""

from typing import TYPE_CHECKING

from vla_zenoh import lazy_names

if TYPE_CHECKING:
    from vla_zenoh.profile.limits import (
        REACH_M,
        REJECT_FACTOR,
        ContactLimits,
        JointLimits,
        KeepOut,
        Limits,
        ReachLimits,
    )
    from vla_zenoh.profile.load import (
        as_robot,
        load_profile,
        load_with_lines,
        override,
        profile_file,
        profile_names,
        read_profile,
        to_yaml,
    )
    from vla_zenoh.profile.profile import PartProfile, Profile
    from vla_zenoh.profile.robot import (
        POSE_JOINTS,
        GripperProfile,
        JointEnds,
        PartBase,
        RobotProfile,
    )
    from vla_zenoh.profile.schema import CameraProfile, Composition, HostProfile, Timing
    from vla_zenoh.profile.session import SessionProfile

__all__ = [
    "POSE_JOINTS",
    "REACH_M",
    "REJECT_FACTOR",
    "CameraProfile",
    "Composition",
    "ContactLimits",
    "GripperProfile",
    "HostProfile",
    "JointEnds",
    "JointLimits",
    "KeepOut",
    "Limits",
    "PartBase",
    "PartProfile",
    "Profile",
    "ReachLimits",
    "RobotProfile",
    "SessionProfile",
    "Timing",
    "as_robot",
    "load_profile",
    "load_with_lines",
    "override",
    "profile_file",
    "profile_names",
    "read_profile",
    "to_yaml",
]

__getattr__ = lazy_names(__name__, "load", "profile", "session", "schema", "robot", "limits")
