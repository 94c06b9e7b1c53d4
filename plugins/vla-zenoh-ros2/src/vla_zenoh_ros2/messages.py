"""All message types of one ROS 2 distribution: values, CDR both ways, and type hashes.

Built on rosbags, with services and actions, and the definitions of this package. A service or
action is several messages. What ROS generates for them (request, response, goal id, status, ...) is
made here, so that their hashes are those of the real thing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from vla_zenoh.codec.cdr import CdrMessages
from vla_zenoh.errors import ProfileError, nearest

STORES = {
    "humble": Stores.ROS2_HUMBLE,
    "iron": Stores.ROS2_IRON,
    "jazzy": Stores.ROS2_JAZZY,
    "kilted": Stores.ROS2_KILTED,
    "lyrical": Stores.ROS2_LYRICAL,
}
"""Distribution -> rosbags' definitions of it."""

_TYPE = re.compile(r"([a-z][a-z0-9_]*)/(msg|srv|action)/([A-Za-z][A-Za-z0-9_]*)")
NO_HASH = "TypeHashNotSupported"
"""In place of a hash where the distribution has none (Humble)."""
MAX_PICTURE_BYTES = 128 * 1024 * 1024
SECOND_NS = 1_000_000_000
_EVENT_INFO = "service_msgs/msg/ServiceEventInfo"
_SEPARATOR = "---"
_SUFFIXES = (".msg", ".srv", ".action")
_PARTS = {"srv": ("_Request", "_Response"), "action": ("_Goal", "_Result", "_Feedback")}

Definitions = dict[str, Any]
"""Type -> (constants, fields), as rosbags keeps them."""


def split_type(kind: str) -> tuple[str, str, str]:
    """``package/msg/Name`` in its three parts; a `ProfileError` if it is no such name."""
    match = _TYPE.fullmatch(kind)
    if match is None:
        raise ProfileError(
            f"{kind[:80]!r} is not a ROS type: write package/msg/Name, package/srv/Name or "
            "package/action/Name"
        )
    return match[1], match[2], match[3]


class Messages(CdrMessages):
    """Message types of one ROS 2 distribution.

    Args:
        distribution: one of `STORES`.
        extra: type -> text of definitions that neither ROS nor this package has.

    Raises:
        ProfileError: unknown distribution, or text that is no definition.
    """

    def __init__(self, distribution: str, extra: Mapping[str, str] | None = None) -> None:
        if distribution not in STORES:
            raise ProfileError(
                f"{distribution!r} is not a ROS distribution we know: {', '.join(STORES)}"
            )
        super().__init__(get_typestore(STORES[distribution]))
        self.distribution = distribution
        shipped_too = {
            kind: text for kind, text in shipped().items() if kind not in self._store.fielddefs
        }
        definitions: Definitions = {}
        for kind, text in (shipped_too | dict(extra or {})).items():
            definitions |= parse(kind, text)
        self._register(definitions)
        # ROS 2 makes a ``char`` of message text a ``uint8``; rosbags hashes it as a character. A
        # ``byte`` has a hash of its own, but rosbags reads it as signed.
        self._hashed = copy(self._store)
        self._hashed.fielddefs = _with_uint8(self._store.fielddefs, "char")
        self._store.fielddefs |= _with_uint8(self._hashed.fielddefs, "byte")

    def _register(self, definitions: Mapping[str, Any]) -> None:
        known = {*self._store.fielddefs, *definitions}
        for kind, (_, fields) in definitions.items():
            for name, described in fields:
                wanted = _named(described)
                if wanted is not None and wanted.endswith("/wstring"):
                    raise ProfileError(f"{kind}.{name} is a wstring, which is not supported")
                if wanted is not None and wanted not in known:
                    raise ProfileError(
                        f"{kind}.{name} is a {wanted}, which is not known: give its text as well"
                    )
        try:
            self._store.register(dict(definitions))
        except TypesysError as error:
            raise ProfileError(str(error)) from error

    # -- values -------------------------------------------------------------------------------
    def __contains__(self, kind: str) -> bool:
        return kind in self._store.fielddefs or f"{kind}_Request" in self._store.fielddefs

    def require(self, kind: str) -> None:
        """Raise a `ProfileError` unless `kind` is a known message or service."""
        split_type(kind)
        if kind not in self:
            known = sorted(self._store.fielddefs)
            raise ProfileError(
                f"{kind} is not a type of ROS 2 {self.distribution}{nearest(kind, known)} "
                "A definition of your own is named in ros2.messages"
            )

    def fields(self, kind: str) -> dict[str, Any]:
        """Field -> rosbags' description of it, in order."""
        return {
            name: described
            for name, described in self._store.fielddefs[kind][1]
            if name != "structure_needs_at_least_one_member"
        }

    def definition(self, kind: str) -> str:
        """Text of a message and of all that it is made of, as bags and MCAP files keep it."""
        return self._hashed.generate_msgdef(kind, ros_version=2)[0]

    def new(self, kind: str, **values: Any) -> Any:
        """A message with these fields; the others are zero, empty or false."""
        made = self._store.types[kind]
        defaults = {
            name: self._zero(described)
            for name, described in self.fields(kind).items()
            if name not in values
        }
        return made(**defaults, **values)

    def _zero(self, described: Any) -> Any:
        node, what = described
        if node == Nodetype.NAME:
            return self.new(what)
        if node == Nodetype.BASE:
            if what[0] == "string":
                return ""
            return False if what[0] == "bool" else 0.0 if what[0].startswith("float") else 0
        (inner, of), size = what
        count = size if node == Nodetype.ARRAY else 0
        if inner == Nodetype.BASE and of[0] != "string":
            return np.zeros(count, np.dtype(of[0]))
        return [self._zero((inner, of)) for _ in range(count)]

    # -- hashes -------------------------------------------------------------------------------
    def hash(self, kind: str) -> str:
        """Type hash of a message or service (REP-2016), as ROS 2 of this distribution has it."""
        if self.distribution == "humble":
            return NO_HASH
        if f"{kind}_Request" in self._hashed.fielddefs and kind not in self._hashed.fielddefs:
            self._define_service(kind)
        return self._hashed.hash_rihs01(kind)

    def _define_service(self, service: str) -> None:
        """The types that exist for the sake of the hash: the service itself, and its event."""
        request = (Nodetype.NAME, f"{service}_Request")
        response = (Nodetype.NAME, f"{service}_Response")
        event = f"{service}_Event"
        of_event = [
            ("info", (Nodetype.NAME, _EVENT_INFO)),
            ("request", (Nodetype.SEQUENCE, (request, 1))),
            ("response", (Nodetype.SEQUENCE, (response, 1))),
        ]
        of_service = [
            ("request_message", request),
            ("response_message", response),
            ("event_message", (Nodetype.NAME, event)),
        ]
        self._hashed.fielddefs |= {event: ([], of_event), service: ([], of_service)}


def _with_uint8(definitions: Definitions, instead: str) -> Definitions:
    """The definitions with ``uint8`` in place of another type of one byte."""
    return {
        kind: (constants, [(name, _as_uint8(described, instead)) for name, described in fields])
        for kind, (constants, fields) in definitions.items()
    }


def _as_uint8(described: Any, instead: str) -> Any:
    node, what = described
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return (node, (_as_uint8(what[0], instead), what[1]))
    return (node, ("uint8", 0)) if node == Nodetype.BASE and what[0] == instead else described


def _named(described: Any) -> str | None:
    """The message a field consists of, if it is one."""
    node, what = described
    if node == Nodetype.NAME:
        return what
    return _named(what[0]) if node in (Nodetype.ARRAY, Nodetype.SEQUENCE) else None


# -- text of definitions --------------------------------------------------------------------------
def shipped() -> dict[str, str]:
    """Type -> text of every definition in the folder ``text`` beside this module."""
    root = Path(__file__).parent / "text"
    return {
        file.relative_to(root).with_suffix("").as_posix(): file.read_text("utf-8")
        for file in sorted(root.glob("*/*/*"))
        if file.suffix in _SUFFIXES
    }


def parse(kind: str, text: str) -> Definitions:
    """Definitions of all messages that `kind` consists of, by the text of its file.

    Raises:
        ProfileError: the text is no such definition.
    """
    _, room, _ = split_type(kind)
    if room == "msg":
        return _message(kind, text)
    suffixes = _PARTS[room]
    parts = [f"{part}\n" for part in re.split(rf"(?m)^\s*{_SEPARATOR}\s*$", text)]
    if len(parts) != len(suffixes):
        raise ProfileError(
            f"{kind}: has {len(parts)} parts; wanted {len(suffixes)}, with a line {_SEPARATOR} "
            "between two"
        )
    found: Definitions = {}
    for suffix, part in zip(suffixes, parts, strict=True):
        found |= _message(f"{kind}{suffix}", part)
    if room == "action":
        found |= _around_action(kind)
    return found


def _message(kind: str, text: str) -> Definitions:
    # rosbags knows messages only: a part of a service is read as one, then called what it is.
    package, _, name = split_type(kind)
    as_message = f"{package}/msg/{name}"
    try:
        return {kind: get_types_from_msg(text, as_message)[as_message]}
    except TypesysError as error:
        raise ProfileError(f"{kind} is not a ROS message: {str(error)[:300]}") from error


def _around_action(kind: str) -> Definitions:
    """Messages that ROS generates around goal, result and feedback."""
    goal_id = "unique_identifier_msgs/UUID goal_id\n"
    text = {
        "_SendGoal_Request": f"{goal_id}{kind}_Goal goal\n",
        "_SendGoal_Response": "bool accepted\nbuiltin_interfaces/Time stamp\n",
        "_GetResult_Request": goal_id,
        "_GetResult_Response": f"int8 status\n{kind}_Result result\n",
        "_FeedbackMessage": f"{goal_id}{kind}_Feedback feedback\n",
    }
    return {
        name: found
        for suffix, lines in text.items()
        for name, found in _message(f"{kind}{suffix}", lines).items()
    }
