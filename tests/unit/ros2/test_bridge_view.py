"""What bridges say of DDS: middleware by participants' ids, bridges that serve one domain."""

from __future__ import annotations

import json

from vla_zenoh_ros2.bridge_view import (
    any_active,
    any_transient_local,
    endpoints_key,
    read_view,
    route_key,
    vendors,
)

FAST, CYCLONE, OTHER = "010f78fdee72", "0110aa00bb11", "01aa00000000"


def seen(bridge: str, participant: str) -> tuple[str, bytes]:
    return f"@/{bridge}/ros2/dds/{participant}", b"{}"


def test_participants_name_their_middleware_and_each_counts_once() -> None:
    view = read_view([seen("a", FAST), seen("b", FAST), seen("a", CYCLONE), seen("a", OTHER)])
    assert view.middleware == {"Cyclone DDS": 1, "DDS of vendor 01aa": 1, "Fast DDS": 1}


def test_two_bridges_serve_one_domain_if_both_see_a_participant() -> None:
    config = [(f"@/{bridge}/ros2/config", b'{"domain": 3}') for bridge in "abc"]
    view = read_view([*config, seen("a", FAST), seen("b", FAST), seen("c", CYCLONE)])
    assert view.doubled == ("a", "b")
    assert view.domains == {"a": 3, "b": 3, "c": 3}
    assert read_view(config).doubled == ()


def test_what_is_no_such_reply_is_left_out() -> None:
    replies = [("a/b", b"{}"), ("@/a/ros2/config", b"[1]"), ("@/a/router", b""), ("", b"")]
    view = read_view(replies)
    assert view.middleware == {}
    assert view.domains == {"a": None}


def test_a_transient_local_writer_is_told_by_its_qos() -> None:
    def writer(qos: dict[str, object]) -> tuple[str, bytes]:
        return f"@/a/ros2/dds/{FAST}/writer/1/rt/vla/active", json.dumps({"qos": qos}).encode()

    latched = writer({"durability": {"kind": "TRANSIENT_LOCAL"}})
    assert any_transient_local([writer({}), latched])
    assert not any_transient_local([writer({}), writer({"durability": {"kind": "VOLATILE"}})])
    assert vendors([latched]) == {"Fast DDS"}
    assert endpoints_key("writer", "rt/vla/active") == "@/*/ros2/dds/*/writer/*/rt/vla/active"


def test_a_route_passes_messages_on_while_it_is_active() -> None:
    key = "@/a/ros2/route/topic/sub/desired_pose"
    assert route_key("/desired_pose") == "@/*/ros2/route/topic/sub/desired_pose"
    assert any_active([(key, b'{"is_active": false}'), (key, b'{"is_active": true}')])
    assert not any_active([(key, b'{"is_active": false}'), (key, b"{}"), (key, b"[]"), (key, b"")])
