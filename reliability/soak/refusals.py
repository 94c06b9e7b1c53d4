"""Which refusals have a cause, and which have none."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Mapping

from vla_zenoh.types import NodeStatus

PREFIX = "refused."
STALL_S = 0.04
"""A computer that did not run a waiting thread for so long may have made anything late."""
Reasons = Mapping[str, frozenset[str]]
"""Kind of node that refuses -> its reasons."""
BEGUN_ANEW = frozenset({"foreign"})
"""A process speaks in the place of one that was heard a moment ago."""
BACKLOG = frozenset({"replayed"})
ASKED_EARLY: Reasons = {"command": frozenset({"activate_refused"})}
"""The arm is asked for again while preflight still finds something missing: that is we."""
OVERDUE: Reasons = {
    "command": frozenset({"stale", "expired", "future", "clock_step", "worker_refused"}),
    "sim": frozenset(
        {
            "pose_late",
            "pose_stale",
            "pose_braking",
            "pose_inactive",
            "pose_jump",
            "pose_too_fast",
            "clock_step",
        }
    ),
    "camera": frozenset({"clock_step"}),
    "worker": frozenset({"clock_step"}),
}
"""Who did not run for a while: chunks are old, and the robot brakes as its stream fell silent."""
FROM_ROBOT: Reasons = {
    "command": BEGUN_ANEW | BACKLOG,
    "worker": BEGUN_ANEW | BACKLOG,
    "camera": BEGUN_ANEW | BACKLOG,
}
FROM_COMMAND: Reasons = {
    "sim": BEGUN_ANEW
    | {"pose_braking", "pose_inactive", "pose_jump", "pose_too_fast", "pose_foreign", "pose_stale"},
    "worker": BEGUN_ANEW,
}
FROM_WORKER: Reasons = {"command": frozenset({"stale", "expired"}) | BEGUN_ANEW}
FROM_CAMERA: Reasons = {"command": frozenset({"stale"}), "worker": BEGUN_ANEW}
RESTARTED: Mapping[str, Reasons] = {"sim": {"sim": frozenset({"pose_inactive"})}}
"""Kind of node that was killed -> who refuses what for it. A simulator is back after 0.7 s, its
arm at home; the stream to the old one brakes, and ends 0.5 s after the arm stands."""
BRAKED_ITSELF: Reasons = {"sim": frozenset({"pose_braking", "pose_inactive", "pose_jump"})}
"""The robot hears a stop as well and brakes by itself. Reset, it rejects what is left of the stream
with which the command node braked."""
WHO_LIVES: Reasons = {"command": frozenset({"foreign_spec", "foreign_status"})}
"""Who was away, or hears of one who was, is told what they say before it knows that they live."""
NEVER = frozenset({"simulation_fault", "inference_failed", "contract", "reset_failed", "seen"})
"""Nothing that is done here may lead to these."""


def joined(*tables: Reasons) -> Reasons:
    """All of them in one."""
    kinds = {kind for table in tables for kind in table}
    return {
        kind: frozenset().union(*(table.get(kind, frozenset()) for table in tables))
        for kind in kinds
    }


FROM: Mapping[str, Reasons] = {
    "sim": FROM_ROBOT,
    "command": FROM_COMMAND,
    "worker": FROM_WORKER,
    "camera": FROM_CAMERA,
    "router": joined(FROM_ROBOT, FROM_COMMAND, FROM_WORKER, FROM_CAMERA),
}
"""Kind of node that was away for a while -> who refuses what for it."""
EXPLAINS: Mapping[str, Reasons] = {
    # what is done, whoever it is done to -> the refusals that follow from it
    "prompt": {},
    "worker": {},
    "rate": {},
    "toggle": ASKED_EARLY,
    "stop": joined(ASKED_EARLY, BRAKED_ITSELF),
    "kill": joined(ASKED_EARLY, WHO_LIVES),
    "freeze": joined(ASKED_EARLY, WHO_LIVES),
    "junk": ASKED_EARLY,
}


class Refusals:
    """Counts what nodes refuse, from one look to the next, across restarts."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[int, dict[str, int]]] = {}

    def since(self, statuses: Mapping[str, NodeStatus]) -> Counter[str]:
        """``node.reason`` -> how often since the last call."""
        out: Counter[str] = Counter()
        for node, status in statuses.items():
            counts = {
                name.removeprefix(PREFIX): count
                for name, count in status.counters.items()
                if name.startswith(PREFIX)
            }
            pid, before = self._known.get(node, (status.pid, {}))
            if pid != status.pid:
                before = {}
            for reason, count in counts.items():
                if count > before.get(reason, 0):
                    out[f"{node}.{reason}"] += count - before.get(reason, 0)
            self._known[node] = (status.pid, counts)
        return out


def kind_of(node: str) -> str:
    """``worker`` of ``worker-scripted``; other nodes are one of their kind."""
    return node.partition("-")[0]


def unexplained(
    found: Mapping[str, int], action: str, stall_s: float, whom: str = ""
) -> dict[str, int]:
    """Those of `found` that neither `action` nor a stall of the computer explains.

    Args:
        found: ``node.reason`` -> how often.
        action: what was done.
        stall_s: the longest that the computer did not run a waiting thread.
        whom: node it was done to; empty: to none.
    """
    tables = [EXPLAINS[action], FROM.get(kind_of(whom), {})]
    if action == "kill":
        tables.append(RESTARTED.get(kind_of(whom), {}))
    if action == "freeze":  # it finds on its desk what has piled up
        own = kind_of(whom)
        tables.append({own: OVERDUE.get(own, frozenset()) | BACKLOG})
    if stall_s > STALL_S:
        tables += [OVERDUE, ASKED_EARLY]
    allowed = joined(*tables)
    out: dict[str, int] = {}
    for name, count in found.items():
        node, _, reason = name.rpartition(".")
        by_junk = action == "junk" and reason not in NEVER
        if not by_junk and reason not in allowed.get(kind_of(node), frozenset()):
            out[name] = count
    return out


class Witness:
    """A thread that sleeps, and sees how much too late it wakes: what the computer did to all."""

    def __init__(self) -> None:
        self._worst_s = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="witness", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        nap_s = 0.005
        while not self._stop.is_set():
            began_s = time.monotonic()
            time.sleep(nap_s)
            self._worst_s = max(self._worst_s, time.monotonic() - began_s - nap_s)

    def worst_s(self) -> float:
        """The longest stall since the last call."""
        worst_s, self._worst_s = self._worst_s, 0.0
        return worst_s

    def close(self) -> None:
        """Look no more."""
        self._stop.set()
        self._thread.join(1.0)
