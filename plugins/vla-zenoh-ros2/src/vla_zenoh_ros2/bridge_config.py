"""What a profile uses of a ROS graph, and the zenoh-bridge-ros2dds that lets only that through."""

from __future__ import annotations

import ipaddress
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import Profile
from vla_zenoh.profile.robot import GRIPPER_ACTIONS, Ros2Gripper, Ros2Profile
from vla_zenoh.profile.schema import TRUSTED_PROTOCOLS, endpoint_faults, host_of, is_loopback
from vla_zenoh.security.bridge import NODE, USER
from vla_zenoh.security.names import Names
from vla_zenoh.security.roles import EVERY_MESSAGE, IN, OUT, rule
from vla_zenoh.security.store import AUTHORITY
from vla_zenoh_ros2.keys import (
    ANSWER_TOPIC,
    BOOL,
    EMPTY,
    LOG,
    OPERATIONS,
    ROSOUT,
    STATUS_TOPIC,
    TEXT,
    Endpoint,
    EntityRole,
)
from vla_zenoh_ros2.pictures import COMPRESSED_IMAGE, IMAGE
from vla_zenoh_ros2.readers import JOINT_STATE, WRENCH
from vla_zenoh_ros2.transforms import TF, TF_MESSAGE, TF_STATIC
from vla_zenoh_ros2.writers import DIAGNOSTICS, GRASP

PROGRAM = "zenoh-bridge-ros2dds"
ALLOWED_AS = {
    EntityRole.SUBSCRIBER: "publishers",
    EntityRole.PUBLISHER: "subscribers",
    EntityRole.CLIENT: "service_servers",
    EntityRole.SERVER: "service_clients",
    EntityRole.ACTION_CLIENT: "action_servers",
}
"""Our end -> what the robot's side of it is called in the bridge's list."""
KINDS = (*ALLOWED_AS.values(), "action_clients")
"""All kinds in that list. One that is empty lets nothing through."""

RANKS = {
    **dict.fromkeys((EMPTY, BOOL, TEXT), "1:express"),
    **dict.fromkeys((JOINT_STATE, WRENCH), "2"),
    **dict.fromkeys((IMAGE, COMPRESSED_IMAGE), "6"),
}
"""Type -> Zenoh's number of a priority, as `vla_zenoh.bus.session` has for orders, states and
images. Each has a queue of its own: in one with the images a stop would be dropped."""

WIDTH = 80
HEAD = """\
// {program} for the profile {name}. Written by `vla-zenoh profile bridge-config`.
// What the profile uses of the robot's ROS graph is let through, by its whole name, and nothing
// else. What a listener does not take in time is dropped: the next joint state is on its way, and
// a slow listener must not hold up the others. Requests go first, images last.
"""


def bridge_config(
    profile: Profile, locks: Mapping[str, Any] | None = None, *, beside: bool = False
) -> dict[str, Any]:
    """Zenoh's configuration, with the plugin's section.

    Args:
        locks: sections for certificates and access, where the bridge is reached by TLS.
        beside: the bridge is a client of our router; else it listens where the node ``ros2``
            looks for it: ``ros2.connect``, or ``session.connect``.

    Raises:
        ProfileError: there is no such bridge, or it would be open to the network.
    """
    ros2 = _section(profile)
    if beside and ros2.connect is not None:
        raise ProfileError(
            f"profile {profile.name}: ros2.connect says that the bridge is at "
            f"{', '.join(ros2.connect)}; leave that out where it is beside our router"
        )
    if profile.session.security is not None and ros2.connect is None:
        raise ProfileError(
            f"profile {profile.name}: ros2.connect is missing: in a secured lab the bridge has a "
            "router of its own, as tcp/127.0.0.1:7450"
        )
    places = ros2.connect or profile.session.connect
    waits = {
        "timeout_ms": -1,
        "exit_on_failure": False,
        "retry": {"period_init_ms": 100, "period_max_ms": 500},
    }
    return {
        "mode": "client" if beside else "router",
        "listen": {"endpoints": [] if beside else [_listening(profile, e) for e in places]},
        "connect": {"endpoints": list(places), **waits} if beside else {"endpoints": []},
        "scouting": {"multicast": {"enabled": False}},
        # The status of an action is kept for those who come late, which needs them.
        "timestamping": {"enabled": True},
        **(locks or {}),
        "plugins": {
            "ros2dds": {
                "domain": ros2.domain,
                "reliable_routes_blocking": False,
                "pub_priorities": _ranked(profile),
                "allow": _allowed(profile),
            }
        },
    }


KEYS = ("**", "**/@adv/**", "@/*/@ros2_lv/**", "@/*/ros2/**")
"""Topics and services, what late listeners ask for, what bridges tell each other, and what they say
of DDS. A star stands for no name that begins with an @."""


def bridge_locks(profile: Profile, folder: Path, names: Names) -> dict[str, Any]:
    """Zenoh's sections ``transport`` and ``access_control`` for the bridge.

    On its computer `folder` has ``ca.pem``, ``bridge.pem`` and ``bridge.key``.
    """
    hosts = [name for name, part in profile.hosts.items() if USER in part.nodes]
    users = [names.current(f"{USER}@{host}") for host in hosts]
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


def bridge_text(profile: Profile, config: Mapping[str, Any]) -> str:
    """That configuration as the text of a JSON5 file."""
    head = HEAD.format(program=PROGRAM, name=profile.name)
    return f"{head}{_json(dict(config))}\n"


def _json(value: Any, margin: str = "") -> str:
    """JSON with short values on one line, so that the list stays readable."""
    flat = json.dumps(value, ensure_ascii=False)
    if len(margin) + len(flat) <= WIDTH or not isinstance(value, (dict, list)):
        return flat
    inner = f"{margin}  "
    if isinstance(value, list):
        parts, ends = [_json(each, inner) for each in value], "[]"
    else:
        parts = [f"{json.dumps(key)}: {_json(each, inner)}" for key, each in value.items()]
        ends = "{}"
    return f",\n{inner}".join(parts).join((f"{ends[0]}\n{inner}", f"\n{margin}{ends[1]}"))


def bridge_command(profile: Profile, file: str = "bridge.json5") -> str:
    """The line that starts the bridge; it has to know which ROS it speaks to."""
    return f"ROS_DISTRO={_section(profile).distribution} {PROGRAM} -c {file}"


def is_locked(profile: Profile) -> bool:
    """Whether the bridge is reached by TLS, and so has a certificate."""
    ros2 = profile.ros2
    return ros2 is not None and any(map(_is_trusted, ros2.connect or ()))


def _section(profile: Profile) -> Ros2Profile:
    ros2 = profile.ros2
    if ros2 is None:
        raise ProfileError(
            f"profile {profile.name!r} has no section ros2; give --profile panda_ros2, or your own"
        )
    if ros2.bridge != "ros2dds":
        raise ProfileError(
            f"profile {profile.name}: ros2.bridge is {ros2.bridge}, and such a robot needs no "
            f"bridge; {PROGRAM} is for ros2dds"
        )
    return ros2


def _listening(profile: Profile, endpoint: str) -> str:
    if not (_is_trusted(endpoint) or is_loopback(endpoint) or profile.session.insecure):
        plain = profile.session.model_copy(update={"security": None})
        (_, why), *_ = endpoint_faults([endpoint], plain, "listen")
        raise ProfileError(f"profile {profile.name}: a bridge that listens at {endpoint} {why}")
    try:
        ipaddress.ip_address(host_of(endpoint))
    except ValueError:
        if not is_loopback(endpoint):
            # A computer often resolves its own name to an address that others cannot reach.
            return f"{endpoint.partition('/')[0]}/[::]:{endpoint.rpartition(':')[2]}"
    return endpoint


def _is_trusted(endpoint: str) -> bool:
    return endpoint.partition("/")[0] in TRUSTED_PROTOCOLS


def _allowed(profile: Profile) -> dict[str, list[str]]:
    """Kind of end on the robot's side -> expressions, each of one whole name."""
    out: dict[str, list[str]] = {kind: [] for kind in KINDS}
    for end in endpoints(profile):
        out[ALLOWED_AS[end.role]].append(f"^{re.escape(end.name)}$")
    return {kind: sorted(set(names)) for kind, names in out.items()}


def _ranked(profile: Profile) -> list[str]:
    """Expressions of names, each with the Zenoh priority of what the bridge sends us of it."""
    heard = (end for end in endpoints(profile) if end.role is EntityRole.SUBSCRIBER)
    ranked = {f"^{re.escape(end.name)}$={RANKS[end.type]}" for end in heard if end.type in RANKS}
    return sorted(ranked)


def endpoints(profile: Profile) -> tuple[Endpoint, ...]:
    """Our ends in the ROS graph, each once; none where the profile has no section ros2.

    Quality of service is left at its default: it is the node's.
    """
    ros2 = profile.ros2
    if ros2 is None:
        return ()
    cameras = profile.ros2_cameras().values()
    topics = [one for camera in cameras for one in (camera, camera.depth) if one is not None]
    found = [Endpoint(EntityRole.SUBSCRIBER, one.topic, one.type) for one in topics]
    for part in profile.part_names if profile.robot.driver == "ros2" else ():
        own = profile.of_part(part).ros2 or ros2
        found += _arm(own, profile.robot.command)
        found += [] if own.gripper is None else _gripper(own.gripper)
    if ros2.tf:
        ends = (EntityRole.SUBSCRIBER, EntityRole.PUBLISHER)
        found += [Endpoint(end, topic, TF_MESSAGE) for end in ends for topic in (TF, TF_STATIC)]
    if ros2.prefix is not None:
        found += _operations(ros2.prefix, services=ros2.services)
    return tuple(dict.fromkeys(found))


def _arm(ros2: Ros2Profile, command: str) -> Iterator[Endpoint]:
    for topic in (ros2.joint_states, ros2.finger_states or ros2.joint_states):
        yield Endpoint(EntityRole.SUBSCRIBER, topic, JOINT_STATE)
    if ros2.wrench is not None:
        yield Endpoint(EntityRole.SUBSCRIBER, ros2.wrench.topic, WRENCH)
    output = ros2.joint_command if command == "joint" else ros2.pose_command
    if output is not None:
        yield Endpoint(EntityRole.PUBLISHER, output.topic, output.type)


def _gripper(gripper: Ros2Gripper) -> Iterator[Endpoint]:
    if gripper.type not in GRIPPER_ACTIONS:
        yield Endpoint(EntityRole.PUBLISHER, gripper.topic, gripper.type)
        return
    yield Endpoint(EntityRole.ACTION_CLIENT, gripper.topic, gripper.type)
    if gripper.grasp is not None:
        yield Endpoint(EntityRole.ACTION_CLIENT, gripper.grasp, GRASP)


def _operations(prefix: str, *, services: bool) -> Iterator[Endpoint]:
    for one in OPERATIONS:
        yield Endpoint(EntityRole.SUBSCRIBER, f"{prefix}/{one.name}", one.type)
        if services:
            yield Endpoint(EntityRole.SERVER, f"{prefix}/{one.service}", one.service_type)
    yield Endpoint(EntityRole.PUBLISHER, f"{prefix}/{ANSWER_TOPIC}", TEXT)
    yield Endpoint(EntityRole.PUBLISHER, f"{prefix}/{STATUS_TOPIC}", DIAGNOSTICS)
    yield Endpoint(EntityRole.PUBLISHER, ROSOUT, LOG)
