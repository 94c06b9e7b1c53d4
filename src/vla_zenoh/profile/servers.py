"""Which node serves what, by the profile."""

from __future__ import annotations

from vla_zenoh.profile.fit import cameras_of, node_name
from vla_zenoh.profile.profile import Profile


def camera_servers(profile: Profile) -> dict[str, str]:
    """Camera -> name of the node that serves it.

    A camera that no host runs is one of ``vla-zenoh node camera``, started by hand under its own
    name.
    """
    servers = dict.fromkeys(profile.cameras, "camera")
    for host, part in profile.hosts.items():
        for camera in cameras_of(profile, part):
            servers[camera] = node_name(profile, host, "camera")
    from_ros2 = (
        name for name, camera in profile.cameras.items() if camera.source.startswith("ros2:")
    )
    return servers | dict.fromkeys(from_ros2, "ros2")
