"""Profiles: one YAML file describes a robot, its computers and its limits."""

from typing import TYPE_CHECKING

from vla_zenoh import lazy_names

if TYPE_CHECKING:
    from vla_zenoh.profile.limits import REACH_M as REACH_M
    from vla_zenoh.profile.limits import REJECT_FACTOR as REJECT_FACTOR
    from vla_zenoh.profile.limits import ContactLimits as ContactLimits
    from vla_zenoh.profile.limits import JointLimits as JointLimits
    from vla_zenoh.profile.limits import KeepOut as KeepOut
    from vla_zenoh.profile.limits import Limits as Limits
    from vla_zenoh.profile.limits import ReachLimits as ReachLimits
    from vla_zenoh.profile.load import as_robot as as_robot
    from vla_zenoh.profile.load import load_profile as load_profile
    from vla_zenoh.profile.load import load_with_lines as load_with_lines
    from vla_zenoh.profile.load import override as override
    from vla_zenoh.profile.load import profile_file as profile_file
    from vla_zenoh.profile.load import read_profile as read_profile
    from vla_zenoh.profile.load import to_yaml as to_yaml
    from vla_zenoh.profile.profile import PartProfile as PartProfile
    from vla_zenoh.profile.profile import Profile as Profile
    from vla_zenoh.profile.robot import POSE_JOINTS as POSE_JOINTS
    from vla_zenoh.profile.robot import GripperProfile as GripperProfile
    from vla_zenoh.profile.robot import JointEnds as JointEnds
    from vla_zenoh.profile.robot import PartBase as PartBase
    from vla_zenoh.profile.robot import RobotProfile as RobotProfile
    from vla_zenoh.profile.schema import CameraProfile as CameraProfile
    from vla_zenoh.profile.schema import Composition as Composition
    from vla_zenoh.profile.schema import HostProfile as HostProfile
    from vla_zenoh.profile.schema import Timing as Timing
    from vla_zenoh.profile.session import SessionProfile as SessionProfile

__getattr__ = lazy_names(__name__, "load", "profile", "session", "schema", "robot", "limits")
