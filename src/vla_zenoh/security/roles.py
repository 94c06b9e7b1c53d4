"""Table of rights: which role may do what on which key, and the rights of one identity.

A key of `keys.py` without a row here is allowed to no role; a test checks that there is none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from itertools import product

from vla_zenoh.keys import KEY_PATHS, PRIMITIVES, ROLLING, Keys
from vla_zenoh.security.identity import Identity, Role

_, ROBOT, CAMERA, WORKER, COMMAND, OPERATOR, VIEWER, REPLAY, _ = Role
NODES = frozenset({ROBOT, CAMERA, WORKER, COMMAND})
LOOKERS = frozenset({OPERATOR, VIEWER})
SPEAKERS = NODES | {OPERATOR, REPLAY}
RECORDERS = ("recorder", ROLLING)
"""Nodes that an operator may run: they only subscribe, and publish their status."""
NOBODY: frozenset[Role] = frozenset()


class Act(Enum):
    """An operation on a key."""

    PUT = "put"
    DELETE = "delete"  # no role may, and nodes reject it
    SUBSCRIBE = "subscribe"
    ANSWER = "answer"  # receive queries
    ASK = "ask"
    ANNOUNCE = "announce"  # hold a liveliness token
    WATCH = "watch"  # see such tokens


@dataclass(frozen=True, slots=True)
class Row:
    """Rights on one member of `Keys`.

    Where a key has parameters, a writer may use its own only: its name, worker, cameras. Readers
    may read all of them, and a replay may write all of them.
    """

    member: str
    put: frozenset[Role] = NOBODY
    delete: frozenset[Role] = NOBODY
    subscribe: frozenset[Role] = NOBODY
    answer: frozenset[Role] = NOBODY
    ask: frozenset[Role] = NOBODY
    announce: frozenset[Role] = NOBODY
    watch: frozenset[Role] = NOBODY

    def roles(self, act: Act) -> frozenset[Role]:
        """Roles that may do `act`."""
        return getattr(self, act.value)


def _setting(member: str) -> Row:
    """A setting: published by the operator, received by the command node, visible to viewers."""
    return Row(
        member,
        put=frozenset({OPERATOR, REPLAY}),
        subscribe=frozenset({COMMAND}) | LOOKERS,
        answer=frozenset({COMMAND}),
        ask=LOOKERS,
    )


def _stream(member: str, writers: set[Role], readers: set[Role]) -> Row:
    return Row(member, put=frozenset(writers) | {REPLAY}, subscribe=frozenset(readers))


TABLE = (
    # Images show people, so a viewer does not see them.
    _stream("camera_raw", {CAMERA, ROBOT}, {WORKER, OPERATOR}),
    _stream("camera_jpeg", {CAMERA, ROBOT}, {WORKER, OPERATOR}),
    _stream("camera_depth", {CAMERA, ROBOT}, {WORKER, OPERATOR}),
    _stream("camera_fitted", {CAMERA, ROBOT}, {WORKER, OPERATOR}),
    _stream("seen", {WORKER}, {OPERATOR}),
    _stream("seen_depth", {WORKER}, {OPERATOR}),
    _stream("seen_record", {WORKER}, {OPERATOR}),
    _stream("state_joint", {ROBOT}, {WORKER, COMMAND, OPERATOR, VIEWER}),
    _stream("state_pose", {ROBOT}, {WORKER, COMMAND, OPERATOR, VIEWER}),
    _stream("state_gripper", {ROBOT}, {WORKER, COMMAND, OPERATOR, VIEWER}),
    _stream("state_privileged", {ROBOT}, {WORKER, OPERATOR, VIEWER}),
    _setting("prompt"),
    _setting("active"),
    Row("holding", announce=frozenset({OPERATOR}), watch=frozenset({COMMAND})),
    _setting("worker"),
    _setting("rate"),
    _setting("speed"),
    # Every role that may stop the arm may slow it down.
    _stream("slower", {OPERATOR}, {COMMAND, OPERATOR, VIEWER}),
    _stream("held", {OPERATOR}, {COMMAND, OPERATOR, VIEWER}),
    _stream("stop", {OPERATOR}, {COMMAND, OPERATOR, VIEWER}),
    _stream("reset", {OPERATOR}, {COMMAND, ROBOT, OPERATOR, VIEWER}),
    _stream("save", {OPERATOR}, {OPERATOR, VIEWER}),
    Row(
        "task",
        put=frozenset({COMMAND, REPLAY}),
        subscribe=frozenset({ROBOT, WORKER}) | LOOKERS,
        answer=frozenset({COMMAND}),
        ask=frozenset({WORKER}) | LOOKERS,
    ),
    _stream("delta", {WORKER}, {COMMAND, OPERATOR, VIEWER}),
    Row(
        "spec",
        put=frozenset({WORKER, REPLAY}),
        subscribe=frozenset({CAMERA, COMMAND, OPERATOR, VIEWER}),
        answer=frozenset({WORKER}),
        ask=frozenset({COMMAND, OPERATOR, VIEWER}),
    ),
    _stream("command_pose", {COMMAND}, {ROBOT, OPERATOR, VIEWER}),
    _stream("command_joint", {COMMAND}, {ROBOT, OPERATOR, VIEWER}),
    _stream("command_gripper", {COMMAND}, {ROBOT, OPERATOR, VIEWER}),
    Row("primitive", answer=frozenset({WORKER}), ask=frozenset({OPERATOR})),
    Row("status", put=SPEAKERS, subscribe=frozenset({COMMAND}) | LOOKERS),
    Row("event", put=SPEAKERS, subscribe=frozenset({COMMAND}) | LOOKERS),
    Row("alive", announce=SPEAKERS, watch=NODES | LOOKERS | {REPLAY}),
    Row("clock", answer=SPEAKERS, ask=NODES | LOOKERS | {REPLAY}),
    _stream("sim_scene", {ROBOT}, {CAMERA, OPERATOR}),
    _stream("sim_objects", {ROBOT}, {OPERATOR, VIEWER}),
    _stream("sim_reset", {OPERATOR}, {ROBOT, OPERATOR}),
    Row("sim_step", answer=frozenset({ROBOT}), ask=frozenset({OPERATOR})),
)

OWN = frozenset({Act.PUT, Act.ANSWER, Act.ANNOUNCE})
"""Acts that a node may do in its own name only."""


def expressions(keys: Keys, member: str, identity: Identity, act: Act) -> Iterator[str]:
    """The key expressions on which `identity` does `act`, where its role may do it at all.

    Args:
        keys: of the robot.
        member: of `Keys`.
        identity: of the node or operator.
        act: in its own name only if it is in `OWN`.
    """
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
        for row in TABLE
        for act in Act
        if identity.roles & row.roles(act)
        for key in expressions(keys, row.member, identity, act)
    ]
