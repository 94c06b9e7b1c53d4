"""R2C: messages and what their numbers mean; which observations are answered, and how."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import r2c_peer as peer
from vla_zenoh_r2c import wire
from vla_zenoh_r2c.admission import Admission
from vla_zenoh_r2c.answer import Answers
from vla_zenoh_r2c.declared import Numbers, read_robot
from vla_zenoh_r2c.pictures import read_image, write_image
from vla_zenoh_r2c.question import Question

from vla_zenoh.errors import CodecError, PeerError, ProfileError, SpecError
from vla_zenoh.policy import ActionSpec, CameraSpec, ModelSpec, Observation, ObservationSpec
from vla_zenoh.profile import load_profile

SO101 = load_profile("so101_sim")
HOME_RAD = np.array(SO101.robot.home_rad)
HOME = [*HOME_RAD, 0.4]
JOINTS = SO101.robot.arm_joints
EXACT_RAD = 1e-6
STEP_RAD = 0.01


@pytest.fixture
def declare(tmp_path: Path) -> Any:
    """Writes a robot's file, with lines replaced; a line that is replaced by nothing is gone."""

    def write(text: str = peer.DECLARED, **lines: str) -> Path:
        for key, line in lines.items():
            (old,) = [each for each in text.splitlines() if each.startswith(f"{key}:")]
            text = text.replace(old, line)
        path = tmp_path / "robot.yaml"
        path.write_text(text)
        return path

    return write


# -- messages -------------------------------------------------------------------------------------
def test_an_observation_is_what_the_robot_wrote() -> None:
    seen = wire.decode_observation(peer.observation(HOME, id=7, timestamp=5, task="pick"))
    assert (seen.id, seen.stamp_ms, seen.task, seen.names) == (7, 5, "pick", peer.NAMES)
    assert seen.images == {"front": peer.jpeg()}
    np.testing.assert_array_equal(seen.position, HOME)


def test_our_observation_is_read_as_we_wrote_it() -> None:
    seen = wire.decode_observation(peer.observation(HOME, id=7, timestamp=5, task="pick"))
    assert peer.read_observation(wire.encode_observation(seen))["images"] == seen.images
    assert wire.decode_observation(wire.encode_observation(seen)).names == seen.names


def test_an_answer_is_read_as_we_wrote_it() -> None:
    rows = np.arange(12.0).reshape(2, 6)
    written = wire.encode_actions(wire.Steps(5, 9, peer.NAMES, rows))
    identity, size, found = peer.read_actions(written)
    assert (identity, size) == (9, 2)
    np.testing.assert_array_equal(found, rows)
    np.testing.assert_array_equal(wire.decode_actions(written).position, rows)


WRONG_OBSERVATIONS = [
    (peer.observation([0.0, float("nan"), 0, 0, 0, 0]), "not_finite", "joint_states.position"),
    (peer.observation([float("inf")] * 6), "not_finite", "joint_states.position"),
    (peer.observation([], names=()), "shape", "has 0 numbers"),
    (peer.observation([0.0] * 5), "shape", "6 names for 5 numbers"),
    (peer.observation(HOME, names=("joint_1",) * 6), "joints", "no name twice"),
    (peer.observation(HOME, id=0), "id", "id is 0"),
    (peer.observation(HOME, timestamp=0), "timestamp", "timestamp is 0"),
    (peer.observation(HOME, encoding="h264"), "image_encoding", "h264"),
    (peer.observation(HOME, images=(("a", b"1"), ("a", b"2"))), "images", "twice"),
    (peer.observation(HOME, task="x" * 100_000), "task", "100000 characters"),
    (peer.observation(HOME)[:-3], "malformed", "no message Observations"),
    (b"{}", "malformed", "no message Observations"),
]


@pytest.mark.parametrize(
    ("payload", "reason", "why"), WRONG_OBSERVATIONS, ids=[why for _, _, why in WRONG_OBSERVATIONS]
)
def test_a_wrong_observation_is_refused_by_name(payload: bytes, reason: str, why: str) -> None:
    with pytest.raises(CodecError, match=why) as caught:
        wire.decode_observation(payload)
    assert caught.value.reason == reason


WRONG_ACTIONS = [
    (peer.actions([[0.0] * 5 + [float("nan")]]), "not_finite", r"position\[0\]"),
    (peer.actions([[0.0] * 6, [0.0] * 5]), "shape", r"position\[1\] has 5 numbers"),
    (peer.actions([[0.0] * 6], chunk_size=2), "shape", "chunk_size is 2"),
    (peer.actions([]), "shape", "has 0 steps"),
    (peer.actions([[0.0] * 6], id=0), "id", "id is 0"),
]


@pytest.mark.parametrize(
    ("payload", "reason", "why"), WRONG_ACTIONS, ids=[why for _, _, why in WRONG_ACTIONS]
)
def test_a_wrong_answer_is_refused_by_name(payload: bytes, reason: str, why: str) -> None:
    with pytest.raises(CodecError, match=why) as caught:
        wire.decode_actions(payload)
    assert caught.value.reason == reason


def test_a_message_that_is_too_large_is_not_read() -> None:
    with pytest.raises(CodecError) as caught:
        wire.decode_actions(bytes(wire.MAX_ACTION_BYTES + 1))
    assert caught.value.reason == "oversize"


# -- what the numbers mean ------------------------------------------------------------------------
WRONG_FILES = [
    ({"unit": ""}, "unit: is missing"),
    ({"step_hz": ""}, "step_hz: is missing"),
    ({"project": ""}, "project: is missing"),
    ({"unit": "unit: ticks"}, "unit: wants 'radians' or 'degrees'"),
    ({"gripper": "gripper: {name: joint_6, shut: 0.0}"}, "gripper.open: is missing"),
    ({"gripper": "gripper: {name: joint_6, shut: 1.0, open: 1.0}"}, "is the same as shut"),
    ({"gripper": ""}, "'joint_6' is not among joints and gripper"),
    ({"order": "order: [joint_1]"}, "'joint_2' is not among order"),
    ({"device": "device: a/b"}, "cannot be part of a key"),
    ({"step_hz": "step_hz: 30\nreversed: [elbow]"}, "'elbow' is not among joints"),
]


@pytest.mark.parametrize(("lines", "why"), WRONG_FILES)
def test_a_meaning_that_is_missing_is_an_error_by_name(
    declare: Any, lines: dict[str, str], why: str
) -> None:
    with pytest.raises(ProfileError, match=why):
        read_robot(declare(**lines))


def test_the_colours_of_a_camera_must_be_declared(declare: Any) -> None:
    text = peer.DECLARED.replace(", colours: rgb", "")
    with pytest.raises(ProfileError, match=r"cameras\.front\.colours: is missing"):
        read_robot(declare(text))


def test_a_joint_that_the_profile_does_not_have_is_an_error_by_name(declare: Any) -> None:
    robot = read_robot(declare(peer.DECLARED.replace("elbow_flex", "elbow")))
    with pytest.raises(ProfileError, match="'elbow' is no arm_joint of profile so101_sim"):
        Numbers(robot, SO101)


def test_a_joint_that_no_number_is_is_an_error_by_name(declare: Any) -> None:
    text = peer.DECLARED.replace("  joint_3: elbow_flex\n", "").replace("joint_3, ", "")
    with pytest.raises(ProfileError, match="no number is joint elbow_flex"):
        Numbers(read_robot(declare(text)), SO101)


def test_degrees_zeros_and_directions_mean_the_same_both_ways(declare: Any) -> None:
    more = "step_hz: 30\nreversed: [joint_2]\nzero: {joint_2: 90.0}"
    numbers = Numbers(read_robot(declare(unit="unit: degrees", step_hz=more)), SO101)
    joints_rad, width_m = numbers.ours(np.array([180.0, 45.0, 0.0, 0.0, 0.0, 0.25]))
    np.testing.assert_allclose(joints_rad, [np.pi, np.pi / 4, 0, 0, 0], atol=EXACT_RAD)
    assert width_m == pytest.approx(0.25 * SO101.robot.gripper.max_width_m)
    back = numbers.theirs(joints_rad, width_m)
    np.testing.assert_allclose(back, [180.0, 45.0, 0.0, 0.0, 0.0, 0.25], atol=EXACT_RAD)


def test_numbers_are_found_by_their_names(declare: Any) -> None:
    numbers = Numbers(read_robot(declare()), SO101)
    mixed = peer.NAMES[::-1]
    np.testing.assert_array_equal(numbers.ordered(mixed, np.arange(6.0)), np.arange(6.0)[::-1])
    with pytest.raises(CodecError, match="declared are joint_1"):
        numbers.ordered(("other", *peer.NAMES[1:]), np.arange(6.0))
    with pytest.raises(CodecError, match="has 5 numbers, declared are 6"):
        numbers.ordered((), np.arange(5.0))


def test_exchanged_colours_are_put_right_both_ways(declare: Any) -> None:
    text = peer.DECLARED.replace("colours: rgb", "colours: bgr")
    camera = read_robot(declare(text)).cameras["front"]
    red = read_image(camera, peer.jpeg((30, 30, 220)))
    assert red.rgb[0, 0, 0] > 200 > 60 > red.rgb[0, 0, 2]
    again = read_image(camera, write_image(camera, red))
    assert again.rgb[0, 0, 0] > 200 > 60 > again.rgb[0, 0, 2]


# -- which observations are answered --------------------------------------------------------------
def seen(id: int, stamp_ms: int) -> wire.Seen:
    return wire.decode_observation(peer.observation(HOME, id=id, timestamp=stamp_ms))


def test_a_robot_that_restarts_at_once_begins_with_its_second_observation() -> None:
    admission = Admission(max_age_s=1.0)
    assert admission.admit(seen(5, 9_900), 9_950, 10.0)
    with pytest.raises(CodecError, match="another robot"):
        admission.admit(seen(1, 10_000), 10_050, 10.1)
    assert admission.admit(seen(6, 11_000), 11_050, 11.1)
    assert not admission.admit(seen(7, 12_000), 12_050, 12.1)


@pytest.mark.parametrize(
    ("id", "stamp_ms", "now_s", "reason"),
    [
        (6, 8_999, 10.0, "stale"),
        (6, 10_200, 10.0, "early"),
        (5, 9_900, 10.0, "replayed"),
        (6, 9_900, 10.0, "replayed"),
        (4, 9_950, 10.5, "foreign"),
    ],
)
def test_an_observation_that_is_not_the_next_of_one_robot_is_refused(
    id: int, stamp_ms: int, now_s: float, reason: str
) -> None:
    admission = Admission(max_age_s=1.0)
    assert admission.admit(seen(5, 9_900), 10_000, 10.0)
    with pytest.raises(CodecError) as caught:
        admission.admit(seen(id, stamp_ms), 10_000, now_s)
    assert caught.value.reason == reason


def test_a_robot_that_starts_again_begins_an_episode() -> None:
    admission = Admission(max_age_s=1.0)
    assert admission.admit(seen(5, 9_900), 10_000, 10.0)
    assert not admission.admit(seen(6, 10_900), 11_000, 11.0)
    assert admission.admit(seen(1, 14_900), 15_000, 15.0)


# -- how they are answered ------------------------------------------------------------------------
class Model:
    """Answers with given steps, and keeps what it was asked."""

    def __init__(self, steps: Any, state: Any = ("joint", "gripper"), **action: Any) -> None:
        fields = {"space": "joint", "joints": JOINTS, "dt_s": 1 / 30, "gripper": "none", **action}
        camera = CameraSpec(camera="front", width=32, height=32, resize="pad")
        self.spec = ModelSpec(
            name="model",
            observation=ObservationSpec(cameras=(camera,), state=state),
            action=ActionSpec(horizon=len(steps), **fields),
        )
        self.steps, self.asked = np.array(steps, np.float32), list[Observation]()

    def infer(self, observation: Observation) -> Any:
        self.asked.append(observation)
        return self.steps


def answers(declare: Any, model: Model, profile: Any = SO101) -> Answers:
    made = Answers(model, read_robot(declare()), profile)
    made.reset()
    return made


def asked(id: int = 1, position: Any = HOME, **more: Any) -> wire.Seen:
    return wire.decode_observation(peer.observation(position, id=id, **more))


def test_a_model_sees_what_the_robot_measured_and_its_id_is_repeated(declare: Any) -> None:
    model = Model([[STEP_RAD] * 5] * 3)
    answer = answers(declare, model).answer(asked(42), 77)
    (observation,) = model.asked
    assert observation.images["front"].shape == (32, 32, 3)
    assert observation.prompt == "HARD: go up"
    np.testing.assert_allclose(observation.joint.position_rad, HOME_RAD)
    assert observation.gripper.width_m == pytest.approx(0.4 * SO101.robot.gripper.max_width_m)
    assert (answer.id, answer.stamp_ms, answer.names) == (42, 77, peer.NAMES)
    wanted = [[*(HOME_RAD + STEP_RAD * nth), 0.4] for nth in (1, 2, 3)]
    np.testing.assert_allclose(answer.position, wanted, atol=EXACT_RAD)


def test_a_slower_model_is_brought_to_the_steps_of_the_robot(declare: Any) -> None:
    answer = answers(declare, Model([[3 * STEP_RAD] * 5], dt_s=0.1)).answer(asked(), 0)
    wanted = [[*(HOME_RAD + STEP_RAD * nth), 0.4] for nth in (1, 2, 3)]
    np.testing.assert_allclose(answer.position, wanted, atol=EXACT_RAD)


def test_deltas_lose_nothing_to_a_robot_that_sags(declare: Any) -> None:
    served = answers(declare, Model([[STEP_RAD] * 5]))
    for nth in range(10):
        sagged = HOME_RAD + STEP_RAD * nth - 0.5 * STEP_RAD
        answer = served.answer(asked(nth + 1, [*(HOME_RAD if nth == 0 else sagged), 0.4]), 0)
    np.testing.assert_allclose(answer.position[-1, :5], HOME_RAD + 10 * STEP_RAD, atol=1e-5)


def test_poses_become_joints(declare: Any) -> None:
    panda = load_profile("panda_sim")
    joints = "".join(f"  j{nth}: {name}\n" for nth, name in enumerate(panda.robot.arm_joints))
    text = (
        "project: lab\ndevice: panda\norder: [j0, j1, j2, j3, j4, j5, j6]\n"
        f"joints:\n{joints}unit: radians\nstep_hz: 30\n"
        "cameras: {front: {name: front, colours: rgb}}\n"
    )
    model = Model(
        [[0.0, 0.0, 0.01, 0.0, 0.0, 0.0]] * 3, ("pose",), space="tcp", joints=(), dt_s=0.1
    )
    served = Answers(model, read_robot(declare(text)), panda)
    served.reset()
    home_rad = np.array(panda.robot.home_rad)
    names = tuple(f"j{nth}" for nth in range(7))
    answer = served.answer(asked(1, home_rad, names=names), 0)
    forward = served._kinematics.forward
    rose_m = forward(answer.position[-1]).position_m - forward(home_rad).position_m
    np.testing.assert_allclose(rose_m, [0.0, 0.0, 0.03], atol=1e-4)
    assert model.asked[0].pose.position_m == pytest.approx(forward(home_rad).position_m)


REFUSED = [
    (Model([[4.0, 0, 0, 0, 0]], kind="absolute"), "joint_range", "shoulder_pan at 4.000"),
    (Model([[0.3, 0, 0, 0, 0]]), "joint_speed", r"shoulder_pan at 9.00 rad/s, allowed: 1.50"),
    (Model([[float("nan"), 0, 0, 0, 0]]), "not_finite", "NaN"),
]


@pytest.mark.parametrize(("model", "reason", "why"), REFUSED)
def test_an_answer_beyond_the_limits_is_refused_as_a_whole(
    declare: Any, model: Model, reason: str, why: str
) -> None:
    with pytest.raises((PeerError, SpecError), match=why) as caught:
        answers(declare, model).answer(asked(), 0)
    assert caught.value.reason == reason


def test_an_observation_without_the_camera_is_refused(declare: Any) -> None:
    served = answers(declare, Model([[0.0] * 5]))
    with pytest.raises(CodecError, match="no 'front'; it has side"):
        served.answer(asked(images=(("side", peer.jpeg()),)), 0)
    with pytest.raises(CodecError, match="not a JPEG file"):
        served.answer(asked(images=(("front", b"pixels"),)), 0)
    with pytest.raises(CodecError, match="task is empty"):
        served.answer(asked(task=""), 0)


def test_a_model_that_needs_more_than_the_robot_has_is_refused_by_name(declare: Any) -> None:
    model = Model([[0.0] * 5])
    camera = CameraSpec(camera="top")
    spec = model.spec.observation.model_copy(update={"cameras": (camera,), "state": ("effort",)})
    model.spec = replace_spec(model.spec, spec)
    with pytest.raises(SpecError, match="needs camera top, effort"):
        answers(declare, model)


def replace_spec(spec: ModelSpec, observation: ObservationSpec) -> ModelSpec:
    return spec.model_copy(update={"observation": observation})


# -- a policy of theirs, asked --------------------------------------------------------------------
@pytest.fixture
def question(declare: Any) -> Question:
    robot = read_robot(declare(step_hz="step_hz: 30\nhorizon: 2"))
    return Question(Numbers(robot, SO101), robot.horizon)


def test_only_the_answer_to_the_newest_question_counts(question: Question) -> None:
    first, second = question.ask(1000), question.ask(1000)
    assert second > first
    assert question.take(peer.actions([HOME], id=first)) is None
    np.testing.assert_array_equal(question.take(peer.actions([HOME], id=second)), [HOME])
    assert (question.ignored, question.twice) == (1, 0)


def test_a_second_answer_to_one_question_is_noticed(question: Question) -> None:
    asked = question.ask(1000)
    assert question.take(peer.actions([HOME], id=asked)) is not None
    assert question.take(peer.actions([HOME], id=asked)) is None
    assert question.twice == asked


def test_what_is_no_answer_is_ignored_and_counted(question: Question) -> None:
    question.ask(1000)
    assert question.take(b"nothing") is None
    assert question.ignored == 1
    assert "no message Actions" in question.complaint


@pytest.mark.parametrize(
    ("rows", "names", "why"),
    [
        ([HOME] * 3, peer.NAMES, "has 3 steps, declared are at most 2"),
        ([HOME[:5]], (), "has 5 numbers, declared are 6"),
        ([HOME], ("x", *peer.NAMES[1:]), "declared are joint_1"),
    ],
)
def test_an_answer_that_cannot_be_used_says_why(
    question: Question, rows: Any, names: tuple[str, ...], why: str
) -> None:
    asked = question.ask(1000)
    with pytest.raises(PeerError, match=why):
        question.take(peer.actions(rows, id=asked, names=names))
