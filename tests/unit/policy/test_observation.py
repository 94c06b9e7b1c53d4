"""One coherent observation out of many streams, and pictures in the form that was asked for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from vla_zenoh.errors import SpecError
from vla_zenoh.policy import ActionSpec, CameraSpec, ModelSpec, Observation, ObservationSpec
from vla_zenoh.policy.observation import History, NotReady, Streams, assemble, prepare_image
from vla_zenoh.types import GripperState, Header, Image, PoseState, Stamped, Task

MS = 1_000_000
NOW_NS = 10**15
TASK = Task(episode=1, active=True, prompt="hold", worker="w", rate_hz=5.0)


def spec(*cameras: str, **fields: Any) -> ModelSpec:
    looks = ObservationSpec(
        cameras=tuple(CameraSpec(camera=camera) for camera in cameras),
        **{"max_skew_s": 0.05, "max_age_s": 0.5, **fields},
    )
    return ModelSpec(name="w", observation=looks, action=ActionSpec(horizon=1, dt_s=0.1))


def picture(ago_ms: float, shade: int = 0) -> Stamped[Image]:
    image = Image(np.full((4, 6, 3), shade, np.uint8))
    return Stamped(Header(NOW_NS - int(ago_ms * MS), 7, "camera"), image, NOW_NS)


def history(*ago_ms: float) -> History:
    made = History()
    for ago in ago_ms:
        pose = PoseState(np.array([ago, 0.0, 0.0]), np.array([1.0, 0, 0, 0]), np.zeros(6))
        made.add(Stamped(Header(NOW_NS - int(ago * MS), 3, "sim"), pose, NOW_NS))
    return made


def grippers(*ago_ms: float) -> History:
    made = History()
    for ago in ago_ms:
        state = GripperState(0.05, moving=False, holding=False)
        made.add(Stamped(Header(NOW_NS - int(ago * MS), 3, "sim"), state, NOW_NS))
    return made


def look(
    wanted: ModelSpec,
    images: dict[str, Stamped[Image]],
    *ago_ms: float,
    task: Task = TASK,
    not_before_ns: int = 0,
) -> Observation | NotReady:
    states = {"pose": history(*ago_ms), "gripper": grippers(*ago_ms)}
    streams = received(wanted, images, states)
    return assemble(wanted, task, streams, not_before_ns=not_before_ns, now_ns=NOW_NS)


def received(
    wanted: ModelSpec, images: dict[str, Stamped[Image]], states: dict[str, History]
) -> Streams:
    """What a worker has got: the streams of its spec, with these pictures and states in them."""
    empty = Streams.of(wanted.observation)
    for name, one in images.items():
        if name in empty.images:
            empty.images[name].add(one)
    return replace(
        empty, states={part: states.get(part, own) for part, own in empty.states.items()}
    )


def refused(answer: Observation | NotReady) -> NotReady:
    assert isinstance(answer, NotReady)
    return answer


def test_the_oldest_picture_stamps_it_and_states_are_the_nearest_to_that() -> None:
    images = {"front": picture(40), "wrist": picture(20)}
    seen = look(spec("front", "wrist"), images, 55, 45, 38, 30, 5)
    assert isinstance(seen, Observation)
    assert seen.stamp_wall_ns == NOW_NS - 40 * MS
    assert seen.seq == 7
    assert seen.pose is not None
    assert seen.pose.position_m[0] == 38
    assert set(seen.images) == {"front", "wrist"}
    assert seen.joint is None
    assert seen.task is TASK


def test_without_pictures_the_oldest_of_the_newest_states_stamps_it() -> None:
    states = {"pose": history(20, 10), "gripper": grippers(30, 15)}
    seen = assemble(spec(), TASK, received(spec(), {}, states), not_before_ns=0, now_ns=NOW_NS)
    assert isinstance(seen, Observation)
    assert seen.stamp_wall_ns == NOW_NS - 15 * MS


def test_what_was_never_heard_is_named() -> None:
    answer = refused(
        assemble(
            spec("front"),
            TASK,
            Streams.of(spec("front").observation),
            not_before_ns=0,
            now_ns=NOW_NS,
        )
    )
    assert answer.why == "nothing received yet of camera 'front', state/pose, state/gripper"
    assert not answer.waiting


def test_a_model_that_needs_a_prompt_waits_for_one() -> None:
    silent = Task(episode=1, active=True, prompt="", worker="w", rate_hz=5.0)
    assert refused(look(spec("front"), {"front": picture(1)}, 1, task=silent)).waiting
    careless = spec("front", prompt=False)
    assert isinstance(look(careless, {"front": picture(1)}, 1, task=silent), Observation)


def test_an_old_picture_is_not_given_to_the_model() -> None:
    answer = refused(look(spec("front"), {"front": picture(501)}, 501))
    assert "0.50 s old, at most 0.5 s" in answer.why
    assert not answer.waiting


def test_a_picture_from_the_future_tells_that_clocks_differ() -> None:
    answer = refused(look(spec("front"), {"front": picture(-200)}, -200))
    assert "0.20 s in the future; synchronise the clocks" in answer.why


def test_a_picture_from_before_the_last_chunk_is_waited_out() -> None:
    images = {"front": picture(30)}
    assert refused(look(spec("front"), images, 30, not_before_ns=NOW_NS - 29 * MS)).waiting
    at_that_moment = look(spec("front"), images, 30, not_before_ns=NOW_NS - 30 * MS)
    assert isinstance(at_that_moment, Observation)


def test_pictures_too_far_apart_make_no_observation() -> None:
    images = {"front": picture(60), "wrist": picture(5)}
    assert (
        "camera 'wrist' is 0.055 s apart" in refused(look(spec("front", "wrist"), images, 60)).why
    )


def test_a_state_too_far_from_the_picture_makes_no_observation() -> None:
    why = refused(look(spec("front"), {"front": picture(10)}, 200, 61)).why
    assert why == "state/pose is 0.051 s apart from the images"


def test_a_history_forgets_the_oldest_and_begins_anew_with_its_writer() -> None:
    kept = History(size=4)
    for ago in range(100, 0, -1):
        kept.add(picture(ago))
        assert len(kept.entries) <= 8
    assert kept.entries[-1].header.stamp_wall_ns == NOW_NS - MS
    kept.add(picture(500))
    assert len(kept.entries) == 1


@pytest.mark.parametrize(
    ("asked_ms", "found_ms"), [(100, 30), (26, 30), (24, 20), (10, 10), (0, 10)]
)
def test_the_nearest_entry_is_found_on_either_side(asked_ms: float, found_ms: float) -> None:
    entry = history(30, 20, 10).nearest(NOW_NS - int(asked_ms * MS))
    assert entry is not None
    assert entry.record.position_m[0] == found_ms
    assert History().nearest(0) is None


# -- pictures -------------------------------------------------------------------------------------


def striped(height: int, width: int) -> Image:
    """Red on the left, green in the middle, blue on the right."""
    rgb = np.zeros((height, width, 3), np.uint8)
    for channel in range(3):
        rgb[:, channel * width // 3 : (channel + 1) * width // 3, channel] = 255
    return Image(rgb)


def camera(**fields: Any) -> CameraSpec:
    return CameraSpec(camera="front", **fields)


def test_a_picture_without_a_wanted_size_comes_as_it_is() -> None:
    image = striped(48, 60)
    np.testing.assert_array_equal(prepare_image(image, camera()), image.rgb)
    same = prepare_image(image, camera(width=60, height=48, resize="none"))
    np.testing.assert_array_equal(same, image.rgb)


def test_another_size_needs_a_rule() -> None:
    with pytest.raises(SpecError, match="sends 60x48, the spec asks for 32x32 and says"):
        prepare_image(striped(48, 60), camera(width=32, height=32))


@pytest.mark.parametrize("size", [(48, 60), (60, 48), (33, 97), (480, 640), (8, 8)])
@pytest.mark.parametrize("wanted", [(32, 32), (64, 20), (20, 64), (224, 224)])
@pytest.mark.parametrize("rule", ["stretch", "pad", "crop"])
def test_every_rule_gives_the_size_that_was_asked_for(
    size: tuple[int, int], wanted: tuple[int, int], rule: str
) -> None:
    given = prepare_image(striped(*size), camera(height=wanted[0], width=wanted[1], resize=rule))
    assert given.shape == (*wanted, 3)
    assert given.dtype == np.uint8
    assert given.flags.c_contiguous


def test_stretch_keeps_the_corners_pad_adds_black_and_crop_cuts_the_longer_side() -> None:
    image = striped(30, 90)
    wanted = {"width": 30, "height": 30}
    stretched = prepare_image(image, camera(**wanted, resize="stretch"))
    assert list(stretched[0, 0]) == [255, 0, 0]
    assert list(stretched[-1, -1]) == [0, 0, 255]
    padded = prepare_image(image, camera(**wanted, resize="pad"))
    assert padded[:10].max() == 0
    assert padded[20:].max() == 0
    assert list(padded[15, 0]) == [255, 0, 0]
    assert list(padded[15, -1]) == [0, 0, 255]
    cropped = prepare_image(image, camera(**wanted, resize="crop"))
    assert (cropped == [0, 255, 0]).all()


def test_bgr_is_the_same_picture_with_channels_turned() -> None:
    image = striped(30, 90)
    given = prepare_image(image, camera(colour="bgr"))
    assert list(given[0, 0]) == [0, 0, 255]
    assert given.flags.c_contiguous
