"""What every client of the wire does, with the packages eclipse-zenoh and msgpack alone.

Written by docs/reference/wire.md; no part of vla-zenoh is imported.
"""

import json
import math
import secrets
import time
from collections import Counter

import msgpack
import zenoh

SCHEMA = 2
OLDEST_NS = 1_000_000_000
MSGPACK = zenoh.Encoding("application/msgpack")
IMAGES = {"congestion_control": zenoh.CongestionControl.DROP, "priority": zenoh.Priority.DATA_LOW}
STATE = {
    "congestion_control": zenoh.CongestionControl.DROP,
    "priority": zenoh.Priority.INTERACTIVE_HIGH,
}
MUST_ARRIVE = {
    "congestion_control": zenoh.CongestionControl.BLOCK,
    "priority": zenoh.Priority.REAL_TIME,
    "express": True,
}
NEWS = {"congestion_control": zenoh.CongestionControl.DROP, "priority": zenoh.Priority.DATA}


class Rejected(Exception):
    """A sample that is not used; `reason` is the name of its counter."""

    def __init__(self, reason: str, why: str) -> None:
        super().__init__(why)
        self.reason = reason


def open_session(endpoint: str) -> zenoh.Session:
    """A client of the router at `endpoint`."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    return zenoh.open(config)


class Node:
    """A node of a robot: liveliness token, clock, status, and samples with headers.

    Args:
        robot: the beginning of all keys, such as ``vla/panda``.
        name: of the node; no other one may have it.
    """

    def __init__(self, session: zenoh.Session, robot: str, name: str) -> None:
        self.session, self.robot, self.name = session, robot, name
        self.source = f"{name}#{secrets.token_hex(4)}"
        self.rejected: Counter[str] = Counter()
        self._next_seq: Counter[str] = Counter()
        self._started_ns, self._status_s = time.time_ns(), 0.0
        self._clock = session.declare_queryable(f"{robot}/clock/{name}", self._tell_time)
        self._token = session.liveliness().declare_token(f"{robot}/alive/{name}")

    def _tell_time(self, query: zenoh.Query) -> None:
        heard_ns = time.time_ns()
        with query:
            said = msgpack.packb({"heard_ns": heard_ns, "said_ns": time.time_ns()})
            query.reply(query.key_expr, said)

    def publish(self, key: str, record: dict, quality: dict, stamp_ns: int = 0) -> None:
        """Put a record with its header."""
        self.put(key, zenoh.ZBytes(msgpack.packb(record)), MSGPACK, quality, stamp_ns)

    def put(
        self,
        key: str,
        payload: zenoh.ZBytes | bytes,
        encoding: zenoh.Encoding,
        quality: dict,
        stamp_ns: int = 0,
    ) -> None:
        """Put bytes with their header."""
        header = {
            "schema": SCHEMA,
            "stamp_wall_ns": stamp_ns or time.time_ns(),
            "seq": self._next_seq[key],
            "source": self.source,
        }
        self._next_seq[key] += 1
        self.session.put(
            f"{self.robot}/{key}",
            payload,
            attachment=msgpack.packb(header),
            encoding=encoding,
            **quality,
        )

    def publish_status(self, state: str, detail: dict | None = None) -> None:
        """Put the status, twice a second at most."""
        if time.monotonic() - self._status_s < 0.5:
            return
        self._status_s = time.monotonic()
        status = {
            "node": self.name,
            "state": state,
            "host": "",
            "pid": 0,
            "started_wall_ns": self._started_ns,
            "counters": {f"refused.{reason}": n for reason, n in self.rejected.items()},
            "detail": detail or {},
        }
        self.publish(f"status/{self.name}", status, NEWS)


def read(sample: zenoh.Sample) -> tuple[dict, dict]:
    """Header and record of a sample; raises `Rejected`."""
    if sample.kind != zenoh.SampleKind.PUT:
        raise Rejected("deleted", "only puts count")
    if sample.attachment is None:
        raise Rejected("no_header", "no attachment")
    header, record = unpack(sample.attachment), unpack(sample.payload)
    if header.get("schema") != SCHEMA:
        raise Rejected("schema", f"version {header.get('schema')}, this program has {SCHEMA}")
    stamp_ns, seq, source = (header.get(name) for name in ("stamp_wall_ns", "seq", "source"))
    if type(stamp_ns) is not int or type(seq) is not int or type(source) is not str:
        raise Rejected("invalid", "a header has stamp_wall_ns, seq and source")
    return header, record


def unpack(payload: zenoh.ZBytes) -> dict:
    """The map in some bytes."""
    try:
        found = msgpack.unpackb(payload.to_bytes())
    except ValueError as error:
        raise Rejected("malformed", str(error)) from error
    if not isinstance(found, dict):
        raise Rejected("malformed", "not a map")
    return found


def number(value: object, name: str) -> float:
    """A finite number: a bool is none, nor are NaN and the infinities."""
    if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    raise Rejected("invalid", f"{name} is {value!r}")


def numbers(record: dict, name: str, count: int) -> list[float]:
    """The `count` finite numbers of a field."""
    found = record.get(name)
    if not isinstance(found, list) or len(found) != count:
        raise Rejected("invalid", f"{name} is not a list of {count}")
    return [number(value, name) for value in found]


class OneWriter:
    """Lets the samples of one source through, each once and in order."""

    def __init__(self) -> None:
        self.source = ""
        self._last_seq: dict[str, int] = {}

    def check(self, header: dict) -> None:
        """Raise `Rejected` for a sample that is not the writer's next."""
        if self.source and header["source"] != self.source:
            raise Rejected("foreign", f"{self.source} is writing")
        if header["seq"] <= self._last_seq.get(header["source"], -1):
            raise Rejected("replayed", f"sample {header['seq']} was there before")
        age_ns = time.time_ns() - header["stamp_wall_ns"]
        if age_ns > OLDEST_NS:
            raise Rejected("stale", f"it is {age_ns / 1e9:.1f} s old")

    def accept(self, header: dict) -> None:
        """Note that the sample is used."""
        self.source = header["source"]
        self._last_seq = {self.source: header["seq"]}

    def release(self) -> None:
        """The writer fell silent: another one may begin, and the old samples are still old."""
        self.source = ""
