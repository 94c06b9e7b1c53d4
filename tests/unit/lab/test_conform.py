"""The rules of the wire on recorded samples: each has a peer that breaks it, and no other does."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from vla_zenoh_conform import rules
from vla_zenoh_conform.rules import RuleFinding, Seen, Trial
from vla_zenoh_conform.samples import Arrived, Raw, arrived

from vla_zenoh.codec import message, records
from vla_zenoh.codec.image import encode_jpeg
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.policy import ActionSpec, ModelSpec
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.types import (
    ActionChunk,
    ClockReply,
    Depth,
    GripperState,
    Header,
    Image,
    JointState,
    NodeStatus,
    PoseState,
    Task,
)

PROFILE = load_profile("panda_sim")
KINEMATICS = make_kinematics(PROFILE)
HOME_RAD = np.array(PROFILE.robot.home_rad)
AT_NS = 1_700_000_000_000_000_000
MS = 1_000_000
SECONDS, HZ = 2.0, 50
CLOCK = (AT_NS, ClockReply(AT_NS + MS, AT_NS + MS), AT_NS + 2 * MS)

Change = Callable[[Arrived], Arrived | None]


def broken(findings: Iterable[RuleFinding]) -> set[str]:
    return {found.rule for found in findings if found.right is False}


def with_header(sample: Arrived, **changes: Any) -> Arrived:
    assert sample.header is not None
    return replace(sample, header=replace(sample.header, **changes))


def replace_camera(profile: Profile, **changes: Any) -> Profile:
    front = profile.cameras["front"].model_copy(update=changes)
    return profile.model_copy(update={"cameras": {**profile.cameras, "front": front}})


def number(sample: Arrived) -> int:
    assert sample.header is not None
    return sample.header.seq


def of(*keys: str) -> Callable[[Change], Change]:
    """Apply a change to samples of these keys only."""

    def only(change: Change) -> Change:
        return lambda sample: change(sample) if sample.key in keys else sample

    return only


# -- robot ------------------------------------------------------------------------------------
def robot_samples() -> Iterator[Arrived]:
    pose = KINEMATICS.forward(KINEMATICS.ordered(PROFILE.robot.arm_joints, HOME_RAD))
    states = {
        "state/joint": JointState(PROFILE.robot.arm_joints, HOME_RAD, np.zeros(7), None),
        "state/pose": PoseState(pose.position_m, quat_from_rotation(pose.rotation), np.zeros(6)),
        "state/gripper": GripperState(0.04, False, False),
    }
    for seq in range(int(SECONDS * HZ)):
        stamp_ns = AT_NS + seq * 20 * MS
        for key, record in states.items():
            yield Arrived(key, stamp_ns + MS, Header(stamp_ns, seq, "sim#1"), record)


def judged(change: Change, **seen: Any) -> set[str]:
    samples = [found for sample in robot_samples() if (found := change(sample)) is not None]
    fields: dict[str, Any] = {"node": "sim", "clocks": [CLOCK], "seconds": SECONDS, **seen}
    return broken(rules.robot(Seen(samples=samples, **fields), PROFILE, KINEMATICS))


def same(sample: Arrived) -> Arrived:
    return sample


def in_degrees(sample: Arrived) -> Arrived:
    record = sample.record
    if not isinstance(record, JointState):
        return sample
    return replace(sample, record=replace(record, position_rad=np.degrees(record.position_rad)))


def in_millimetres(sample: Arrived) -> Arrived:
    record = sample.record
    if not isinstance(record, PoseState):
        return sample
    return replace(sample, record=replace(record, position_m=1e3 * record.position_m))


POSE = of("state/pose")
ROBOTS: dict[str, tuple[Change, dict[str, Any], set[str]]] = {
    "as it should be": (same, {}, set()),
    "no token": (same, {"alive": False}, {"alive"}),
    "no clock": (same, {"clocks": []}, {"clock"}),
    "a clock that answers before it is asked": (
        *(same, {"clocks": [(AT_NS, ClockReply(AT_NS + MS, AT_NS), AT_NS + MS)]}),
        {"clock"},
    ),
    "one record is no record": (
        POSE(lambda s: replace(s, record=None, why="invalid: NaN") if number(s) == 5 else s),
        *({}, {"state/pose: records"}),
    ),
    "a field of another version": (
        *(POSE(lambda s: replace(s, unknown=("PoseState.temper",))), {}),
        {"state/pose: fields"},
    ),
    "two writers": (
        POSE(lambda s: with_header(s, source="sim#2") if number(s) > 50 else s),
        *({}, {"state/pose: source"}),
    ),
    "a source of another name": (
        *(POSE(lambda s: with_header(s, source="other#1")), {}),
        {"state/pose: source"},
    ),
    "a seq that goes back": (
        POSE(lambda s: with_header(s, seq=3) if number(s) == 50 else s),
        *({}, {"state/pose: seq"}),
    ),
    "stamps that stand": (
        POSE(lambda s: with_header(s, stamp_wall_ns=AT_NS) if number(s) in (1, 2) else s),
        *({}, {"state/pose: stamps"}),
    ),
    "stamps in milliseconds": (
        *(POSE(lambda s: with_header(s, stamp_wall_ns=AT_NS // 1_000_000 + number(s))), {}),
        {"state/pose: stamps", "states belong together"},
    ),
    "stamps of the future": (
        lambda s: with_header(s, stamp_wall_ns=AT_NS + (number(s) * 20 + 500) * MS),
        {},
        {f"{key}: stamps" for key in rules.ROBOT_KEYS},
    ),
    "ten states a second": (
        lambda s: s if number(s) % 5 == 0 else None,
        {},
        {f"{key}: rate" for key in rules.ROBOT_KEYS},
    ),
    "no gripper": (
        *(lambda s: None if s.key == "state/gripper" else s, {}),
        {"state/gripper: rate", "states belong together"},
    ),
    "stamps of their own": (
        POSE(lambda s: with_header(s, stamp_wall_ns=AT_NS + number(s) * 20 * MS + 1)),
        *({}, {"states belong together"}),
    ),
    "other joints": (
        of("state/joint")(lambda s: replace(s, record=replace(s.record, names=tuple("abcdefg")))),
        *({}, {"joint names"}),
    ),
    "degrees": (in_degrees, {}, {"joints in rad", "pose is that of the joints"}),
    "millimetres": (in_millimetres, {}, {"pose is that of the joints"}),
    "a gripper in centimetres": (
        of("state/gripper")(lambda s: replace(s, record=GripperState(0.8, False, False))),
        *({}, {"gripper width in m"}),
    ),
}


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_breaks_the_rules_that_it_breaks_and_no_other(name: str) -> None:
    change, seen, wanted = ROBOTS[name]
    assert judged(change, **seen) == wanted


# -- robot that is moved ------------------------------------------------------------------------
def trial(what: str, way: Callable[[float], float], mode: str = "ready") -> Trial:
    """A trial of 1 rad; the event is in the middle of it."""
    times_s = np.arange(0.0, 3.0, 0.01).tolist()
    return Trial(what, 1.0, [(t, way(t), mode) for t in times_s], 1.0, 0.1)


def follows(time_s: float) -> float:
    return rules.way_at(time_s)


def brakes(time_s: float) -> float:
    return min(rules.way_at(time_s), 0.6)


def stands(time_s: float) -> float:
    return 0.0


def creeps(time_s: float) -> float:
    return brakes(time_s) + 0.02 * time_s


@pytest.mark.parametrize("what", rules.TRIALS)
def test_a_robot_that_does_its_duty_breaks_no_rule(what: str) -> None:
    if what in (rules.FOLLOW, rules.AFTER_RESET):
        right = trial(what, follows)
    elif what in (rules.SILENT, rules.STOP):
        right = trial(what, brakes, "latched")
    else:
        right = trial(what, stands)
    assert not broken(rules.moved([right]))


@pytest.mark.parametrize(
    ("what", "way", "mode"),
    [
        (rules.FOLLOW, stands, "ready"),
        (rules.AFTER_RESET, stands, "latched"),
        *((what, follows, "ready") for what in (*rules.WRONG, rules.LATCHED)),
        (rules.SILENT, follows, "ready"),
        (rules.SILENT, creeps, "ready"),
        (rules.STOP, follows, "latched"),
        (rules.STOP, creeps, "latched"),
        (rules.STOP, brakes, "ready"),
    ],
)
def test_a_robot_that_neglects_its_duty_breaks_that_rule(
    what: str, way: Callable[[float], float], mode: str
) -> None:
    assert broken(rules.moved([trial(what, way, mode)])) == {what}


@pytest.mark.parametrize("what", rules.TRIALS)
def test_a_robot_whose_states_end_breaks_every_rule(what: str) -> None:
    assert broken(rules.moved([Trial(what, 1.0)])) == {what}


# -- worker -----------------------------------------------------------------------------------
SPEC = ModelSpec(name="pi0", action=ActionSpec(horizon=2, dt_s=0.1, gripper="none"))
TASK = Task(2, True, "go", "pi0", 10.0)
CHUNK = ActionChunk(
    *("pi0", SPEC.hash, 2, AT_NS, 1, AT_NS + 10**9, np.full((2, 6), 0.01, np.float32)),
    *(AT_NS + MS, AT_NS + 2 * MS, AT_NS + 3 * MS),
)


def worker_samples() -> Iterator[Arrived]:
    for seq in range(2):
        stamp_ns = AT_NS + seq * 1000 * MS
        yield Arrived("spec/pi0", stamp_ns, Header(stamp_ns, seq, "worker-pi0#1"), SPEC)
        yield Arrived("task", stamp_ns, Header(stamp_ns, seq, "command#1"), TASK)
    for seq in range(20):
        stamp_ns = AT_NS + (seq * 100 + 10) * MS
        shift = {name: getattr(CHUNK, name) + seq * 100 * MS for name in TIMES}
        header = Header(stamp_ns, seq, "worker-pi0#1")
        yield Arrived("delta/pi0", stamp_ns + MS, header, replace(CHUNK, **shift))


TIMES = (
    "observation_stamp_ns",
    "valid_until_ns",
    "observed_ns",
    "inference_start_ns",
    "inference_end_ns",
)


def chunks_with(**changes: Any) -> Change:
    return of("delta/pi0")(lambda s: replace(s, record=replace(s.record, **changes)))


WORKERS: dict[str, tuple[Change, dict[str, Any], set[str]]] = {
    "as it should be": (same, {}, set()),
    "no answer to a query of its spec": (same, {"replied": None}, {"spec on query"}),
    "no spec": (
        *(lambda s: None if s.key == "spec/pi0" else s, {}),
        {"spec/pi0: rate", "spec on query"},
    ),
    "half the rate": (
        lambda s: None if s.key == "delta/pi0" and number(s) % 2 else s,
        *({}, {"delta/pi0: rate"}),
    ),
    "the name of another worker": (chunks_with(worker="act"), {}, {"worker in chunks"}),
    "the hash of another spec": (chunks_with(spec_hash="0" * 16), {}, {"spec_hash"}),
    "an episode of its own": (chunks_with(episode=7), {}, {"episode"}),
    "an end before its start": (chunks_with(inference_end_ns=AT_NS), {}, {"times in order"}),
    "too many columns": (
        *(chunks_with(steps=np.zeros((2, 7), np.float32)), {}),
        {"steps as its spec says"},
    ),
    "millimetres": (
        *(chunks_with(steps=np.full((2, 6), 10.0, np.float32)), {}),
        {"steps as its spec says"},
    ),
}


@pytest.mark.parametrize("name", WORKERS)
def test_a_worker_breaks_the_rules_that_it_breaks_and_no_other(name: str) -> None:
    change, seen, wanted = WORKERS[name]
    samples = [found for sample in worker_samples() if (found := change(sample)) is not None]
    fields: dict[str, Any] = {"clocks": [CLOCK], "replied": SPEC, **seen}
    found = rules.worker(Seen("worker-pi0", samples, SECONDS, **fields), PROFILE)
    assert broken(found) == wanted


@pytest.mark.parametrize(
    ("percent", "every", "wanted"),
    [(50.0, 2, set()), (50.0, 1, set()), (50.0, 4, {"delta/pi0: rate"}), (0.0, 100, set())],
)
def test_at_a_lower_speed_override_a_worker_may_send_as_few_chunks_as_are_asked_for(
    percent: float, every: int, wanted: set[str]
) -> None:
    samples: list[Arrived] = []
    for sample in worker_samples():
        if sample.key == "task":
            samples.append(replace(sample, record=replace(TASK, speed_percent=percent)))
        elif sample.key != "delta/pi0" or (number(sample) + 1) % every == 0:
            samples.append(sample)
    seen = Seen("worker-pi0", samples, SECONDS, clocks=[CLOCK], replied=SPEC)
    assert broken(rules.worker(seen, PROFILE)) == wanted


# -- camera -----------------------------------------------------------------------------------
CAMERA = replace_camera(load_profile("panda_sim"), depth_unit_m=0.001, jpeg_width=320)
RAW, JPEG, DEPTH = (f"camera/front/{kind}" for kind in ("raw", "jpeg", "depth"))
STATUS = "status/camera"
IMAGES = 30


def image_of(key: str, shade: int) -> Image | Depth:
    if key == DEPTH:
        return Depth(np.full((480, 640), shade, np.uint16), 0.001)
    size = (480, 640, 3) if key == RAW else (240, 320, 3)
    return Image(np.full(size, shade, np.uint8))


def camera_status(detail: dict[str, Any]) -> Arrived:
    status = NodeStatus("camera", "running", "here", 1, AT_NS, {}, {}, {}, {}, detail)
    return Arrived(STATUS, AT_NS, Header(AT_NS, 0, "camera#1"), status)


def camera_samples() -> Iterator[Arrived]:
    yield camera_status({"cameras": {"front": {"age_s": 0.01}}})
    for seq in range(IMAGES):
        stamp_ns = AT_NS + seq * 10**9 // IMAGES
        for key in (RAW, JPEG, DEPTH):
            header = Header(stamp_ns, seq, "camera#1")
            yield Arrived(key, stamp_ns + MS, header, image_of(key, seq))


def frozen_but(changing: set[int]) -> Change:
    """Its images change at these numbers only."""

    def change(sample: Arrived) -> Arrived:
        if sample.key == STATUS:
            return sample
        shade = max((at for at in changing if at <= number(sample)), default=100)
        return replace(sample, record=image_of(sample.key, shade))

    return change


def change_of(*keys: str) -> set[str]:
    return {f"{key}: images change" for key in keys}


CAMERAS: dict[str, tuple[Change, set[str]]] = {
    "as it should be": (same, set()),
    "a third of the rate": (
        of(RAW)(lambda s: s if number(s) % 3 == 0 else None),
        {f"{RAW}: rate"},
    ),
    "a status without the age of its images": (
        of(STATUS)(lambda s: replace(s, record=replace(s.record, detail={}))),
        {"status: age of its images"},
    ),
    "an age that is no number": (
        of(STATUS)(lambda s: camera_status({"cameras": {"front": {"age_s": "new"}}})),
        {"status: age of its images"},
    ),
    "no JPEG": (lambda s: None if s.key == JPEG else s, {f"{JPEG}: rate"}),
    "no depth, which the profile declares": (
        *(lambda s: None if s.key == DEPTH else s,),
        {f"{DEPTH}: rate"},
    ),
    "a JPEG that is no image": (
        of(JPEG)(lambda s: replace(s, record=None, why="truncated: no end")),
        {f"{JPEG}: records"},
    ),
    "a JPEG as wide as the raw image": (
        of(JPEG)(lambda s: replace(s, record=image_of(RAW, number(s)))),
        {f"{JPEG}: size"},
    ),
    "raw images of half the size": (
        of(RAW)(lambda s: replace(s, record=image_of(JPEG, number(s)))),
        {f"{RAW}: size"},
    ),
    "another unit": (
        of(DEPTH)(lambda s: replace(s, record=Depth(s.record.counts, 0.01))),
        {f"{DEPTH}: unit"},
    ),
    "all images are the same": (of(RAW)(frozen_but(set())), change_of(RAW)),
    "all but one repeat": (of(RAW)(frozen_but({9})), change_of(RAW)),
    "all but one repeat, in every stream": (frozen_but({20}), change_of(RAW, JPEG, DEPTH)),
    "every second one repeats": (of(JPEG)(frozen_but(set(range(0, 30, 2)))), change_of(JPEG)),
    "one repeats": (of(JPEG)(frozen_but(set(range(30)) - {7})), set()),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_a_camera_breaks_the_rules_that_it_breaks_and_no_other(name: str) -> None:
    change, wanted = CAMERAS[name]
    samples = [found for sample in camera_samples() if (found := change(sample)) is not None]
    seen = Seen("camera", samples, 1.0, clocks=[CLOCK])
    assert broken(rules.camera(seen, "front", CAMERA)) == wanted


def test_a_camera_without_depth_in_the_profile_is_not_asked_for_it() -> None:
    samples = [sample for sample in camera_samples() if sample.key != DEPTH]
    profile = replace_camera(CAMERA, depth_unit_m=None)
    seen = Seen("camera", samples, 1.0, clocks=[CLOCK])
    assert not broken(rules.camera(seen, "front", profile))


def test_a_camera_without_images_is_quoted_with_what_its_status_says() -> None:
    why = "an image of type int64 cannot be shown"
    detail = {"cameras": {"front": {"why": why}}}
    said = camera_status(detail)
    found = list(rules.camera(Seen("camera", [said], 1.0, clocks=[CLOCK]), "front", CAMERA))
    assert broken(found) == {f"{key}: rate" for key in (RAW, JPEG, DEPTH)}
    assert all(why in each.text for each in found if each.right is False)


@pytest.mark.parametrize(
    ("key", "encoding"),
    [(RAW, "image/jpeg"), (JPEG, "zenoh/bytes;rgb8;480x640"), (DEPTH, "image/jpeg"), (JPEG, "")],
)
def test_an_image_of_another_encoding_than_its_key_says_is_named(key: str, encoding: str) -> None:
    header = records.encode_header(Header(AT_NS, 1, "camera#1"))
    found = arrived(
        Raw(key, encode_jpeg(Image(np.zeros((4, 4, 3), np.uint8))), header, encoding, 1)
    )
    assert found.record is None
    assert "encoding" in found.why


def test_bytes_that_are_no_record_are_named() -> None:
    header = records.encode_header(Header(AT_NS, 1, "sim#1"))
    for payload, why in ((b"\xc1", "malformed"), (message.pack({"width_m": 0.0}), "lacks")):
        found = arrived(Raw("state/gripper", payload, header, "", AT_NS))
        assert found.record is None
        assert why in found.why
