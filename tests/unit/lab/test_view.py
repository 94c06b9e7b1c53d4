"""What a run's samples become in Rerun, read back from its file."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
import rerun as rr
from view_rig import Shown
from vla_zenoh_view.rerun_logger import DRAW_NS, RerunLogger
from vla_zenoh_view.robot_model import archetype_of

from vla_zenoh.codec import records
from vla_zenoh.codec.image import depth_schema, encode_depth, encode_jpeg
from vla_zenoh.errors import ResourceError
from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.lab.recording.sample import JPEG, MSGPACK, TEXT, Sample
from vla_zenoh.lab.recording.writer import RecordingWriter
from vla_zenoh.policy import ActionSpec, ModelSpec
from vla_zenoh.profile import (
    Profile,
    load_profile,
    override,
)
from vla_zenoh.types import (
    LATENCY_STAGES,
    ActionChunk,
    Cause,
    Depth,
    Event,
    GripperCommand,
    GripperState,
    Header,
    Image,
    InferenceDebug,
    JointCommand,
    JointState,
    NodeStatus,
    ObjectPoses,
    PoseCommand,
    PoseState,
    Task,
)

WITH_MESHES = "example-robot-data:panda_description/urdf/panda.urdf"
PROFILE = override(load_profile("panda_sim"), {"robot": {"description": WITH_MESHES}})
BARE = override(PROFILE, {"robot": {"description": "/nowhere/arm.urdf"}})
KEYS = PROFILE.keys
ZERO_NS = 1_700_000_000_000_000_000
MS = 1_000_000
SECOND = 1000 * MS
DOWN = np.array([1.0, 0.0, 0.0, 0.0])
HOME_TCP_M = (0.43, 0.0, 0.16)
STEP_M = 0.01
POSITION_TOLERANCE_M = 1e-6
TCP_TOLERANCE_M = 1e-3
"""The profile gives its home to ten digits, its comment the TCP to a centimetre's hundredth."""
FINGER_MM = 20.0
SPEC = ModelSpec(name="scripted", action=ActionSpec(horizon=3, dt_s=0.2, gripper="none"))


def put(key: str, record: Any, at_ns: int, seq: int = 0, source: str = "node#1") -> Sample:
    header = Header(ZERO_NS + at_ns, seq, source)
    return Sample(key, records.encode(record), MSGPACK, header, ZERO_NS + at_ns + MS)


def picture(key: str, at_ns: int, seq: int = 0) -> Sample:
    jpeg = encode_jpeg(Image(np.full((48, 64, 3), 128, np.uint8)))
    return Sample(key, jpeg, JPEG, Header(ZERO_NS + at_ns, seq, "c#1"), ZERO_NS + at_ns + MS)


def goal_m(at_ns: int) -> np.ndarray:
    """The goal goes up by a step every 0.2 s."""
    return np.array([0.43, 0.0, 0.16 + STEP_M * (1 + at_ns // (200 * MS))])


def command(at_ns: int, cause: Cause | None = None) -> PoseCommand:
    goal = goal_m(at_ns)
    return PoseCommand(goal - 0.002, DOWN, np.zeros(6), np.zeros(6), goal, DOWN, "active", cause)


def chunk(at_ns: int, seq: int, **more: Any) -> Sample:
    rows = np.zeros((3, 6), np.float32)
    rows[:, 2] = STEP_M
    of: dict[str, Any] = {
        "worker": "scripted",
        "spec_hash": SPEC.hash,
        "episode": 1,
        "observation_stamp_ns": ZERO_NS + at_ns - 50 * MS,
        "observation_seq": seq,
        "valid_until_ns": ZERO_NS + at_ns + SECOND,
        "steps": rows,
        "observed_ns": ZERO_NS + at_ns - 40 * MS,
        "inference_start_ns": ZERO_NS + at_ns - 40 * MS,
        "inference_end_ns": ZERO_NS + at_ns - 10 * MS,
    }
    record = ActionChunk(**{**of, **more})
    return put(KEYS.delta(record.worker), record, at_ns, seq)


def status(**more: Any) -> NodeStatus:
    detail = {"speed_share": 0.25, "why": "waiting for a chunk"}
    counters = {"refused.stale": 3, "skipped.superseded": 2, "refused.schema": 0}
    said = {"node": "command", "state": "active", "host": "lab", "pid": 1, "started_wall_ns": 1}
    return NodeStatus(**{**said, "counters": counters, "detail": detail, **more})


def run() -> Iterable[Sample]:
    """A second of a robot that works, with what strangers put among it."""
    joints = PROFILE.robot.arm_joints
    angles = np.array(PROFILE.robot.home_rad)
    for setting, text in (("prompt", "HARD: go *up*"), ("active", "true")):
        yield Sample(KEYS.full(setting), text.encode(), TEXT, None, ZERO_NS)
    yield put(KEYS.task, Task(1, True, "HARD: go *up*", "scripted", 5.0), 0)
    yield put(KEYS.spec("scripted"), SPEC, 0)
    for index in range(200):
        at_ns = index * 5 * MS
        pose = PoseState(goal_m(at_ns) - 0.003, DOWN, np.full(6, 0.1))
        yield put(KEYS.state_pose, pose, at_ns, index)
        yield put(
            KEYS.state_joint,
            JointState(joints, angles, np.zeros(7), np.zeros(7)),
            at_ns,
            index,
        )
        yield put(KEYS.state_gripper, GripperState(0.04, False, False), at_ns, index)
        yield put(KEYS.command_pose, command(at_ns), at_ns, index)
    objects = ObjectPoses(
        ("red_brick", "puck"),
        np.array([[0.5, 0.1, 0.01], [-1.2, 0.6, 0.0]]),
        np.array([[0.0, 0, 0, 1]] * 2),
    )
    yield put(KEYS.sim_objects, objects, SECOND)
    yield chunk(SECOND, 1)
    cause = Cause("scripted", 1, *(ZERO_NS + SECOND + ms * MS for ms in (-50, -40, -40, -10)),
                  ZERO_NS + SECOND, ZERO_NS + SECOND + MS)  # fmt: skip
    yield put(KEYS.command_pose, command(SECOND, cause), SECOND + 5 * MS, 201)
    yield put(KEYS.command_pose, command(SECOND, cause), SECOND + 9 * MS, 202)
    yield put(KEYS.command_gripper, GripperCommand(0.08, 0.1, 20.0), SECOND)
    yield picture(KEYS.camera_jpeg("front"), SECOND)
    yield picture(KEYS.camera_jpeg("extra"), SECOND)
    yield picture(KEYS.seen("scripted", "front"), SECOND)
    seen = InferenceDebug(
        "scripted", 1, SPEC.hash, 1, ZERO_NS, "go up", np.zeros((3, 6)), 30.0, {"a": 1.5}
    )
    yield put(KEYS.seen_record("scripted"), seen, SECOND)
    bound = Event("warning", "limit", "singularity", "panda_joint4", 0.02, 0.05, 4)
    yield put(KEYS.event("command"), bound, SECOND)
    yield put(KEYS.status("command"), status(), SECOND + MS)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Shown:
    """The run, written as a recording, read from it, and shown."""
    folder = tmp_path_factory.mktemp("view")
    writer = RecordingWriter(
        folder / "run.mcap", KEYS, profile_yaml="about: x\n", base_frame="base", began_ns=ZERO_NS
    )
    for sample in run():
        writer.write(sample)
    writer.finish({"dropped": {}})
    show = RerunLogger(PROFILE, stream := stream_to(folder / "run.rrd"))
    for entry in open_recording(folder / "run.mcap").entries():
        show.log(entry)
    assert show.rejected == {}
    stream.disconnect()
    return Shown(folder / "run.rrd")


def stream_to(path: Path) -> rr.RecordingStream:
    stream = rr.RecordingStream("test")
    stream.save(path)
    return stream


def heard(tmp_path: Path, *samples: Sample, profile: Profile = BARE) -> tuple[RerunLogger, Shown]:
    """Samples off the wire, shown."""
    show = RerunLogger(profile, stream := stream_to(tmp_path / "a.rrd"), live=True)
    for sample in samples:
        show.log(sample)
    show.close()
    stream.disconnect()
    return show, Shown(tmp_path / "a.rrd")


# -- the robot ------------------------------------------------------------------------------------
def test_every_link_has_a_mesh_once_and_a_place_at_all_times(shown: Shown) -> None:
    below = {path for path in shown.paths if path.startswith("world/robot/")}
    meshes = {path for path in below if path.count("/") == 3}
    links = {path.rpartition("/")[0] for path in meshes}
    assert len(meshes) == len(links)
    assert {
        f"world/robot/panda_{name}" for name in ("link0", "link7", "hand", "leftfinger")
    } < links
    for mesh in meshes:
        assert shown.static(mesh) >= {"Asset3D:blob", "Asset3D:media_type"}
    for link in links:
        assert "Transform3D:translation" not in shown.static(link), "it would hide the moving one"
        assert len(shown.stamps_ns(link)) > 5


def test_the_hand_stands_where_kinematics_has_it(shown: Shown) -> None:
    (hand,) = shown.values("world/robot/panda_hand", "Transform3D:translation")[-1]
    assert hand[:2] == pytest.approx(HOME_TCP_M[:2], abs=TCP_TOLERANCE_M)
    (left,) = shown.values("world/robot/panda_leftfinger", "Transform3D:translation")[-1]
    (right,) = shown.values("world/robot/panda_rightfinger", "Transform3D:translation")[-1]
    assert math.dist(left, right) * 1e3 == pytest.approx(2 * FINGER_MM, abs=1e-3)


@pytest.mark.parametrize(
    ("shape", "component", "value"),
    [
        (coal.Box(0.1, 0.2, 0.3), "Boxes3D:half_sizes", [0.05, 0.1, 0.15]),
        (coal.Cylinder(0.1, 0.4), "Cylinders3D:lengths", 0.4),
        (coal.Sphere(0.1), "Ellipsoids3D:half_sizes", [0.1, 0.1, 0.1]),
        (coal.Capsule(0.1, 0.2), "Capsules3D:lengths", 0.2),
    ],
    ids=["box", "cylinder", "sphere", "capsule"],
)
def test_primitive_shapes_have_their_size(
    tmp_path: Path, shape: Any, component: str, value: Any
) -> None:
    stream = stream_to(tmp_path / "a.rrd")
    stream.set_time("time", timestamp=1)
    stream.log("shape", archetype_of(pin.GeometryObject("a", 0, pin.SE3.Identity(), shape)))
    stream.disconnect()
    ((found,),) = Shown(tmp_path / "a.rrd").values("shape", component)
    assert found == pytest.approx(value)


def test_a_shape_that_rerun_cannot_draw_is_named() -> None:
    shape = pin.GeometryObject("hull", 0, pin.SE3.Identity(), coal.Cone(0.1, 0.2))
    with pytest.raises(ResourceError, match=r"the shape hull \(Cone\) cannot be drawn"):
        archetype_of(shape)


def test_a_camera_is_drawn_on_its_link_with_what_its_lens_sees(tmp_path: Path) -> None:
    lens = {"width": 640, "height": 480, "fx_px": 500, "fy_px": 501, "cx_px": 321, "cy_px": 241}
    (tmp_path / "lens.yaml").write_text(json.dumps(lens))
    mount = {"frame": "eye", "link": "panda_hand", "position_m": [0.05, 0.0, 0.04]}
    camera = {
        "source": "file:clip.mp4",
        "intrinsics": str(tmp_path / "lens.yaml"),
        "crop": {"left": 100, "top": 0, "width": 320, "height": 480},
        "width": 160,
        "height": 240,
        "mount": {**mount, "rpy_rad": [0.0, 0.0, 1.5708]},
    }
    profile = override(PROFILE, {"cameras": {"eye": camera}})
    _, shown = heard(tmp_path, profile=profile)
    eye = "world/robot/panda_hand/camera/eye"
    assert {"Transform3D:translation", "Transform3D:mat3x3"} <= shown.static(eye)
    ((matrix,),) = shown.held(f"{eye}/lens", "Pinhole:image_from_camera")
    np.testing.assert_allclose(matrix, [250, 0, 0, 0, 250.5, 0, 110.5, 120.5, 1])


def test_what_the_arm_keeps_out_of_is_drawn_where_it_is(tmp_path: Path) -> None:
    shapes = {
        "post": {"centre_m": [0.4, 0.5, 0.4], "box_m": [0.1, 0.2, 0.8], "yaw_rad": math.pi / 2},
        "lamp": {"centre_m": [0.3, 0.0, 1.1], "radius_m": 0.15},
        "wall": {"centre_m": [-0.5, 0.0, 0.0], "normal": [1, 0, 0]},
    }
    profile = override(BARE, {"limits": {"reach": {"keep_out": shapes}}})
    show = RerunLogger(profile, stream := stream_to(tmp_path / "a.rrd"))
    show.close()
    stream.disconnect()
    shown = Shown(tmp_path / "a.rrd")
    assert "Boxes3D:half_sizes" in shown.static("world/keep_out/post")
    assert "Ellipsoids3D:half_sizes" in shown.static("world/keep_out/lamp")
    assert "Boxes3D:half_sizes" in shown.static("world/keep_out/wall")


def test_without_a_description_all_else_is_shown(tmp_path: Path) -> None:
    show, shown = heard(tmp_path, *run())
    assert show.rejected == {}
    assert not any(path.startswith("world/robot") for path in shown.paths)
    assert shown.values("world/pose/measured", "Transform3D:translation")
    assert "The robot itself is not shown" in shown.texts("text/now")[-1]


# -- poses, chunks --------------------------------------------------------------------------------
def test_states_and_commands_are_thinned_out_evenly(shown: Shown) -> None:
    drawn = shown.values("world/pose/measured", "Transform3D:translation")
    assert len(drawn) == pytest.approx(SECOND / DRAW_NS, rel=0.15)
    assert shown.values("world/pose/goal", "Transform3D:translation")[0][0] == pytest.approx(
        goal_m(0), abs=POSITION_TOLERANCE_M
    )


def test_trails_follow_the_poses(shown: Shown) -> None:
    for name in ("goal", "commanded", "measured"):
        (strip,) = shown.values(f"world/trail/{name}", "LineStrips3D:strips")[-1]
        heights = [point[2] for point in strip]
        assert heights == sorted(heights)
        assert heights[-1] - heights[0] == pytest.approx(4 * STEP_M, abs=STEP_M + 1e-6)


def test_a_chunk_is_a_ribbon_from_the_goal_its_observation_saw(shown: Shown) -> None:
    ((strip,),) = shown.values("world/chunk/scripted", "LineStrips3D:strips")
    expected = [goal_m(SECOND - 50 * MS) + (0, 0, STEP_M * step) for step in range(4)]
    np.testing.assert_allclose(strip, expected, atol=POSITION_TOLERANCE_M)


@pytest.mark.parametrize("seen_ms", [200, 400])
def test_a_chunk_in_the_middle_of_another_stands_on_what_that_had_asked_for(
    tmp_path: Path, seen_ms: int
) -> None:
    """The command stream says where a step ends; half of it is done when the observation is."""
    start_ns = 150 * MS
    shown = heard(
        tmp_path,
        put(KEYS.spec("scripted"), SPEC, 0),
        put(KEYS.command_pose, command(0), 0),
        chunk(start_ns, 1),  # the first one, so it begins then: its step 2 ends at 550 ms
        put(KEYS.command_pose, command(200 * MS), start_ns, 1),
        chunk(seen_ms * MS + 50 * MS, 2),
    )[1]
    _, ((second, *_),) = shown.values("world/chunk/scripted", "LineStrips3D:strips")
    # At 200 ms a quarter of the first step is asked for, at 400 ms one and a quarter of two.
    assert second[2] == pytest.approx(goal_m(200 * MS)[2] - 0.75 * STEP_M, abs=POSITION_TOLERANCE_M)


def test_a_ribbon_that_nobody_renews_is_taken_away(tmp_path: Path) -> None:
    pose = PoseState(goal_m(0), DOWN, np.zeros(6))
    _, shown = heard(
        tmp_path,
        put(KEYS.spec("scripted"), SPEC, 0),
        put(KEYS.command_pose, command(0), 0),
        chunk(100 * MS, 1),
        put(KEYS.state_pose, pose, SECOND),
        put(KEYS.state_pose, pose, 3 * SECOND, 1),
    )
    (cleared,) = shown.values("world/chunk/scripted", "Clear:is_recursive")
    assert cleared == [True]


def test_joint_commands_are_shown_as_the_pose_they_lead_to(tmp_path: Path) -> None:
    home = np.array(PROFILE.robot.home_rad)
    still = np.zeros(7)
    told = JointCommand(PROFILE.robot.arm_joints, home, still, still, "active")
    _, shown = heard(tmp_path, put(KEYS.command_joint, told, 0), profile=PROFILE)
    ((position,),) = shown.values("world/pose/commanded", "Transform3D:translation")
    assert position == pytest.approx(HOME_TCP_M, abs=TCP_TOLERANCE_M)


# -- figures and words ----------------------------------------------------------------------------
def test_latencies_are_those_of_a_chunks_first_command(shown: Shown) -> None:
    found = [shown.scalars(f"plot/latency/{name}") for name in LATENCY_STAGES]
    # The answer of the model takes 11 ms to the command node and 4 ms more to the command.
    assert found == [[10.0], [30.0], [11.0], [4.0], [55.0]]


def test_figures_have_the_units_of_their_titles(shown: Shown) -> None:
    assert shown.scalars("plot/gripper/measured")[-1] == pytest.approx(40.0)
    assert shown.scalars("plot/gripper/commanded") == pytest.approx([80.0])
    assert shown.scalars("plot/speed/measured")[-1] == pytest.approx(100.0 * math.sqrt(3))
    assert shown.scalars("plot/bounds/share") == pytest.approx([25.0])
    assert shown.scalars("plot/joints/panda_joint4")[-1] == pytest.approx(PROFILE.robot.home_rad[3])
    assert shown.scalars("plot/tracking/distance")[-1] == pytest.approx(math.sqrt(3), abs=1e-6)


def test_now_says_prompt_state_bounds_and_refusals(shown: Shown) -> None:
    now = shown.texts("text/now")[-1]
    for words in ("HARD: go \\*up\\*", "**active**, waiting for a chunk", "scripted at 5 Hz"):
        assert words in now
    assert "Bounds acting: singularity panda\\_joint4" in now
    assert "Refused by the command node: stale 3" in now
    assert "schema" not in now


def test_events_and_settings_stand_in_the_log(shown: Shown) -> None:
    assert shown.texts("events/command") == [
        "command: singularity panda_joint4 (0.02, limit 0.05) x4"
    ]
    assert shown.texts("events/settings") == ["prompt: HARD: go *up*", "active: true"]


def test_pictures_and_the_models_view_are_there(shown: Shown) -> None:
    for path in ("camera/front", "camera/extra", "seen/scripted/front"):
        (media,) = shown.values(path, "EncodedImage:media_type")
        assert media == ["image/jpeg"]
    (answer,) = shown.texts("seen/scripted/answer")
    assert "30.0 ms, 3 steps" in answer
    assert '{"a": 1.5}' in answer


# -- what cannot be shown -------------------------------------------------------------------------
def test_broken_samples_are_counted_by_key_and_reason_and_shown(tmp_path: Path) -> None:
    header = Header(ZERO_NS, 0, "x#1")
    broken = [
        Sample(KEYS.state_pose, b"\xff\xff", MSGPACK, header, ZERO_NS),
        Sample(KEYS.state_pose, b"", MSGPACK, None, ZERO_NS),
        Sample(KEYS.camera_jpeg("front"), b"no picture", JPEG, header, ZERO_NS),
        Sample(KEYS.full("camera/front"), b"", JPEG, header, ZERO_NS),
        Sample(KEYS.prompt, b"\xff\xfe", TEXT, None, ZERO_NS),
        Sample(KEYS.full("some/thing"), b"", TEXT, None, ZERO_NS),
        put(KEYS.spec("scripted"), SPEC, 0),
        chunk(0, 1, spec_hash="ffff"),
        chunk(0, 2, steps=np.zeros((1, 9), np.float32)),
        put(KEYS.event("command"), Event("info", "notice", "x"), 0),
        put(KEYS.status("command"), status(), MS),
    ]
    before = put(KEYS.command_pose, command(-SECOND), -SECOND)
    show, shown = heard(tmp_path, before, *broken)
    assert show.rejected == {
        "state/pose: malformed": 1,
        "state/pose: no_header": 1,
        "camera/front/jpeg: malformed": 1,
        "prompt: malformed": 1,
        "some/thing: malformed": 1,
        "delta/scripted: no_spec": 1,
        "delta/scripted: does not fit its spec": 1,
    }
    assert "**Not shown here:**" in shown.texts("text/now")[-1]
    assert shown.texts("events/command") == ["command: x"]


def test_a_chunk_that_comes_before_its_spec_is_drawn_when_that_is_there(tmp_path: Path) -> None:
    before = put(KEYS.command_pose, command(-SECOND), -SECOND)
    samples = (before, chunk(0, 1), chunk(200 * MS, 2), put(KEYS.spec("scripted"), SPEC, SECOND))
    show, shown = heard(tmp_path, *samples)
    assert show.rejected == {}
    assert shown.stamps_ns("world/chunk/scripted") == [ZERO_NS, ZERO_NS + 200 * MS]


def test_a_reset_of_the_simulator_is_an_event(tmp_path: Path) -> None:
    show, shown = heard(tmp_path, Sample(KEYS.sim_reset, b"3", TEXT, None, ZERO_NS))
    assert show.rejected == {}
    assert shown.texts("events/settings") == ["sim/reset: 3"]


def test_what_is_not_of_the_robot_is_passed_over(tmp_path: Path) -> None:
    other = Keys("somebody")
    show, _ = heard(tmp_path, Sample(other.prompt, b"go", TEXT, None, ZERO_NS))
    assert (show.shown, show.rejected) == ({}, {})


def test_a_stamp_of_another_clock_does_not_stretch_the_time_line(tmp_path: Path) -> None:
    sample = put(KEYS.event("command"), Event("info", "notice", "x"), 0)
    far = Sample(sample.key, sample.payload, MSGPACK, Header(1, 0, "x#1"), ZERO_NS)
    _, shown = heard(tmp_path, far)
    assert shown.stamps_ns("events/command") == [ZERO_NS]


def test_objects_that_are_parked_away_are_left_out(shown: Shown) -> None:
    (labels,) = shown.values("world/objects", "Points3D:labels")
    assert labels == ["red"]


def test_the_first_step_of_an_answer_has_names_and_units(shown: Shown) -> None:
    (answer,) = shown.texts("seen/scripted/answer")
    assert "| first step | x | y | z |" in answer
    assert "| mm | +0.0 | +0.0 | +0.0 |" in answer


# -- depth ----------------------------------------------------------------------------------------
def test_depth_of_a_camera_and_of_a_model_have_views_of_their_own(tmp_path: Path) -> None:
    depth = Depth(np.arange(48, dtype=np.uint16).reshape(6, 8) * 100, 0.001)
    encoding = f"image/png;{depth_schema(depth)}"
    samples = [
        Sample(key, encode_depth(depth), encoding, Header(ZERO_NS, 1, "camera#1"), ZERO_NS)
        for key in (KEYS.camera_depth("front"), KEYS.seen_depth("scripted", "front"))
    ]
    show, seen = heard(tmp_path, *samples)
    assert show.rejected == {}
    assert {"camera/front\\ depth", "seen/scripted/front\\ depth"} <= set(seen.paths)


def test_what_is_no_depth_is_counted_and_not_shown(tmp_path: Path) -> None:
    key, header = KEYS.camera_depth("front"), Header(ZERO_NS, 1, "camera#1")
    show, seen = heard(tmp_path, Sample(key, b"x", "image/png;depth16;0.001", header, ZERO_NS))
    assert show.rejected == {"camera/front/depth: malformed": 1}
    assert not any("depth" in path for path in seen.paths)
