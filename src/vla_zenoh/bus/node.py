"""Base of every node: its publishers, subscribers, status, events and counters."""

from __future__ import annotations

import itertools
import os
import secrets
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, TypeVar

import zenoh

from vla_zenoh.bus.bounded import Bounded
from vla_zenoh.bus.buffers import (
    CallbackRing,
    ReceivedSample,
    SampleBuffer,
    bytes_of,
    header_of,
)
from vla_zenoh.bus.clock import Clock, ClockSync
from vla_zenoh.bus.host import own_host_id
from vla_zenoh.bus.metrics import EventThrottle, Traffic
from vla_zenoh.bus.name_check import NameCheck
from vla_zenoh.bus.reception import REMEDY, SHARE, Reception, lost_in_words
from vla_zenoh.bus.session import QOS, alive_nodes, open_session
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError, NodeError
from vla_zenoh.keys import ENDED, Kind, last_chunk
from vla_zenoh.profile import Profile
from vla_zenoh.types import Event, Header, NodeStatus, SingleWriterFilter, Stamped

MSGPACK = zenoh.Encoding("application/msgpack")
STATUS_PERIOD_S = 0.5
IMAGE_LINK_TIMEOUT_S = 10.0
LOSSES_PERIOD_S = 5.0
"""Events of lost samples are published at most this often, with their sum."""
MAX_NEWER_SOURCES, MAX_UNKNOWN_NAMED = 256, 8
"""Senders whose unknown fields are named, and names in each event; all are counted."""

Record = TypeVar("Record")
AnyBuffer = TypeVar("AnyBuffer", bound=SampleBuffer)


class Publisher:
    """Publishes records on one key, each with its header."""

    def __init__(
        self, session: zenoh.Session, key: str, kind: Kind, source: str, clock: Clock
    ) -> None:
        self._publisher = session.declare_publisher(key, **QOS[kind])
        self._source, self._clock = source, clock
        self.key = key
        self.seq = 0
        self.sent_bytes = 0

    @property
    def has_subscribers(self) -> bool:
        """Whether any subscriber matches."""
        return self._publisher.matching_status.matching  # pyright: ignore  # stub says bool

    def publish(
        self,
        record: Any,
        *,
        stamp_wall_ns: int | None = None,
        seq: int | None = None,
        encoding: Any = MSGPACK,
    ) -> Header:
        """Publish a record, or encoded bytes, with its time of capture (None: now) and sequence
        number (None: one more than the last)."""
        header = Header(
            self._clock.wall_ns() if stamp_wall_ns is None else stamp_wall_ns,
            self.seq if seq is None else seq,
            self._source,
        )
        payload = record if isinstance(record, bytes) else records.encode(record)
        self._publisher.put(payload, attachment=records.encode_header(header), encoding=encoding)
        self.seq += 1
        self.sent_bytes += len(payload)
        return header

    def undeclare(self) -> None:
        """Close it."""
        self._publisher.undeclare()


def publish_together(stamp_wall_ns: int, seq: int, *states: tuple[Publisher, Any]) -> None:
    """Publish records of one time: all are encoded before the first one is put.

    What is put at once travels in one packet, and wakes every thread on its way once.
    """
    payloads = [records.encode(record) for _, record in states]
    for (publisher, _), payload in zip(states, payloads, strict=True):
        publisher.publish(payload, stamp_wall_ns=stamp_wall_ns, seq=seq)


class Node:
    """A process on the bus.

    Args:
        name: unique for this robot.
        profile: the effective profile.
        session: open session, which the caller closes.
        host: name of this host in the profile, if known.
        routes: the session is a router's.

    Raises:
        NodeError: a node of this name is already running, or the router does not answer.
    """

    def __init__(
        self,
        name: str,
        profile: Profile,
        session: zenoh.Session,
        *,
        host: str | None = None,
        routes: bool = False,
    ) -> None:
        self.name, self.profile, self.session = name, profile, session
        self.host_id = own_host_id(profile.session, host)
        self.keys = profile.keys
        self.clock = Clock()
        self.source = f"{name}#{secrets.token_hex(4)}"
        self.counters: Counter[str] = Counter()
        self._newer_sources: Bounded[str, None] = Bounded(MAX_NEWER_SOURCES)
        self.started_wall_ns = time.time_ns()
        self._declared: list[Any] = []
        self._publishers: list[Publisher] = []
        self._buffers: dict[SampleBuffer, list[Any]] = {}  # with their subscribers
        self._image_session: zenoh.Session | None = None
        self.traffic = Traffic(session)
        self.reception = Reception(self.keys)
        self._follows = False
        self._short: dict[str, str] = {}
        self._losses: Counter[str] = Counter()
        self._losses_s = 0.0
        self._status_s, self._last_state = 0.0, ""
        if alive_nodes(session, self.keys, name, routes=routes):
            raise self._duplicate()
        bound_s = profile.timing.max_clock_offset_s
        self.clocks = ClockSync(session, self.keys, self.clock, name, bound_s)
        self._name_check = NameCheck(session, self.keys.clock(name), routes=routes)
        self.serve(self.keys.clock(name), self.clocks.reply)
        self._token = session.liveliness().declare_token(self.keys.alive(name))
        self._status = self.declare_publisher(self.keys.status(name), Kind.TELEMETRY)
        events = self.declare_publisher(self.keys.event(name), Kind.TELEMETRY)
        self._events = EventThrottle(events.publish)

    def _duplicate(self) -> NodeError:
        return NodeError(
            f"node {self.name!r} of robot {self.profile.robot.name!r} is already running: "
            "`vla-zenoh status` says where. Stop it, or start this one with a different --name, "
            "if the command has that option"
        )

    def declare_publisher(self, key: str, kind: Kind) -> Publisher:
        """A publisher on `key`.

        Raises:
            SessionError: the router does not answer at the port for images.
        """
        publisher = Publisher(self._session_for(kind), key, kind, self.source, self.clock)
        self._publishers.append(publisher)
        return publisher

    def undeclare(self, publisher: Publisher) -> None:
        """Close a publisher."""
        self._publishers.remove(publisher)
        publisher.undeclare()

    def _session_for(self, kind: Kind) -> zenoh.Session:
        """Images have a connection of their own if the profile says so."""
        if kind is not Kind.FRAME or not self.profile.session.separate_links:
            return self.session
        if self._image_session is None:
            self._image_session = open_session(
                self.profile.session, identity=self.name, images=True, wait_s=IMAGE_LINK_TIMEOUT_S
            )
            self.traffic.sessions.append(self._image_session)
        return self._image_session

    def emit(self, event: Event) -> None:
        """Publish an event; repetitions are throttled and counted, see `EventThrottle`."""
        self._events.emit(event)

    def reject(self, reason: str, why: str, about: str = "") -> None:
        """Count a rejection and emit an event; what each is `about` is throttled by itself."""
        self.counters[f"refused.{reason}"] += 1
        self._events.emit(Event("warning", "refusal", reason, why[:1000]), about)

    def publish_status(
        self,
        state: str,
        *,
        detail: Mapping[str, Any] | None = None,
        ages_s: Mapping[str, float] | None = None,
        rates_hz: Mapping[str, float] | None = None,
        latency_ms: Mapping[str, tuple[float, float]] | None = None,
        now: bool = False,
    ) -> None:
        """Publish the status if it is due: periodically, when `state` changes, or `now`.

        Raises:
            NodeError: see `status_due`; not with `now`, by which a node says that it ends.
        """
        if now:
            self._poll()
        elif not self.status_due(state):
            return
        self._status_s, self._last_state = time.monotonic(), state
        self._report_losses()
        self._status.publish(
            NodeStatus(
                *(self.name, state, self.host_id.host, os.getpid(), self.started_wall_ns),
                ages_s or {},
                rates_hz or {},
                latency_ms or {},
                dict(self.counters),
                {**(detail or {}), **self._bus_detail()},
                self.host_id.boot,
            )
        )

    def publish_end(self, detail: Mapping[str, Any] | None = None) -> None:
        """Publish that the node ends as it should; not while an exception ends it."""
        if sys.exc_info()[0] is None:
            self.publish_status(ENDED, detail=detail, now=True)

    def status_due(self, state: str) -> bool:
        """Whether `publish_status` would publish now; lets a fast loop skip collecting details.

        Raises:
            NodeError: another node of this name was there already, see `NameCheck`.
        """
        self._poll()
        if self._name_check.taken:
            raise self._duplicate()
        due = time.monotonic() - self._status_s >= STATUS_PERIOD_S
        return due or state != self._last_state

    def _poll(self) -> None:
        self.clocks.poll()
        self._name_check.poll()
        self._report_rejected()
        self._events.poll()

    def follow_senders(self) -> None:
        """Compare what arrives with the statuses of all senders; of images this is done anyway."""
        if not self._follows:
            self._follows = True
            # At once, on Zenoh's thread: what has arrived by then is what the status is about.
            handler = zenoh.handlers.Callback(self._on_status, indirect=False)
            status = self.session.declare_subscriber(self.keys.all_status, handler)
            self._declared.append(status)

    def _on_status(self, sample: zenoh.Sample) -> None:
        with suppress(CodecError):  # who reads statuses for their content counts it
            status = records.decode(NodeStatus, bytes_of(sample.payload))
            self.reception.status_received(status)

    def _report_losses(self) -> None:
        before, self._short = self._short, self.reception.short()
        for name, why in self._short.items():
            if name not in before:
                self.counters["short_streams"] += 1
                self.emit(Event("warning", "fault", "short_stream", why[:1000], limit=SHARE))
        for name in before.keys() - self._short.keys():
            self.emit(Event("info", "notice", "whole_stream", f"{name}: samples arrive again"))
        lost = self.traffic.lost - self._losses
        if lost and time.monotonic() - self._losses_s >= LOSSES_PERIOD_S:
            self._losses, self._losses_s = Counter(self.traffic.lost), time.monotonic()
            why = f"samples that never arrived: {lost_in_words(lost, self.keys)}; {REMEDY}"
            count = float(lost.total())
            self.emit(Event("warning", "fault", "samples_lost", why[:1000], value=count))

    def _bus_detail(self) -> dict[str, Any]:
        short, traffic = self.keys.short, self.traffic
        net = {
            "sent": {short(key): rates for key, rates in traffic.sent(self._publishers).items()},
            "lost": {short(key): count for key, count in traffic.lost.items()},
            "short": self._short,
            "links": traffic.links(),
            "shared_memory": traffic.memory(),
        }
        clocks = {
            node: {
                "offset_ms": round(found.offset_s * 1e3, 3),
                "uncertainty_ms": round(found.uncertainty_s * 1e3, 3),
                "round_trip_ms": round(found.round_trip_s * 1e3, 3),
            }
            for node, found in self.clocks.offsets().items()
        }
        return {"clocks": clocks, "net": net}

    def subscribe(self, key: str, buffer: AnyBuffer, kind: Kind = Kind.STATE) -> AnyBuffer:
        """Subscribe to a key expression; samples go to `buffer`, which is returned.

        Samples that the buffer rejects are counted and reported with the next status. `kind`
        matters for images only, which may have their own connection.

        Raises:
            SessionError: the router does not answer at the port for images.
        """
        self.watch_buffer(buffer)
        if kind is Kind.FRAME:
            self.follow_senders()
        self._buffers[buffer].append(buffer.subscribe(self._session_for(kind), key))
        if isinstance(buffer, CallbackRing):  # a ring that Zenoh fills cannot count
            self.reception.watch(key, buffer.arrived)
        return buffer

    def unsubscribe(self, buffer: SampleBuffer) -> None:
        """Undeclare the subscribers of `buffer`."""
        self.reception.unwatch(buffer.arrived)
        for subscriber in self._buffers[buffer]:
            self.traffic.forget(str(subscriber.key_expr))
            subscriber.undeclare()
        self._report_rejected()
        del self._buffers[buffer]

    def watch_buffer(self, buffer: SampleBuffer) -> None:
        """Count and report the samples that `buffer` rejects."""
        self._buffers.setdefault(buffer, [])

    def _report_rejected(self) -> None:
        for buffer in self._buffers:
            for found in buffer.pop_rejected():
                key = self.keys.short(found.key)
                self.counters[f"refused.{found.reason}"] += found.times - 1
                self.reject(found.reason, f"{key}: {found.why}", key)

    def on_tokens(self, expression: str, callback: Callable[[str, bool], None]) -> None:
        """Call back with (last part of the key, alive) for every liveliness token.

        Now and at every change, on Zenoh's thread.
        """

        def change(sample: zenoh.Sample) -> None:
            callback(last_chunk(str(sample.key_expr)), sample.kind == zenoh.SampleKind.PUT)

        handler = zenoh.handlers.Callback(change, indirect=False)
        self._declared.append(
            self.session.liveliness().declare_subscriber(expression, handler, history=True)
        )

    def serve(self, key: str, reply: Callable[[zenoh.Query], None]) -> None:
        """Answer queries on `key`; `reply` runs on Zenoh's thread."""

        def handle(query: zenoh.Query) -> None:
            with query:
                reply(query)

        handler = zenoh.handlers.Callback(handle, indirect=False)
        self._declared.append(self.session.declare_queryable(key, handler, complete=True))

    def adopt_system_time(self) -> float:
        """Adopt the system's wall clock; a step of it (s) is counted, reported and returned."""
        step_s = self.clock.adopt_system_time()
        if step_s:
            self.reject("clock_step", f"the wall clock was set by {step_s:+.3f} s")
        return step_s

    def decode(
        self,
        kind: type[Record],
        arrival: ReceivedSample,
        writer_filter: SingleWriterFilter | None = None,
        read: Callable[[zenoh.Sample], Record] | None = None,
    ) -> Stamped[Record] | None:
        """Decode a sample, with its stamps on this node's clock, see `ClockSync`.

        None if it was rejected, which is counted and reported. `read`: decodes what is no record of
        msgpack.
        """
        key, unknown = str(arrival.sample.key_expr), list[str]()
        try:
            header = header_of(arrival.sample, unknown)
            if writer_filter is not None:  # first: a flood by another source must cost little
                writer_filter.check(header, arrival.mono_ns)
            if read is None:
                record = records.decode(kind, bytes_of(arrival.sample.payload), unknown)
            else:
                record = read(arrival.sample)
            if unknown:
                self._count_unknown(header.source, unknown)
            here, record = self.clocks.to_local_clock(header, record)
        except CodecError as error:
            self.reject_sample(key, error)
            return None
        if writer_filter is not None:
            writer_filter.accept(header, arrival.mono_ns)
        self.traffic.received(key, header, arrival.nth)
        return Stamped(here, record, self.clock.wall_at(arrival.mono_ns))

    def _count_unknown(self, source: str, fields: list[str]) -> None:
        """Count ignored fields, and name them once for each sender."""
        self.counters["unknown_fields"] += len(fields)
        if source in self._newer_sources:
            return
        self._newer_sources[source] = None
        named = ", ".join(fields[:MAX_UNKNOWN_NAMED])
        why = f"{source[:60]} sends {named}, which this version does not know: ignored"
        self._events.emit(Event("info", "notice", "unknown_fields", why[:1000]), source)

    def decode_text(
        self, decode: Callable[[bytes], Record], arrival: ReceivedSample
    ) -> Record | None:
        """Decode a setting in plain text; None if it was rejected."""
        try:
            return decode(bytes_of(arrival.sample.payload))
        except CodecError as error:
            self.reject_sample(str(arrival.sample.key_expr), error)
            return None

    def reject_sample(self, key: str, error: CodecError) -> None:
        short = self.keys.short(key)
        self.reject(error.reason, f"{short}: {error}", short)

    def close(self) -> None:
        """Leave the bus. The liveliness token goes first, so that others notice at once."""
        self._token.undeclare()
        for declared in (*self._declared, *itertools.chain(*self._buffers.values())):
            declared.undeclare()
        self._declared.clear()
        self._buffers.clear()
        if self._image_session is not None:
            self._image_session.close()
            self._image_session = None
