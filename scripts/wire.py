"""Writes wire/wire.json, test vectors of the wire for clients in any language, and
wire/records.schema.json, a JSON Schema of every record.

python scripts/wire.py            # write
python scripts/wire.py --check    # exit status 1 where a file differs from the code
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgpack
import msgspec
import numpy as np

from vla_zenoh import types
from vla_zenoh.codec import message, records, settings
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import SCHEMA
from vla_zenoh.policy import ActionSpec, ModelSpec
from vla_zenoh.types.form import form_of

WIRE = Path(__file__).resolve().parents[1] / "wire"
AT_NS = 1_700_000_000_000_000_000
NAN, INFINITE = float("nan"), float("inf")
DOWN = (1.0, 0.0, 0.0, 0.0)
CAUSE = types.Cause("pi0", 7, AT_NS, AT_NS + 1, AT_NS + 2, AT_NS + 3, AT_NS + 4, AT_NS + 5)
NEGATIVE = {**asdict(CAUSE), "chunk_seq": -1}
NAMES = ("joint1", "joint2")

VALID: tuple[Any, ...] = (
    types.JointState(NAMES, np.array([0.1, -0.2]), np.zeros(2), np.array([1.5, 0.0])),
    types.JointState(NAMES, np.zeros(2), np.zeros(2), None, np.array([0.1, -0.2])),
    types.PoseState(np.array([0.4, 0.0, 0.3]), np.array(DOWN), np.zeros(6)),
    types.PoseState(
        np.array([0.4, 0.0, 0.3]),
        np.array(DOWN),
        np.zeros(6),
        np.array([0.0, 0.0, 5.0, 0.0, 0.0, 0.0]),
        np.array([0.4, 0.0, 0.31]),
        np.array(DOWN),
    ),
    types.GripperState(0.04, moving=False, holding=True),
    types.GripperState(0.0, moving=True, holding=False, mode="reflex", faults=("over current",)),
    types.PrivilegedState({"expert": np.array([0.5, -1.0])}),
    types.SceneState("table", np.array([0.0, 1.0]), 3),
    types.ObjectPoses(("brick",), np.array([[0.4, 0.1, 0.02]]), np.array([[0.0, 0.0, 0.0, 1.0]])),
    types.ActionChunk(
        *("pi0", "0123456789abcdef", 2, AT_NS, 41, AT_NS + 10**9),
        np.array([[0.01, 0.0, 0.0, 1.0], [0.02, 0.0, 0.0, 1.0]], np.float32),
        *(AT_NS + 1, AT_NS + 2, AT_NS + 3),
    ),
    types.InferenceDebug(
        *("pi0", 7, "0123456789abcdef", 2, AT_NS, "put the brick away"),
        np.zeros((1, 4), np.float32),
        85.5,
        {"tokens": [1, 2], "note": None},
    ),
    CAUSE,
    types.PoseCommand(
        *(np.array([0.4, 0.0, 0.3]), np.array(DOWN), np.zeros(6), np.zeros(6)),
        *(np.array([0.5, 0.0, 0.3]), np.array(DOWN), "active", CAUSE),
    ),
    types.JointCommand(NAMES, np.array([0.1, -0.2]), np.zeros(2), np.zeros(2), "holding"),
    types.GripperCommand(0.04, 0.1, 20.0),
    types.Task(2, True, "put the brick away", "pi0", 5.0),
    types.Task(3, False, "", "pi0", 5.0, 30.0),
    types.NodeStatus(
        *("command", "active", "lab-pc", 4711, AT_NS),
        {"state/pose": 0.004},
        {"command/pose": 250.0},
        {"inference": (80.0, 95.5)},
        {"refused.stale": 2},
        {"why": "ready", "clocks": {"sim": None}},
    ),
    types.Event("warning", "refusal", "stale_chunk", "it is 2.1 s old", 2.1, 1.0, 3),
    types.ClockReply(AT_NS, AT_NS + 1000),
    ModelSpec(name="pi0", action=ActionSpec(horizon=10, dt_s=0.1)),
)

INVALID: tuple[tuple[type, str, dict[str, Any]], ...] = (
    (types.JointState, "a joint twice", {"names": ["a", "a"]}),
    (types.JointState, "a velocity is missing", {"velocity_rad_s": [0.0]}),
    (types.JointState, "NaN", {"position_rad": [0.0, NAN]}),
    (types.PoseState, "infinity", {"twist": [0.0, 0.0, INFINITE, 0.0, 0.0, 0.0]}),
    (types.PoseState, "two of three numbers", {"position_m": [0.4, 0.0]}),
    (types.PoseState, "text for a number", {"position_m": ["0.4", "0.0", "0.3"]}),
    (types.PoseState, "true for a number", {"position_m": [True, 0.0, 0.3]}),
    (types.PoseState, "more than 1e6", {"position_m": [2e6, 0.0, 0.3]}),
    (types.PoseState, "a quaternion that is not unit", {"quat_xyzw": [0.0, 0.0, 0.0, 0.9]}),
    (types.PoseState, "half a reference", {"reference_position_m": [0.4, 0.0, 0.3]}),
    (types.GripperState, "millimetres", {"width_m": 40.0}),
    (types.GripperState, "1 for true", {"moving": 1}),
    (types.PrivilegedState, "NaN", {"values": {"expert": [NAN]}}),
    (types.SceneState, "a negative seed", {"seed": -1}),
    (types.ObjectPoses, "a name without a pose", {"names": ["brick", "bin"]}),
    (types.ActionChunk, "NaN", {"steps": [[0.01, 0.0, 0.0, NAN]]}),
    (types.ActionChunk, "rows of several lengths", {"steps": [[0.01, 0.0], [0.02]]}),
    (types.ActionChunk, "no steps", {"steps": []}),
    (types.ActionChunk, "one row instead of a list of rows", {"steps": [0.01, 0.0]}),
    (types.ActionChunk, "a negative time", {"valid_until_ns": -1}),
    (types.ActionChunk, "seconds in place of nanoseconds", {"observed_ns": 1.7e9}),
    (types.InferenceDebug, "a negative duration", {"inference_ms": -1.0}),
    (types.Cause, "a text for a number", {"chunk_seq": "7"}),
    (types.PoseCommand, "a cause that is none", {"cause": 5}),
    (
        types.PoseCommand,
        "a cause with a negative number",
        {"cause": {**asdict(CAUSE), "chunk_seq": -1}},
    ),
    (types.JointCommand, "no joints", {"names": []}),
    (types.JointCommand, "a state of 33 characters", {"state": "x" * 33}),
    (types.GripperCommand, "no speed", {"speed_m_s": 0.0}),
    (types.GripperCommand, "opens further than 1 m", {"width_m": 1.5}),
    (types.Task, "more than 100 percent", {"speed_percent": 130.0}),
    (types.Task, "no rate", {"rate_hz": 0.0}),
    (types.Task, "bytes for text", {"prompt": b"go"}),
    (types.NodeStatus, "an age that is NaN", {"ages_s": {"state/pose": NAN}}),
    (types.NodeStatus, "a detail nested too deep", {"detail": {"a": [[[[1]]]]}}),
    (types.Event, "an unknown level", {"level": "loud"}),
    (types.Event, "an unknown kind", {"kind": "x"}),
    (types.Event, "none of them", {"count": 0}),
    (types.ClockReply, "a negative time", {"heard_ns": -5}),
    (ModelSpec, "an unknown field", {"colour": "red"}),
)

HEADERS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("a header", {}),
    ("a field of a later version", {"later": [1, 2]}),
    ("an older version", {"schema": SCHEMA - 1}),
    ("a newer version", {"schema": SCHEMA + 1}),
    ("a version that is no number", {"schema": "2"}),
    ("a negative number", {"seq": -1}),
    ("a source of 129 characters", {"source": "x" * 129}),
)

SETTINGS: tuple[tuple[str, Callable[[bytes], Any], tuple[bytes, ...]], ...] = (
    ("active", settings.decode_activation, (b"true", b"off", b"true while anna", b"maybe")),
    ("prompt", settings.decode_text, (b" put the brick away\n", b"\xff", b"\x1b[2J")),
    ("worker", settings.decode_name, (b"pi0", b"a/b")),
    ("rate", settings.decode_rate, (b"5", b"1e3", b"fast")),
    ("speed", settings.decode_percent, (b"30 %", b"130", b"")),
    ("held", settings.decode_held, (b"0.04 0.04 0.12 at 0 0 0.02", b"", b"4 4 12")),
    ("sim/reset", settings.decode_seed, (b"", b"17", b"-1")),
)


def vectors() -> Iterator[dict[str, Any]]:
    """Every vector: what it is, its bytes, and the value or the reason of its rejection."""
    for record in VALID:
        payload = records.encode(record)
        found = _vector("record", type(record).__name__, "valid", payload, message.unpack, payload)
        yield found | ({"spec_hash": record.hash} if isinstance(record, ModelSpec) else {})
    firsts = {type(record): message.unpack(records.encode(record)) for record in reversed(VALID)}
    later = firsts[types.Task] | {"later": 1}
    task = _known(types.Task)
    yield _vector("record", "Task", "a field of a later version", message.pack(later), task)
    singles = msgpack.packb(firsts[types.ActionChunk], use_single_float=True)
    chunk = _known(types.ActionChunk)
    yield _vector("record", "ActionChunk", "numbers of 32 bits", singles, chunk)
    whole = message.pack(firsts[types.PoseState] | {"position_m": [1, 0, 0]})
    yield _vector("record", "PoseState", "whole numbers", whole, _known(types.PoseState))
    for kind, about, changes in INVALID:
        yield _vector(
            "record", kind.__name__, about, message.pack(firsts[kind] | changes), _known(kind)
        )
    for about, payload in (("not a map", b"\x93\x01\x02\x03"), ("cut off", b"\x86\xa7episode")):
        yield _vector("record", "Task", about, payload, task)
    yield _vector("record", "Task", "no fields", message.pack({}), task)
    head = {"schema": SCHEMA, **asdict(types.Header(AT_NS, 41, "sim#5f3a"))}
    for about, changes in HEADERS:
        read = lambda payload: asdict(records.decode_header(payload))  # noqa: E731
        yield _vector("header", "Header", about, message.pack(head | changes), read)
    yield _vector(
        "header", "Header", "no seq", message.pack({"schema": SCHEMA}), records.decode_header
    )
    for key, decode, payloads in SETTINGS:
        for payload in payloads:
            yield _vector("setting", key, repr(payload)[1:], payload, decode)


def _known(kind: type) -> Callable[[bytes], Any]:
    return lambda payload: message.unpack(records.encode(records.decode(kind, payload)))


def _vector(
    what: str, kind: str, about: str, payload: bytes, read: Callable[..., Any], *arguments: Any
) -> dict[str, Any]:
    head = {"what": what, "kind": kind, "about": about, "bytes": payload.hex()}
    try:
        value = read(*(arguments or (payload,)))
    except CodecError as error:
        return {**head, "valid": False, "reason": error.reason, "why": str(error)}
    return {**head, "valid": True, "value": value}


def wire() -> str:
    """Text of wire.json."""
    found = {"schema": SCHEMA, "vectors": list(vectors())}
    return json.dumps(found, indent=1, ensure_ascii=True) + "\n"


def schema() -> str:
    """Text of records.schema.json."""
    kinds = [type(record) for record in VALID if type(record) is not ModelSpec]
    structs = [form_of(kind).struct for kind in dict.fromkeys((types.Header, *kinds))]
    _, found = msgspec.json.schema_components(structs, ref_template="#/$defs/{name}")
    header = found["Header"]  # the version of the wire is no field of the program's
    header["properties"] = {"schema": {"const": SCHEMA}, **header["properties"]}
    header["required"] = ["schema", *header["required"]]
    spec = ModelSpec.model_json_schema(ref_template="#/$defs/{model}")
    found |= {**spec.pop("$defs"), "ModelSpec": spec}
    whole = {"$schema": "https://json-schema.org/draft/2020-12/schema", "$defs": found}
    return json.dumps(whole, indent=1) + "\n"


def main() -> None:
    """Write the files, or compare them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    options = parser.parse_args()
    for name, text in (("wire.json", wire()), ("records.schema.json", schema())):
        path = WIRE / name
        if not options.check:
            path.write_text(text, "utf-8")
        elif not path.is_file() or path.read_text("utf-8") != text:
            sys.exit(f"wire/{name} differs from the code: run python scripts/wire.py")


if __name__ == "__main__":
    main()
