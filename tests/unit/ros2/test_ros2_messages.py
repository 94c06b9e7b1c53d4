"""CDR and type hashes of ROS 2 messages, against published hashes and other people's CDR."""

from __future__ import annotations

import contextlib
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ros2_oracles import plain, random_messages
from vla_zenoh_ros2 import readers
from vla_zenoh_ros2.messages import NO_HASH, STORES, Messages

from benchmarks.codec.other_cdr import MODULES, OtherCdr
from vla_zenoh.codec.cdr import MAX_MESSAGE_BYTES
from vla_zenoh.errors import CodecError, ProfileError

JAZZY = Messages("jazzy")
SPOKEN = (
    "action_msgs/srv/CancelGoal_Request",
    "action_msgs/srv/CancelGoal_Response",
    "control_msgs/action/GripperCommand_GetResult_Response",
    "control_msgs/action/GripperCommand_SendGoal_Request",
    "control_msgs/action/ParallelGripperCommand_GetResult_Response",
    "control_msgs/action/ParallelGripperCommand_SendGoal_Request",
    "diagnostic_msgs/msg/DiagnosticArray",
    "franka_msgs/action/Grasp_SendGoal_Request",
    "franka_msgs/action/Move_GetResult_Request",
    "franka_msgs/action/Move_GetResult_Response",
    "franka_msgs/action/Move_SendGoal_Request",
    "franka_msgs/action/Move_SendGoal_Response",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/TwistStamped",
    "geometry_msgs/msg/WrenchStamped",
    "multi_mode_control_msgs/msg/CartesianImpedanceGoal",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/JointState",
    "std_msgs/msg/Bool",
    "std_msgs/msg/Float64",
    "std_msgs/msg/Float64MultiArray",
    "std_msgs/msg/String",
    "std_srvs/srv/SetBool_Request",
    "std_srvs/srv/SetBool_Response",
    "std_srvs/srv/Trigger_Request",
    "std_srvs/srv/Trigger_Response",
    "tf2_msgs/msg/TFMessage",
    "trajectory_msgs/msg/JointTrajectory",
    "vla_msgs/srv/SetPrompt_Request",
    "vla_msgs/srv/SetRequest_Request",
)
PUBLISHED = {
    "std_msgs/msg/Byte": ("41e1a3345f73fe93ede006da826a6ee274af23dd4653976ff249b0f44e3e798f"),
    "example_interfaces/srv/AddTwoInts": (
        "e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
    ),
    "example_interfaces/srv/SetBool": (
        "a69782e5631b12e15c8e218410de1685bbf13e382718295adad14037a24afbe8"
    ),
    "rmw_dds_common/msg/ParticipantEntitiesInfo": (
        "91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e"
    ),
    "rosgraph_msgs/msg/Clock": ("692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564"),
    "sensor_msgs/msg/Range": ("b42b62562e93cbfe9d42b82fe5994dfa3d63d7d5c90a317981703f7388adff3a"),
    "std_msgs/msg/String": ("df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
    "std_srvs/srv/Trigger": ("eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"),
}
"""What ROS 2 itself says of these types, in rmw_zenoh's design, its tokens and generated code."""
BEGINNINGS = {
    "geometry_msgs/msg/PoseStamped": "10f3786d7d40",
    "geometry_msgs/msg/TwistStamped": "5f0fcd4f81d5",
    "sensor_msgs/msg/CameraInfo": "b3dfd68ff46c",
    "sensor_msgs/msg/CompressedImage": "156407715315",
    "sensor_msgs/msg/Image": "d31d41a9a4c4",
    "sensor_msgs/msg/JointState": "a13ee3a330e3",
    "std_msgs/msg/Bool": "feb91e995ff9",
    "std_msgs/msg/Float64MultiArray": "1025ddc6b955",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23",
    "trajectory_msgs/msg/JointTrajectory": "179b33eba59d",
}
EXAMPLES = {
    "example_interfaces/srv/AddTwoInts": "int64 a\nint64 b\n---\nint64 sum\n",
    "example_interfaces/srv/SetBool": "bool data\n---\nbool success\nstring message\n",
}
ROUND_TRIPS = 15
"""Random messages of each type and library."""
BEHIND = bytes.fromhex("2356 0000 803e 4720 ff")
"""What the buffer that a bag is replayed from had behind a message."""
MUTATIONS = 100_000
MUTATED_KINDS = list(readers.READERS)


@pytest.mark.parametrize("kind", PUBLISHED)
def test_a_hash_is_the_one_that_ros_publishes(kind: str) -> None:
    assert Messages("jazzy", EXAMPLES).hash(kind) == f"RIHS01_{PUBLISHED[kind]}"


@pytest.mark.parametrize("kind", BEGINNINGS)
def test_a_hash_begins_as_the_known_one(kind: str) -> None:
    assert JAZZY.hash(kind).startswith(f"RIHS01_{BEGINNINGS[kind]}")


@pytest.mark.parametrize("distribution", STORES)
def test_every_distribution_knows_all_types_that_are_spoken(distribution: str) -> None:
    messages = Messages(distribution)
    for kind in SPOKEN:
        messages.require(kind)
        again = messages.decode(kind, messages.encode(messages.new(kind)))
        assert again.__msgtype__ == kind


def test_humble_has_no_hashes() -> None:
    messages = Messages("humble")
    assert messages.hash("std_msgs/msg/String") == NO_HASH
    assert messages.hash("std_srvs/srv/Trigger") == NO_HASH


@pytest.mark.parametrize("library", MODULES)
@pytest.mark.parametrize("kind", SPOKEN)
def test_cdr_is_that_of_other_libraries_byte_for_byte(kind: str, library: str) -> None:
    oracle = OtherCdr(library, JAZZY)

    @settings(max_examples=ROUND_TRIPS)
    @given(random_messages(JAZZY, kind))
    def compare(message: object) -> None:
        payload = JAZZY.encode(message)
        theirs = oracle.encode(oracle.of(message))
        assert payload == theirs
        assert plain(JAZZY.decode(kind, theirs)) == plain(message)
        assert plain(JAZZY.decode(kind, theirs + BEHIND)) == plain(message)
        assert plain(oracle.decode(kind, payload)) == plain(message)

    compare()


@given(
    st.sampled_from(SPOKEN), st.data(), st.binary(max_size=12), st.binary(min_size=2, max_size=2)
)
def test_messages_are_read_of_both_endiannesses_with_any_options_and_whatever_stands_behind(
    kind: str, data: st.DataObject, behind: bytes, options: bytes
) -> None:
    message = data.draw(random_messages(JAZZY, kind))
    for little_endian in (True, False):
        payload = bytes(JAZZY._store.serialize_cdr(message, kind, little_endian=little_endian))
        received = payload[:2] + options + payload[4:] + behind
        assert plain(JAZZY.decode(kind, received)) == plain(message)


def test_a_message_that_is_cut_off_or_of_another_representation_is_rejected() -> None:
    payload = JAZZY.encode(JAZZY.new("std_msgs/msg/Float64", data=1.5))
    for wrong in (payload[:-1], payload[:3], b"\0\7" + payload[2:]):
        with pytest.raises(CodecError, match="Float64"):
            JAZZY.decode("std_msgs/msg/Float64", wrong)


def test_a_joint_state_replayed_from_a_larger_buffer_is_read() -> None:
    payload = bytes.fromhex(
        "00010000 00000000 00000000 01000000 00000000 02000000 02000000 61000000 02000000 62000000"
        "02000000 9a999999 9999b93f 9a999999 9999c93f 00000000 00000000 23560000 803e4720"
    )
    joints = readers.read(JAZZY, "sensor_msgs/msg/JointState", payload)
    assert joints.names == ("a", "b")
    assert joints.position.tolist() == [0.1, 0.2]


@pytest.mark.parametrize("value", [0, 127, 128, 255])
def test_a_byte_has_no_sign(value: int) -> None:
    payload = JAZZY.encode(JAZZY.new("std_msgs/msg/Byte", data=value))
    assert payload[4] == value
    assert JAZZY.decode("std_msgs/msg/Byte", payload).data == value
    assert "byte data" in JAZZY.definition("std_msgs/msg/Byte")


def test_a_wstring_is_named() -> None:
    with pytest.raises(ProfileError, match="text is a wstring, which is not supported"):
        Messages("jazzy", {"lab_msgs/msg/Note": "wstring text"})


@given(st.sampled_from(MUTATED_KINDS), st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(kind: str, payload: bytes) -> None:
    _read(kind, payload)
    _read(kind, b"\x00\x01\x00\x00" + payload)


def _read(kind: str, payload: bytes) -> None:
    with contextlib.suppress(CodecError):
        readers.read(JAZZY, kind, payload)


def _mutated(payload: bytes, dice: random.Random) -> bytes:
    out = bytearray(payload)
    for _ in range(dice.randint(1, 4)):
        what, at = dice.randrange(4), dice.randrange(len(out)) if out else 0
        if what == 0 and out:
            out[at] = dice.randrange(256)
        elif what == 1:
            del out[at : at + dice.randint(1, 40)]
        elif what == 2:
            out[at:at] = dice.randbytes(dice.randint(1, 40))
        elif len(out) >= at + 4:
            out[at : at + 4] = dice.choice([b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f"])
    return bytes(out)


def _examples() -> dict[str, bytes]:
    """A full message of every type that is read."""
    header = JAZZY.new(
        "std_msgs/msg/Header",
        stamp=JAZZY.new("builtin_interfaces/msg/Time", sec=5, nanosec=7),
        frame_id="base",
    )
    joints = {"name": ["a", "b"], "position": np.ones(2), "velocity": np.ones(2)}
    png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x04\0\0\0\x04"
    fields = {
        "sensor_msgs/msg/JointState": {"header": header, **joints, "effort": np.ones(2)},
        "geometry_msgs/msg/WrenchStamped": {"header": header},
        "sensor_msgs/msg/Image": {
            "header": header,
            "height": 4,
            "width": 3,
            "encoding": "bgr8",
            "step": 9,
            "data": np.arange(36, dtype=np.uint8),
        },
        "sensor_msgs/msg/CompressedImage": {
            "header": header,
            "format": "png",
            "data": np.frombuffer(png, np.uint8),
        },
        "std_msgs/msg/String": {"data": "hold"},
        "std_msgs/msg/Bool": {"data": True},
    }
    assert set(fields) == set(MUTATED_KINDS)
    return {kind: JAZZY.encode(JAZZY.new(kind, **values)) for kind, values in fields.items()}


@pytest.mark.parametrize("count", [2_000, pytest.param(MUTATIONS, marks=pytest.mark.slow)])
def test_mutated_messages_are_read_or_refused(count: int) -> None:
    examples = list(_examples().items())
    dice = random.Random(5)
    refused = 0
    for turn in range(count):
        kind, payload = examples[turn % len(examples)]
        try:
            readers.read(JAZZY, kind, _mutated(payload, dice))
        except CodecError:
            refused += 1
    assert count / 10 < refused < count


def test_a_message_that_is_too_large_is_refused_before_it_is_read() -> None:
    with pytest.raises(CodecError, match="at most") as caught:
        JAZZY.decode("std_msgs/msg/String", bytes(MAX_MESSAGE_BYTES + 1))
    assert caught.value.reason == "oversize"


def test_a_value_that_does_not_fit_its_field_is_refused() -> None:
    with pytest.raises(CodecError, match="builtin_interfaces") as caught:
        JAZZY.encode(JAZZY.new("builtin_interfaces/msg/Time", sec=2**31))
    assert caught.value.reason == "unencodable"


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        ({"lab_msgs/msg/Goal": "float64 9x\n"}, "lab_msgs/msg/Goal is not a ROS message"),
        (
            {"lab_msgs/msg/Goal": "lab_msgs/Point at\n"},
            "lab_msgs/msg/Goal.at is a lab_msgs/msg/Poi",
        ),
        ({"lab_msgs/srv/Go": "float64 x\n"}, "lab_msgs/srv/Go: has 1 parts; wanted 2"),
        ({"lab_msgs/Goal": "float64 x\n"}, "'lab_msgs/Goal' is not a ROS type"),
        ({"std_msgs/msg/String": "float64 data\n"}, "different definition"),
    ],
)
def test_text_that_is_no_definition_is_told(extra: dict[str, str], said: str) -> None:
    with pytest.raises(ProfileError) as caught:
        Messages("jazzy", extra)
    assert said in str(caught.value)


def test_an_unknown_type_is_told_with_the_nearest_known_one() -> None:
    with pytest.raises(ProfileError, match="did you mean 'sensor_msgs/msg/JointState'"):
        JAZZY.require("sensor_msgs/msg/JointStates")
    with pytest.raises(ProfileError, match="not a ROS distribution"):
        Messages("noetic")


def test_every_type_that_is_read_exists() -> None:
    for kind in readers.READERS:
        JAZZY.require(kind)
