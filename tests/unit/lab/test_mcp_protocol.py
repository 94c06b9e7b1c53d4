"""The Model Context Protocol: what a line of a client is read as."""

from __future__ import annotations

import json
from typing import Any

import pytest
from vla_zenoh_mcp.protocol import (
    DESCRIPTIONS,
    INVALID_PARAMS,
    INVALID_REQUEST,
    LOOKING,
    MAX_LINE,
    NO_METHOD,
    PARSE_ERROR,
    VERSIONS,
    Call,
    Cancelled,
    Reply,
    read,
    tools,
)

OFFERED = tools(["front"], list(DESCRIPTIONS))


def asked(method: str, params: Any = None, number: Any = 1) -> Call | Cancelled | Reply:
    message = {"jsonrpc": "2.0", "id": number, "method": method, "params": params}
    message = {name: value for name, value in message.items() if value is not None}
    return read(json.dumps(message).encode(), OFFERED, "1.0")


def answer(method: str, params: Any = None) -> dict[str, Any]:
    found = asked(method, params)
    assert isinstance(found, Reply)
    return json.loads(found.line)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_known_version_is_agreed_to(version: str) -> None:
    assert (
        answer("initialize", {"protocolVersion": version})["result"]["protocolVersion"] == version
    )


def test_an_unknown_version_is_answered_by_the_newest() -> None:
    result = answer("initialize", {"protocolVersion": "2099-01-01"})["result"]
    assert result["protocolVersion"] == VERSIONS[-1]
    assert result["serverInfo"] == {"name": "vla-zenoh", "version": "1.0"}


def test_every_tool_has_a_schema_without_the_holder() -> None:
    offered = answer("tools/list")["result"]["tools"]
    assert [tool["name"] for tool in offered] == list(DESCRIPTIONS)
    for tool in offered:
        assert tool["inputSchema"]["type"] == "object"
        assert "holder" not in json.dumps(tool["inputSchema"]["properties"])
        assert "holder" not in tool["inputSchema"].get("required", [])
        assert "\n" not in tool["description"]


def test_a_viewer_is_offered_nothing_that_moves() -> None:
    assert [tool["name"] for tool in tools(["front"], sorted(LOOKING))] == ["state"]


def test_a_call_is_read_with_its_arguments() -> None:
    params = {"name": "grip", "arguments": {"width_m": 0.02}}
    assert asked("tools/call", params) == Call(1, "grip", {"width_m": 0.02})
    assert asked("tools/call", {"name": "home"}) == Call(1, "home", {})


def test_a_notification_is_not_answered_and_a_cancellation_is_read() -> None:
    line = b'{"jsonrpc": "2.0", "method": "notifications/initialized"}'
    assert read(line, OFFERED, "1.0") == Reply("")
    line = b'{"jsonrpc": "2.0", "method": "notifications/cancelled", "params": {"requestId": 7}}'
    assert read(line, OFFERED, "1.0") == Cancelled(7)


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (b"{", PARSE_ERROR),
        (b"\xff", PARSE_ERROR),
        (b"[" * 100_000, PARSE_ERROR),
        (b"[]", INVALID_REQUEST),
        (b'{"jsonrpc": "1.0", "id": 1, "method": "ping"}', INVALID_REQUEST),
        (b'{"jsonrpc": "2.0", "id": 1}', INVALID_REQUEST),
        (b" " * (MAX_LINE + 1), INVALID_REQUEST),
        (b'{"jsonrpc": "2.0", "id": 1, "method": "server/discover"}', NO_METHOD),
        (b'{"jsonrpc": "2.0", "id": 1, "method": "ping", "params": []}', None),
        (b'{"jsonrpc": "2.0", "id": 1, "method": "ping", "params": [1]}', INVALID_PARAMS),
        (b'{"jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": {}}', INVALID_PARAMS),
    ],
)
def test_a_wrong_line_is_answered_by_its_error(line: bytes, code: int | None) -> None:
    found = read(line, OFFERED, "1.0")
    assert isinstance(found, Reply)
    assert json.loads(found.line).get("error", {}).get("code") == code
