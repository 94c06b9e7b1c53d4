"""Certificate of a ROS 2 bridge that is reached over a network.

The bridge is a router: its clients bypass our command node. So it accepts only certificates of this
lab, and of those serves the node ``ros2`` only, by the rules of the package vla-zenoh-ros2.
"""

from __future__ import annotations

from vla_zenoh.profile import Profile
from vla_zenoh.profile.schema import TRUSTED_PROTOCOLS, host_of, is_loopback
from vla_zenoh.security.roles import Identity, Role

NODE, USER = "bridge", "ros2"
"""Its name in its certificate, and the one node that it serves."""


def bridges(profile: Profile, host: str | None = None) -> list[Identity]:
    """The bridge, with the host (or only this one) that runs the node ``ros2``.

    None where only that host reaches it.
    """
    places = profile.ros2.connect if profile.ros2 is not None else None
    trusted = [each.partition("/")[0] in TRUSTED_PROTOCOLS for each in places or ()]
    if not any(trusted) and all(map(is_loopback, places or ())):
        return []
    addresses = tuple(dict.fromkeys(map(host_of, places or ())))
    return [
        Identity(Role.BRIDGE, NODE, name, addresses=addresses)
        for name, part in profile.hosts.items()
        if USER in part.nodes and host in (None, name)
    ]
