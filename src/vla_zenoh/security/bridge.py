"""Certificate and access rules of a ROS 2 bridge that is reached over a network.

The bridge is a router: its clients bypass our command node. So it accepts only certificates of this
lab, and of those serves the node ``ros2`` only.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vla_zenoh.profile import Profile
from vla_zenoh.profile.schema import TRUSTED_PROTOCOLS, host_of, is_loopback
from vla_zenoh.security.names import Names
from vla_zenoh.security.roles import EVERY_MESSAGE, IN, OUT, Identity, Role, rule
from vla_zenoh.security.store import AUTHORITY

NODE, USER = "bridge", "ros2"
"""Its name in its certificate, and the one node that it serves."""
ALL_VIEW_KEYS = "@/*/ros2/**"
"""What bridges say of DDS."""
KEYS = ("**", "**/@adv/**", "@/*/@ros2_lv/**", ALL_VIEW_KEYS)
"""Topics and services, what late listeners ask for, what bridges tell each other, and what they say
of DDS. A star stands for no name that begins with an @."""


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
        for name in _users(profile)
        if host in (None, name)
    ]


def bridge_locks(profile: Profile, folder: Path, names: Names) -> dict[str, Any]:
    """Zenoh's sections ``transport`` and ``access_control`` for the bridge.

    On its computer `folder` has ``ca.pem``, ``bridge.pem`` and ``bridge.key``.
    """
    users = [names.current(f"{USER}@{host}") for host in _users(profile)]
    return {
        "transport": {
            "link": {
                "tls": {
                    "root_ca_certificate": str(folder / f"{AUTHORITY}.pem"),
                    "listen_certificate": str(folder / f"{NODE}.pem"),
                    "listen_private_key": str(folder / f"{NODE}.key"),
                    "enable_mtls": True,
                    "close_link_on_expiration": True,
                }
            }
        },
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": [rule(USER, (IN, OUT), EVERY_MESSAGE, KEYS)],
            "subjects": [{"id": USER, "cert_common_names": users}],
            "policies": [{"rules": [USER], "subjects": [USER]}],
        },
    }


def _users(profile: Profile) -> list[str]:
    return [name for name, part in profile.hosts.items() if USER in part.nodes]
