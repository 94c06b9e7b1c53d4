"""What `vla-zenoh net` makes of what nodes say."""

from __future__ import annotations

from typing import Any

from vla_zenoh.cli.net import NOBODY, Line, lines_of
from vla_zenoh.types import NodeStatus

HZ, BYTES_S = 200.0, 20_000.0


def said(node: str, host: str, **detail: Any) -> NodeStatus:
    return NodeStatus(node, "running", host, 1, 1, detail=detail)


def by_name(*statuses: NodeStatus) -> dict[str, NodeStatus]:
    return {status.node: status for status in statuses}


def test_what_was_lost_of_a_writer_that_is_silent_is_shown() -> None:
    found = by_name(
        said("worker-a", "gpu", net={"lost": {"state/pose": 7, "task": 1}}),
        said("worker-b", "gpu", net={"lost": {"state/pose": 2}}),
        said("command", "robot", net={"sent": {"task": [5.0, 100.0]}}),
    )
    assert lines_of(found) == [
        Line("task", "command", "robot", 5.0, 100.0, {"worker-a": 1}),
        Line("state/pose", NOBODY, NOBODY, 0.0, 0.0, {"worker-a": 7, "worker-b": 2}),
    ]


def test_a_key_that_somebody_writes_has_his_lines_alone() -> None:
    found = by_name(
        said("sim", "robot", net={"sent": {"state/pose": [HZ, BYTES_S]}}),
        said("worker-a", "gpu", net={"lost": {"state/pose": 7}}),
    )
    assert lines_of(found) == [Line("state/pose", "sim", "robot", HZ, BYTES_S, {"worker-a": 7})]
