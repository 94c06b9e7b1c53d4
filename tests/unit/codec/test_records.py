"""Every record comes back as it was; whatever else arrives is refused with CodecError alone."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from random_records import ALL_RECORDS as RECORDS
from random_records import headers, refusal, same

from vla_zenoh import types
from vla_zenoh.codec import message, records
from vla_zenoh.errors import CodecError, RecordError
from vla_zenoh.keys import SCHEMA
from vla_zenoh.policy import ModelSpec
from vla_zenoh.types import (
    Cause,
    Event,
    GripperState,
    Header,
    JointCommand,
    JointState,
    NodeStatus,
    ObjectPoses,
    PoseCommand,
    PoseState,
    Task,
)
from vla_zenoh.types.form import Count, Record, bound_text

# A record drawn at random normalises its quaternion once more when it is read: one bit may differ.
QUATERNION_TOLERANCE = 1e-15
DECODES = 10
MAX_SENTENCE = 8000  # characters of an error message
KINDS = sorted(RECORDS, key=lambda kind: kind.__name__)
NOTHING_TAKEN = settings(max_examples=12, suppress_health_check=[HealthCheck.too_slow])

by_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)


def decoded_or_refused(kind: type, payload: bytes) -> bool:
    error = refusal(records.decode, kind, payload)
    return error is None or (
        error.reason in {"malformed", "invalid", "oversize"} and 0 < len(str(error)) < MAX_SENTENCE
    )


def near(one: Any, other: Any) -> bool:
    for name in one.__dataclass_fields__:
        a, b = getattr(one, name), getattr(other, name)
        if "quat" in name and a is not None:
            if not np.allclose(a, b, rtol=0, atol=QUATERNION_TOLERANCE):
                return False
        elif not same(a, b):
            return False
    return True


def as_map(record: Any) -> Any:
    if isinstance(record, ModelSpec):
        return record.to_dict()
    if dataclasses.is_dataclass(record):
        names = [field.name for field in dataclasses.fields(record)]
        return {name: as_map(getattr(record, name)) for name in names}
    if isinstance(record, np.ndarray):
        return record.tolist()
    if isinstance(record, Mapping):
        return {name: as_map(value) for name, value in record.items()}
    return list(record) if isinstance(record, tuple) else record


def test_every_kind_of_record_is_tested_here() -> None:
    kinds = {
        kind
        for module in (types.records, types.stream)
        for kind in vars(module).values()
        if dataclasses.is_dataclass(kind) and kind.__module__.startswith(f"{types.__name__}.")
    }
    beside = {types.Stamped, types.Image, types.Depth}
    assert kinds - beside == set(RECORDS) - {ModelSpec}


@by_kind
def test_every_field_of_a_record_is_drawn_at_random(kind: type) -> None:
    names = kind.model_fields if kind is ModelSpec else [f.name for f in dataclasses.fields(kind)]
    values: dict[str, set[str]] = {name: set() for name in names}

    @given(RECORDS[kind])
    @settings(NOTHING_TAKEN, derandomize=True, database=None)
    def draw(record: Any) -> None:
        for name, known in values.items():
            if len(known) < 2:
                known.add(repr(getattr(record, name)))

    draw()
    same = [name for name, known in values.items() if len(known) == 1]
    assert not same, f"tests/random_records.py draws no {', '.join(same)} for {kind.__name__}"


@by_kind
@given(data=st.data())
@NOTHING_TAKEN
def test_a_record_is_written_as_a_map_of_its_fields_comes_back_as_it_was_and_stays_so(
    kind: type, data: st.DataObject
) -> None:
    record = data.draw(RECORDS[kind])
    payload = records.encode(record)
    assert payload == msgpack.packb(as_map(record))
    back = records.decode(kind, payload)
    assert back == record if kind is ModelSpec else near(record, back)
    fields = list(type(back).model_fields if kind is ModelSpec else back.__dataclass_fields__)
    for name in fields:
        value = getattr(back, name)
        if isinstance(value, np.ndarray):
            assert not value.flags.writeable
            assert value.flags.c_contiguous
        with pytest.raises((dataclasses.FrozenInstanceError, ValueError)):
            setattr(back, name, value)


@by_kind
@given(payload=st.binary(max_size=300))
@NOTHING_TAKEN
def test_arbitrary_bytes_are_refused_or_read(kind: type, payload: bytes) -> None:
    assert decoded_or_refused(kind, payload)


@by_kind
@given(data=st.data())
@NOTHING_TAKEN
def test_a_truncated_record_is_refused_and_a_spoilt_one_or_read_as_any_reader_does(
    kind: type, data: st.DataObject
) -> None:
    payload = bytearray(records.encode(data.draw(RECORDS[kind])))
    cut = data.draw(st.integers(0, len(payload) - 1))
    with pytest.raises(CodecError):
        records.decode(kind, bytes(payload[:cut]))
    for _ in range(data.draw(st.integers(0, 9))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    assert decoded_or_refused(kind, bytes(payload))
    with suppress(CodecError):
        read = records.decode(kind, bytes(payload))
        plain = records.from_map(kind, message.unpack(bytes(payload)))
        np.testing.assert_equal(as_map(read), as_map(plain))


ANY_KEY = st.text(max_size=5) | st.binary(max_size=5)
ANY_VALUE = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=8)
    | st.just(np.array([np.nan, 1.0]))
    | st.just(np.array(["a", "b"]))
    | st.just(np.array([[True]]))
    | st.just(np.float32(2)),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(ANY_KEY, inner, max_size=4),
    max_leaves=8,
)


@by_kind
@given(data=st.data())
@NOTHING_TAKEN
def test_a_field_may_hold_anything_and_is_refused_or_read(kind: type, data: st.DataObject) -> None:
    fields = message.unpack(records.encode(data.draw(RECORDS[kind])))
    name = data.draw(st.sampled_from(sorted(fields)))
    assert decoded_or_refused(kind, message.pack(fields | {name: data.draw(ANY_VALUE)}))


def forged(record: Any, **fields: Any) -> bytes:
    return message.pack(message.unpack(records.encode(record)) | fields)


TASK = Task(episode=1, active=True, prompt="go", worker="w", rate_hz=5.0)
POSE = PoseState(np.zeros(3), np.array([0, 0, 0, 1.0]), np.zeros(6))
GRIPPER = GripperState(0.04, moving=False, holding=False)
STATUS = NodeStatus("n", "s", "h", 1, 1)
UNIT = np.array([0, 0, 0, 1.0])
COMMAND = PoseCommand(np.zeros(3), UNIT, np.zeros(6), np.zeros(6), np.zeros(3), UNIT, "active")
CAUSE = Cause("w", *range(7))
JOINTS = JointState(("a", "b"), np.zeros(2), np.zeros(2), np.zeros(2))
JOINT_COMMAND = JointCommand(("a", "b"), np.zeros(2), np.zeros(2), np.zeros(2), "active")
OBJECTS = ObjectPoses(("a",), np.zeros((1, 3)), np.array([[0, 0, 0, 1.0]]))
HEADER_REASONS = {"schema", "invalid", "malformed"}


@pytest.mark.parametrize(
    ("record", "fields", "said"),
    [
        (TASK, {"rate_hz": True}, "rate_hz is True, allowed: a number from 0.01 to 1000"),
        (TASK, {"rate_hz": "5"}, "rate_hz is '5'"),
        (TASK, {"rate_hz": float("nan")}, "rate_hz is nan"),
        (TASK, {"rate_hz": float("inf")}, "rate_hz is inf"),
        (TASK, {"episode": 1.0}, "episode is 1.0, allowed: a whole number from 0"),
        (TASK, {"episode": 2**63}, "episode is 9223372036854775808"),
        (TASK, {"episode": -1}, "episode is -1"),
        (TASK, {"active": 1}, "active is 1, allowed: true or false"),
        (TASK, {"prompt": b"go"}, "prompt is b'go', allowed: text of at most 4096 characters"),
        (TASK, {"prompt": "x" * 5000}, "prompt is 'xxx"),
        (POSE, {"position_m": [True, 0, 0]}, r"position_m\[0\] is True"),
        (POSE, {"position_m": ["1", "2", "3"]}, r"position_m\[0\] is '1'"),
        (
            POSE,
            {"position_m": [[1], [2, 3]]},
            r"position_m is \[\[1\], \[2, 3\]\], allowed: a list of 3",
        ),
        (POSE, {"position_m": {"x": 1}}, "position_m is {'x': 1}"),
        (POSE, {"position_m": None}, "position_m is None"),
        (POSE, {"position_m": np.zeros((1, 3))}, "position_m is .* allowed: a list of 3"),
        (POSE, {"position_m": np.full(3, np.nan)}, r"position_m\[0\] is nan"),
        (POSE, {"twist": np.zeros(5)}, "twist is .* allowed: a list of 6"),
        (POSE, {"quat_xyzw": [0, 0, 0, 0.9]}, "quat_xyzw has norm 0.9"),
        (POSE, {"quat_xyzw": [0, 0, 0, 0]}, "quat_xyzw has norm 0"),
        (POSE, {"reference_position_m": [0, 0, 0]}, "needs both position and quaternion"),
        (JOINTS, {"reference_rad": [0]}, "reference_rad has 1 numbers, allowed: one for each of"),
        (JOINTS, {"reference_rad": [0, np.nan]}, r"reference_rad\[1\] is nan"),
        (JOINT_COMMAND, {"names": ["a", "a"]}, "allowed: at least one name, none of them twice"),
        (JOINT_COMMAND, {"names": []}, "allowed: at least one name, none of them twice"),
        (JOINT_COMMAND, {"position_rad": [0, np.inf]}, r"position_rad\[1\] is inf"),
        (JOINT_COMMAND, {"velocity_rad_s": np.zeros(3)}, "velocity_rad_s has 3 numbers"),
        (JOINT_COMMAND, {"acceleration_rad_s2": None}, "acceleration_rad_s2 is None"),
        (JOINT_COMMAND, {"state": 1}, "state is 1, allowed: text of at most 32 characters"),
        (GRIPPER, {"faults": "fire"}, "faults is 'fire', allowed: a list of"),
        (GRIPPER, {"faults": [b"fire"]}, r"faults\[0\] is b'fire'"),
        (GRIPPER, {"width_m": 40}, "width_m is 40, allowed: null or a number from -0.01 to 1"),
        (STATUS, {"rates_hz": {"a": float("nan")}}, "rates_hz.a is nan, allowed: a finite number"),
        (STATUS, {"counters": {"b": 1, "a": 1.5}}, "counters.a is 1.5, allowed: a whole number"),
        (STATUS, {"counters": {b"a": 1}}, "a name in counters is wrong"),
        (STATUS, {"latency_ms": {"a": [1]}}, r"latency_ms.a is \[1\], allowed: a list of 2"),
        (STATUS, {"detail": {"a": b"x"}}, "detail.a is b'x', allowed: text, numbers"),
        (STATUS, {"detail": {"a": {"b": {"c": {"d": {}}}}}}, "detail.a is .* nested 3 deep"),
        (STATUS, {"detail": {"a": float("nan")}}, "detail.a is nan"),
        (STATUS, {"detail": [1]}, r"detail is \[1\], allowed: a map"),
        (STATUS, {"detail": {str(n): n for n in range(1025)}}, "detail is .* 0 to 1024 names"),
        (
            Event("info", "notice", "x"),
            {"level": "loud"},
            "level is 'loud', allowed: error or info",
        ),
        (Event("info", "notice", "x"), {"kind": "x"}, "kind is 'x', allowed: fault or"),
        (Event("info", "notice", "x"), {"count": 0}, "count is 0, allowed: a whole number from 1"),
        (COMMAND, {"cause": 5}, "cause is 5, allowed: null or a Cause"),
        (COMMAND, {"cause": {}}, "cause lacks worker"),
        (JOINT_COMMAND, {"cause": {}}, "cause lacks worker"),
        (
            COMMAND,
            {"cause": {**dataclasses.asdict(CAUSE), "chunk_seq": -1}},
            "cause.chunk_seq is -1, allowed: a whole number from 0",
        ),
        (
            OBJECTS,
            {"position_m": np.zeros((3, 1))},
            r"position_m\[0\] is \[0.0\], allowed: a list of 3",
        ),
        (OBJECTS, {"position_m": np.zeros((2, 3))}, "position_m has 2 rows, allowed: one for each"),
        (OBJECTS, {"quat_xyzw": np.ones((1, 4))}, r"quat_xyzw\[0\] has norm 2"),
        (JOINTS, {"effort_nm": [-np.inf, 0]}, r"effort_nm\[0\] is -inf"),
        (COMMAND, {"goal_quat_xyzw": [1, 1, 1, 1]}, "goal_quat_xyzw has norm 2"),
        (JOINT_COMMAND, {"velocity_rad_s": [0, np.inf]}, r"velocity_rad_s\[1\] is inf"),
    ],
)
def test_a_wrong_value_is_refused_by_name(record: Any, fields: Any, said: str) -> None:
    with pytest.raises(CodecError, match=said) as caught:
        records.decode(type(record), forged(record, **fields))
    assert caught.value.reason == "invalid"


def test_numbers_of_any_kind_are_read_where_they_fit() -> None:
    task = records.decode(Task, forged(TASK, rate_hz=5, episode=np.int32(3)))
    assert type(task.rate_hz) is float
    assert type(task.episode) is int
    pose = records.decode(PoseState, forged(POSE, position_m=[1, 2, 3], twist=np.ones(6, np.int8)))
    assert pose.position_m.tolist() == [1.0, 2.0, 3.0]
    assert pose.twist.dtype == np.float64


def test_fields_that_are_missing_are_named() -> None:
    with pytest.raises(CodecError, match="Task lacks episode, active, prompt, worker, rate_hz"):
        records.decode(Task, message.pack({}))
    with pytest.raises(CodecError, match=r"Task is a map of its fields: .* got `array`"):
        records.decode(Task, message.pack([1]))


def test_unknown_fields_are_ignored_and_named() -> None:
    cause = {**as_map(CAUSE), "later": np.zeros(3)}
    for record, more, named in (
        (TASK, {"episodes": 1}, ["Task.'episodes'"]),
        (TASK, {"a": [[1]], "b": b"x"}, ["Task.'a'", "Task.'b'"]),
        (COMMAND, {"cause": cause}, ["Cause.'later'"]),
        (POSE, {}, []),
    ):
        unknown: list[str] = []
        found = records.decode(type(record), forged(record, **more), unknown)
        assert unknown == named
        if "cause" not in more:
            assert same(found, record)


def test_unknown_fields_of_a_header_are_named() -> None:
    header = message.unpack(records.encode_header(Header(1, 2, "sim#1")))
    for more, named in (({}, []), ({"hop": 1}, ["Header.'hop'"])):
        unknown: list[str] = []
        records.decode_header(message.pack({**header, **more}), unknown)
        assert unknown == named


@pytest.mark.parametrize(
    ("value", "text"),
    [(1e6, "1e6"), (-1e6, "-1e6"), (1e-4, "0.0001"), (1e-5, "1e-5"), (1e10, "1e10"), (0.0, "0")],
)
def test_bounds_are_written_as_a_person_does(value: float, text: str) -> None:
    assert bound_text(value) == text


def invalid_values(value: Any) -> list[Any]:
    """Values that no record accepts in place of `value`."""
    wrong: list[Any] = [b"no", [b"no"]]
    if isinstance(value, np.ndarray) and value.size:
        wrong += [np.full(value.shape, np.nan), np.full(value.shape, np.inf)]
        wrong.append(np.full((*value.shape, 1, 1), 0.5))
    elif type(value) is float:
        wrong += [math.nan, -math.inf]
    return wrong


@by_kind
@given(data=st.data())
@settings(max_examples=4, suppress_health_check=[HealthCheck.too_slow])
def test_an_invalid_value_of_any_field_is_rejected(kind: type, data: st.DataObject) -> None:
    if kind is ModelSpec:
        return  # a model of Pydantic, which has no fields that bytes are not valid for
    record = data.draw(RECORDS[kind])
    fields = message.unpack(records.encode(record))
    for name, value in fields.items():
        for wrong in invalid_values(value):
            bad = message.pack(fields | {name: wrong})
            assert refusal(records.decode, kind, bad) is not None, (name, wrong)


def test_a_record_is_checked_when_it_is_built_as_when_it_is_read() -> None:
    checked = 0

    @dataclasses.dataclass(frozen=True, slots=True)
    class Counted(Record):
        seq: Count

        def _check(self) -> None:
            nonlocal checked
            checked += 1
            if self.seq == 7:
                raise RecordError("seq is 7, allowed: any other")

    payload = records.encode(Counted(6))
    for count in range(2, DECODES):
        assert records.decode(Counted, payload).seq == 6
        assert checked == count
    with pytest.raises(RecordError, match="allowed: any other"):
        Counted(7)
    with pytest.raises(CodecError, match="Counted: seq is 7, allowed: any other"):
        records.decode(Counted, message.pack({"seq": 7}))


def test_an_error_message_stays_short_whatever_is_in_the_field() -> None:
    for value in ("x" * 100_000, b"x" * 100_000, [[0] * 5000] * 9, np.full(9000, np.nan)):
        with pytest.raises(CodecError) as caught:
            records.decode(PoseState, forged(POSE, position_m=value))
        assert len(str(caught.value)) < 1000


def test_a_map_with_an_entry_that_is_not_even_text_is_rejected_by_its_field() -> None:
    payload = forged(STATUS, latency_ms={"z": "12345678"}).replace(b"12345678", b"\xff" * 8)
    with pytest.raises(CodecError, match=r"NodeStatus: latency_ms\.\.\.\. is"):
        records.decode(NodeStatus, payload)


def test_the_wrong_entry_is_named_beside_another_field_that_is_too_large_to_show() -> None:
    large = {str(n): "x" * 1000 for n in range(100)}
    payload = forged(STATUS, detail=large, rates_hz={"good": 1.0, "bad": float("nan")})
    with pytest.raises(CodecError, match=r"NodeStatus: rates_hz\.bad is nan"):
        records.decode(NodeStatus, payload)


def test_an_oversize_record_is_refused_before_it_is_read() -> None:
    payload = b"\xdf" + b"\xff" * (records.MAX_RECORD_BYTES + 1)
    with pytest.raises(CodecError) as caught:
        records.decode(Task, payload)
    assert caught.value.reason == "oversize"


def test_what_a_stranger_says_of_himself_can_be_printed_as_json() -> None:
    payload = forged(STATUS, detail={"a\x1b[2J": ["\u202e", {"b": None}], "n": 2**62})
    status = records.decode(NodeStatus, payload)
    assert json.loads(json.dumps(dataclasses.asdict(status)))["detail"]["n"] == 2**62


# -- headers ----------------------------------------------------------------------------------
@given(headers)
def test_a_header_comes_back_as_it_was(written: Any) -> None:
    assert records.decode_header(records.encode_header(written)) == written


@given(st.binary(max_size=200))
def test_arbitrary_attachments_are_refused_or_read(attachment: bytes) -> None:
    error = refusal(records.decode_header, attachment)
    assert error is None or error.reason in HEADER_REASONS


@given(headers)
def test_a_header_is_plain_msgpack_for_any_reader(written: Any) -> None:
    fields = {"schema": SCHEMA, **dataclasses.asdict(written)}
    assert message.unpack(records.encode_header(written)) == fields
    assert records.decode_header(message.pack(fields)) == written


@given(headers, st.data())
def test_a_spoilt_header_is_read_as_msgpack_or_not(written: Any, data: st.DataObject) -> None:
    payload = bytearray(records.encode_header(written))
    at = data.draw(st.integers(0, len(payload) - 1))
    payload[at : at + data.draw(st.integers(0, 2))] = data.draw(st.binary(max_size=3))
    with suppress(CodecError):
        read = records.decode_header(bytes(payload))
        found = message.unpack(bytes(payload))
        assert {name: found[name] for name in dataclasses.asdict(read)} == dataclasses.asdict(read)
        assert found["schema"] == SCHEMA


@given(headers, st.data())
def test_flipped_bits_in_a_header_are_refused_or_read(written: Any, data: st.DataObject) -> None:
    payload = bytearray(records.encode_header(written))
    payload[data.draw(st.integers(0, len(payload) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    error = refusal(records.decode_header, bytes(payload))
    assert error is None or error.reason in HEADER_REASONS


@given(st.sampled_from(["schema", "stamp_wall_ns", "seq", "source"]), ANY_VALUE)
def test_a_header_field_may_hold_anything(name: str, value: Any) -> None:
    fields = {"schema": SCHEMA, "stamp_wall_ns": 1, "seq": 1, "source": "a"} | {name: value}
    error = refusal(records.decode_header, message.pack(fields))
    assert error is None or error.reason in HEADER_REASONS


GOOD = {"schema": SCHEMA, "stamp_wall_ns": 5, "seq": 6, "source": "sim#1"}


@pytest.mark.parametrize(
    ("attachment", "reason"),
    [
        (None, "no_header"),
        (b"", "malformed"),
        (b"\xc1", "malformed"),
        (msgpack.packb([1]), "malformed"),
        (msgpack.packb(GOOD | {"schema": SCHEMA + 1}), "schema"),
        (msgpack.packb(GOOD | {"schema": True}), "schema"),
        (msgpack.packb(GOOD | {"schema": float(SCHEMA)}), "schema"),
        (msgpack.packb({"schema": SCHEMA}), "malformed"),
        (msgpack.packb(GOOD | {"seq": -1}), "invalid"),
        (msgpack.packb(GOOD | {"source": "x" * 200}), "invalid"),
        (msgpack.packb(GOOD | {"padding": b"x" * 2000}), "malformed"),
    ],
)
def test_a_wrong_header_is_refused_with_its_reason(attachment: bytes | None, reason: str) -> None:
    with pytest.raises(CodecError) as caught:
        records.decode_header(attachment)
    assert caught.value.reason == reason
