"""Message text (``.msg``, ``.srv``, ``.action``) to definitions, and the text shipped with us.

A service or action is several messages. What ROS generates for them (request, response, goal id,
status, ...) is made here, so that their hashes are those of the real thing.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from rosbags.typesys import TypesysError, get_types_from_msg

from vla_zenoh.errors import ProfileError
from vla_zenoh.ros2.names import split_type

SEPARATOR = "---"
_SUFFIXES = (".msg", ".srv", ".action")
_PARTS = {"srv": ("_Request", "_Response"), "action": ("_Goal", "_Result", "_Feedback")}

Definitions = dict[str, Any]
"""Type -> (constants, fields), as rosbags keeps them."""


def shipped() -> dict[str, str]:
    """Type -> text of every definition in the folder ``text`` beside this module."""
    root = Path(__file__).parent / "text"
    return {
        file.relative_to(root).with_suffix("").as_posix(): file.read_text("utf-8")
        for file in sorted(root.glob("*/*/*"))
        if file.suffix in _SUFFIXES
    }


def parse(kind: str, text: str) -> Definitions:
    """Definitions of all messages that `kind` consists of.

    Args:
        kind: ``package/msg/Name``, ``package/srv/Name`` or ``package/action/Name``.
        text: of its file.

    Raises:
        ProfileError: the text is no such definition.
    """
    package, room, name = split_type(kind)
    if room == "msg":
        return _message(package, room, name, text)
    suffixes = _PARTS[room]
    parts = [f"{part}\n" for part in re.split(rf"(?m)^\s*{SEPARATOR}\s*$", text)]
    if len(parts) != len(suffixes):
        raise ProfileError(
            f"{kind}: has {len(parts)} parts; wanted {len(suffixes)}, with a line {SEPARATOR} "
            "between two"
        )
    found: Definitions = {}
    for suffix, part in zip(suffixes, parts, strict=True):
        found |= _message(package, room, f"{name}{suffix}", part)
    if room == "action":
        found |= _around_action(kind)
    return found


def _message(package: str, room: str, name: str, text: str) -> Definitions:
    # rosbags knows messages only: a part of a service is read as one, then called what it is.
    try:
        parsed = dict(get_types_from_msg(text, f"{package}/msg/{name}"))
    except TypesysError as error:
        raise ProfileError(
            f"{package}/{room}/{name} is not a ROS message: {str(error)[:300]}"
        ) from error
    return {f"{package}/{room}/{name}": parsed[f"{package}/msg/{name}"]}


def _around_action(kind: str) -> Definitions:
    """Messages that ROS generates around goal, result and feedback."""
    package, room, name = split_type(kind)
    text = {
        "_SendGoal_Request": "unique_identifier_msgs/UUID goal_id\n{}_Goal goal\n",
        "_SendGoal_Response": "bool accepted\nbuiltin_interfaces/Time stamp\n",
        "_GetResult_Request": "unique_identifier_msgs/UUID goal_id\n",
        "_GetResult_Response": "int8 status\n{}_Result result\n",
        "_FeedbackMessage": "unique_identifier_msgs/UUID goal_id\n{}_Feedback feedback\n",
    }
    found: Definitions = {}
    for suffix, lines in text.items():
        own = f"{package}/{room}/{name}"
        found |= _message(package, room, f"{name}{suffix}", lines.format(own))
    return found
