"""Records a peer on the bus, and sends a robot the commands of the trials."""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import zenoh

from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh.bus.node import MSGPACK
from vla_zenoh.bus.session import QOS, alive_nodes, put_text
from vla_zenoh.codec import message, records
from vla_zenoh.codec.image import MAX_IMAGE_BYTES
from vla_zenoh.codec.records import MAX_HEADER_BYTES
from vla_zenoh.errors import CodecError, NodeError
from vla_zenoh.keys import Keys, Kind
from vla_zenoh.policy import ModelSpec
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
    ClockReply,
    GripperState,
    Header,
    JointBound,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
)
from vla_zenoh_conform import rules
from vla_zenoh_conform.rules import Seen, Trial
from vla_zenoh_conform.samples import Raw, arrived

Record = TypeVar("Record")
ASKS, REPLY_S = 3, 1.0
MAX_SAMPLES = 200_000
PERIOD_S, BEFORE_S, AFTER_S, REST_S = 0.01, 0.3, 1.0, 0.7
WAY_M = 0.03
WAY = JointBound(0.1, WAY_M)
WRONG_SHARE = 0.3
"""Of that way, where commands must be rejected: a robot that does not reject them follows."""
OLD_NS = 2_000_000_000
RESET_S = 0.5


class Listener:
    """Keeps the samples of some keys as they arrive."""

    def __init__(self, session: zenoh.Session, keys: Keys, wanted: Sequence[str]) -> None:
        self._keys = keys
        self.raw: list[Raw] = []
        self._subscribers = [
            session.declare_subscriber(keys.full(key), zenoh.handlers.Callback(self._keep))
            for key in wanted
        ]

    def _keep(self, sample: zenoh.Sample) -> None:
        if len(self.raw) == MAX_SAMPLES or sample.kind != zenoh.SampleKind.PUT:
            return
        try:
            payload = bytes_of(sample.payload, MAX_IMAGE_BYTES)
            header = bytes_of(sample.attachment, MAX_HEADER_BYTES)
        except CodecError:  # neither can be decoded then
            payload = header = b""
        self.raw.append(
            Raw(
                self._keys.short(str(sample.key_expr)),
                payload,
                header or None,
                str(sample.encoding),
                time.time_ns(),
            )
        )

    def close(self) -> None:
        """Stop."""
        for subscriber in self._subscribers:
            subscriber.undeclare()


@contextmanager
def recording(session: zenoh.Session, keys: Keys, wanted: Sequence[str]) -> Iterator[Listener]:
    """A `Listener` while the block lasts."""
    found = Listener(session, keys, wanted)
    try:
        yield found
    finally:
        found.close()


def look(
    session: zenoh.Session, keys: Keys, node: str, wanted: Sequence[str], seconds: float
) -> Seen:
    """Listen to a peer for some seconds, and ask it what it answers."""
    with recording(session, keys, [*wanted, keys.status(node)]) as kept:
        began_s = time.monotonic()
        alive = node in alive_nodes(session, keys, node)
        clocks = [found for _ in range(ASKS) if (found := _clock(session, keys.clock(node)))]
        spec = _reply(session, keys.spec(node.removeprefix("worker-")), ModelSpec)
        time.sleep(max(seconds - (time.monotonic() - began_s), 0.0))
        took_s = time.monotonic() - began_s
    return Seen(node, [arrived(raw) for raw in kept.raw], took_s, alive, clocks, spec)


def _reply(session: zenoh.Session, key: str, kind: type[Record]) -> Record | None:
    """The first valid reply to a query."""
    for reply in session.get(key, timeout=REPLY_S):
        if reply.ok is not None:
            with suppress(CodecError):
                return records.decode(kind, bytes_of(reply.ok.payload))
    return None


def _clock(session: zenoh.Session, key: str) -> tuple[int, ClockReply, int] | None:
    asked_ns = time.time_ns()
    reply = _reply(session, key, ClockReply)
    return None if reply is None else (asked_ns, reply, time.time_ns())


class Mover:
    """Sends the commands of the trials, of one joint or of the TCP's height.

    Raises:
        NodeError: a command node is alive, or the lab has certificates.
    """

    def __init__(self, session: zenoh.Session, profile: Profile) -> None:
        keys = profile.keys
        if profile.session.security is not None:
            raise NodeError(
                "in a lab with certificates only the command node may command a robot: try it "
                "with --move on a router without"
            )
        if "command" in alive_nodes(session, keys, "command"):
            raise NodeError(
                "the command node of this robot is running, and a robot follows one writer: stop "
                "it, and leave the robot's node and the router"
            )
        self._session, self._keys, self._profile = session, keys, profile
        self._joint = profile.robot.command == "joint"
        self._source, self._other = (
            f"{name}#{secrets.token_hex(4)}" for name in ("conform", "other")
        )
        self._seq = 0
        self._gone = 0.0
        self._base: Any = None

    def run(self) -> Iterator[Trial]:
        """One trial after the other; the arm moves by 0.1 rad, or 3 cm, there and back."""
        for what in rules.TRIALS:
            if what == rules.AFTER_RESET:
                put_text(self._session, self._keys.reset, "")
                time.sleep(RESET_S)
            yield self._trial(what)
            time.sleep(REST_S)

    def _trial(self, what: str) -> Trial:
        share = WRONG_SHARE if what in rules.WRONG else 1.0
        with recording(self._session, self._keys, rules.ROBOT_KEYS) as kept:
            time.sleep(BEFORE_S)
            self._base = self._state(kept)
            if self._base is None:
                return Trial(what, share)
            way = WAY.of(self._base.slides)[-1] if self._joint else WAY_M
            asked = share * float(way)
            signed = -asked if self._gone > 0 else asked
            began_ns = time.time_ns()
            event_s = self._send(what, signed)
            time.sleep(AFTER_S)
        track = self._track(kept.raw, began_ns)
        if track:
            self._gone += track[-1][1]
        patience_s = self._profile.timing.command_timeout_s
        return Trial(what, asked, track, event_s, patience_s if what == rules.SILENT else PERIOD_S)

    def _state(self, kept: Listener) -> Any:
        kind = JointState if self._joint else PoseState
        for raw in reversed(kept.raw):
            record = arrived(raw).record
            if isinstance(record, kind):
                return record
        return None

    def _send(self, what: str, asked: float) -> float:
        """Put the commands of a trial; when its event was, in s."""
        began_s = time.monotonic()
        middle_s = event_s = rules.DURATION_S / 2
        stopped = False
        while (now_s := time.monotonic() - began_s) < rules.DURATION_S:
            if what == rules.SILENT and now_s > middle_s:
                return now_s
            if what == rules.STOP and now_s > middle_s and not stopped:
                put_text(self._session, self._keys.stop, "vla-zenoh conform")
                stopped, event_s = True, now_s
            self._put(what, asked, now_s)
            time.sleep(PERIOD_S)
        return event_s

    def _put(self, what: str, asked: float, now_s: float) -> None:
        payload = self._command(asked, now_s)
        if what in (rules.NAN, rules.REPLAYED) and now_s < BEFORE_S:
            self._publish(self._command(0.0, 0.0))
        elif what == rules.NAN:
            self._publish(_with_nan(payload))
        elif what == rules.REPLAYED:
            self._publish(payload, seq=self._seq - 1)
        elif what == rules.FOREIGN:
            self._publish(self._command(0.0, 0.0))
            self._publish(payload, source=self._other)
        elif what == rules.STALE:
            self._publish(payload, late_ns=OLD_NS)
        else:
            self._publish(payload)

    def _command(self, asked: float, now_s: float) -> bytes:
        """The command at a time of the motion, from where the arm was."""
        step_s = 1e-3
        before, here, after = (
            asked * rules.way_at(now_s + offset) for offset in (-step_s, 0.0, step_s)
        )
        rate, change = (after - before) / (2 * step_s), (after - 2 * here + before) / step_s**2
        base = self._base
        if isinstance(base, JointState):
            axis = np.zeros(len(base.names))
            axis[-1] = 1.0
            held = base.position_rad if base.reference_rad is None else base.reference_rad
            moved = (held + here * axis, rate * axis, change * axis)
            return records.encode(JointCommand(base.names, *moved, "active"))
        axis = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        held_m, quat = base.reference_position_m, base.reference_quat_xyzw
        if held_m is None:
            held_m, quat = base.position_m, base.quat_xyzw
        place = held_m + here * axis[:3]
        return records.encode(
            PoseCommand(place, quat, rate * axis, change * axis, place, quat, "active")
        )

    def _publish(
        self, payload: bytes, *, source: str = "", seq: int | None = None, late_ns: int = 0
    ) -> None:
        header = Header(time.time_ns() - late_ns, self._seq, source or self._source)
        if seq is None:
            self._seq += 1
        else:
            header = replace(header, seq=seq)
        key = self._keys.command_joint if self._joint else self._keys.command_pose
        attachment = records.encode_header(header)
        self._session.put(
            key, payload, attachment=attachment, encoding=MSGPACK, **QOS[Kind.CONTROL]
        )

    def _track(self, raws: Sequence[Raw], began_ns: int) -> list[tuple[float, float, str]]:
        mode, track = "", []
        for raw in raws:
            found = arrived(raw).record
            if isinstance(found, GripperState):
                mode = found.mode
            elif isinstance(found, type(self._base)) and raw.received_ns >= began_ns:
                way = self._place(found) - self._place(self._base)
                track.append(((raw.received_ns - began_ns) / 1e9, way, mode))
        return track

    def _place(self, state: Any) -> float:
        return float(state.position_rad[-1] if self._joint else state.position_m[2])


def _with_nan(payload: bytes) -> bytes:
    fields = message.unpack(payload)
    name = "velocity_rad_s" if "velocity_rad_s" in fields else "twist"
    return message.pack({**fields, name: [float("nan")] * len(fields[name])})
