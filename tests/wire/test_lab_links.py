"""Between hosts: clocks that differ, links of their own for commands, pictures made smaller."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from access_check import check_access
from access_rehearsal import surprises
from camera_rig import PATIENCE_S, camera_rig, free_endpoint, grey, until

from vla_zenoh.bus.buffers import LatestSample
from vla_zenoh.bus.clock import MAX_HEARD
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session, second_link
from vla_zenoh.codec.image import decode_jpeg
from vla_zenoh.control.preflight import PeerSnapshot, reasons_of_worker
from vla_zenoh.keys import Kind
from vla_zenoh.policy import ActionSpec, CameraSpec, ModelSpec, ObservationSpec
from vla_zenoh.policy.observation import prepare_image, size_variant
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.profile.schema import CameraProfile
from vla_zenoh.security.roles import Act, access_control
from vla_zenoh.types import Header, Image, Stamped, Task

pytestmark = pytest.mark.long

AHEAD_NS = 60_000_000
"""How far the other clock is ahead in these tests; within the bound of the profile."""
STAMP_TOLERANCE_S = 0.02
JPEG_TOLERANCE = 8  # of 255


@contextmanager
def two_nodes() -> Iterator[tuple[Node, Node]]:
    """The command node and a robot's, each with a session of its own."""
    endpoint = free_endpoint()
    profile = override(
        load_profile("panda_sim"), {"session": {"listen": [endpoint], "connect": [endpoint]}}
    )
    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as here,
        open_session(profile.session) as there,
    ):
        near, far = Node("command", profile, here), Node("sim", profile, there)
        yield near, far
        near.close()
        far.close()


def set_ahead(node: Node, by_ns: int) -> None:
    """Its clock, as another host's would be."""
    node.clock.offset_ns += by_ns


def asked(node: Node, other: str) -> Any:
    def known() -> Any:
        node.clocks.poll()
        return node.clocks.offsets().get(other)

    node.clocks.track(other)
    return until(f"the clock of {other}", known)


def test_a_clock_that_is_ahead_is_measured_within_its_uncertainty() -> None:
    with two_nodes() as (near, far):
        set_ahead(far, AHEAD_NS)
        time.sleep(0.1)
        found = asked(near, "sim")
        assert abs(found.offset_s - AHEAD_NS / 1e9) <= found.uncertainty_s
        back = asked(far, "command")
        assert abs(back.offset_s + AHEAD_NS / 1e9) <= back.uncertainty_s


def test_stamps_of_another_host_are_read_on_the_own_clock() -> None:
    with two_nodes() as (near, far):
        set_ahead(far, AHEAD_NS)
        slot = near.subscribe(near.keys.task, LatestSample())
        asked(near, "sim")
        out = far.declare_publisher(far.keys.task, Kind.ORDER)
        until("a listener", lambda: out.has_subscribers)

        def exchange() -> Stamped[Task] | None:
            out.publish(Task(0, False, "hold", "scripted", 5.0))
            assert slot.wait(PATIENCE_S)
            arrival = slot.pop()
            assert arrival is not None
            near.clocks.poll()
            stamped = near.decode(Task, arrival)
            assert stamped is not None
            late_s = (stamped.received_ns - stamped.header.stamp_wall_ns) / 1e9
            return stamped if abs(late_s) < STAMP_TOLERANCE_S else None

        assert until("a stamp on our clock", exchange)


def test_a_clock_beyond_the_bound_is_told_and_its_stamps_stay() -> None:
    with two_nodes() as (near, far):
        set_ahead(far, 2_000_000_000)
        found = asked(near, "sim")
        peers = PeerSnapshot(frozenset({"sim"}), clocks={"sim": near.clocks.offsets()["sim"][:2]})
        reasons = reasons_of_worker(
            near.profile, "scripted", "hold", peers, None, time.time_ns(), 1.0
        )
        said = [reason for reason in reasons if "clock of node 'sim'" in reason]
        assert len(said) == 1
        assert "at most 0.1 s is allowed (timing.max_clock_offset_s)" in said[0]
        assert abs(found.offset_s - 2.0) <= found.uncertainty_s


def test_a_source_that_cannot_be_a_node_is_not_asked() -> None:
    with two_nodes() as (near, _):
        for name in ("", "a/b", "**", "x" * 100, "\n", "sim/../..", "command"):
            near.clocks.to_local_clock(Header(0, 0, f"{name}#1"), None)
        near.clocks.poll()
        assert near.clocks._peers == {}
        for number in range(500):
            near.clocks.to_local_clock(Header(0, 0, f"stranger{number}#1"), None)
        assert len(near.clocks._peers) == MAX_HEARD


def test_commands_and_pictures_travel_on_links_of_their_own() -> None:
    endpoint = free_endpoint()
    profile = override(
        load_profile("panda_sim"),
        {"session": {"listen": [endpoint], "connect": [endpoint], "separate_links": True}},
    )
    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as there,
        open_session(profile.session) as here,
    ):
        camera, worker = Node("camera", profile, there), Node("worker-far", profile, here)
        pictures = camera.declare_publisher(profile.keys.camera_jpeg("front"), Kind.FRAME)
        news = camera.declare_publisher(profile.keys.state_pose, Kind.STATE)
        seen = worker.subscribe(pictures.key, LatestSample(), Kind.FRAME)
        heard = worker.subscribe(news.key, LatestSample())
        until("a reader of both", lambda: pictures.has_subscribers and news.has_subscribers)
        for stream, slot in ((pictures, seen), (news, heard)):
            stream.publish(b"something")
            assert slot.wait(PATIENCE_S)
        port, own = endpoint.removeprefix("tcp/"), second_link(endpoint).removeprefix("tcp/")
        for node in (camera, worker):
            assert node.traffic.links() == sorted([f"tcp/{port}", f"tcp/{own}"])
        assert [str(link.dst) for link in there.info.links()] == [f"tcp/{port}"]
        camera.close()
        worker.close()


def chart(folder: Path) -> Path:
    """A picture with something in it: dark left, light right."""
    picture = np.concatenate([grey(40, 320, 480), grey(200, 320, 480)], axis=1)
    assert cv2.imwrite(str(folder / "chart.png"), picture)
    return folder


def test_jpeg_between_hosts_is_thinned_and_narrowed_as_the_profile_says(tmp_path: Path) -> None:
    camera = CameraProfile(
        source=f"file:{chart(tmp_path)}", rate_hz=50, jpeg_rate_hz=10, jpeg_width=160
    )
    with camera_rig({"front": camera}) as rig:
        raws, _raw = rig.listen(rig.profile.keys.camera_raw("front"))
        jpegs, _jpeg = rig.listen(rig.profile.keys.camera_jpeg("front"))
        until("pictures of both", lambda: len(jpegs) >= 10 and len(raws) >= 40)
        stamps = [frame.header.stamp_wall_ns for frame in jpegs]
        rate_hz = (len(stamps) - 1) / ((stamps[-1] - stamps[0]) / 1e9)
        assert rate_hz < 12.0  # of 50; a busy machine gives fewer
        assert decode_jpeg(jpegs[-1].payload).rgb.shape == (120, 160, 3)
        numbers = [frame.header.seq for frame in jpegs]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def test_a_model_on_another_host_gets_pictures_in_its_own_size(tmp_path: Path) -> None:
    wanted = CameraSpec(camera="front", width=224, height=224, resize="pad", colour="bgr")
    spec = ModelSpec(
        name="far",
        observation=ObservationSpec(cameras=(wanted,)),
        action=ActionSpec(horizon=1, dt_s=0.2, frame="tcp", rotation="rpy", gripper="none"),
    )
    camera = CameraProfile(source=f"file:{chart(tmp_path)}", rate_hz=50, fit_for_workers=True)
    with camera_rig({"front": camera}) as rig:
        form = size_variant(wanted)
        assert form == "224x224-pad"
        whole, _whole = rig.listen(rig.profile.keys.camera_jpeg("front"))
        fitted, _fitted = rig.listen(rig.profile.keys.camera_fitted("front", form))
        node = Node("worker-far", rig.profile, rig.watcher)
        out = node.declare_publisher(node.keys.spec("far"), Kind.TELEMETRY)
        until("the camera node", lambda: out.has_subscribers)
        out.publish(spec)
        until("fitted pictures", lambda: len(fitted) > 5 and len(whole) > 5)
        node.close()
        image = decode_jpeg(fitted[-1].payload)
        assert image.rgb.shape == (224, 224, 3)
        # What the worker makes of it is what it would have made of the whole picture.
        from_whole = prepare_image(decode_jpeg(whole[-1].payload), wanted)
        from_fitted = prepare_image(Image(image.rgb), wanted)
        assert np.median(np.abs(from_whole.astype(int) - from_fitted)) < JPEG_TOLERANCE
        assert len(fitted[-1].payload) < len(whole[-1].payload)


@pytest.fixture(scope="module")
def lab() -> Profile:
    return override(
        load_profile("panda_sim"),
        {
            "session": {
                "listen": ["tls/127.0.0.1:7447"],
                "connect": ["tls/127.0.0.1:7447"],
                "security": {"people": {"wall": "viewer", "stage": "replay"}},
            },
            "cameras": {"wrist": None},
        },
    )


def test_every_role_does_its_part_and_nothing_else_with_real_sessions(lab: Profile) -> None:
    verdicts = check_access(lab)
    assert not any(surprises(lab).values())
    assert {one.identity.node for one in verdicts} == {
        "sim",
        "camera",
        "command",
        "worker-scripted",
        "operator",
        "worker-teleop",  # the operator's own, to drive by hand
        "viewer",
        "replay",
    }
    for one in verdicts:
        assert one.faults == ()
        assert one.must > 0
        assert one.must_not > 0


@pytest.mark.slow
def test_a_rule_that_lets_a_viewer_delete_is_named(lab: Profile) -> None:
    rules: dict[str, Any] = access_control([lab])
    reset = lab.keys.reset
    more = {
        "id": "too much",
        "messages": ["delete"],
        "flows": ["ingress"],
        "permission": "allow",
        "key_exprs": [reset],
    }
    rules["rules"].append(more)
    for policy in rules["policies"]:
        if policy["subjects"] == ["viewer@wall"]:
            policy["rules"].append("too much")
    assert surprises(lab, rules)["viewer@wall"] == [("can", Act.DELETE, reset)]
    faults = {one.identity.node: one.faults for one in check_access(lab, rules)}
    assert faults.pop("viewer") == (
        f"viewer@wall can delete {reset} and must not: rule 'too much' allows it",
    )
    assert not any(faults.values())


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_everybody_of_every_robot_of_a_router_tries_the_keys_of_all(lab: Profile) -> None:
    other = override(
        lab,
        {
            "robot": {"name": "second"},
            "session": {"security": {"people": {"wall": "operator"}}},
        },
    )
    verdicts = check_access(lab, also=[other])
    assert not any(surprises(lab, also=[other]).values())
    named = {one.identity.common_name: one for one in verdicts}
    assert {"viewer@wall", "operator@wall", "sim@here"} <= set(named)
    assert [fault for one in verdicts for fault in one.faults] == []
    alone = {one.identity.common_name: one for one in check_access(lab)}
    assert named["viewer@wall"].must == alone["viewer@wall"].must  # of its own robot alone
    assert named["viewer@wall"].must_not > 2 * alone["viewer@wall"].must_not
    missing = check_access(lab, access_control([lab]), also=[other])
    faults = {one.identity.common_name: one.faults for one in missing}
    assert any("vla/second/" in fault and "no rule allows" in fault for fault in faults["sim@here"])


@pytest.mark.slow
def test_a_missing_rule_and_one_too_much_are_named(lab: Profile) -> None:
    rules: dict[str, Any] = access_control([lab])
    told = "vla/panda:worker-scripted@here:egress:declare_subscriber"
    for rule in rules["rules"]:
        if rule["id"] == told:
            rule["key_exprs"] = ["vla/panda/nothing"]
        if rule["id"].startswith("vla/panda:viewer@wall:") and rule["messages"][0] in (
            "declare_subscriber",
            "put",
        ):
            rule["key_exprs"].append(lab.keys.camera_jpeg("front"))
    faults = {one.identity.node: one.faults for one in check_access(lab, rules)}
    key = lab.keys.delta("scripted")
    found = surprises(lab, rules)
    assert ("cannot", Act.PUT, key) in found["worker-scripted@here"]
    assert found["viewer@wall"] == [("can", Act.SUBSCRIBE, lab.keys.camera_jpeg("front"))]
    assert (
        f"worker-scripted@here cannot {Act.PUT.value} {key}: no rule allows egress "
        f"declare_subscriber {key}"
    ) in faults["worker-scripted"]
    assert faults["viewer"] == (
        f"viewer@wall can subscribe {lab.keys.camera_jpeg('front')} and must not: rule "
        "'vla/panda:viewer@wall:ingress:declare_subscriber' allows it",
    )
    assert faults["sim"] == faults["command"] == ()
