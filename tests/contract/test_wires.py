"""Other systems' wires: what goes out comes back, and whatever comes in is read or refused."""

from __future__ import annotations

import io
import json
import pickle
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from model_wires import groot, npy, openpi, openvla_rest, origami

from vla_zenoh.errors import PeerError
from vla_zenoh.interop.field_mapping import read_field_mapping
from vla_zenoh.lab.serve import openpi_frames
from vla_zenoh.policy import ActionSpec

EXAMPLES, MUTATIONS = 20, 60
DTYPES = ("|b1", "|u1", "<i4", "<i8", "<f4", "<f8", ">f4", "<f2")
arrays = st.sampled_from(DTYPES).flatmap(
    lambda dtype: hnp.arrays(np.dtype(dtype), hnp.array_shapes(min_dims=0, max_dims=4, max_side=4))
)
values = st.recursive(
    arrays | st.text(max_size=20) | st.integers(-(2**40), 2**40) | st.booleans() | st.none(),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=8,
)
maps = st.dictionaries(st.text(min_size=1, max_size=8), values, min_size=1, max_size=4)


def same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return (
            isinstance(b, np.ndarray)
            and a.dtype == b.dtype
            and a.shape == b.shape
            and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
        )
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and a == b


# -- there and back -------------------------------------------------------------------------------
@settings(max_examples=EXAMPLES)
@given(arrays)
def test_an_npy_file_is_what_numpy_writes_and_reads(array: np.ndarray[Any, Any]) -> None:
    data = npy.dump(array)
    assert same(np.load(io.BytesIO(data), allow_pickle=False), array)
    assert same(npy.load(data), array)
    turned = np.asfortranarray(array)
    assert same(np.ascontiguousarray(npy.load(npy.dump(turned))), np.ascontiguousarray(turned))


@settings(max_examples=EXAMPLES)
@given(maps)
def test_groots_values_come_back(value: dict[str, Any]) -> None:
    assert same(groot.unpack(groot.pack(value)), value)


@settings(max_examples=EXAMPLES)
@given(maps)
def test_openvlas_values_come_back(value: dict[str, Any]) -> None:
    assert same(openvla_rest.unpack(openvla_rest.pack(value)), value)


@settings(max_examples=EXAMPLES)
@given(maps)
def test_openpis_observations_come_back(fields: dict[str, Any]) -> None:
    assert same(openpi_frames.read_observation(openpi.request(fields)), fields)


@settings(max_examples=EXAMPLES)
@given(maps, st.text(min_size=1, max_size=8))
def test_origamis_requests_carry_their_number(fields: dict[str, Any], number: str) -> None:
    asked = msgpack.unpackb(origami.request("infer", number, "s", fields))
    assert (asked["request_id"], asked["session_id"]) == (number, "s")
    assert asked["protocol_version"] == "origami-zenoh-v1"
    assert asked["operation"] == "infer"


def test_an_array_of_openpi_has_byte_keys_and_one_of_groot_is_an_npy_file() -> None:
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    sent = msgpack.unpackb(openpi.request({"state": array}))["state"]
    assert sent == {
        b"__ndarray__": True,
        b"data": array.tobytes(),
        b"dtype": "<f4",
        b"shape": [2, 3],
    }
    sent = msgpack.unpackb(groot.request("get_action", {"state": array}))["data"]["state"]
    assert set(sent) == {"__ndarray_class__", "as_npy"}
    assert same(np.load(io.BytesIO(sent["as_npy"])), array)
    sent = json.loads(openvla_rest.request({"state": array}))["state"]
    assert (sent["dtype"], sent["shape"], set(sent)) == (
        "<f4",
        [2, 3],
        {"__numpy__", "dtype", "shape"},
    )


# -- whatever comes in ----------------------------------------------------------------------------
SERVED = ActionSpec(horizon=1, dt_s=0.1)
ACTIONS = np.linspace(-1, 1, 14, dtype=np.float32).reshape(2, 7)
MODALITY = {"__ModalityConfig_class__": True, "as_json": '{"modality_keys": ["x"]}'}
ANSWERS: dict[str, tuple[bytes, Callable[[bytes], Any]]] = {
    "openpi": (openpi_frames.answer(ACTIONS, 1.0, None), openpi.read_answer),
    "openpi metadata": (
        openpi_frames.metadata(SERVED, {"a": "b"}),
        openpi.read_metadata,
    ),
    "openpi request": (
        openpi.request({"image": np.zeros((2, 2, 3), np.uint8), "prompt": "up"}),
        openpi_frames.read_observation,
    ),
    "groot": (groot.pack([{"x": ACTIONS}, {}]), groot.read_actions),
    "groot modalities": (groot.pack({"video": MODALITY}), groot.read_answer),
    "openvla": (
        openvla_rest.pack([row for row in ACTIONS]).encode(),
        lambda body: openvla_rest.read_answer(200, body),
    ),
    "origami": (
        origami.message.pack(
            {
                "protocol_version": "origami-zenoh-v1",
                "operation": "infer",
                "request_id": "1",
                "actions": ACTIONS,
            }
        ),
        lambda payload: origami.read_answer(payload, "infer", "1"),
    ),
}
READ: dict[str, Any] = {
    "openpi": {"actions": ACTIONS, "server_timing": {"infer_ms": 1.0}},
    "openpi metadata": {
        "action_dim": SERVED.dimension,
        "action_horizon": 1,
        "observation": {"a": "b"},
        openpi.SPEC: SERVED.model_dump(mode="json"),
        openpi_frames.TAKES_COMMITTED: False,
    },
    "openpi request": {"image": np.zeros((2, 2, 3), np.uint8), "prompt": "up"},
    "groot": {"x": ACTIONS},
    "groot modalities": {"video": {"modality_keys": ["x"]}},
    "openvla": ACTIONS,
    "origami": ACTIONS,
}


LAYOUT = read_field_mapping("x", openpi.PRESETS, "libero", {"keys": "actions"}, max_width_m=0.08)
NAMED = read_field_mapping("x", groot.PRESETS, "libero", {"keys": "x"}, max_width_m=0.08)
MAX_MESSAGE = 1500


def refused(read: Callable[[bytes], Any], payload: bytes) -> PeerError | None:
    """Reads it, to the numbers of an action where it is one; any other error is a failure."""
    try:
        answer = read(payload)
        (NAMED if isinstance(answer, dict) and "x" in answer else LAYOUT).gather(answer)
    except PeerError as error:
        return error
    return None


@pytest.mark.parametrize("name", ANSWERS)
def test_an_untouched_answer_is_read(name: str) -> None:
    payload, read = ANSWERS[name]
    assert same(read(payload), READ[name])


@pytest.mark.parametrize("name", ANSWERS)
@settings(max_examples=MUTATIONS)
@given(data=st.data())
def test_a_mutated_answer_is_read_or_refused_and_nothing_else(name: str, data: Any) -> None:
    payload, read = ANSWERS[name]
    mutated = bytearray(payload)
    for _ in range(data.draw(st.integers(1, 4))):
        where = data.draw(st.integers(0, len(mutated)))
        kind = data.draw(st.sampled_from(("change", "cut", "insert", "repeat")))
        if kind == "change" and where < len(mutated):
            mutated[where] = data.draw(st.integers(0, 255))
        elif kind == "cut":
            del mutated[where : where + data.draw(st.integers(1, 8))]
        elif kind == "insert":
            mutated[where:where] = data.draw(st.binary(min_size=1, max_size=6))
        else:
            mutated[where:where] = mutated[max(where - 8, 0) : where]
    refusal = refused(read, bytes(mutated))
    assert refusal is None or len(str(refusal)) < MAX_MESSAGE


@pytest.mark.parametrize("name", ANSWERS)
@settings(max_examples=EXAMPLES)
@given(noise=st.binary(max_size=200))
def test_noise_is_read_or_refused_and_nothing_else(name: str, noise: bytes) -> None:
    refused(ANSWERS[name][1], noise)


@pytest.mark.parametrize("name", ANSWERS)
@pytest.mark.parametrize("nested", [b"\x91" * 5000, b"[" * 200_000, b'{"a":' * 100_000])
def test_what_is_nested_without_end_is_refused(name: str, nested: bytes) -> None:
    with pytest.raises(PeerError):
        ANSWERS[name][1](nested)


class Trap:
    """Would say so if it was ever unpickled."""

    sprung = False

    def __reduce__(self) -> Any:
        return (setattr, (Trap, "sprung", True))


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_pickles_are_refused_by_name_and_never_opened(protocol: int) -> None:
    with pytest.raises(PeerError, match=r"pickles, which run code.*never read"):
        groot.read_answer(pickle.dumps({"action.x": Trap()}, protocol))
    assert not Trap.sprung


def test_a_torch_file_is_refused_by_name() -> None:
    with pytest.raises(PeerError, match="pickles"):
        groot.read_answer(b"PK\x03\x04" + bytes(200))


def test_pickled_objects_within_an_npy_file_are_refused() -> None:
    out = io.BytesIO()
    np.save(out, np.array([Trap()], object), allow_pickle=True)
    packed = msgpack.packb({"x": {"__ndarray_class__": True, "as_npy": out.getvalue()}})
    with pytest.raises(PeerError, match="not that of a plain array"):
        groot.read_answer(packed)
    assert not Trap.sprung


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (10**9,), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (4000000000, 4000000000), }",
        "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
        "__import__('os').abort()",
    ],
)
def test_a_header_that_numpy_would_not_write_for_numbers_is_refused(header: str) -> None:
    text = header.encode().ljust(117) + b"\n"
    data = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(4)
    with pytest.raises(PeerError):
        npy.load(data)


# -- errors of servers ----------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("read", "said"),
    [
        (openpi.read_answer, "Traceback (most recent call last):\n  File\nKeyError: 'no such key'"),
        (openpi.read_answer, openpi.message.pack({"type": "error", "message": "no such key"})),
        (groot.read_answer, groot.pack({"error": "no such key"})),
        (
            lambda payload: origami.read_answer(payload, "infer", "1"),
            origami.message.pack({"error": {"code": "X", "message": "no such key"}}),
        ),
        (
            lambda body: openvla_rest.read_answer(422, body),
            b'{"detail": "no such key"}',
        ),
        (lambda body: openvla_rest.read_answer(200, body), b'{"detail": "no such key"}'),
    ],
)
def test_a_servers_error_is_told_in_its_words(read: Callable[[Any], Any], said: Any) -> None:
    with pytest.raises(PeerError, match="no such key") as raised:
        read(said)
    assert raised.value.reason == "peer_error"


def test_openvlas_text_error_is_an_error_although_its_status_is_200() -> None:
    with pytest.raises(PeerError, match="its log says why") as raised:
        openvla_rest.read_answer(200, b'"error"')
    assert raised.value.reason == "peer_error"


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity"])
def test_json_that_is_none_is_refused(number: str) -> None:
    with pytest.raises(PeerError, match="holds"):
        openvla_rest.unpack(f"[{number}]")


@pytest.mark.parametrize("field", ["protocol_version", "operation", "request_id"])
def test_an_answer_to_another_question_of_origami_is_refused(field: str) -> None:
    answer = {
        "protocol_version": "origami-zenoh-v1",
        "operation": "infer",
        "request_id": "1",
        "actions": ACTIONS,
        field: "2",
    }
    with pytest.raises(PeerError, match=f"{field} of the answer"):
        origami.read_answer(origami.message.pack(answer), "infer", "1")


def test_groots_two_shapes() -> None:
    fields = {
        "video.image": np.zeros((4, 5, 3), np.uint8),
        "state.x": np.zeros(1, np.float32),
        "task": "go",
    }
    flat = groot.observation(fields, "n1.5")
    assert flat["video.image"].shape == (1, 4, 5, 3)
    assert flat["state.x"].shape == (1, 1)
    assert flat["task"] == ["go"]
    nested = groot.observation(fields, "n1.6")
    assert nested["options"] is None
    assert nested["observation"]["video"]["image"].shape == (1, 1, 4, 5, 3)
    assert nested["observation"]["state"]["x"].shape == (1, 1, 1)
    assert nested["observation"]["language"] == {"task": [["go"]]}
    rows = np.zeros((1, 4, 1), np.float32)
    assert set(groot.read_actions(groot.pack([{"x": rows}, {}]))) == {"x"}
    assert set(groot.read_actions(groot.pack({"action.x": rows[0]}))) == {"x"}
