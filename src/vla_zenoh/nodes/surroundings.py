"""What the command node hears of the other nodes: who is alive, specs, camera ages."""

from __future__ import annotations

import socket
import threading
import time
from typing import Any

from vla_zenoh import keys as key_names
from vla_zenoh.control.names import worker_node
from vla_zenoh.control.preflight import Surroundings
from vla_zenoh.nodes.node import Node
from vla_zenoh.nodes.slots import Arrival, Mailbox
from vla_zenoh.policy import ModelSpec
from vla_zenoh.types import NodeStatus, Stamped

MAX_WORKERS = 32
CLOCKS_PERIOD_S = 0.25
STATUSES_A_TICK, SPECS_A_TICK = 8, 4
"""What is more was not sent by any node of ours: each says something twice a second."""


class Neighbours:
    """Collects status, specs and liveliness into a `Surroundings`."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._lock = threading.Lock()
        self._alive: set[str] = set()
        self._changed = True
        self._specs: dict[str, ModelSpec] = {}
        self._spec_sources: dict[str, str] = {}
        self._voices: dict[str, str] = {}
        self._complaints: dict[str, str] = {}
        self._cameras: dict[str, tuple[str, float, int]] = {}
        self._hosts: dict[str, str] = {}
        self._next_clocks_s = 0.0
        self._statuses = node.listen(node.keys.all_status, Mailbox(STATUSES_A_TICK))
        self._new_specs = node.listen(node.keys.all_specs, Mailbox(SPECS_A_TICK))
        node.on_alive(self._on_alive)
        self._robot_node = node.profile.robot.driver

    def _on_alive(self, name: str, alive: bool) -> None:
        with self._lock:
            (self._alive.add if alive else self._alive.discard)(name)
            self._changed = True
            if not alive:
                self._voices.pop(name, None)
                self._hosts.pop(name, None)
            if not alive and name.startswith("worker-"):
                worker = name.removeprefix("worker-")
                self._specs.pop(worker, None)
                self._spec_sources.pop(worker, None)
                self._complaints.pop(worker, None)

    def look(self, now_ns: int) -> Surroundings | None:
        """The surroundings now, or None when nothing changed."""
        for arrival in self._statuses.take_all():
            stamped = self._node.read(NodeStatus, arrival)
            if stamped is not None and self._speaks_for_itself(stamped, arrival):
                self._take_status(stamped.record, now_ns)
        for arrival in self._new_specs.take_all():
            stamped = self._node.read(ModelSpec, arrival)
            if stamped is not None:
                worker = key_names.last(str(arrival.sample.key_expr))
                self._take_spec(worker, stamped.record, stamped.header.source)
        self._follow_clocks()
        with self._lock:
            if not self._changed:
                return None
            self._changed = False
            return Surroundings(
                frozenset(self._alive),
                self._robot_node,
                dict(self._specs),
                dict(self._spec_sources),
                dict(self._complaints),
                {
                    camera: age_s + (now_ns - heard_ns) / 1e9
                    for camera, (_, age_s, heard_ns) in self._cameras.items()
                },
                {camera: node for camera, (node, _, _) in self._cameras.items()},
                socket.gethostname(),
                dict(self._hosts),
                self._node.clocks.known(),
            )

    def _follow_clocks(self) -> None:
        """Measure the clocks of all nodes, and look at them now and then."""
        if time.monotonic() < self._next_clocks_s:
            return
        self._next_clocks_s = time.monotonic() + CLOCKS_PERIOD_S
        with self._lock:
            for name in self._alive:
                self._node.clocks.follow(name)
            self._changed = True

    def owner(self, worker: str) -> str | None:
        """The source that speaks for a worker: who published its spec."""
        with self._lock:
            return self._spec_sources.get(worker)

    def _speaks_for_itself(self, status: Stamped[NodeStatus], arrival: Arrival) -> bool:
        """A node's status counts on its own key, while it is alive, by the first who wrote it."""
        name, source = status.record.node, status.header.source
        with self._lock:
            ours = name == key_names.last(str(arrival.sample.key_expr)) and name in self._alive
            if ours and self._voices.setdefault(name, source) == source:
                return True
        self._node.counters["refused.foreign_status"] += 1
        return False

    def _take_spec(self, worker: str, spec: ModelSpec, source: str) -> None:
        with self._lock:
            known = self._spec_sources.get(worker)
            if worker_node(worker) not in self._alive or (known is not None and known != source):
                self._node.counters["refused.foreign_spec"] += 1
                return
            if known is None and len(self._specs) >= MAX_WORKERS:
                return
            if self._specs.get(worker) != spec:
                self._specs[worker] = spec
                self._spec_sources[worker] = source
                self._changed = True

    def _take_status(self, status: NodeStatus, now_ns: int) -> None:
        with self._lock:
            self._hosts[status.node] = status.host
            if status.node.startswith("worker-"):
                complaint = status.detail.get("complaint", "")
                worker = status.node.removeprefix("worker-")
                if isinstance(complaint, str) and len(self._complaints) < MAX_WORKERS:
                    self._complaints[worker] = complaint[:300]
                    self._changed = True
            cameras = status.detail.get("cameras")
            if isinstance(cameras, dict):
                for camera, fields in cameras.items():
                    self._take_camera(status.node, camera, fields, now_ns)

    def _take_camera(self, node: str, camera: Any, fields: Any, now_ns: int) -> None:
        if camera not in self._node.profile.cameras or not isinstance(fields, dict):
            return
        age_s = fields.get("age_s")
        if isinstance(age_s, (int, float)) and not isinstance(age_s, bool):
            self._cameras[camera] = (node, float(age_s), now_ns)
            self._changed = True
