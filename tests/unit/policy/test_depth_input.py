"""Depth as a declared input of a model: its unit, range and size, and the moment it belongs to."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from vla_zenoh.errors import SpecError
from vla_zenoh.policy import (
    ActionSpec,
    CameraSpec,
    DepthSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.policy.observation import NotReady, Streams, assemble, prepare_depth
from vla_zenoh.types import Depth, Header, Image, Stamped, Task

MS = 1_000_000
NOW_NS = 10**15
TASK = Task(episode=1, active=True, prompt="hold", worker="w", rate_hz=5.0)
HASH_BEFORE_DEPTH = "3551a47d575ad01c"
"""Of `single_picture`, as it was before a spec could declare depth."""


def depth_of(*counts: int, unit_m: float = 0.001) -> Depth:
    return Depth(np.array([counts], np.uint16), unit_m)


def given(depth: Depth, **fields: Any) -> list[int]:
    return prepare_depth(depth, DepthSpec(camera="front", **fields))[0].tolist()


def single_picture() -> ModelSpec:
    front = CameraSpec(camera="front", width=224, height=224, resize="pad")
    looks = ObservationSpec(cameras=(front,), state=("pose", "gripper"))
    return ModelSpec(name="w", observation=looks, action=ActionSpec(horizon=8, dt_s=0.1))


def with_depth(**fields: Any) -> ModelSpec:
    looks = ObservationSpec(
        cameras=(CameraSpec(camera="front"),),
        depth=(DepthSpec(camera="front"),),
        state=(),
        **{"max_skew_s": 0.05, **fields},
    )
    return ModelSpec(name="w", observation=looks, action=ActionSpec(horizon=1, dt_s=0.1))


# -- what the model is given ----------------------------------------------------------------------
def test_the_same_unit_goes_through_count_by_count() -> None:
    counts = (0, 1, 2, 499, 65534, 65535)
    assert given(depth_of(*counts)) == list(counts)


def test_another_unit_is_converted_and_what_does_not_fit_was_not_measured() -> None:
    assert given(depth_of(0, 1, 500, 7000), unit_m=0.0001) == [0, 10, 5000, 0]
    assert given(depth_of(0, 4, 5, 5000, unit_m=0.0001), unit_m=0.001) == [0, 0, 0, 500]


def test_what_lies_out_of_the_declared_range_was_not_measured() -> None:
    found = given(depth_of(0, 299, 300, 1500, 1501), near_m=0.3, far_m=1.5)
    assert found == [0, 0, 300, 1500, 0]


def test_the_count_of_what_was_not_measured_is_as_declared() -> None:
    assert given(depth_of(0, 7, 65534, 65535), invalid=65535) == [65535, 7, 65534, 65535]


def test_a_smaller_picture_has_no_distance_that_was_not_in_the_larger_one() -> None:
    counts = np.where(np.arange(64) % 2 == 0, 500, 2000).astype(np.uint16)
    depth = Depth(np.tile(counts, (48, 1)), 0.001)
    small = prepare_depth(depth, DepthSpec(camera="c", width=20, height=20, resize="stretch"))
    assert small.shape == (20, 20)
    assert set(np.unique(small)) <= {500, 2000}
    padded = DepthSpec(camera="c", width=32, height=32, resize="pad", invalid=65535)
    out = prepare_depth(depth, padded)
    assert (out[0] == 65535).all()
    assert set(np.unique(out)) <= {500, 2000, 65535}


def test_another_size_without_a_rule_is_an_error() -> None:
    with pytest.raises(SpecError, match="sends 4x1, the spec asks for 8x8"):
        prepare_depth(depth_of(1, 2, 3, 4), DepthSpec(camera="c", width=8, height=8))


# -- the spec -------------------------------------------------------------------------------------
def test_a_model_without_depth_has_the_hash_it_always_had() -> None:
    spec = single_picture()
    assert "depth" not in spec.to_dict()["observation"]
    assert spec.hash == HASH_BEFORE_DEPTH


def test_depth_travels_in_the_spec_and_changes_its_hash() -> None:
    spec = with_depth()
    assert ModelSpec.from_dict(spec.to_dict()) == spec
    coarse = with_depth().observation.model_copy(
        update={"depth": (DepthSpec(camera="front", unit_m=0.01),)}
    )
    assert spec.model_copy(update={"observation": coarse}).hash != spec.hash


def test_a_range_that_is_empty_and_a_camera_twice_are_errors() -> None:
    with pytest.raises(ValidationError, match="must be more than near_m"):
        DepthSpec(camera="c", near_m=1.0, far_m=1.0)
    with pytest.raises(ValidationError, match="given once"):
        ObservationSpec(depth=(DepthSpec(camera="c"), DepthSpec(camera="c", unit_m=0.01)))


def test_a_camera_of_colour_and_depth_is_one_camera() -> None:
    assert with_depth().observation.camera_names == ("front",)


# -- one moment -----------------------------------------------------------------------------------
def received(colour_ms: list[float], depth_ms: list[float]) -> Streams:
    streams = Streams.of(with_depth().observation)
    for ago in colour_ms:
        header = Header(NOW_NS - int(ago * MS), 1, "camera")
        image = Image(np.full((2, 2, 3), int(ago) % 256, np.uint8))
        streams.images["front"].add(Stamped(header, image, NOW_NS))
    for ago in depth_ms:
        header = Header(NOW_NS - int(ago * MS), 1, "camera")
        streams.depth["front"].add(Stamped(header, depth_of(int(ago) + 1), NOW_NS))
    return streams


def look(spec: ModelSpec, streams: Streams) -> Observation | NotReady:
    return assemble(spec, TASK, streams, not_before_ns=0, now_ns=NOW_NS)


def test_colour_and_depth_of_one_moment_belong_together() -> None:
    # The depth of the newest colour picture is still under way.
    seen = look(with_depth(), received([73, 40, 7], [73, 40]))
    assert isinstance(seen, Observation)
    assert seen.stamp_wall_ns == NOW_NS - 40 * MS
    assert seen.images["front"][0, 0, 0] == 40
    assert seen.depth["front"][0, 0] == 41


def test_depth_that_never_came_or_is_far_from_the_colour_is_named() -> None:
    none = look(with_depth(), received([10], []))
    assert isinstance(none, NotReady)
    assert none.why == "nothing received yet of depth of camera 'front'"
    old = look(with_depth(), received([10], [110]))
    assert isinstance(old, NotReady)
    assert old.why == "camera 'front' is 0.100 s apart from the others"


def test_pictures_are_kept_as_long_as_they_may_be_paired_and_no_longer() -> None:
    streams = received([ago for ago in range(1000, 0, -10)], [5])
    assert len(streams.images["front"].entries) <= 16
    alone = Streams.of(single_picture().observation)
    for ago in range(100, 0, -1):
        header = Header(NOW_NS - ago * MS, 1, "camera")
        alone.images["front"].add(Stamped(header, Image(np.ones((2, 2, 3), np.uint8)), NOW_NS))
    assert len(alone.images["front"].entries) == 1
