"""Profiles: one YAML file says everything about a robot, its lab and its limits."""

from vla_zenoh.profile.load import load_profile, profile_names, to_yaml
from vla_zenoh.profile.schema import (
    CameraProfile,
    GripperProfile,
    HostProfile,
    Limits,
    Profile,
    RobotProfile,
    SessionProfile,
    Timing,
)

__all__ = [
    "CameraProfile",
    "GripperProfile",
    "HostProfile",
    "Limits",
    "Profile",
    "RobotProfile",
    "SessionProfile",
    "Timing",
    "load_profile",
    "profile_names",
    "to_yaml",
]
