"""diagnostic_msgs/DiagnosticArray of our nodes' status, for rqt_robot_monitor and the like."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vla_zenoh.ros2.messages import Messages
from vla_zenoh.ros2.samples import Stamp
from vla_zenoh.ros2.writers import header
from vla_zenoh.types import NodeStatus

TYPE = "diagnostic_msgs/msg/DiagnosticArray"
OK, WARN, ERROR, STALE = range(4)
BAD = frozenset(
    {"fault", "stopped", "degraded", "braking", "waiting", "silent", "stalled", "unheeded"}
)
MAX_VALUE = 200
PLAIN = (str, int, float, bool)


def write(
    messages: Messages,
    robot: str,
    nodes: Mapping[str, tuple[NodeStatus, float, bool]],
    stamp: Stamp,
) -> Any:
    """One entry for each node of a robot; `nodes` has their status, its age in s, and alive."""
    return messages.new(
        TYPE,
        header=header(messages, stamp),
        status=[_entry(messages, robot, *node) for node in nodes.values()],
    )


def _entry(messages: Messages, robot: str, status: NodeStatus, age_s: float, alive: bool) -> Any:
    level = STALE if not alive else WARN if status.state in BAD else OK
    if status.state == "fault":
        level = ERROR
    why = str(status.detail.get("why", ""))
    values = {
        "age_s": f"{age_s:.2f}",
        **{f"{name}_hz": f"{rate_hz:.1f}" for name, rate_hz in status.rates_hz.items()},
        **{
            f"{name}_ms": f"p50 {p50:.1f}, p95 {p95:.1f}"
            for name, (p50, p95) in status.latency_ms.items()
        },
        **{name: str(value) for name, value in status.detail.items() if isinstance(value, PLAIN)},
        **{name: str(count) for name, count in status.counters.items() if count},
    }
    return messages.new(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=level,
        name=f"vla-zenoh/{robot}: {status.node}",
        message=f"{status.state}: {why}" if why else status.state,
        hardware_id=status.host,
        values=[
            messages.new("diagnostic_msgs/msg/KeyValue", key=key, value=value[:MAX_VALUE])
            for key, value in values.items()
        ],
    )
