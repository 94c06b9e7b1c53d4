"""Keys, liveliness tokens and attachments of both ways in, letter by letter."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from vla_zenoh_ros2.keys import (
    COMMAND,
    DEFAULT,
    GID_BYTES,
    SENSOR,
    Attachment,
    Endpoint,
    EntityRole,
    RmwZenoh,
    Ros2Dds,
    dds_type,
    gid_of,
    parts_of,
)

from vla_zenoh.errors import CodecError, ProfileError

HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
ZID = "f9980ee0495eaafb3e38f0d19e2eae12"
CHATTER = Endpoint(EntityRole.PUBLISHER, "/chatter", "std_msgs/msg/String")
MOVE = Endpoint(EntityRole.ACTION_CLIENT, "/panda_gripper/move", "franka_msgs/action/Move")

bridge = Ros2Dds(ZID, lambda kind: HASH)
rmw = RmwZenoh(ZID, "vla_panda", 2, lambda kind: HASH)


def test_a_type_is_written_as_dds_does() -> None:
    assert dds_type("sensor_msgs/msg/Image") == "sensor_msgs::msg::dds_::Image_"
    assert dds_type("franka_msgs/action/Move_SendGoal") == (
        "franka_msgs::action::dds_::Move_SendGoal_"
    )
    with pytest.raises(ProfileError, match="not a ROS type"):
        dds_type("Image")


def test_a_bridges_key_is_the_name_without_its_first_slash() -> None:
    assert bridge.key(CHATTER) == "chatter"
    assert bridge.key(parts_of(MOVE)["send_goal"]) == "panda_gripper/move/_action/send_goal"


@pytest.mark.parametrize(
    ("endpoint", "rest"),
    [
        (CHATTER, f"MP/chatter/std_msgs§msg§String/:1:0:0,10:typehash={HASH};"),
        (
            Endpoint(EntityRole.SUBSCRIBER, "/a/b", "sensor_msgs/msg/Image", SENSOR),
            f"MS/a§b/sensor_msgs§msg§Image/:0:0:0,5:typehash={HASH};",
        ),
        (
            Endpoint(EntityRole.SERVER, "/vla/stop", "std_srvs/srv/Trigger"),
            "SS/vla§stop/std_srvs§srv§Trigger",
        ),
        (MOVE, "AC/panda_gripper§move/franka_msgs§action§Move"),
    ],
)
def test_a_token_tells_a_bridge_what_to_route(endpoint: Endpoint, rest: str) -> None:
    assert bridge.token(endpoint, 7) == f"@/{ZID}/@ros2_lv/{rest}"


def test_without_hashes_a_bridges_token_has_none() -> None:
    token = Ros2Dds(ZID, None).token(CHATTER, 1)
    assert token == f"@/{ZID}/@ros2_lv/MP/chatter/std_msgs§msg§String/:1:0:0,10"
    assert bridge.node_token() == f"@/{ZID}/@ros2_lv"


def test_a_key_of_rmw_zenoh_names_domain_type_and_hash() -> None:
    assert rmw.key(CHATTER) == f"2/chatter/std_msgs::msg::dds_::String_/{HASH}"
    goal = parts_of(MOVE)["get_result"]
    assert rmw.key(goal) == (
        f"2/panda_gripper/move/_action/get_result/franka_msgs::action::dds_::Move_GetResult_/{HASH}"
    )


def test_a_token_of_rmw_zenoh_is_that_of_its_design() -> None:
    server = Endpoint(EntityRole.SERVER, "/add_two_ints", "example_interfaces/srv/AddTwoInts")
    assert RmwZenoh(ZID, "add_two_ints_server", 2, lambda kind: HASH).token(server, 10) == (
        f"@ros2_lv/2/{ZID}/0/10/SS/%/%/add_two_ints_server/%add_two_ints/"
        f"example_interfaces::srv::dds_::AddTwoInts_/{HASH}/::,10:,:,:,,"
    )
    assert rmw.node_token() == f"@ros2_lv/2/{ZID}/0/0/NN/%/%/vla_panda"


def test_tokens_of_two_endpoints_differ() -> None:
    assert rmw.token(CHATTER, 1) != rmw.token(CHATTER, 2)


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (DEFAULT, "::,10:,:,:,,"),
        (COMMAND, "::,1:,:,:,,"),
        (SENSOR, "2::,5:,:,:,,"),
    ],
)
def test_what_is_the_default_is_left_out_of_rmw_zenohs_qos(qos: object, text: str) -> None:
    assert qos.as_rmw_zenoh() == text  # pyright: ignore


@given(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1), st.binary(min_size=16, max_size=16))
def test_an_attachment_comes_back(seq: int, stamp_ns: int, gid: bytes) -> None:
    payload = Attachment(seq, stamp_ns, gid).encode()
    assert len(payload) == 33
    assert Attachment.decode(payload) == Attachment(seq, stamp_ns, gid)


def test_an_attachment_has_the_layout_that_zenoh_serialises() -> None:
    import zenoh.ext as ext

    gid = bytes(range(16))
    theirs = ext.z_serialize((ext.Int64(3), ext.Int64(9), gid)).to_bytes()
    assert Attachment(3, 9, gid).encode() == theirs


@given(st.binary(max_size=40))
def test_other_bytes_are_no_attachment(payload: bytes) -> None:
    try:
        Attachment.decode(payload)
    except CodecError as error:
        assert error.reason == "malformed"  # noqa: PT017
    else:
        assert len(payload) == 33


def test_a_missing_attachment_is_told() -> None:
    with pytest.raises(CodecError) as caught:
        Attachment.decode(None)
    assert caught.value.reason == "no_attachment"


def test_a_gid_is_made_of_the_token() -> None:
    assert gid_of("a") == gid_of("a") != gid_of("b")
    assert len(gid_of("a")) == GID_BYTES
