"""Identities of a lab, and which role may do what on which key, also as rules of Zenoh's router.

An identity is the common name of a certificate, ``NODE@HOST``: one for each node of each host, and
one for its operators. A key of `keys.py` without a row here is allowed to no role; a test checks
that there is none.

Zenoh checks messages where they enter and leave the router, so one right takes several rules. The
samples of a writer must enter, and it must *learn* of subscribers, or it never sends; the
declaration of a reader must enter, and the samples must leave. Messages without a rule
are dropped silently.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from enum import Enum
from itertools import product
from typing import TYPE_CHECKING, Any

from vla_zenoh.errors import ProfileError
from vla_zenoh.keys import KEY_PATHS, NODE_KINDS, PRIMITIVES, ROLLING, Keys, worker_node
from vla_zenoh.security.names import UNCHANGED, Names

if TYPE_CHECKING:
    from vla_zenoh.profile import Profile
    from vla_zenoh.profile.stop_profile import StopProfile


class Role(Enum):
    """Role of an identity. What each may do is in `TABLE`."""

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
        """As in its certificate, unless `Names.current` says otherwise."""
        return f"{self.node}@{self.host}"


def operator_role(profile: Profile | StopProfile, host: str) -> Role | None:
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


def _people(profile: Profile | StopProfile) -> Mapping[str, str]:
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
            offers = profile.ros2 is not None and profile.ros2.prefix is not None
            people = (Role.OPERATOR,) if offers else ()
            found.append(Identity(role, name, host, cameras=from_ros2, speaks_for=people))
        else:
            found.append(Identity(role, name, host))
    return found


# -- what each role may do ------------------------------------------------------------------------
_, ROBOT, CAMERA, WORKER, COMMAND, OPERATOR, VIEWER, REPLAY, _ = Role
NODES = frozenset({ROBOT, CAMERA, WORKER, COMMAND})
LOOKERS = frozenset({OPERATOR, VIEWER})
SPEAKERS = NODES | {OPERATOR, REPLAY}
RECORDERS = ("recorder", ROLLING)
"""Nodes that an operator may run: they only subscribe, and publish their status."""


class Act(Enum):
    """An operation on a key."""

    PUT = "put"
    DELETE = "delete"  # no role may, and nodes reject it
    SUBSCRIBE = "subscribe"
    ANSWER = "answer"  # receive queries
    ASK = "ask"
    ANNOUNCE = "announce"  # hold a liveliness token
    WATCH = "watch"  # see such tokens


Allowed = Mapping[Act, Set[Role]]
"""Rights on one member of `Keys`.

Where a key has parameters, a writer may use its own only: its name, worker, cameras. Readers may
read all of them, and a replay may write all of them."""

SETTING: Allowed = {
    Act.PUT: {OPERATOR, REPLAY},
    Act.SUBSCRIBE: {COMMAND} | LOOKERS,
    Act.ANSWER: {COMMAND},
    Act.ASK: LOOKERS,
}
"""Published by the operator, received by the command node, visible to viewers."""


def _streams(names: str, writers: Set[Role], readers: Set[Role]) -> dict[str, Allowed]:
    """The same rights on several members."""
    return {key: {Act.PUT: writers | {REPLAY}, Act.SUBSCRIBE: readers} for key in names.split()}


TABLE: Mapping[str, Allowed] = {
    # Images show people, so a viewer does not see them.
    **_streams(
        "camera_raw camera_jpeg camera_depth camera_fitted", {CAMERA, ROBOT}, {WORKER, OPERATOR}
    ),
    **_streams("seen seen_depth seen_record", {WORKER}, {OPERATOR}),
    **_streams("state_joint state_pose state_gripper", {ROBOT}, {WORKER, COMMAND} | LOOKERS),
    **_streams("state_privileged", {ROBOT}, {WORKER} | LOOKERS),
    **dict.fromkeys(("prompt", "active", "worker", "rate", "speed"), SETTING),
    "holding": {Act.ANNOUNCE: {OPERATOR}, Act.WATCH: {COMMAND}},
    # Every role that may stop the arm may slow it down.
    **_streams("slower held", {OPERATOR}, {COMMAND} | LOOKERS),
    **_streams("stop reset", {OPERATOR}, {COMMAND, ROBOT} | LOOKERS),
    **_streams("save", {OPERATOR}, LOOKERS),
    "task": {
        Act.PUT: {COMMAND, REPLAY},
        Act.SUBSCRIBE: {ROBOT, WORKER} | LOOKERS,
        Act.ANSWER: {COMMAND},
        Act.ASK: {WORKER} | LOOKERS,
    },
    **_streams("delta", {WORKER}, {COMMAND} | LOOKERS),
    "spec": {
        Act.PUT: {WORKER, REPLAY},
        Act.SUBSCRIBE: {CAMERA, COMMAND} | LOOKERS,
        Act.ANSWER: {WORKER},
        Act.ASK: {COMMAND} | LOOKERS,
    },
    **_streams("command_pose command_joint command_gripper", {COMMAND}, {ROBOT} | LOOKERS),
    "primitive": {Act.ANSWER: {WORKER}, Act.ASK: {OPERATOR}},
    # A worker compares what it receives with what the senders say they sent.
    "status": {Act.PUT: SPEAKERS, Act.SUBSCRIBE: {COMMAND, WORKER} | LOOKERS},
    "event": {Act.PUT: SPEAKERS, Act.SUBSCRIBE: {COMMAND} | LOOKERS},
    "alive": {Act.ANNOUNCE: SPEAKERS, Act.WATCH: NODES | LOOKERS | {REPLAY}},
    "clock": {Act.ANSWER: SPEAKERS, Act.ASK: NODES | LOOKERS | {REPLAY}},
    **_streams("sim_scene", {ROBOT}, {CAMERA, OPERATOR}),
    **_streams("sim_objects", {ROBOT}, LOOKERS),
    **_streams("sim_reset", {OPERATOR}, {ROBOT, OPERATOR}),
    "sim_step": {Act.ANSWER: {ROBOT}, Act.ASK: {OPERATOR}},
}

OWN = frozenset({Act.PUT, Act.ANSWER, Act.ANNOUNCE})
"""Acts that a node may do in its own name only."""


def expressions(keys: Keys, member: str, identity: Identity, act: Act) -> Iterator[str]:
    """Key expressions of a `member` of `Keys` on which `identity` does `act`, if its role may."""
    path = KEY_PATHS[member]
    for parts in product(*(_choices(name, identity, act) for name in path.parameters)):
        yield path.text(keys, *parts)


def _choices(parameter: str, identity: Identity, act: Act) -> tuple[str, ...]:
    if act not in OWN or (identity.role is REPLAY and act is Act.PUT):
        return ("*",)
    if parameter == "node":
        return RECORDERS if identity.role is OPERATOR else (identity.node,)
    if parameter == "worker":
        return (identity.worker,) if identity.worker else ()
    if parameter == "primitive":
        return ("*",) if identity.worker == PRIMITIVES else ()
    if parameter in ("form", "holder"):
        return ("*",)
    if parameter == "camera":  # a worker shows what it saw of any camera
        return ("*",) if identity.role is Role.WORKER else identity.cameras
    return ()


@dataclass(frozen=True, slots=True)
class Right:
    """One thing that one identity may do."""

    identity: Identity
    act: Act
    key: str


def rights(keys: Keys, identity: Identity) -> list[Right]:
    """All rights of `identity`; none are listed for a router, which forwards everything."""
    return [
        Right(identity, act, key)
        for member, allowed in TABLE.items()
        for act, roles in allowed.items()
        if identity.roles & roles
        for key in expressions(keys, member, identity, act)
    ]


IN, OUT = "ingress", "egress"
WISHES = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")
"""Leave the router with the key of the query, which may be wider than that of the reply."""

MESSAGES: Mapping[Act, Sequence[tuple[str, str]]] = {
    # what is done: (way through the router, message)
    Act.PUT: ((IN, "put"), (OUT, "declare_subscriber")),
    Act.DELETE: ((IN, "delete"),),
    Act.SUBSCRIBE: ((IN, "declare_subscriber"), (OUT, "put")),
    Act.ANSWER: ((IN, "declare_queryable"), (IN, "reply"), (OUT, "query")),
    Act.ASK: ((IN, "query"), (OUT, "declare_queryable"), (OUT, "reply")),
    Act.ANNOUNCE: (
        (IN, "liveliness_token"),
        (OUT, "declare_liveliness_subscriber"),
        (OUT, "liveliness_query"),
    ),
    Act.WATCH: (
        (IN, "declare_liveliness_subscriber"),
        (IN, "liveliness_query"),
        (OUT, "liveliness_token"),
    ),
}
EVERY_MESSAGE = tuple(dict.fromkeys(message for ways in MESSAGES.values() for _, message in ways))


def access_control(profiles: Iterable[Profile], names: Names = UNCHANGED) -> dict[str, Any]:
    """Zenoh's section ``access_control`` for a router that serves the robots of these profiles.

    Whatever is not named is denied.
    """
    rules: dict[str, dict[str, Any]] = {}
    of_subject: dict[str, dict[str, None]] = {}
    for profile in profiles:
        for identity in identities(profile):
            own = of_subject.setdefault(identity.common_name, {})
            for made in _rules(identity, profile.keys_of_all_parts):
                rules.setdefault(made["id"], made)
                own[made["id"]] = None
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": list(rules.values()),
        "subjects": [
            {"id": name, "cert_common_names": [names.current(name)]} for name in of_subject
        ],
        "policies": [{"rules": list(own), "subjects": [name]} for name, own in of_subject.items()],
    }


def _rules(identity: Identity, keys: Keys) -> list[dict[str, Any]]:
    if identity.role is Role.ROUTER:
        return [rule("router", (IN, OUT), EVERY_MESSAGE, ["**"])]
    granted: dict[tuple[str, str], dict[str, None]] = {}
    for right in rights(keys, identity):
        for flow, message in MESSAGES[right.act]:
            wish = flow == OUT and message in WISHES
            # A subscriber may ask for more than this key: the writer must still learn of it.
            key = "**" if wish else right.key
            granted.setdefault((flow, message), {})[key] = None
            if right.act is Act.SUBSCRIBE:
                granted[flow, message].update(dict.fromkeys(wide(keys, identity)))
            if right.act is Act.WATCH and flow == IN and identity.roles & LOOKERS:
                # They may ask which robots there are; the answer contains those they may know.
                granted[flow, message][keys.all_robots] = None
    who = f"{keys.root}/{keys.robot}:{identity.common_name}"
    return [
        rule(f"{who}:{flow}:{message}", (flow,), (message,), found)
        for (flow, message), found in granted.items()
    ]


def wide(keys: Keys, identity: Identity) -> list[str]:
    """Key expressions with which an operator may subscribe to many keys at once.

    Zenoh allows a subscription only as a whole. An operator reads everything. A viewer may ask for
    all of a group, as ``state/*``, where it may read each of its keys.
    """
    if Role.OPERATOR in identity.roles:
        return [keys.all_keys]
    if identity.role is not Role.VIEWER:
        return []
    groups: dict[str, bool] = {}
    for member, allowed in TABLE.items():
        may = identity.role in allowed.get(Act.SUBSCRIBE, ())
        for key in expressions(keys, member, identity, Act.SUBSCRIBE):
            above, _, _ = key.rpartition("/")
            groups[above] = groups.get(above, True) and may
    top = keys.all_keys.removesuffix("/**")
    return [f"{group}/*" for group, may in groups.items() if may and group != top]


def rule(
    name: str, flows: Iterable[str], messages: Iterable[str], keys: Iterable[str]
) -> dict[str, Any]:
    """A rule of Zenoh that allows `messages` on `keys`."""
    return {
        "id": name,
        "messages": list(messages),
        "flows": list(flows),
        "permission": "allow",
        "key_exprs": list(keys),
    }
