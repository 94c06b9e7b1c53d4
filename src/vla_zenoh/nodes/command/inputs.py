"""Inputs of the command node at every tick: settings, chunks, states, steps of its clock, and what
the other nodes say about themselves."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from typing import Any, TypeVar

from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample, ZenohRing, header_of
from vla_zenoh.bus.host import HostId
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import MAX_MESSAGE_BYTES
from vla_zenoh.bus.stream import Stream
from vla_zenoh.codec import settings
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.control.commander_io import Inputs, NewStates, Setting
from vla_zenoh.control.preflight import PeerSnapshot
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import CRASHED, ON_BEHALF, Keys, last_chunk, worker_node
from vla_zenoh.policy import ModelSpec
from vla_zenoh.security.roles import expected_nodes
from vla_zenoh.types import (
    ActionChunk,
    GripperState,
    Header,
    JointState,
    NodeStatus,
    PoseState,
    Stamped,
)

Record = TypeVar("Record")
STATES = 32
"""States buffered between two ticks: the robot's, and room for those of another source."""
CHUNKS = 64
WORDS = settings.MAX_SETTING_BYTES
SETTINGS: tuple[tuple[str, int, int, Callable[[bytes], Any]], ...] = (
    ("stop", 8, MAX_MESSAGE_BYTES, lambda _: None),
    ("reset", 8, MAX_MESSAGE_BYTES, lambda _: None),
    ("prompt", 16, WORDS, settings.decode_text),
    ("worker", 16, WORDS, settings.decode_name),
    ("rate", 16, WORDS, settings.decode_rate),
    ("speed", 16, WORDS, settings.decode_percent),
    ("slower", 16, WORDS, settings.decode_percent),
    ("active", 16, WORDS, settings.decode_activation),
)
"""Name of each key, samples buffered between two ticks, largest payload, and decoder: a stop has
any payload."""
CLOCK_PERIOD_S = 0.1
JOINT_PERIOD_S = 0.025

MAX_WORKERS, MAX_HOLDERS = 32, 32
MAX_WHY = 300
CLOCKS_PERIOD_S = 0.25
SILENT_S = 2.0
"""After this time another source of a node's status is accepted: of two nodes of one name one ends,
and their token stays."""
STATUSES_AT_ONCE, SPECS_AT_ONCE = 32, 16
"""More than our nodes publish between two updates: each does so twice a second."""


class CommandInputs:
    """Subscriptions of the command node to the robot, the workers and the clients' settings."""

    def __init__(self, node: Node) -> None:
        self._node, keys = node, node.keys
        self._peer_monitor = PeerMonitor(node)
        self.chunk_arrival = threading.Event()
        """Set when a chunk arrives."""
        ring = CallbackRing(CHUNKS, arrival=self.chunk_arrival)
        self.chunks = node.subscribe(keys.all_deltas, ring)
        names = node.profile.part_names
        self._parts = {name: _PartInputs(node, keys.of_part(name)) for name in names}
        node.follow_senders()
        self._settings = [
            (name, node.subscribe(getattr(keys, name), ZenohRing(size, limit)), decode)
            for name, size, limit, decode in SETTINGS
        ]
        self._last_clock = 0.0
        self._robot_alive = False

    def read_news(self, now_ns: int) -> None:
        """Read status and specs of the other nodes, for the next `poll`."""
        self._peer_monitor.read_news(now_ns)

    def poll(self, now_ns: int, *, take_chunks: bool = True) -> Inputs:
        """What was received since the last call, for the tick at `now_ns`, wall clock.

        `take_chunks`: else they are left to `poll_streams`.
        """
        settings_put = self._poll_settings()
        peers = self._peer_monitor.snapshot(now_ns)
        if peers is not None:
            self._robot_alive = peers.robot_node in peers.alive
        if not self._robot_alive:
            for part in self._parts.values():
                part.restart()
        inputs = self.poll_streams(settings_put, take_chunks=take_chunks)
        inputs.settings, inputs.peers = [*settings_put, *self._check_clock()], peers
        return inputs

    def poll_streams(
        self, settings_put: Sequence[Setting] = (), *, take_chunks: bool = True
    ) -> Inputs:
        """The chunks and states among them."""
        if take_chunks:
            self.chunk_arrival.clear()
        arrived = self.chunks.drain() if take_chunks else ()
        chunks = [self._chunk(arrival) for arrival in arrived]
        inputs = Inputs(chunks=[chunk for chunk in chunks if chunk is not None])
        requested = any(setting.name in ("active", "worker") for setting in settings_put)
        states = {name: part.poll(requested) for name, part in self._parts.items()}
        if "" in states:
            inputs.pose, inputs.gripper, inputs.joint = states[""]
        else:
            inputs.parts = states
        return inputs

    def _poll_settings(self) -> list[Setting]:
        """Settings put since the last tick, in the order of the router's timestamps.

        Each setting has a buffer of its own, so that a flood of one does not push out another.
        Without timestamps only the order on each key is kept.
        """
        arrivals = [
            (arrival.put_ns, name, "", decode, arrival)
            for name, buffer, decode in self._settings
            for arrival in buffer.drain()
        ]
        arrivals += [
            (arrival.put_ns, "held", name, settings.decode_held, arrival)
            for name, part in self._parts.items()
            for arrival in part.held.drain()
        ]
        if not arrivals:
            return []
        if all(put_ns is not None for put_ns, *_ in arrivals):
            arrivals.sort(key=itemgetter(0))
        put: list[Setting] = []
        for put_ns, name, part, decode, arrival in arrivals:
            if name in ("stop", "reset"):
                put.append(Setting(name, put_ns=put_ns))
                continue
            value = self._node.decode_text(decode, arrival)
            if value is None and name == "active":
                value = False  # whoever wrote `False.` or JSON meant the arm to stop
            if value is not None:
                put.append(Setting(name, value, put_ns, part))
        return put

    def _chunk(self, arrival: ReceivedSample) -> Stamped[ActionChunk] | None:
        """A chunk from the source of the worker whose key it came on, None for any other."""
        worker = last_chunk(str(arrival.sample.key_expr))
        owner = self._peer_monitor.owner(worker)
        try:
            header = header_of(arrival.sample)
            if owner is not None and header.source != owner:  # first: there may be a flood of them
                by, ours = header.source[:60], owner[:60]
                raise CodecError("foreign", f"by {by!r}; the source of this worker is {ours!r}")
        except CodecError as error:
            self._node.reject(error.reason, f"delta/{worker}: {error}")
            return None
        chunk = self._node.decode(ActionChunk, arrival)
        if chunk is not None and chunk.record.worker != worker:
            self._node.reject("foreign", "chunk on the delta key of another worker")
            return None
        return chunk

    def _check_clock(self) -> list[Setting]:
        if time.monotonic() - self._last_clock < CLOCK_PERIOD_S:
            return []
        self._last_clock = time.monotonic()
        step_s = self._node.adopt_system_time()
        if abs(step_s) <= self._node.profile.timing.max_clock_step_s:
            return []
        return [Setting("lose", f"the wall clock was set by {step_s:+.3f} s")]


class _PartInputs:
    """Subscriptions to the states of one part, and to what it holds."""

    def __init__(self, node: Node, keys: Keys) -> None:
        silence_s = node.profile.timing.state_timeout_s

        def stream(key: str, kind: type[Record]) -> Stream[Record, CallbackRing]:
            return Stream(node, key, kind, CallbackRing(STATES, SMALL_BYTES), silence_s)

        self._pose = stream(keys.state_pose, PoseState)
        self._joint = stream(keys.state_joint, JointState)
        self._gripper = stream(keys.state_gripper, GripperState)
        self.held = node.subscribe(keys.held, ZenohRing(16, WORDS))
        self._last_joint = 0.0

    def restart(self) -> None:
        """Drop what arrived; the next states may be of any source: the robot's node is gone."""
        for stream in (self._pose, self._joint, self._gripper):
            stream.restart()

    def poll(self, requested: bool) -> NewStates:
        """The newest states; joints, which are expensive to decode, every `JOINT_PERIOD_S` and when
        an activation is `requested`."""
        joint, now_s = None, time.monotonic()
        if requested or now_s - self._last_joint >= JOINT_PERIOD_S:
            joint = self._joint.newest()
            if joint is not None:
                self._last_joint = now_s
        return NewStates(self._pose.newest(), joint=joint, gripper=self._gripper.newest())


class PeerMonitor:
    """Collects status, specs and liveliness into a `PeerSnapshot`."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._lock = threading.Lock()
        self._alive: set[str] = set()
        self._holders: set[str] = set()
        self._nodes_gone: set[str] = set()
        self._holders_gone: set[str] = set()
        """Those that were gone since the last snapshot, even if they are back."""
        self._changed = True
        self._specs: dict[str, ModelSpec] = {}
        self._spec_sources: dict[str, str] = {}
        self._status_sources: dict[str, tuple[str, float]] = {}  # with the time of the last one
        self._complaints: dict[str, str] = {}
        self._servers = node.profile.camera_servers()
        self._cameras: dict[str, tuple[float, int]] = {}
        self._camera_faults: dict[str, str] = {}
        self._camera_reasons: dict[str, str] = {}
        self._expected = frozenset(expected_nodes(node.profile))
        self._down: dict[str, str] = {}
        self._hosts: dict[str, HostId] = {}
        self._same_host: set[str] = set()
        self._next_clocks_s = 0.0
        self._statuses = node.subscribe(node.keys.all_status, ZenohRing(STATUSES_AT_ONCE))
        self._new_specs = node.subscribe(node.keys.all_specs, ZenohRing(SPECS_AT_ONCE))
        node.on_tokens(node.keys.all_alive, self._on_alive)
        node.on_tokens(node.keys.all_holding, self._on_holding)
        self._robot_node = node.profile.robot.node

    def _on_alive(self, name: str, alive: bool) -> None:
        with self._lock:
            (self._alive.add if alive else self._alive.discard)(name)
            self._changed = True
            if alive:
                self._down.pop(name, None)
                return
            self._nodes_gone.add(name)
            self._forget(name)

    def _forget(self, name: str) -> None:
        for known in (self._status_sources, self._hosts):
            known.pop(name, None)
        self._same_host.discard(name)
        for camera in [camera for camera, node in self._servers.items() if node == name]:
            for known in (self._cameras, self._camera_faults, self._camera_reasons):
                known.pop(camera, None)
        if name.startswith("worker-"):
            for known in (self._specs, self._spec_sources, self._complaints):
                known.pop(name.removeprefix("worker-"), None)

    def _on_holding(self, name: str, present: bool) -> None:
        with self._lock:
            self._changed = True
            if not present:
                self._holders_gone.add(name)
                self._holders.discard(name)
            elif len(self._holders) < MAX_HOLDERS:
                self._holders.add(name)
            else:
                self._node.counters["refused.holder"] += 1

    def read_news(self, now_ns: int) -> None:
        """Read status and specs, and measure clocks."""
        for arrival in self._statuses.drain():
            self._receive_status(arrival, now_ns)
        for arrival in self._new_specs.drain():
            self._receive_spec(arrival)
        self._track_clocks()

    def snapshot(self, now_ns: int) -> PeerSnapshot | None:
        """What is known, None if nothing changed since the last call."""
        with self._lock:
            if not self._changed:
                return None
            # A token that was gone between two polls is gone for one: what depends on it ends.
            alive = frozenset(self._alive - self._nodes_gone)
            holders = frozenset(self._holders - self._holders_gone)
            self._changed = len(alive) < len(self._alive) or len(holders) < len(self._holders)
            self._nodes_gone.clear()
            self._holders_gone.clear()
            return PeerSnapshot(
                alive,
                self._robot_node,
                dict(self._specs),
                dict(self._spec_sources),
                dict(self._complaints),
                {
                    camera: age_s + (now_ns - received_ns) / 1e9
                    for camera, (age_s, received_ns) in self._cameras.items()
                },
                {camera: self._servers[camera] for camera in self._cameras},
                {name: place.host for name, place in self._hosts.items()},
                frozenset(self._same_host),
                {node: at[:2] for node, at in self._node.clocks.offsets().items()},
                holders,
                dict(self._camera_faults),
                dict(self._camera_reasons),
                dict(self._down),
            )

    def _track_clocks(self) -> None:
        """Keep measuring the clock offsets of all nodes."""
        if time.monotonic() < self._next_clocks_s:
            return
        self._next_clocks_s = time.monotonic() + CLOCKS_PERIOD_S
        with self._lock:
            for name in self._alive:
                self._node.clocks.track(name)
            self._changed = True

    def owner(self, worker: str) -> str | None:
        """The source of a worker: the one that published its spec."""
        with self._lock:
            return self._spec_sources.get(worker)

    # The source is checked before the payload: messages of other sources are not decoded, and no
    # clock is measured for a made-up name.
    def _receive_status(self, arrival: ReceivedSample, now_ns: int) -> None:
        """Accept a live node's status on its own key, from one source until that is silent."""
        name, header = self._name_and_header(arrival)
        if header is None:
            return
        source, now_s = header.source, time.monotonic()
        with self._lock:
            alive = name in self._alive
            known, heard_s = self._status_sources.get(name, (source, now_s))
            ours = alive and (known == source or now_s - heard_s > SILENT_S)
        # `up` may see a node start later than we do.
        if source.startswith(ON_BEHALF) or (not alive and name in self._expected):
            self._receive_on_behalf(name, arrival, header)
            return
        stamped = self._node.decode(NodeStatus, arrival) if ours else None
        if ours and stamped is None:
            return  # rejected and counted already
        status = stamped.record if stamped is not None and stamped.record.node == name else None
        with self._lock:
            # A node that is gone must not block a restarted one of the same name.
            if status is not None and name in self._alive:
                # A worker whose spec is known already is not a new one.
                worker = name.removeprefix("worker-")
                if known != source and self._spec_sources.get(worker) != source:
                    self._forget(name)
                self._status_sources[name], self._changed = (source, now_s), True
                self._update_from_status(status)
            else:
                self._node.counters["refused.foreign_status"] += 1
                return
        cameras = status.detail.get("cameras")
        for camera, fields in cameras.items() if isinstance(cameras, dict) else ():
            if camera in self._servers and isinstance(fields, dict):
                self._update_camera(name, camera, fields, now_ns)

    def _receive_on_behalf(self, name: str, arrival: ReceivedSample, header: Header) -> None:
        """Keep why a node is down, as its host's `up` reports it, or the command of a worker that
        was started by hand; for display only."""
        stamped = self._node.decode(NodeStatus, arrival)
        why = None if stamped is None else stamped.record.detail.get("complaint")
        if stamped is None or stamped.record.state != CRASHED or not isinstance(why, str):
            return
        with self._lock:
            room = name in self._expected or name in self._down or len(self._down) < MAX_WORKERS
            if name not in self._alive and room:
                self._down[name], self._changed = why[:MAX_WHY], True

    def _receive_spec(self, arrival: ReceivedSample) -> None:
        """Accept a live worker's spec on its own key, from one source or that of its status."""
        worker, header = self._name_and_header(arrival)
        if header is None:
            return
        source, node = header.source, worker_node(worker)
        with self._lock:
            known = self._spec_sources.get(worker)
            speaks, _ = self._status_sources.get(node, ("", 0.0))
            ours = node in self._alive and (known in (None, source) or speaks == source)
            if ours and known is None and len(self._specs) >= MAX_WORKERS:
                self._node.counters["refused.more_workers"] += 1
                return
        stamped = self._node.decode(ModelSpec, arrival) if ours else None
        if ours and stamped is None:
            return
        with self._lock:
            if stamped is not None and node in self._alive:
                if self._specs.get(worker) != stamped.record or known != source:
                    self._specs[worker] = stamped.record
                    self._spec_sources[worker] = source
                    self._changed = True
                return
        self._node.counters["refused.foreign_spec"] += 1

    def _name_and_header(self, arrival: ReceivedSample) -> tuple[str, Header | None]:
        """Node or worker name from the sample's key, and the header; None: it is rejected."""
        key = str(arrival.sample.key_expr)
        try:
            return last_chunk(key), header_of(arrival.sample)
        except CodecError as error:
            self._node.reject_sample(key, error)
            return last_chunk(key), None

    def _update_from_status(self, status: NodeStatus) -> None:
        place = HostId(status.host, status.boot)
        if self._hosts.get(status.node) != place:
            self._hosts[status.node] = place
            same = place.shares_clock(self._node.host_id)
            (self._same_host.add if same else self._same_host.discard)(status.node)
        if status.node.startswith("worker-"):
            complaint = status.detail.get("complaint", "")
            worker = status.node.removeprefix("worker-")
            if not isinstance(complaint, str):
                return
            if not complaint:
                self._complaints.pop(worker, None)
            elif worker in self._complaints or len(self._complaints) < MAX_WORKERS:
                self._complaints[worker] = complaint[:MAX_WHY]
            else:
                self._node.counters["refused.more_workers"] += 1

    def _update_camera(
        self, node: str, camera: str, fields: Mapping[Any, Any], now_ns: int
    ) -> None:
        """Update a camera from the status of the node that serves it by the profile."""
        server = self._servers[camera]
        if node != server:
            self._node.reject(
                "foreign_camera",
                f"node {node!r} reports camera {camera!r}, which node {server!r} serves by the "
                "profile (hosts.HOST.cameras; --name of `vla-zenoh node camera`)",
                node,
            )
            return
        age_s, bad, reason = (fields.get(name) for name in ("age_s", "bad", "why"))
        self._camera_reasons[camera] = reason[:MAX_WHY] if isinstance(reason, str) else ""
        why = bad.get("why") if isinstance(bad, Mapping) else None
        if isinstance(why, str):
            self._camera_faults[camera] = why[:MAX_WHY]
        else:
            self._camera_faults.pop(camera, None)
        if isinstance(age_s, (int, float)) and not isinstance(age_s, bool):
            self._cameras[camera] = (max(float(age_s), 0.0), now_ns)
