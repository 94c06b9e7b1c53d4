"""What a soak judges by: counters across restarts, causes, and growth."""

from __future__ import annotations

import json
import os
import sys
import time
from collections import Counter

import pytest
from ledger import (
    CALM_MIB,
    FRONT_OF_RAY,
    GROWTH_HANDLES,
    GROWTH_MIB,
    RAY_MIB,
    ROUTER_MIB,
    Growth,
    Held,
    Ledger,
    look,
    segments,
)
from refusals import EXPLAINS, FROM, NEVER, STALL_S, Refusals, Witness, unexplained
from report import Found, line

from vla_zenoh.types import NodeStatus

HELD_S = 0.5
"""For so long the interpreter is held, as a busy computer would."""


def status(pid: int, **refused: int) -> NodeStatus:
    counters = {f"refused.{name}": count for name, count in refused.items()}
    return NodeStatus("sim", "running", "h", pid, 0, {}, {}, {}, counters | {"other": 9}, {})


def test_refusals_are_counted_from_look_to_look_and_anew_after_a_restart() -> None:
    refusals = Refusals()
    assert refusals.since({"sim": status(1, stale=2)}) == {"sim.stale": 2}
    assert refusals.since({"sim": status(1, stale=2)}) == {}
    assert refusals.since({"sim": status(1, stale=5)}) == {"sim.stale": 3}
    assert refusals.since({"sim": status(2, stale=1)}) == {"sim.stale": 1}


def test_a_refusal_needs_a_cause() -> None:
    found = {"command.stale": 1, "worker-a.malformed": 2}
    malformed = {"worker-a.malformed": 2}
    assert unexplained(found, "prompt", 0.0) == found
    assert unexplained(found, "kill", 0.0, "worker-b") == malformed
    assert unexplained(found, "prompt", 2 * STALL_S) == malformed
    assert unexplained(found, "junk", 0.0) == {}
    rest = {"sim.pose_inactive": 4}
    assert unexplained(rest, "kill", 0.0, "sim") == {}
    for action, whom in (("kill", "camera"), ("prompt", ""), ("toggle", "")):
        assert unexplained(rest, action, 0.0, whom) == rest
    jump = {"sim.pose_jump": 1}
    assert unexplained(jump, "kill", 0.0, "sim") == jump
    assert unexplained({"sim.simulation_fault": 1}, "junk", 0.0) == {"sim.simulation_fault": 1}


@pytest.mark.parametrize(
    ("found", "action", "whom", "explained"),
    [
        ("sim.pose_braking", "kill", "command", True),
        ("sim.pose_braking", "kill", "camera", False),
        ("sim.pose_braking", "freeze", "sim", True),
        ("sim.pose_braking", "kill", "sim", False),
        ("command.stale", "freeze", "camera", True),
        ("command.stale", "freeze", "sim", False),
        ("command.foreign_status", "freeze", "command", True),
        ("command.activate_refused", "stop", "", True),
        ("sim.pose_inactive", "stop", "", True),
        ("sim.pose_too_fast", "stop", "", False),
        ("command.activate_refused", "prompt", "", False),
        ("camera.stale", "freeze", "router", False),
    ],
)
def test_a_cause_explains_what_follows_from_it_alone(
    found: str, action: str, whom: str, explained: bool
) -> None:
    assert (unexplained({found: 1}, action, 0.0, whom) == {}) == explained


def test_all_causes_name_reasons_of_nodes_that_there_are() -> None:
    for table in (*EXPLAINS.values(), *FROM.values()):
        assert table.keys() <= {"sim", "command", "worker", "camera"}
        assert not any(reasons & NEVER or "malformed" in reasons for reasons in table.values())


def test_what_was_found_is_told_as_json() -> None:
    found = Found(1, killed=Counter(sim=2), refused={"kill": Counter({"command.stale": 3})})
    found.held["start"] = {"segments": segments()}
    told = json.loads(json.dumps(found.to_dict()))
    assert told["killed"] == {"sim": 2}
    assert told["refused"] == {"kill": {"command.stale": 3}}
    assert told["code"] == 0
    assert (
        line(found) == "| 1, 0 | 0 | 2 | 3 (0) | 0 | 0 | 0 | 0.000 m/s, 0.00 m/s² | -; - ms | 0 |"
    )


def test_growth_beyond_its_bound_is_a_leak() -> None:
    first = Held(20.0, 100.0, 90.0, 80.0, 30, 20)
    little = first._replace(heap_mib=80.0 + GROWTH_MIB, handles=30 + GROWTH_HANDLES)
    much = little._replace(heap_mib=little.heap_mib + 1)
    assert Growth("sim", 1, 60.0, first, little).leaks == []
    (words,) = Growth("sim", 1, 60.0, first, much).leaks
    assert "heap_mib" in words


def test_in_the_calm_less_is_allowed() -> None:
    first = Held(20.0, 100.0, 90.0, 80.0, 30, 20)
    more = first._replace(heap_mib=80.0 + CALM_MIB + 1)
    assert Growth("sim", 1, 60.0, first, more).leaks == []
    assert Growth("sim", 1, 60.0, first, more, True).leaks != []
    assert Growth("router", 1, 60.0, first, more, True).leaks != []


def test_only_a_router_may_take_what_it_takes_once() -> None:
    first = Held(20.0, 100.0, 90.0, 80.0, 30, 20)
    more = first._replace(heap_mib=80.0 + ROUTER_MIB)
    assert Growth("router", 1, 60.0, first, more).leaks == []
    assert Growth("router", 1, 60.0, first, more._replace(heap_mib=more.heap_mib + 1)).leaks != []
    assert Growth("sim", 1, 60.0, first, more).leaks != []


def test_a_worker_in_front_of_ray_may_take_what_ray_keeps_of_requests() -> None:
    first = Held(20.0, 100.0, 90.0, 80.0, 30, 20)
    more = first._replace(heap_mib=80.0 + RAY_MIB)
    for calm in (False, True):
        assert Growth(f"shade {FRONT_OF_RAY}", 1, 60.0, first, more, calm).leaks == []
        assert Growth("shade", 1, 60.0, first, more, calm).leaks != []
    beyond = more._replace(heap_mib=more.heap_mib + 1)
    assert Growth(f"shade {FRONT_OF_RAY}", 1, 60.0, first, beyond).leaks != []


def test_what_this_process_holds_is_seen() -> None:
    before = look(os.getpid(), 0.0)
    with open(os.devnull):
        assert look(os.getpid(), 0.0).handles == before.handles + 1
    assert before.heap_mib <= before.rss_mib
    assert before.pss_mib <= before.rss_mib
    ledger = Ledger(lambda: {"me": os.getpid()})
    assert set(ledger.newest()) == {"me"}
    assert ledger.growth() == []
    ledger.close()


def test_nothing_is_looked_at_while_broken_links_settle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ledger.PERIOD_S", 0.01)
    looks: list[float] = []

    def pids() -> dict[str, int]:
        looks.append(time.monotonic())
        return {}

    ledger = Ledger(pids)
    while not looks:
        time.sleep(0.01)
    ledger.links_broke()
    time.sleep(0.05)
    seen = len(looks)
    time.sleep(0.2)
    assert len(looks) == seen
    ledger.close()


def test_a_witness_sees_a_stall_once() -> None:
    witness, usual_s = Witness(), sys.getswitchinterval()
    sys.setswitchinterval(10 * HELD_S)  # nobody else runs until this thread lets go
    try:
        time.sleep(0.05)
        witness.worst_s()
        end_s = time.perf_counter() + HELD_S
        while time.perf_counter() < end_s:
            pass
        time.sleep(0.05)
    finally:
        sys.setswitchinterval(usual_s)
    assert witness.worst_s() > 0.8 * HELD_S
    assert witness.worst_s() < HELD_S
    witness.close()
