"""Table of rights: which role may do what on which key, and the rights of one identity.

A key of `keys.py` without a row here is allowed to no role; a test checks that there is none.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from itertools import product

from vla_zenoh.keys import Keys
from vla_zenoh.security.identity import Identity, Role

_, ROBOT, CAMERA, WORKER, COMMAND, OPERATOR, VIEWER, REPLAY, _ = Role
NODES = frozenset({ROBOT, CAMERA, WORKER, COMMAND})
LOOKERS = frozenset({OPERATOR, VIEWER})
SPEAKERS = NODES | {OPERATOR, REPLAY}
RECORDER = "recorder"
"""Nodes that an operator may run: they only subscribe, and publish their status."""
NOBODY: frozenset[Role] = frozenset()

_ANY = "any"
"""Stands for `*` while a key is made: a key's parts may not be that."""


class Act(Enum):
    """An operation on a key."""

    PUT = "put"
    DELETE = "delete"  # no role may, and nodes reject it
    SUBSCRIBE = "subscribe"
    ANSWER = "answer"  # be asked by queries
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
    _stream("camera_fitted", {CAMERA, ROBOT}, {WORKER, OPERATOR}),
    _stream("seen", {WORKER}, {OPERATOR}),
    _stream("seen_record", {WORKER}, {OPERATOR}),
    _stream("state_joint", {ROBOT}, {WORKER, COMMAND, OPERATOR, VIEWER}),
    _stream("state_pose", {ROBOT}, {WORKER, COMMAND, OPERATOR, VIEWER}),
    _stream("state_gripper", {ROBOT}, {WORKER, COMMAND, OPERATOR, VIEWER}),
    _setting("prompt"),
    _setting("active"),
    Row("holding", announce=frozenset({OPERATOR}), watch=frozenset({COMMAND})),
    _setting("worker"),
    _setting("rate"),
    _setting("speed"),
    # Every role that may stop the arm may slow it down.
    _stream("slower", {OPERATOR}, {COMMAND, OPERATOR, VIEWER}),
    _stream("stop", {OPERATOR}, {COMMAND, OPERATOR, VIEWER}),
    _stream("reset", {OPERATOR}, {COMMAND, ROBOT, OPERATOR, VIEWER}),
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
    Row("status", put=SPEAKERS, subscribe=frozenset({COMMAND}) | LOOKERS),
    Row("event", put=SPEAKERS, subscribe=frozenset({COMMAND}) | LOOKERS),
    Row("alive", announce=SPEAKERS, watch=NODES | LOOKERS | {REPLAY}),
    Row("clock", answer=SPEAKERS, ask=NODES | LOOKERS | {REPLAY}),
    _stream("sim_scene", {ROBOT}, {CAMERA, OPERATOR}),
    _stream("sim_objects", {ROBOT}, {OPERATOR, VIEWER}),
    _stream("sim_reset", {OPERATOR}, {ROBOT, OPERATOR}),
    Row("sim_step", answer=frozenset({ROBOT}), ask=frozenset({OPERATOR})),
)

NO_KEYS = ("short", "full", "group", "on")
"""Members of `Keys` that give text and no key of their own."""
OWN = frozenset({Act.PUT, Act.ANSWER, Act.ANNOUNCE})
"""Acts that a node may do in its own name only."""


def key_members() -> dict[str, tuple[str, ...]]:
    """Every member of `Keys` that makes one key -> its parameters. Selectors are left out."""
    out: dict[str, tuple[str, ...]] = {}
    for name, value in vars(Keys).items():
        make = value.fget if isinstance(value, property) else value
        if name.startswith(("_", "all_")) or name in NO_KEYS or not inspect.isfunction(make):
            continue
        signature = inspect.signature(make)
        if signature.return_annotation == "str":
            out[name] = tuple(signature.parameters)[1:]
    return out


def expressions(keys: Keys, member: str, identity: Identity, act: Act) -> Iterator[str]:
    """The key expressions on which `identity` does `act`, where its role may do it at all.

    Args:
        keys: of the robot.
        member: of `Keys`.
        identity: of the node or operator.
        act: in its own name only if it is in `OWN`.
    """
    parameters = key_members()[member]
    if not parameters:
        yield str(getattr(keys, member))
        return
    choices = [_choices(name, identity, act) for name in parameters]
    for chosen in product(*choices):
        yield _with_stars(keys, member, chosen)


def _choices(parameter: str, identity: Identity, act: Act) -> tuple[str, ...]:
    if act not in OWN or (identity.role is REPLAY and act is Act.PUT):
        return ("*",)
    if parameter == "node":
        return (RECORDER if identity.role is OPERATOR else identity.node,)
    if parameter == "worker":
        return (identity.worker,) if identity.worker else ()
    if parameter in ("form", "holder"):
        return ("*",)
    if parameter == "camera":  # a worker shows what it saw of any camera
        return ("*",) if identity.role is Role.WORKER else identity.cameras
    return ()


def _with_stars(keys: Keys, member: str, chosen: tuple[str, ...]) -> str:
    make = getattr(keys, member)
    fixed = [_ANY if part == "*" else part for part in chosen]
    key, parts = str(make(*fixed)), list(chosen)
    if "*" not in parts:
        return key
    # Parameters stand in a key in their order, each once: take them from behind.
    chunks = key.split("/")
    at = len(chunks) - 1
    for part, text in zip(reversed(parts), reversed(fixed), strict=True):
        while chunks[at] != text:
            at -= 1
        chunks[at] = part
        at -= 1
    return "/".join(chunks)


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
