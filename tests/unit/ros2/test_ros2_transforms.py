"""Transforms of tf2: what is read, written, refused, and where a camera is mounted."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from vla_zenoh_ros2.messages import Messages
from vla_zenoh_ros2.transforms import (
    MAX_FRAMES,
    TF_MESSAGE,
    Edge,
    FrameTree,
    difference,
    placed,
    publishable,
    read_transforms,
    tf_message,
)

from vla_zenoh.errors import CodecError
from vla_zenoh.kinematics.so3 import rotation_from_rpy

M = Messages("jazzy")
QUARTER = rotation_from_rpy(np.array([0.0, 0.0, np.pi / 2]))


def edge(parent: str, child: str, x_m: float = 0.0, **how: Any) -> Edge:
    return Edge(parent, child, placed((x_m, 0.0, 0.0), np.eye(3)), **{"fixed": True, **how})


def tree(*edges: Edge) -> FrameTree:
    frames = FrameTree()
    for each in edges:
        frames.add(each)
    return frames


def message(
    parent: str = "base",
    child: str = "camera",
    quat: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0),
    position: tuple[float, ...] = (1.0, 2.0, 3.0),
    sec: int = 5,
) -> Any:
    """A TFMessage as it comes from ROS, with the first transform good and the second as given."""
    out = tf_message(M, [edge("base", "good"), edge(parent, child)], 5 * 10**9)
    given = out.transforms[1]
    for name, value in zip("xyzw", quat, strict=True):
        setattr(given.transform.rotation, name, value)
    for name, value in zip("xyz", position, strict=True):
        setattr(given.transform.translation, name, value)
    given.header.stamp.sec = sec
    return out


def test_transforms_are_read_as_they_were_written() -> None:
    sent = [Edge("base", "camera", placed((0.1, -0.2, 0.3), QUARTER), False, 7_000_000_009)]
    payload = M.encode(tf_message(M, sent, 7_000_000_009))
    (read,), faults = read_transforms(M.decode(TF_MESSAGE, payload), fixed=False)
    assert not faults
    assert (read.parent, read.child, read.fixed, read.stamp_ns) == (
        "base",
        "camera",
        False,
        7_000_000_009,
    )
    assert read.pose == pytest.approx(sent[0].pose, abs=1e-12)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"quat": (0.0, 0.0, 0.0, 0.0)}, "not of length 1"),
        ({"quat": (0.5, 0.5, 0.5, 0.6)}, "not of length 1"),
        ({"quat": (float("nan"), 0.0, 0.0, 1.0)}, "NaN"),
        ({"position": (float("inf"), 0.0, 0.0)}, "NaN"),
        ({"position": (1e300, 0.0, 0.0)}, "above 1e6"),
        ({"child": ""}, "no name"),
        ({"child": "/"}, "no name"),
        ({"child": "x" * 300}, "letters"),
        ({"child": "base"}, "its own parent"),
        ({"child": "/base"}, "its own parent"),
        ({"sec": -1}, "a stamp of"),
    ],
)
def test_a_transform_that_is_wrong_is_named_and_the_others_are_read(
    wrong: dict[str, Any], said: str
) -> None:
    edges, faults = read_transforms(message(**wrong), fixed=True)
    assert [each.child for each in edges] == ["good"]
    assert said in str(faults[0])


def test_a_leading_slash_is_no_part_of_a_name_and_a_quaternion_is_normalised() -> None:
    given = message("/base", "/camera", quat=(0.0, 0.0, 0.001, 1.0))
    (_, read), faults = read_transforms(given, fixed=True)
    assert not faults
    assert (read.parent, read.child) == ("base", "camera")
    assert read.pose[:3, :3] @ read.pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)


def test_a_pose_leads_up_and_down_the_tree() -> None:
    frames = tree(
        edge("world", "base", 1.0),
        Edge("world", "stand", placed((3.0, 0.0, 0.0), QUARTER), True),
        edge("stand", "camera", 0.5),
    )
    assert frames.pose("camera", "base")[:3, 3] == pytest.approx((2.0, 0.5, 0.0))
    assert frames.pose("base", "camera") == pytest.approx(
        np.linalg.inv(frames.pose("camera", "base"))
    )
    with pytest.raises(CodecError, match="no transforms lead"):
        frames.pose("camera", "elsewhere")


def test_a_camera_is_mounted_on_the_first_link_above_it_or_stands_in_the_base() -> None:
    frames = tree(
        edge("base", "hand", 0.4, fixed=False, stamp_ns=1),
        edge("hand", "mount", 0.1),
        edge("mount", "eye", 0.02),
        edge("world", "base", 1.0),
        edge("world", "tripod", 2.0),
    )
    link, pose = frames.mount("eye", {"base", "hand"}, "base")
    assert link == "hand"
    assert pose[0, 3] == pytest.approx(0.12)
    link, pose = frames.mount("tripod", {"base", "hand"}, "base")
    assert link == "base"
    assert pose[0, 3] == pytest.approx(1.0)
    with pytest.raises(CodecError, match="no transforms lead"):
        frames.mount("nowhere", {"base"}, "base")


def test_a_cycle_two_parents_and_what_is_older_are_named() -> None:
    frames = tree(edge("a", "b"), edge("b", "c"))
    with pytest.raises(CodecError, match="above its own parent"):
        frames.add(edge("c", "a"))
    frames.add(edge("x", "c"))
    assert frames.parents == {"c": {"b", "x"}}
    frames.add(edge("a", "d", fixed=False, stamp_ns=10))
    with pytest.raises(CodecError, match="older than the one before"):
        frames.add(edge("a", "d", fixed=False, stamp_ns=9))


def test_a_moving_transform_that_stopped_coming_is_not_used() -> None:
    frames = tree(
        edge("base", "gone", fixed=False, stamp_ns=10**9),
        edge("base", "alive", fixed=False, stamp_ns=9 * 10**9),
    )
    assert frames.pose("alive", "base") is not None
    with pytest.raises(CodecError, match=r"8\.0 s old"):
        frames.pose("gone", "base")


def test_a_clock_that_is_set_back_begins_anew() -> None:
    """As a simulation does that is reset: nothing of before is taken for new, or blocks it."""
    frames = tree(
        edge("base", "a", fixed=False, stamp_ns=100 * 10**9),
        edge("base", "b", fixed=False, stamp_ns=100 * 10**9),
        edge("b", "eye"),
    )
    frames.add(edge("base", "a", 0.5, fixed=False, stamp_ns=10**9))
    assert frames.pose("a", "base")[0, 3] == pytest.approx(0.5)
    with pytest.raises(CodecError, match="no transforms lead"):
        frames.pose("eye", "base")


def test_a_flood_of_frames_ends_at_a_limit() -> None:
    frames = tree(*(edge("base", f"frame{number}") for number in range(MAX_FRAMES)))
    with pytest.raises(CodecError, match="more than"):
        frames.add(edge("base", "one more"))


def test_no_frame_is_published_that_another_node_publishes_or_that_closes_a_cycle() -> None:
    ours = [edge("base", "link1"), edge("link1", "link2"), edge("link2", "top")]
    allowed, refused = publishable(ours, tree(edge("world", "link1"), edge("top", "link2x")))
    assert [each.child for each in allowed] == ["link2", "top"]
    assert refused == {"link1": "another node publishes it, in world"}
    _, refused = publishable(ours, tree(edge("top", "base")))
    assert list(refused) == ["top"]
    assert publishable(ours, FrameTree())[1] == {}


def test_a_difference_is_in_metres_and_radians() -> None:
    apart = difference(placed((0, 0, 0), np.eye(3)), placed((0.3, 0.4, 0.0), QUARTER))
    assert apart == pytest.approx((0.5, np.pi / 2))
