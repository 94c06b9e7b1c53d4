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
LATE = frozenset(
    {
        *("stale", "expired", "future", "replayed", "foreign", "clock_step", "activate_refused"),
        *("pose_braking", "pose_jump", "pose_replayed", "pose_foreign"),
    }
)
"""What being late, or having been away, can lead to."""
AWAY = frozenset({"foreign_spec", "foreign_status"})
"""Who was away hears of others before it knows again that they live."""
ANYTHING = frozenset({"*"})
EXPLAINS: dict[str, frozenset[str]] = {
    # what is done -> the refusals that follow from it
    "prompt": frozenset(),
    "worker": frozenset(),
    "rate": frozenset(),
    "toggle": frozenset({"activate_refused"}),
    "stop": frozenset({"activate_refused"}),
    "kill": LATE | AWAY | {"spec_mismatch"},
    "freeze": LATE | AWAY,
    "junk": ANYTHING,
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


def unexplained(found: Mapping[str, int], action: str, stall_s: float) -> dict[str, int]:
    """Those of `found` that neither `action` nor a stall of the computer explains."""
    allowed = EXPLAINS[action] | (LATE if stall_s > STALL_S else frozenset())
    if "*" in allowed:
        return {}
    return {name: count for name, count in found.items() if name.rpartition(".")[2] not in allowed}


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
