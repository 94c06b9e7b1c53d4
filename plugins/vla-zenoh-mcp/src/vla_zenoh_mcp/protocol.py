"""The Model Context Protocol, as far as a server of tools on stdio needs it. Pure.

JSON-RPC 2.0, one message a line: ``initialize``, ``ping``, ``tools/list``, ``tools/call``, and the
notification ``notifications/cancelled``. Source: modelcontextprotocol.io/specification, versions
`VERSIONS`. Clients of later ones ask ``server/discover`` first and fall back to ``initialize``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from vla_zenoh_primitives.requests import REQUESTS

from vla_zenoh.errors import CodecError

VERSIONS = ("2024-11-05", "2025-03-26", "2025-06-18", "2025-11-25")
MAX_LINE = 256 * 1024
PARSE_ERROR, INVALID_REQUEST, NO_METHOD, INVALID_PARAMS = -32700, -32600, -32601, -32602
Id = str | int
INSTRUCTIONS = (
    "Moves one robot arm within the bounds of its profile. Positions are metres in the base frame "
    "of the robot, joints rad, rotations quaternions x, y, z, w. One motion at a time; a call "
    "returns when the arm stands. Targets are checked before anything moves. The tool stop may be "
    "called at any time; only a person can end a stop."
)
DESCRIPTIONS: Mapping[str, str] = {
    "move_to": "Move the tool centre point straight to a pose, or the joints to positions.",
    "home": "Move the joints to the home position.",
    "grip": "Open or close the gripper while the arm stands.",
    "run": "Let a policy (worker) move the arm until a condition holds or the time is over.",
    "stop": "Emergency stop: the arm brakes and stays stopped until a person resets it.",
    "state": "Where arm and gripper are, what drives them, which workers and cameras there are.",
    "picture": "What a camera sees now, as a JPEG.",
}
LOOKING = frozenset({"state"})
"""Tools of a viewer, who may not see images."""


class Call(NamedTuple):
    """A call of a tool."""

    id: Id
    name: str
    arguments: dict[str, Any]


class Cancelled(NamedTuple):
    """The client does not wait for the answer to `id` any more."""

    id: Id


class Reply(NamedTuple):
    """What is sent back at once; empty: nothing."""

    line: str


def tools(cameras: Sequence[str], allowed: Sequence[str]) -> list[dict[str, Any]]:
    """Descriptions of the tools, with the JSON schema of their arguments.

    Args:
        allowed: names of the tools that this client may call.
    """
    empty = {"type": "object", "properties": {}, "additionalProperties": False}
    schemas: dict[str, Any] = {name: _schema(kind) for name, kind in REQUESTS.items()}
    schemas |= {"stop": empty, "state": empty}
    camera = {"type": "string", "enum": list(cameras)}
    schemas["picture"] = {**empty, "properties": {"camera": camera}, "required": ["camera"]}
    return [
        {
            "name": name,
            "description": DESCRIPTIONS[name],
            "inputSchema": schemas[name],
            "annotations": {"readOnlyHint": name in ("state", "picture")},
        }
        for name in DESCRIPTIONS
        if name in allowed
    ]


def _schema(kind: Any) -> dict[str, Any]:
    schema = kind.model_json_schema()
    del schema["properties"]["holder"]
    schema["required"] = [name for name in schema.get("required", ()) if name != "holder"]
    schema["description"] = schema.pop("description", "").partition("\n\n")[0]
    return schema


def read(
    line: bytes, offered: Sequence[Mapping[str, Any]], version: str
) -> Call | Cancelled | Reply:
    """What one line of a client asks for.

    Args:
        line: of at most `MAX_LINE` bytes.
        offered: by `tools`.
    """
    try:
        message = _decoded(line)
    except CodecError as error:
        code = PARSE_ERROR if error.reason == "malformed" else INVALID_REQUEST
        return Reply(failure(None, code, str(error)))
    asked, method, params = message.get("id"), message["method"], message.get("params") or {}
    if not isinstance(params, dict):
        return Reply(failure(asked, INVALID_PARAMS, "params wants a map"))
    if not isinstance(asked, (str, int)) or isinstance(asked, bool):
        gone = params.get("requestId")
        if method == "notifications/cancelled" and isinstance(gone, (str, int)):
            return Cancelled(gone)
        return Reply("")  # other notifications
    if method == "initialize":
        wanted = params.get("protocolVersion")
        said = {
            "protocolVersion": wanted if wanted in VERSIONS else VERSIONS[-1],
            "capabilities": {"tools": {"listChanged": False}},
            "serverInfo": {"name": "vla-zenoh", "version": version},
            "instructions": INSTRUCTIONS,
        }
        return Reply(success(asked, said))
    if method == "ping":
        return Reply(success(asked, {}))
    if method == "tools/list":
        return Reply(success(asked, {"tools": list(offered)}))
    if method != "tools/call":
        return Reply(failure(asked, NO_METHOD, f"there is no method {str(method)[:60]!r} here"))
    name, arguments = params.get("name"), params.get("arguments") or {}
    known = [tool["name"] for tool in offered]
    if not isinstance(name, str) or name not in known:
        why = f"there is no tool {str(name)[:60]!r} for this certificate; {', '.join(known)}"
        return Reply(failure(asked, INVALID_PARAMS, why))
    if not isinstance(arguments, dict):
        return Reply(failure(asked, INVALID_PARAMS, "arguments wants a map"))
    return Call(asked, name, arguments)


def _decoded(line: bytes) -> dict[str, Any]:
    if len(line) > MAX_LINE:
        raise CodecError("oversize", f"a line of {len(line)} bytes, at most {MAX_LINE} are read")
    try:
        message = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise CodecError("malformed", f"not JSON: {type(error).__name__}") from error
    if not isinstance(message, dict) or message.get("jsonrpc") != "2.0":
        raise CodecError("invalid", "wants one JSON-RPC 2.0 message on each line")
    if not isinstance(message.get("method"), str):
        raise CodecError("invalid", "a message without a method: this server asks nothing")
    return message


def success(asked: Id, result: Mapping[str, Any]) -> str:
    """The answer to request `asked`, one line."""
    return json.dumps({"jsonrpc": "2.0", "id": asked, "result": result})


def failure(asked: Any, code: int, why: str) -> str:
    """The error that answers request `asked`, one line."""
    known = asked if isinstance(asked, (str, int)) else None
    return json.dumps({"jsonrpc": "2.0", "id": known, "error": {"code": code, "message": why}})


def said(fields: Mapping[str, Any], *, ok: bool) -> dict[str, Any]:
    """Result of a tool: `fields` as structure and as text."""
    text = {"type": "text", "text": json.dumps(fields)}
    return {"content": [text], "structuredContent": dict(fields), "isError": not ok}
