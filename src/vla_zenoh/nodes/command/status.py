"""What the command node says of itself: states, latencies by stage, room at the goal."""

from __future__ import annotations

import math
from typing import Any

from vla_zenoh.bus.metrics import Percentiles, RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.control.commander import Commander, Outputs
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.types import LATENCY_STAGES, Cause

MAX_WHY = 2000
SPREAD_S = 8.0
"""Status tells how cost and lateness of ticks were spread over so long."""
CHUNKS = 128
"""Status tells the latencies of so many: at 10 Hz of the last 13 s."""


class CommandStatus:
    """Measures ticks and latencies, and writes them into the node's status.

    Args:
        node: the command node.
        mind: its commander.
    """

    def __init__(self, node: Node, mind: Commander) -> None:
        self._node, self._mind = node, mind
        ticks = round(SPREAD_S * node.profile.timing.command_hz)
        self._latency = {stage: Percentiles(CHUNKS) for stage in LATENCY_STAGES}
        self._cost_us, self._late_us = Percentiles(ticks), Percentiles(ticks)
        self._pose_age_ms = Percentiles(ticks)
        self._rate = RateMeter()
        self._was_at_rest = True
        self.realtime = False

    def ticked(self, now_ns: int, late_s: float, cost_s: float) -> None:
        """A turn was made for this time: so late it was woken, so long it took."""
        pose = self._mind.pose
        if pose is not None:
            self._pose_age_ms.add((now_ns - pose.header.stamp_wall_ns) / 1e6)
        self._late_us.add(late_s * 1e6)
        self._rate.tick()
        self._cost_us.add(cost_s * 1e6)

    def measure(self, cause: Cause) -> None:
        """A chunk came into force: how long each stage of its way took."""
        published_ns = self._node.clock.wall_ns()
        for stage, duration_ms in cause.latency_ms(published_ns).items():
            self._latency[stage].add(duration_ms)

    def report(self, out: Outputs, chunks_dropped: int) -> None:
        """Write status when it is due, or there is news."""
        mind = self._mind
        # An event is news of a change, so status says the same at once.
        now = any(event.kind == "transition" for event in out.events) or out.task_changed
        now = now or mind.at_rest != self._was_at_rest
        self._was_at_rest = mind.at_rest
        if not now and not self._node.status_due(mind.state.value):
            return
        task = mind.task
        wall_ns = self._node.clock.wall_ns()
        ages_s = {
            name: (wall_ns - stamped.received_ns) / 1e9
            for name, stamped in (("pose", mind.pose), ("gripper", mind.gripper_state))
            if stamped is not None
        }
        latency = {name: meter.summary() for name, meter in self._latency.items()}
        self._node.counters["command.smoothing_failures"] = mind.smoothing_failures
        self._node.counters["command.gripper_timeouts"] = mind.gripper.timeouts
        self._node.counters["command.chunks_dropped"] = chunks_dropped
        self._node.publish_status(
            mind.state.value,
            detail={
                "why": mind.why[:MAX_WHY],
                "prompt": task.prompt,
                "worker": task.worker,
                "rate_hz": task.rate_hz,
                "speed_percent": task.speed_percent,
                "episode": task.episode,
                "accepted_chunks": mind.progress.chunks,
                "accepted_steps": mind.progress.steps,
                "policy_done": mind.progress.done,
                "held_by": mind.deadman.name if task.active else "",
                "at_rest": mind.at_rest,
                "streaming": mind.streaming,
                "speed_share": round(mind.speed, 3),
                "tracking_mm": round(mind.tracking_m * 1e3, 3),
                "tracking_mrad": round(mind.tracking_rad * 1e3, 3),
                "elbow_mrad": round(mind.elbow_rad * 1e3, 3),
                "tick_us": self._cost_us.spread(),
                "late_us": self._late_us.spread(),
                "pose_age_ms": self._pose_age_ms.spread(),
                "realtime": self.realtime,
                "dry_run": mind.dry_run,
                **self._goal(),
                **self._margins(),
                **self._contact(),
            },
            ages_s=ages_s,
            rates_hz={"loop": self._rate.rate_hz},
            latency_ms={name: values for name, values in latency.items() if values},
            now=now,
        )

    def _goal(self) -> dict[str, Any]:
        goal = self._mind.goal
        if goal is None:
            return {}
        return {
            "goal_m": [round(float(value), 6) for value in goal.pose.position_m],
            "goal_quat_xyzw": [round(float(v), 6) for v in quat_from_rotation(goal.pose.rotation)],
            "goal_width_m": round(goal.width_m, 5),
        }

    def _contact(self) -> dict[str, Any]:
        """What presses against the arm; None where the robot does not tell."""
        force_n, torque_nm = self._mind.contact.force_n, self._mind.contact.torque_nm
        return {
            "external_force_n": None if force_n is None else round(force_n, 2),
            "external_torque_nm": None if torque_nm is None else round(torque_nm, 2),
        }

    def _margins(self) -> dict[str, Any]:
        """Room the arm has at its goal."""
        reach = self._mind.reach
        if reach is None or self._mind.goal is None:
            return {}
        room = reach.margins
        return {
            "joint_margin_rad": round(room.joint_rad, 4),
            "joint_margin_of": room.joint,
            "singular_value": round(room.singular_value, 4),
            "self_distance_m": round(room.self_m, 4) if math.isfinite(room.self_m) else None,
            "table_distance_m": round(room.table_m, 4) if math.isfinite(room.table_m) else None,
        }
