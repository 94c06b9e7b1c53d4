"""What every node has: a name on the bus, status, events, counters, and checked streams."""

from __future__ import annotations

import os
import secrets
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import zenoh

from vla_zenoh.bus import clock_sync as offsets
from vla_zenoh.bus.buffers import (
    CallbackRing,
    LatestSample,
    ReceivedSample,
    SampleBuffer,
    ZenohRing,
    bytes_of,
    header_of,
)
from vla_zenoh.bus.clock import Clock
from vla_zenoh.bus.clock_sync import ClockSync
from vla_zenoh.bus.event_throttle import EventThrottle
from vla_zenoh.bus.host_id import own_host_id
from vla_zenoh.bus.liveliness import alive_nodes
from vla_zenoh.bus.metrics import Traffic
from vla_zenoh.bus.session import QOS, open_session
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError, NodeError
from vla_zenoh.keys import Kind
from vla_zenoh.profile import Profile
from vla_zenoh.types import Event, Header, NodeStatus, Stamped
from vla_zenoh.types.stream import SingleWriterFilter

MSGPACK = zenoh.Encoding("application/msgpack")
STATUS_PERIOD_S = 0.5
PICTURES_PATIENCE_S = 10.0

Record = TypeVar("Record")
AnyBuffer = TypeVar("AnyBuffer", LatestSample, CallbackRing, ZenohRing)


class Publisher:
    """Writes records on one key, each with its header."""

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
        """Somebody listens."""
        return self._publisher.matching_status.matching  # pyright: ignore  # stub says bool

    def publish(
        self,
        record: Any,
        *,
        stamp_wall_ns: int | None = None,
        seq: int | None = None,
        encoding: Any = MSGPACK,
    ) -> Header:
        """Write a record, or ready-made bytes, stamped now unless told otherwise."""
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

    def close(self) -> None:
        """No more is written."""
        self._publisher.undeclare()


class Node:
    """A process on the bus.

    Args:
        name: unique for this robot; a second node of the same name is refused.
        profile: the effective profile.
        session: an open session, closed by whoever opened it.
        host: of the profile, on which this runs, where somebody said so.

    Raises:
        NodeError: a node of this name is alive already, or the router does not say.
    """

    def __init__(
        self, name: str, profile: Profile, session: zenoh.Session, *, host: str | None = None
    ) -> None:
        self.name, self.profile, self.session = name, profile, session
        self.host_id = own_host_id(profile.session, host)
        self.keys = profile.keys
        self.clock = Clock()
        self.source = f"{name}#{secrets.token_hex(4)}"
        self.counters: Counter[str] = Counter()
        self.started_wall_ns = time.time_ns()
        self._declared: list[Any] = []
        self._streams: list[Publisher] = []
        self._slots: list[SampleBuffer] = []
        self._subscribers: list[tuple[SampleBuffer, Any]] = []
        self._pictures: zenoh.Session | None = None
        self.traffic = Traffic(session)
        self._last_status = 0.0
        self._last_state = ""
        self._refuse_a_second_one()
        self.clocks = ClockSync(
            session, self.keys, self.clock, name, profile.timing.max_clock_offset_s
        )
        own_clock = self.keys.clock(name)
        self.serve(own_clock, lambda query: offsets.reply_with_stamps(self.clock, own_clock, query))
        self._token = session.liveliness().declare_token(self.keys.alive(name))
        self._status = self.declare_publisher(self.keys.status(name), Kind.TELEMETRY)
        self._news = EventThrottle(
            self.declare_publisher(self.keys.event(name), Kind.TELEMETRY).publish
        )

    def _refuse_a_second_one(self) -> None:
        if alive_nodes(self.session, self.keys, self.name):
            raise NodeError(
                f"a node {self.name!r} of robot {self.profile.robot.name!r} is alive already; "
                "stop it first, or give this one another --name where the command has it"
            )

    # -- writing ------------------------------------------------------------------------------
    def declare_publisher(self, key: str, kind: Kind) -> Publisher:
        """A writer for `key`.

        Raises:
            SessionError: it is for pictures, and the router does not answer at their port.
        """
        made = Publisher(self._session_for(kind), key, kind, self.source, self.clock)
        self._streams.append(made)
        return made

    def undeclare(self, stream: Publisher) -> None:
        """Nothing is written there any more."""
        self._streams.remove(stream)
        stream.close()

    def _session_for(self, kind: Kind) -> zenoh.Session:
        """Pictures have a connection of their own where the profile says so."""
        if kind is not Kind.FRAME or not self.profile.session.separate_links:
            return self.session
        if self._pictures is None:
            self._pictures = open_session(
                self.profile.session, identity=self.name, images=True, wait_s=PICTURES_PATIENCE_S
            )
            self.traffic.add(self._pictures)
        return self._pictures

    def emit(self, event: Event) -> None:
        """Write an event; a flood of the same is thinned out and counted, see `EventThrottle`."""
        self._news.emit(event)

    def reject(self, reason: str, why: str, about: str = "") -> None:
        """Count a refusal by reason, and say why.

        Args:
            reason: short stable name.
            why: a sentence.
            about: what is refused; a flood of refusals of one thing does not silence another's.
        """
        self.counters[f"refused.{reason}"] += 1
        self._news.emit(Event("warning", "refusal", reason, why[:1000]), about)

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
        """Write status when it is time, when `state` changed, or `now`."""
        self._tick()
        clock = time.monotonic()
        if not now and state == self._last_state and clock - self._last_status < STATUS_PERIOD_S:
            return
        self._last_status, self._last_state = clock, state
        self._status.publish(
            NodeStatus(
                self.name,
                state,
                self.host_id.host,
                os.getpid(),
                self.started_wall_ns,
                ages_s or {},
                rates_hz or {},
                latency_ms or {},
                dict(self.counters),
                {**(detail or {}), "clocks": self._clocks_in_words(), "net": self._net()},
                self.host_id.boot,
            )
        )

    def _tick(self) -> None:
        self.clocks.tick()
        self._tell_of_refused()
        self._news.tick()

    def _net(self) -> dict[str, Any]:
        found = self.traffic.detail(self._streams)
        short = self.keys.short
        return {
            what: {short(key): value for key, value in said.items()}
            if isinstance(said, Mapping)
            else said
            for what, said in found.items()
        }

    def _clocks_in_words(self) -> dict[str, dict[str, float]]:
        return {
            node: {
                "offset_ms": round(found.offset_s * 1e3, 3),
                "uncertainty_ms": round(found.uncertainty_s * 1e3, 3),
                "round_trip_ms": round(found.round_trip_s * 1e3, 3),
            }
            for node, found in self.clocks.offsets().items()
        }

    def status_due(self, state: str) -> bool:
        """Whether `report` would write now: lets a fast loop skip collecting what to report."""
        self._tick()
        due = time.monotonic() - self._last_status >= STATUS_PERIOD_S
        return due or state != self._last_state

    # -- reading ------------------------------------------------------------------------------
    def subscribe(self, key: str, buffer: AnyBuffer, kind: Kind = Kind.STATE) -> AnyBuffer:
        """Let samples on `key` fall into `slot`; of `kind` it matters whether they are pictures.

        Those that it does not take are counted and told with the next report.

        Raises:
            SessionError: the router does not answer at the port of pictures.
        """
        session = self._session_for(kind)
        self.watch_buffer(buffer)
        if isinstance(buffer, ZenohRing):
            subscriber = session.declare_subscriber(key, buffer.channel())
            buffer.receive_from(subscriber.try_recv)
            self._subscribers.append((buffer, subscriber))
            return buffer
        handler = zenoh.handlers.Callback(buffer, indirect=False)
        self._subscribers.append((buffer, session.declare_subscriber(key, handler)))
        return buffer

    def unsubscribe(self, buffer: SampleBuffer) -> None:
        """Let no more samples fall into `slot`."""
        for found, subscriber in self._subscribers:
            if found is buffer:
                subscriber.undeclare()
        self._subscribers = [pair for pair in self._subscribers if pair[0] is not buffer]
        self._tell_of_refused()
        self._slots.remove(buffer)

    def watch_buffer(self, buffer: SampleBuffer) -> None:
        """Count and tell what `slot` does not take."""
        self._slots.append(buffer)

    def _tell_of_refused(self) -> None:
        for slot in self._slots:
            for found in slot.pop_rejected():
                key = self.keys.short(found.key)
                self.counters[f"refused.{found.reason}"] += found.times - 1
                self.reject(found.reason, f"{key}: {found.why}", key)

    def on_alive(self, callback: Callable[[str, bool], None]) -> None:
        """Call back with (node name, alive) now and at every change, on Zenoh's thread."""
        self.on_tokens(self.keys.all_alive, callback)

    def on_tokens(self, expression: str, callback: Callable[[str, bool], None]) -> None:
        """Likewise with the last part of the key of every liveliness token."""

        def change(sample: zenoh.Sample) -> None:
            callback(str(sample.key_expr).rsplit("/", 1)[-1], sample.kind == zenoh.SampleKind.PUT)

        handler = zenoh.handlers.Callback(change, indirect=False)
        self._declared.append(
            self.session.liveliness().declare_subscriber(expression, handler, history=True)
        )

    def serve(self, key: str, reply: Callable[[zenoh.Query], None]) -> None:
        """Answer `get` on `key`; `reply` runs on Zenoh's thread."""

        def handle(query: zenoh.Query) -> None:
            with query:
                reply(query)

        handler = zenoh.handlers.Callback(handle, indirect=False)
        self._declared.append(self.session.declare_queryable(key, handler, complete=True))

    def adopt_system_time(self) -> None:
        """Take over the system's wall clock; that it was set is counted and told."""
        step_s = self.clock.adopt_system_time()
        if step_s:
            self.reject("clock_step", f"the wall clock was set by {step_s:+.3f} s")

    def arrival_wall_ns(self, arrival: ReceivedSample) -> int:
        """Arrival time on this node's wall clock."""
        return self.clock.wall_ns() - (time.monotonic_ns() - arrival.mono_ns)

    def decode(
        self,
        kind: type[Record],
        arrival: ReceivedSample,
        writer_filter: SingleWriterFilter | None = None,
        header: Header | None = None,
    ) -> Stamped[Record] | None:
        """Decode a stream sample; a refusal is counted and told, and None is returned.

        Its stamps are put on this node's clock, see `vla_zenoh.bus.clock_sync`.

        Args:
            kind: the record.
            arrival: the sample.
            speaker: of its key: only he is heard, and each of his records once.
            header: of the sample, if it is decoded already.
        """
        sample = arrival.sample
        try:
            header = header or self.header(arrival)
            if writer_filter is not None:  # before the payload: who shouts nonsense costs least
                writer_filter.check(header, arrival.mono_ns)
            record = records.decode(kind, bytes_of(sample.payload))
            here, record = self.clocks.to_local_clock(header, record)
        except CodecError as error:
            key = self.keys.short(str(sample.key_expr))
            self.reject(error.reason, f"{key}: {error}", key)
            return None
        if writer_filter is not None:
            writer_filter.heard(header, arrival.mono_ns)
        self.traffic.received(str(sample.key_expr), header, arrival.nth)
        return Stamped(here, record, self.arrival_wall_ns(arrival))

    @staticmethod
    def header(arrival: ReceivedSample) -> Header:
        """What the sample's writer says of it.

        Raises:
            CodecError: it has no header that can be read.
        """
        return header_of(arrival.sample)

    def decode_text(
        self, decode: Callable[[bytes], Record], arrival: ReceivedSample
    ) -> Record | None:
        """Decode a plain setting likewise."""
        try:
            return decode(bytes_of(arrival.sample.payload))
        except CodecError as error:
            key = self.keys.short(str(arrival.sample.key_expr))
            self.reject(error.reason, f"{key}: {error}", key)
            return None

    def close(self) -> None:
        """Say goodbye: the liveliness token goes first, so that others notice at once."""
        self._token.undeclare()
        for declared in (*self._declared, *(subscriber for _, subscriber in self._subscribers)):
            declared.undeclare()
        self._declared.clear()
        self._subscribers.clear()
        if self._pictures is not None:
            self._pictures.close()
            self._pictures = None
