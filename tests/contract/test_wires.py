"""Other systems' wires: what goes out comes back, and whatever comes in is read or refused."""

from __future__ import annotations

import io
import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from model_wires import (
    groot,
    lerobot_server,
    npy,
    openpi,
    openvla_rest,
    origami,
    pickles,
    xpolicylab,
)
from vla_zenoh_policy_servers.field_mapping import read_field_mapping
from vla_zenoh_serve import openpi_server

from vla_zenoh.errors import PeerError
from vla_zenoh.policy import ActionSpec
from vla_zenoh.profile import load_profile

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
    assert same(openpi_server.read_observation(openpi.request(fields)), fields)


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
OF_TORCH = Path(__file__).with_name("lerobot_actions.pickle")
"""What lerobot 0.6.1 answers: `TimedAction`s with the numbers 7 to 11."""


def xpolicylab_answer(payload: Any, **changes: Any) -> bytes:
    asked = xpolicylab.request("infer", "1", xpolicylab.Place("e"), {"payload": payload})
    frame = msgpack.unpackb(asked, strict_map_key=False)
    frame |= {"message_type": "infer_result", "payload": frame["payload"]["payload"]}
    packed = msgpack.packb({**frame, **changes})
    assert packed is not None
    return packed


ANSWERS: dict[str, tuple[bytes, Callable[[bytes], Any]]] = {
    "openpi": (openpi_server.pack_answer(ACTIONS, 1.0, None), openpi.read_answer),
    "openpi metadata": (
        openpi_server.metadata(SERVED, {"a": "b"}),
        openpi.read_metadata,
    ),
    "openpi request": (
        openpi.request({"image": np.zeros((2, 2, 3), np.uint8), "prompt": "up"}),
        openpi_server.read_observation,
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
    "xpolicylab": (
        xpolicylab_answer({"actions": [{"x": row} for row in ACTIONS], "latency_ms": 1.0}),
        lambda frame: xpolicylab.read_actions(xpolicylab.read_answer(frame, "infer", "1")),
    ),
    "lerobot server": (
        lerobot_server.policy_setup(OF_TORCH.read_bytes()),
        lambda payload: lerobot_server.read_actions(payload, 7),
    ),
}
READ: dict[str, Any] = {
    "openpi": {"actions": ACTIONS, "server_timing": {"infer_ms": 1.0}},
    "openpi metadata": {
        "action_dim": SERVED.dimension,
        "action_horizon": 1,
        "observation": {"a": "b"},
        openpi.SPEC: SERVED.model_dump(mode="json"),
        openpi_server.TAKES_COMMITTED: False,
    },
    "openpi request": {"image": np.zeros((2, 2, 3), np.uint8), "prompt": "up"},
    "groot": {"x": ACTIONS},
    "groot modalities": {"video": {"modality_keys": ["x"]}},
    "openvla": ACTIONS,
    "origami": ACTIONS,
    "xpolicylab": {"x": ACTIONS},
    # Of torch 2.11: single, double, bfloat16 and half floats, and a row with strides.
    "lerobot server": np.array([[0.75, 1.0, 1.25]] * 5),
}


PANDA = load_profile("panda_sim")
LAYOUT = read_field_mapping("x", openpi.PRESETS, "libero", {"keys": "actions"}, profile=PANDA)
NAMED = read_field_mapping("x", groot.PRESETS, "libero", {"keys": "x"}, profile=PANDA)
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
            lambda frame: xpolicylab.read_answer(frame, "infer", "1"),
            xpolicylab_answer({"code": "x", "message": "no such key"}, message_type="error"),
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


# -- XPolicyLab -----------------------------------------------------------------------------------
def test_an_observation_of_xpolicylab_is_nested_by_its_names() -> None:
    picture = np.zeros((2, 3, 3), np.uint8)
    fields = {"vision/cam_head/color": picture, "state/ee_pose": ACTIONS[0], "instruction": "go"}
    nested = {
        "data_format_version": "v1.0",
        "vision": {"cam_head": {"color": picture}},
        "state": {"ee_pose": ACTIONS[0]},
        "instruction": "go",
    }
    assert same(xpolicylab.observation(fields), nested)


@pytest.mark.parametrize(
    ("actions", "why"),
    [
        ([], "no steps"),
        ([{"x": [1.0]}, {"y": [1.0]}], "other names"),
        ([{"x": [1.0]}, {"x": [1.0, 2.0]}], "different sizes"),
        ([{"x": [1.0]}, 3], "other names"),
        ([{"x": ["far"]}], "not numbers"),
        ([{"y": [1.0]}], "no 'x'"),
        ([{"x": [float("inf")]}], "NaN or infinity"),
        ("up", "not numbers"),
        ([{"x": {b"nd": True, b"kind": b"O", b"type": "|O", b"data": b"x"}}], "kind b'O'"),
        ([{"x": {b"nd": True, b"kind": b"", b"type": "|O", b"shape": [1], b"data": b"x"}}], "'|O'"),
        (
            [{"x": {b"nd": True, b"kind": b"", b"type": "<f8", b"shape": [9**9], b"data": b"x"}}],
            "cannot have 1 bytes",
        ),
    ],
)
def test_steps_of_xpolicylab_that_are_none_are_refused(actions: Any, why: str) -> None:
    frame = xpolicylab_answer({"actions": actions})
    with pytest.raises(PeerError, match=why.replace("|O", r"\|O")) as raised:
        NAMED.gather(xpolicylab.read_actions(xpolicylab.read_answer(frame, "infer", "1")))
    assert raised.value.reason == "peer_reply"


@pytest.mark.parametrize(
    ("frame", "why"),
    [
        (xpolicylab_answer({}, message_id="2"), "message_id of the answer is '2'"),
        (xpolicylab_answer({}, message_type="reset_result"), "is 'reset_result', not infer_result"),
        (xpolicylab_answer(None), "no frame with a payload"),
        (xpolicylab_answer({}), "has no actions"),
    ],
)
def test_a_frame_of_xpolicylab_that_answers_something_else_is_refused(
    frame: bytes, why: str
) -> None:
    with pytest.raises(PeerError, match=why):
        xpolicylab.read_actions(xpolicylab.read_answer(frame, "infer", "1"))


def test_a_text_frame_of_xpolicylab_is_refused() -> None:
    with pytest.raises(PeerError, match="a text frame"):
        xpolicylab.read_answer("hello", "hello", "1")


# -- lerobot's pickles ----------------------------------------------------------------------------
def called(name: str, arguments: bytes = b")") -> bytes:
    module, _, last = name.rpartition(".")
    return f"\x80\x03c{module}\n{last}\n".encode("latin-1") + arguments + b"R."


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_a_pickle_that_runs_code_is_refused_by_name_and_never_run(protocol: int) -> None:
    with pytest.raises(
        PeerError, match=r"which is not allowed and was not run|instruction"
    ) as told:
        pickles.read(pickle.dumps([Trap()], protocol))
    assert not Trap.sprung
    assert told.value.reason == "peer_reply"


@pytest.mark.parametrize(
    "name",
    ["os.system", "builtins.eval", "torch.load", "torch._utils._rebuild_parameter", "numpy.load"],
)
def test_a_name_that_is_not_allowed_is_told(name: str) -> None:
    with pytest.raises(PeerError, match=f"names '{name}', which is not allowed"):
        pickles.read(called(name))


def test_numbers_of_a_storage_may_be_of_torchs_own_type_alone() -> None:
    data = OF_TORCH.read_bytes().replace(b"DoubleStorage", b"StringStorage")
    with pytest.raises(PeerError, match=r"names 'torch\.StringStorage'"):
        pickles.read(data)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b".",
        b"\x80\x04",
        b"\x80\x03]q\x05.",
        b"\x80\x03h\x00.",
        b"\x80\x03(.",
        b"\x80\x03K\x01K\x02.",
        b"\x80\x03NQ.",
        b"\x80\x03Nb.",
        b"\x80\x03X\xff\xff\xff\x7fa.",
        called("torch.storage._load_from_bytes", b"C\x02ab\x85"),
        called("torch.storage._load_from_bytes"),
        called("torch._utils._rebuild_tensor_v2"),
        called("collections.OrderedDict", b"K\x01\x85"),
        called(pickles.TIMED_ACTION)[:-1] + b"}(X\x01\x00\x00\x00aub}b.",
    ],
)
def test_a_pickle_that_is_broken_or_something_else_is_refused(data: bytes) -> None:
    with pytest.raises(PeerError):
        lerobot_server.read_actions(lerobot_server.policy_setup(data), 7)


def test_a_pickle_that_grows_while_it_is_read_is_refused() -> None:
    # 64 tuples, each of two of the one before, whose hash nobody lives to see.
    twice = b"".join(b"\x94(h%ch%ct" % (depth, depth) for depth in range(64))
    with pytest.raises(PeerError, match="tuple where str belongs"):
        pickles.read(b"\x80\x04})" + twice + b"Ns.")
    with pytest.raises(PeerError, match="more than"):
        pickles.read(b"\x80\x03" + b"N" * 300_000 + b".")


def test_every_cut_of_an_answer_is_refused() -> None:
    data = OF_TORCH.read_bytes()
    for end in range(len(data)):
        with pytest.raises(PeerError):
            pickles.read(data[:end])


def test_an_answer_to_another_observation_of_lerobots_server_is_refused() -> None:
    payload = lerobot_server.policy_setup(OF_TORCH.read_bytes())
    with pytest.raises(PeerError, match="has the number 7, not 8"):
        lerobot_server.read_actions(payload, 8)


@pytest.mark.parametrize("payload", [b"\x0a\x05ab", b"\x12\x01a", b"\x0a" + b"\xff" * 9])
def test_what_is_no_message_of_lerobots_server_is_refused(payload: bytes) -> None:
    with pytest.raises(PeerError, match="no Actions message"):
        lerobot_server.read_actions(payload, 7)


@settings(max_examples=EXAMPLES)
@given(
    st.recursive(
        st.none()
        | st.booleans()
        | st.integers(-(2**31), 2**31 - 1)
        | st.floats(allow_nan=False)
        | st.text(max_size=8)
        | st.binary(max_size=8),
        lambda inner: (
            st.lists(inner, max_size=4)
            | st.tuples(inner, inner)
            | st.dictionaries(st.text(max_size=8), inner, max_size=4)
        ),
    )
)
def test_what_is_written_for_lerobot_is_read_by_pythons_pickle(value: Any) -> None:
    data = pickles.write(value)
    assert pickle.loads(data) == value
    assert pickles.read(data) == value


def test_a_picture_written_for_lerobot_is_an_array_of_numpy() -> None:
    picture = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    assert same(pickle.loads(pickles.write({"front": picture}))["front"], picture)


@given(st.integers(0, 3 * lerobot_server.PART_BYTES))
@settings(max_examples=5)
def test_an_observation_for_lerobot_is_sent_in_parts(size: int) -> None:
    parts = [*lerobot_server.observation_parts(bytes(size))]
    assert all(len(part) < 4 * 1024 * 1024 for part in parts)
    assert sum(len(part) for part in parts) >= size
    states = [part[1] for part in parts]
    assert states == ([1] + [2] * (len(parts) - 2) + [3])[-len(parts) :] if parts else size == 0
