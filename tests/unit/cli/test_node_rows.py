"""What `status` says of nodes that live, ended, or never came, and of what moves."""

from __future__ import annotations

from typing import Any

import pytest

from vla_zenoh.cli.node_rows import (
    MODE_WORDS,
    Statuses,
    acting_limits,
    hosts_down,
    mode_of,
    node_rows,
)
from vla_zenoh.types import NodeStatus

EXPECTED = {"command": "robot", "sim": "robot", "worker-brick": "gpu"}


def status(node: str, state: str = "running", host: str = "robot", **detail: Any) -> NodeStatus:
    return NodeStatus(
        node=node, state=state, host=host, pid=1, started_wall_ns=1, ages_s={}, rates_hz={},
        counters={}, detail=detail,
    )  # fmt: skip


def alive(*statuses: NodeStatus) -> Statuses:
    return {each.node: (each, 0.1, True) for each in statuses}


@pytest.mark.parametrize("mode", ["sim", "dry_run", "live"])
def test_the_command_node_s_mode_stands_in_front_of_what_moves(mode: str) -> None:
    assert mode_of(alive(status("command", mode=mode))) == mode
    assert MODE_WORDS[mode][0] == {"sim": "SIM", "dry_run": "DRY RUN", "live": "LIVE"}[mode]


def test_the_mode_of_a_command_node_that_ended_is_unknown() -> None:
    ended = {"command": (status("command", mode="live"), 5.0, False)}
    assert mode_of(ended) == mode_of({}) == "unknown"


@pytest.mark.parametrize("name", ["recorder", "replay", "worker-teleop", "rolling", "benchmark"])
def test_a_node_that_ended_well_is_not_dead_and_one_that_died_is(name: str) -> None:
    said = {name: (status(name, "ended"), 60.0, False)}
    (row,) = (row for row in node_rows(said, {}) if row.name == name)
    assert (row.state, row.why) == ("ended", "")
    said = {name: (status(name, "recording"), 60.0, False)}
    (row,) = (row for row in node_rows(said, {}) if row.name == name)
    assert row.state == "dead"


def test_a_node_of_another_version_is_unreadable_with_what_to_update() -> None:
    why = "status/command: schema 3 of the wire, this program has 2: update vla-zenoh"
    (row,) = node_rows({}, {}, frozenset({"command"}), {"command": why})
    assert (row.state, row.why, row.alive) == ("unreadable", why, True)


@pytest.mark.parametrize(("age_s", "state"), [(0.4, "running"), (2.0, "unreadable")])
def test_a_piece_of_junk_hides_no_node_whose_status_comes(age_s: float, state: str) -> None:
    said = {"sim": (status("sim"), age_s, True)}
    (row,) = node_rows(said, {}, frozenset({"sim"}), {"sim": "junk"})
    assert row.state == state


def test_a_node_of_the_profile_that_ended_is_missing() -> None:
    said = {**alive(status("command")), "sim": (status("sim", "ended"), 60.0, False)}
    rows = {row.name: row for row in node_rows(said, EXPECTED)}
    assert rows["sim"].state == "missing"
    assert "`vla-zenoh up` on host robot" in rows["sim"].why


def test_a_mode_that_no_version_knows_is_unknown() -> None:
    assert mode_of(alive(status("command", mode="\x1b[31mlive"))) == "unknown"
    assert mode_of(alive(status("command", mode=["live"]))) == "unknown"


def test_a_node_that_the_profile_expects_on_a_running_host_is_missing() -> None:
    rows = {row.name: row for row in node_rows(alive(status("command")), EXPECTED)}
    assert rows["sim"].state == "missing"
    assert "`vla-zenoh up` on host robot" in rows["sim"].why


def test_nodes_of_a_host_that_is_down_are_told_as_that_host() -> None:
    said = alive(status("command"), status("sim"))
    assert hosts_down(said, EXPECTED) == {"gpu": ["worker-brick"]}
    assert "worker-brick" not in {row.name for row in node_rows(said, EXPECTED)}


@pytest.mark.parametrize("name", ["sim", "worker-of-my-own"])
def test_a_node_with_a_token_and_no_status_yet_is_starting_or_busy(name: str) -> None:
    rows = {r.name: r for r in node_rows(alive(status("command")), EXPECTED, frozenset({name}))}
    assert (rows[name].state, rows[name].alive) == ("starting", True)


def test_a_node_that_crashed_says_why_and_one_that_ended_is_dead() -> None:
    crashed = status("worker-brick", "crashed", "gpu", complaint="weights.pt not found")
    said = {"worker-brick": (crashed, 1.0, False), "sim": (status("sim"), 9.0, False)}
    rows = {row.name: row for row in node_rows(said, EXPECTED)}
    assert (rows["worker-brick"].state, rows["worker-brick"].why) == (
        "crashed",
        "weights.pt not found",
    )
    assert rows["sim"].state == "dead"


def test_limits_that_act_are_those_of_a_living_command_node() -> None:
    said = alive(status("command", limits=["elbow: joint_velocity", "slower: table"]))
    assert acting_limits(said) == ["elbow: joint_velocity", "slower: table"]
    assert acting_limits(alive(status("command", limits=3))) == []


def test_the_real_robot_s_node_is_not_missed_where_a_simulated_one_runs_in_its_place() -> None:
    expected = {"command": "robot", "arm": "robot"}
    said = alive(status("command", mode="sim"), status("sim"))
    assert "arm" not in {row.name for row in node_rows(said, expected)}
    said = alive(status("command", mode="live"), status("sim"))
    assert "arm" in {row.name for row in node_rows(said, expected)}
