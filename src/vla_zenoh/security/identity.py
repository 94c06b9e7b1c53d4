"""Identities of a lab: one for each node of each host, and one for its operators.

An identity is the common name of a certificate, ``NODE@HOST``; the router's rules go by it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

from vla_zenoh.errors import ProfileError
from vla_zenoh.keys import NODE_KINDS, PRIMITIVES, worker_node

if TYPE_CHECKING:
    from vla_zenoh.profile import Profile


class Role(Enum):
    """Role of an identity. What each may do is in `vla_zenoh.security.roles`."""

    ROUTER = "router"  # forwards everything
    ROBOT = "robot"
    CAMERA = "camera"
    WORKER = "worker"
    COMMAND = "command"
    OPERATOR = "operator"  # a person who drives the robot
    VIEWER = "viewer"  # a person or screen that watches, without images
    REPLAY = "replay"  # publishes a recording in place of all nodes; for routers without a robot
    BRIDGE = "bridge"  # of a ROS 2 robot; serves the node ros2 only, has no rights at our routers


PEOPLE = (Role.OPERATOR, Role.VIEWER, Role.REPLAY)
TELEOP = "teleop"
"""Worker name of an operator who teleoperates."""


@dataclass(frozen=True, slots=True)
class Identity:
    """Holder of a certificate.

    It `speaks_for` further roles: the node of a ROS 2 robot publishes the requests of ROS users,
    the node of the primitives changes settings for those who may ask it.
    """

    role: Role
    node: str  # name on the bus; of a person operator, viewer or replay
    host: str  # in the profile
    worker: str = ""
    cameras: tuple[str, ...] = ()  # that it serves
    speaks_for: tuple[Role, ...] = ()
    addresses: tuple[str, ...] = ()  # of a bridge: at which it serves

    @property
    def roles(self) -> frozenset[Role]:
        """Its own role and those in `speaks_for`."""
        return frozenset({self.role, *self.speaks_for})

    @property
    def common_name(self) -> str:
        """As in its certificate."""
        return f"{self.node}@{self.host}"


def operator_role(profile: Profile, host: str) -> Role | None:
    """Role of a person at `host`; None: the profile does not know that host."""
    if host in (people := _people(profile)):
        return Role(people[host])
    if host not in profile.hosts:
        return None
    return Role.OPERATOR if "command" in profile.hosts[host].nodes else Role.VIEWER


def identities_of(profile: Profile, host: str) -> list[Identity]:
    """All identities at `host`, or a `ProfileError`: its nodes and its operators."""
    role = operator_role(profile, host)
    if role is None:
        known = ", ".join(sorted({*profile.hosts, *_people(profile)}))
        raise ProfileError(
            f"profile {profile.name} knows no host {host!r}, it knows: {known}. For a computer "
            "that only watches or drives, use --role viewer or --role operator"
        )
    found = [*_nodes(profile, host)] if host in profile.hosts else []
    names = {identity.node for identity in found}
    return [*found, *(one for one in operator_identities(host, role) if one.node not in names)]


def operator_identities(host: str, role: Role) -> list[Identity]:
    """Identities of a person at a host; an operator is also a worker, for teleoperation."""
    people = Identity(role, role.value, host)
    if role is not Role.OPERATOR:
        return [people]
    return [people, Identity(Role.WORKER, worker_node(TELEOP), host, worker=TELEOP)]


def identities(profile: Profile) -> list[Identity]:
    """All identities of the lab."""
    hosts = dict.fromkeys([*profile.hosts, *_people(profile)])
    return [identity for host in hosts for identity in identities_of(profile, host)]


def expected_nodes(profile: Profile) -> dict[str, str]:
    """Nodes that publish a status where the profile runs -> their hosts.

    A router that is the only one is left out: a client that receives anything has reached it, and
    it may be a ``zenohd``, which publishes none.
    """
    found = {one.node: host for host in profile.hosts for one in _nodes(profile, host)}
    found.pop("router", None)
    return found


def _people(profile: Profile) -> Mapping[str, str]:
    return profile.session.security.people if profile.session.security is not None else {}


def _nodes(profile: Profile, host: str) -> list[Identity]:
    part = profile.hosts[host]
    from_ros2 = tuple(n for n, c in profile.cameras.items() if c.from_ros2)
    found: list[Identity] = []
    for kind in part.nodes:
        role, name = Role(NODE_KINDS[kind].role), profile.node_name(host, kind)
        if kind == PRIMITIVES:
            found.append(Identity(role, name, host, worker=PRIMITIVES, speaks_for=(Role.OPERATOR,)))
        elif role is Role.WORKER:
            workers = profile.workers_of(part)
            found += [Identity(role, worker_node(one), host, worker=one) for one in workers]
        elif role is Role.CAMERA:
            served = tuple(c for c in profile.cameras_of(part) if c not in from_ros2)
            found.append(Identity(role, name, host, cameras=served))
        elif kind == "ros2":
            offers = profile.ros2 is not None and profile.ros2.services is not None
            people = (Role.OPERATOR,) if offers else ()
            found.append(Identity(role, name, host, cameras=from_ros2, speaks_for=people))
        else:
            found.append(Identity(role, name, host))
    return found
