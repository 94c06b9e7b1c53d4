"""What `vla-zenoh net` makes of what nodes say."""

from __future__ import annotations

from typing import Any

from vla_zenoh_diagnose.net import NOBODY, Line, lines_of, pairs_of

from vla_zenoh.types import NodeStatus

HZ, BYTES_S = 200.0, 20_000.0


ONE, OTHER = "0f3c5a1e-52b7-4c11-9a52-01b5c1d7e8a0", "a91d77c4-0d7e-4b8f-8b57-6a5f40c2e9d3"
CLOCK = {"offset_ms": 1.0, "uncertainty_ms": 0.5, "round_trip_ms": 2.0}


def said(node: str, host: str, boot: str = ONE, **detail: Any) -> NodeStatus:
    return NodeStatus(node, "running", host, 1, 1, detail=detail, boot=boot)


def by_name(*statuses: NodeStatus) -> dict[str, NodeStatus]:
    return {status.node: status for status in statuses}


def test_what_was_lost_of_a_writer_that_is_silent_is_shown() -> None:
    found = by_name(
        said("worker-a", "gpu", net={"lost": {"state/pose": 7, "task": 1}}),
        said("worker-b", "gpu", net={"lost": {"state/pose": 2}}),
        said("command", "robot", net={"sent": {"task": [5.0, 100.0, 10]}}),
    )
    assert lines_of(found) == [
        Line("task", "command", "robot", 5.0, 100.0, {"worker-a": 1}),
        Line("state/pose", NOBODY, NOBODY, 0.0, 0.0, {"worker-a": 7, "worker-b": 2}),
    ]


def test_a_key_that_somebody_writes_has_his_lines_alone() -> None:
    found = by_name(
        said("sim", "robot", net={"sent": {"state/pose": [HZ, BYTES_S, 7]}}),
        said("worker-a", "gpu", net={"lost": {"state/pose": 7}}),
    )
    assert lines_of(found) == [Line("state/pose", "sim", "robot", HZ, BYTES_S, {"worker-a": 7})]


def hosts(*statuses: NodeStatus) -> set[tuple[str, str]]:
    return {(pair.seen_from, pair.host) for pair in pairs_of(by_name(*statuses), [])}


def test_two_computers_of_the_same_name_are_a_pair() -> None:
    sim = said("sim", "ubuntu", ONE, clocks={"worker-a": CLOCK, "command": CLOCK})
    worker = said(
        "worker-a", "ubuntu", OTHER, clocks={"sim": CLOCK}, net={"sent": {"delta/a": [1.0, 9.0, 3]}}
    )
    command = said("command", "ubuntu", ONE, clocks={"sim": CLOCK})
    assert hosts(sim, worker, command) == {
        ("ubuntu (0f3c5a1e)", "ubuntu (a91d77c4)"),
        ("ubuntu (a91d77c4)", "ubuntu (0f3c5a1e)"),
    }
    assert [line.host for line in lines_of(by_name(sim, worker))] == ["ubuntu (a91d77c4)"]


def test_two_hosts_of_the_profile_are_a_pair_also_where_they_are_one_machine() -> None:
    sim = said("sim", "robot", clocks={"worker-a": CLOCK})
    assert hosts(sim, said("worker-a", "gpu")) == {("robot", "gpu")}


def test_nodes_of_one_computer_are_no_pair() -> None:
    for boot in (ONE, ""):
        sim = said("sim", "robot", boot, clocks={"command": CLOCK, "gone": CLOCK})
        assert hosts(sim, said("command", "robot", boot, clocks={"sim": CLOCK})) == set()
