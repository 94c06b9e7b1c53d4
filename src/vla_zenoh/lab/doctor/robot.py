"""Whether the command node can bound the robot of a profile with what lies on this computer."""

from __future__ import annotations

from collections.abc import Iterator

from vla_zenoh.errors import MissingExtraError, VlaZenohError
from vla_zenoh.lab.doctor.finding import HostFinding
from vla_zenoh.profile import Profile


def robot(profile: Profile, host: str | None = None) -> Iterator[HostFinding]:
    """The robot's description, its meshes, and whether it has what the profile names.

    Args:
        profile: the lab.
        host: which of its hosts this computer is; None: all of them. Nothing is said of one that
            does not run the command node.
    """
    hosts = [profile.hosts[host]] if host is not None else list(profile.hosts.values())
    if not any("command" in part.nodes for part in hosts):
        return
    try:
        from vla_zenoh.control.reachability import make_reachability_filter

        make_reachability_filter(profile)
    except (MissingExtraError, ImportError):
        return  # told with the libraries
    except (VlaZenohError, ValueError) as error:  # the latter Pinocchio's, of what is no URDF
        advice = "vla-zenoh profile check"
        yield HostFinding("robot", "fail", f"{profile.robot.description}: {error}", advice)
        return
    joints = len(profile.robot.arm_joints)
    yield HostFinding("robot", "ok", f"{joints} joints, with collision shapes")
