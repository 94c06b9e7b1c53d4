"""Malformed, foreign and replayed samples for every key of the table."""

from __future__ import annotations

import itertools
import random
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import zenoh
from chain import Chain

from vla_zenoh.codec import message, records
from vla_zenoh.keys import KEY_PATHS, SCHEMA, Keys
from vla_zenoh.types import (
    Event,
    GripperCommand,
    Header,
    JointCommand,
    PrivilegedState,
    Task,
)

HUGE = bytes(2_000_000)
STRANGER = "stranger#00000000"
STREAMS = (
    "state_joint",
    "state_pose",
    "state_gripper",
    "state_privileged",
    "task",
    "delta",
    "spec",
    "command_pose",
    "command_joint",
    "command_gripper",
    "status",
    "event",
    "sim_scene",
    "sim_objects",
)
SETTINGS = ("prompt", "active", "worker", "rate", "speed", "slower", "held", "reset", "sim_reset")
OTHERS = (
    "camera_raw",
    "camera_jpeg",
    "camera_fitted",
    "camera_depth",
    "seen",
    "seen_depth",
    "seen_record",
    "alive",
    "holding",
    "clock",
    "sim_step",
    "primitive",
    "save",
)
OBEYED = ("stop",)
"""Whatever is put there stops the arm; it is tried at the end."""
SELDOM = {
    "command_gripper": GripperCommand(0.0, 0.1, 10.0),
    "command_joint": JointCommand(("a", "b"), np.ones(2), np.zeros(2), np.zeros(2), "active"),
    "event": Event("info", "notice", "nothing", "happened"),
    "state_privileged": PrivilegedState({"expert": np.ones(39)}),
    "task": Task(1 << 60, True, "HARD: yaw left", "scripted", 100.0),
}
"""Not written all the time: true but for their writer."""
NAMES = {
    "camera": "front",
    "form": "224x224-pad",
    "worker": "scripted",
    "node": "command",
    "holder": "anna",
    "primitive": "home",
}


class Junk(NamedTuple):
    """A put: on which key, what."""

    kind: str
    key: str
    payload: bytes
    attachment: bytes | None


def all_keys(keys: Keys) -> dict[str, str]:
    """Every key of the table by its name there, with names of parts that exist."""
    out: dict[str, str] = {}
    for name, path in KEY_PATHS.items():
        member = getattr(keys, name)
        out[name] = (
            member(*(NAMES[part] for part in path.parameters)) if path.parameters else member
        )
    return out


def samples_of(
    chain: Chain, seconds: float = 1.2, *wanted: str
) -> dict[str, tuple[bytes, bytes | None]]:
    """The newest true sample on each stream, to make false ones of.

    Waits for those `wanted`, by default for all that are written all the time.
    """
    found: dict[str, tuple[bytes, bytes | None]] = {}

    def keep(sample: zenoh.Sample) -> None:
        attachment = sample.attachment
        found[str(sample.key_expr)] = (
            sample.payload.to_bytes(),
            attachment.to_bytes() if attachment is not None else None,
        )

    subscriber = chain.session.declare_subscriber(
        chain.profile.keys.all_keys, zenoh.handlers.Callback(keep, indirect=False)
    )
    time.sleep(seconds)
    keys = all_keys(chain.profile.keys)
    wanted = wanted or tuple(keys[name] for name in STREAMS if name not in SELDOM)
    chain.until(f"samples on {wanted}", lambda: found.keys() >= set(wanted))
    subscriber.undeclare()
    for name, record in SELDOM.items():
        header = records.encode_header(Header(time.time_ns(), 0, STRANGER))
        found.setdefault(keys[name], (records.encode(record), header))
    return found


def spoil(value: Any, make: Callable[[Any], Any]) -> Any:
    """`value` with every number in it replaced by what `make` gives."""
    if isinstance(value, dict):
        return {key: spoil(item, make) for key, item in value.items()}
    if isinstance(value, list):
        return [spoil(item, make) for item in value]
    if isinstance(value, bool) or value is None or isinstance(value, (str, bytes)):
        return value
    return make(value)


def junk_for_stream(key: str, payload: bytes, attachment: bytes, seq: int) -> Iterator[Junk]:
    true = records.decode_header(attachment)
    stranger = records.encode_header(Header(time.time_ns(), seq, STRANGER))
    old = records.encode_header(Header(time.time_ns() - 3_600_000_000_000, seq, STRANGER))
    forged = records.encode_header(true)
    fields = message.unpack(payload)
    yield Junk("noise", key, random.randbytes(200), forged)
    yield Junk("truncated", key, payload[: len(payload) // 2], forged)
    yield Junk("foreign", key, payload, stranger)
    yield Junk("old stamp", key, payload, old)
    yield Junk("replayed", key, payload, attachment)
    yield Junk("no header", key, payload, None)
    yield Junk("noise for a header", key, payload, random.randbytes(40))
    schema = message.unpack(attachment) | {"schema": SCHEMA + 1}
    yield Junk("schema", key, payload, message.pack(schema))
    for what, make in (
        ("nan", lambda value: np.nan),
        ("1e9", lambda value: 1e9),
        ("wrong shape", lambda value: [value]),
    ):
        yield Junk(what, key, message.pack(spoil(fields, make)), forged)
        yield Junk(f"foreign {what}", key, message.pack(spoil(fields, make)), stranger)
    if "spec_hash" in fields:
        yield Junk("spec hash", key, message.pack(fields | {"spec_hash": "0" * 16}), stranger)
    yield Junk("huge", key, HUGE, forged)
    yield Junk("empty", key, b"", forged)


def junk_for_setting(name: str, key: str) -> Iterator[Junk]:
    # What can be read is obeyed, by whomever it was put: these cannot.
    yield Junk("noise", key, b"\xff\xfe" + random.randbytes(50), None)
    yield Junk("control characters", key, b"\x00\x9b\x1b[2J", None)
    yield Junk("huge", key, HUGE, None)
    if name != "prompt":
        yield Junk("nan", key, b"nan/nan", None)
        yield Junk("1e9", key, b"-1e9 x", None)
        yield Junk("empty", key, b"", None)


def junk_for_other(key: str, sample: tuple[bytes, bytes | None] | None) -> Iterator[Junk]:
    header = records.encode_header(Header(time.time_ns(), 1, STRANGER))
    yield Junk("noise", key, random.randbytes(200), header)
    yield Junk("huge", key, HUGE, header)
    yield Junk("empty", key, b"", header)
    yield Junk("no header", key, random.randbytes(57_600), None)
    if sample is not None:
        yield Junk("replayed", key, *sample)
        yield Junk("foreign", key, sample[0], header)


def all_junk(chain: Chain, samples: dict[str, tuple[bytes, bytes | None]]) -> Iterator[Junk]:
    """Without end, over all keys again and again."""
    keys = all_keys(chain.profile.keys)
    for seq in itertools.count():
        for name in STREAMS:
            payload, attachment = samples[keys[name]]
            assert attachment is not None
            yield from junk_for_stream(keys[name], payload, attachment, seq)
        for name in SETTINGS:
            yield from junk_for_setting(name, keys[name])
        for name in OTHERS:
            yield from junk_for_other(keys[name], samples.get(keys[name]))
