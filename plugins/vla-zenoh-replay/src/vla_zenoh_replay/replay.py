"""Publishes a recorded run with its original timing, never onto a live robot."""

from __future__ import annotations

import queue
import secrets
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import zenoh

from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import alive_nodes
from vla_zenoh.codec import image as image_codec
from vla_zenoh.codec import message
from vla_zenoh.errors import CodecError, NodeError, ProfileError, RecordingError, in_words
from vla_zenoh.keys import NODE_KINDS, Keys
from vla_zenoh.lab.recording.reader import Recording
from vla_zenoh.lab.recording.record_types import group_of
from vla_zenoh.lab.recording.sample import JPEG, Sample, stamps_moved
from vla_zenoh.lab.statistics import percentiles
from vla_zenoh.profile import Profile
from vla_zenoh.runtime.process import realtime_thread
from vla_zenoh.types import Header

MAX_SOURCE = 128
"""Characters of a header's source."""


class Restamper:
    """Moves samples of one pass over a file.

    Args:
        began_ns: start of the recording, wall clock of its recorder.
        starts_ns: start of the pass, wall clock here.
        speed: 2 is twice as fast.
        suffix: of the sources, another one in each pass: subscribers drop repeated sequence numbers
            of the same source.
    """

    def __init__(
        self, began_ns: int, starts_ns: int, speed: float, here: Keys, there: Keys, suffix: str
    ) -> None:
        self._began_ns, self._starts_ns, self._speed = began_ns, starts_ns, speed
        self._here, self._there, self._suffix = here, there, suffix

    def moved_ns(self, stamp_ns: int) -> int:
        """A stamp of the recording moved to the pass; 0 means none and stays."""
        if stamp_ns == 0:
            return 0
        since_ns = stamp_ns - self._began_ns
        if self._speed != 1.0:
            since_ns = round(since_ns / self._speed)
        return max(0, self._starts_ns + since_ns)

    def move(self, entry: Sample) -> Sample:
        """The sample to publish, at the time `received_ns`."""
        header = entry.header
        if header is not None:
            # Of a node that was restarted, the numbers began again.
            node, _, start = header.source.partition("#")
            source = f"{node}#{self._suffix}{start}"[:MAX_SOURCE]
            header = Header(self.moved_ns(header.stamp_wall_ns), header.seq, source)
        payload = entry.payload
        if entry.fields is not None:
            payload = message.pack(stamps_moved(entry.fields, self.moved_ns))
        return Sample(
            self._there.full(self._here.short(entry.key)),
            payload,
            entry.encoding,
            header,
            self.moved_ns(entry.received_ns),
            entry.attachment,
        )


NAME = "replay"
CAMERAS = "camera"
GROUPS = (
    *(CAMERAS, "state", "command", "delta", "spec", "seen", "task"),
    *("prompt", "active", "worker", "rate", "speed", "slower", "held", "stop", "reset"),
    *("status", "event", "sim"),
)
"""Parts of a recording that can be selected: the first chunk of a key after the robot."""
AHEAD = 400
"""Samples that are decoded ahead of their time."""
START_AFTER_NS = 500_000_000
"""Delay of the first sample: the router knows the publishers by then."""
SLICE_S = 0.1
SWITCH_INTERVAL_S = 5e-4
MAX_ERRORS = 1_000_000
# One priority for all: Zenoh keeps the order within a priority, and drops nothing.
QOS: dict[str, Any] = {
    "congestion_control": zenoh.CongestionControl.BLOCK,
    "priority": zenoh.Priority.DATA,
    "express": True,
}
_ROBOT = tuple(kind for kind, traits in NODE_KINDS.items() if traits.role in ("robot", "command"))
"""Prefixes of nodes that are a robot or move one."""


@dataclass(slots=True)
class ReplayResult:
    """Result of a replay.

    Args:
        left_out: samples not published, by node that is alive and publishes its own.
        late_ms: lateness of samples: p50, p95, max.
        interval_error_ms: difference to the recorded interval between two samples of a key: p50,
            p95, max.
    """

    samples: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0
    passes: int = 0
    left_out: Counter[str] = field(default_factory=Counter)
    late_ms: dict[str, float] = field(default_factory=dict)
    interval_error_ms: dict[str, float] = field(default_factory=dict)
    damage: str = ""
    failure: str = ""


class Replay:
    """Node that publishes the samples of a recording.

    Args:
        profile: of the robot that the recording is replayed as.
        session: an open session; the caller closes it.
        groups: parts to replay, of `GROUPS`.
        speed: 2 is twice as fast.

    Raises:
        NodeError: a robot is alive on these keys and `groups` is more than cameras; or the
            liveliness query failed.
    """

    def __init__(
        self,
        profile: Profile,
        session: zenoh.Session,
        file: Recording,
        *,
        groups: Collection[str] = GROUPS,
        speed: float = 1.0,
        loop: bool = False,
    ) -> None:
        self._file, self._groups = file, frozenset(groups)
        self._speed, self._loop = speed, loop
        self._here, self._there = file.keys, profile.keys
        self._link_lost = False
        self._alive = alive_nodes(session, profile.keys)
        self._reject_live_robot()
        self.node = Node(NAME, profile, session)
        self.node.on_tokens(self.node.keys.all_alive, self._on_alive)
        self._publishers: dict[str, Any] = {}
        self._raw: dict[str, Any] = {}
        self.replayed = ReplayResult()
        self._late_ns: deque[int] = deque(maxlen=MAX_ERRORS)
        self._errors_ns: deque[int] = deque(maxlen=MAX_ERRORS)
        self._last: dict[str, tuple[int, int]] = {}

    # -- liveliness ---------------------------------------------------------------------------
    def _on_alive(self, name: str, alive: bool) -> None:
        (self._alive.add if alive else self._alive.discard)(name)
        if name == NAME and not alive:  # ours: the link is lost, and with it every token
            self._link_lost = True

    def _reject_live_robot(self) -> None:
        live = sorted(name for name in list(self._alive) if name.startswith(_ROBOT))
        if live and self._groups != {CAMERAS}:
            raise NodeError(
                f"robot {self._there.robot!r} is alive ({', '.join(live)}): a replay would command "
                "it, or mislead it with old states. Replay as another robot with --robot NAME, or "
                "only the cameras with --only cameras"
            )

    # -- running ------------------------------------------------------------------------------
    def run(self, stop: threading.Event) -> ReplayResult:
        """Replay up to the end, or until `stop` is set."""
        # With Python's default of 5 ms, this thread may wait that long for the reading one.
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        began_s = time.monotonic()
        try:
            with realtime_thread():
                while not stop.is_set():
                    if not self._one_pass(stop):
                        self.replayed.failure = self.replayed.failure or "nothing to publish"
                        break
                    self.replayed.passes += 1
                    if not self._loop:
                        break
        except NodeError as error:
            self.replayed.failure = str(error)
        self.replayed.seconds = time.monotonic() - began_s
        self.replayed.damage = self._file.damage
        self.replayed.late_ms = percentiles(np.array(self._late_ns) / 1e6)
        self.replayed.interval_error_ms = percentiles(np.array(self._errors_ns) / 1e6)
        self.node.publish_end()
        self.node.close()
        return self.replayed

    def _one_pass(self, stop: threading.Event) -> bool:
        ready: queue.Queue[tuple[int, Sample] | Exception | None] = queue.Queue(AHEAD)
        ending = threading.Event()
        self._last.clear()
        # Both clocks are read once: setting the wall clock does not disturb the pass.
        starts_ns = self.node.clock.wall_ns() + START_AFTER_NS
        to_mono_ns = time.monotonic_ns() - self.node.clock.wall_ns()
        reader = threading.Thread(
            target=self._prepare, args=(ready, ending, starts_ns), name="reader", daemon=True
        )
        reader.start()
        anything = False
        try:
            while not stop.is_set():
                try:
                    found = ready.get(timeout=SLICE_S)
                except queue.Empty:
                    continue
                if found is None:
                    break
                if isinstance(found, Exception):
                    path = self._file.path
                    raise NodeError(f"{path} cannot be replayed: {in_words(found)}") from found
                anything = True
                self._put(*found, to_mono_ns, stop)
        finally:
            ending.set()
            reader.join()
        return anything or stop.is_set()

    # -- reading ahead ------------------------------------------------------------------------
    def _prepare(self, ready: queue.Queue[Any], ending: threading.Event, starts_ns: int) -> None:
        end: Exception | None = None
        try:
            self._read_ahead(ready, ending, starts_ns)
        except Exception as error:  # the other thread waits for the end
            end = error
        _hand_over(ready, end, ending)

    def _read_ahead(self, ready: queue.Queue[Any], ending: threading.Event, starts_ns: int) -> None:
        restamper: Restamper | None = None
        suffix = secrets.token_hex(4)
        for entry in self._chosen():
            if restamper is None:
                restamper = Restamper(
                    entry.received_ns, starts_ns, self._speed, self._here, self._there, suffix
                )
            sample = restamper.move(entry)
            self._publisher(sample.key)
            if not _hand_over(ready, (entry.received_ns, sample), ending):
                return

    def _chosen(self) -> Iterator[Sample]:
        for entry in self._file.entries(lambda key: group_of(self._here, key) in self._groups):
            writer = "" if entry.header is None else entry.header.source.partition("#")[0]
            if writer in self._alive:
                self.replayed.left_out[writer] += 1
            else:
                yield entry

    def _publisher(self, key: str) -> Any:
        if key not in self._publishers:
            self._publishers[key] = self.node.session.declare_publisher(key, **QOS)
            camera = key.split("/")[-2]
            with suppress(ProfileError):  # a name that no camera of ours has
                if group_of(self._there, key) == CAMERAS and key == self._there.camera_jpeg(camera):
                    raw = self._there.camera_raw(camera)
                    self._raw[key] = self.node.session.declare_publisher(raw, **QOS)
        return self._publishers[key]

    # -- writing ------------------------------------------------------------------------------
    def _put(
        self, recorded_ns: int, sample: Sample, to_mono_ns: int, stop: threading.Event
    ) -> None:
        due_ns = sample.received_ns + to_mono_ns
        while (left_s := (due_ns - time.monotonic_ns()) / 1e9) > 0:
            if left_s > SLICE_S:
                self._check_robot()
                if stop.wait(SLICE_S):
                    return
            else:
                time.sleep(left_s)
        self._check_robot()
        now_ns = time.monotonic_ns()
        self._publishers[sample.key].put(
            sample.payload, encoding=sample.encoding, attachment=sample.attached
        )
        raw = self._raw.get(sample.key)
        if raw is not None and sample.encoding == JPEG and raw.matching_status.matching:
            self._put_raw(raw, sample)
        self.replayed.samples[sample.key] += 1
        self._late_ns.append(now_ns - due_ns)
        before = self._last.get(sample.key)
        if before is not None:
            asked_ns = (recorded_ns - before[0]) / self._speed
            self._errors_ns.append(round(abs(now_ns - before[1] - asked_ns)))
        self._last[sample.key] = (recorded_ns, now_ns)

    def _put_raw(self, publisher: Any, sample: Sample) -> None:
        """Publish the JPEG decoded, for a worker that subscribes to raw images."""
        with suppress(CodecError):  # subscribers of the JPEG reject it themselves
            image = image_codec.decode_jpeg(sample.payload)
            schema = zenoh.Encoding.ZENOH_BYTES.with_schema(image_codec.raw_schema(image))
            publisher.put(
                image_codec.encode_raw(image), encoding=schema, attachment=sample.attached
            )

    def _check_robot(self) -> None:
        """Publish status, and end at once when a robot comes alive, or may do so unnoticed.

        Raises:
            NodeError: a robot is alive, or the link to the router is or was lost.
        """
        # Zenoh links again by itself, and samples may arrive there before a robot's token here.
        if self._link_lost or not self.node.session.info.routers_zid():
            raise NodeError(
                "the link to the router was lost, and a robot may have come alive meanwhile: the "
                "replay ended. Start it again"
            )
        self._reject_live_robot()
        if self.node.status_due("replaying"):
            self.node.counters["samples"] = self.replayed.samples.total()
            detail = {"file": str(self._file.path), "pass": self.replayed.passes + 1}
            self.node.publish_status("replaying", detail=detail)


def parse_groups(names: Collection[str]) -> frozenset[str]:
    """The groups of these names; without names all of them.

    Raises:
        RecordingError: an unknown group; the message lists the known ones.
    """
    plain = {"cameras": "camera", "states": "state", "commands": "command", "deltas": "delta"}
    groups = {plain.get(name, name) for name in names}
    unknown = sorted(groups - set(GROUPS))
    if unknown:
        raise RecordingError(
            f"--only {unknown[0]}: unknown part; known are cameras, {', '.join(GROUPS)}"
        )
    return frozenset(groups or GROUPS)


def _hand_over(ready: queue.Queue[Any], item: Any, ending: threading.Event) -> bool:
    """Add to the queue; False once the reader of the queue is ending."""
    while not ending.is_set():
        try:
            ready.put(item, timeout=SLICE_S)
            return True
        except queue.Full:
            continue
    return False
