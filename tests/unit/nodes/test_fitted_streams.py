"""In which sizes living models want pictures: one each, and only while they live."""

from __future__ import annotations

import pytest

from vla_zenoh.nodes.camera.node import MAX_MODELS, SILENCE_S, RequestedSizes
from vla_zenoh.policy import ActionSpec, CameraSpec, ModelSpec, ObservationSpec


def spec(width: int | None, camera: str = "front") -> ModelSpec:
    resize = "none" if width is None else "stretch"
    one = CameraSpec(camera=camera, width=width, height=width, resize=resize)
    return ModelSpec(
        name="any",
        observation=ObservationSpec(cameras=(one,)),
        action=ActionSpec(horizon=1, dt_s=0.2, frame="tcp", rotation="rpy", gripper="none"),
    )


def test_each_worker_asks_for_what_it_said_last() -> None:
    asked = RequestedSizes()
    for width in range(100, 200, 2):
        assert asked.add("thief", spec(width), 0.0)
    assert asked.add("honest", spec(224), 0.0)
    assert list(asked.sizes("front", 1.0)) == ["198x198-stretch", "224x224-stretch"]
    assert asked.sizes("wrist", 1.0) == {}


def test_two_workers_of_one_model_ask_for_one_size() -> None:
    asked = RequestedSizes()
    asked.add("a", spec(224), 0.0)
    asked.add("b", spec(224), 0.0)
    assert list(asked.sizes("front", 0.0)) == ["224x224-stretch"]


def test_a_model_that_takes_any_size_asks_for_none() -> None:
    asked = RequestedSizes()
    asked.add("a", spec(None), 0.0)
    assert asked.sizes("front", 0.0) == {}


def test_who_fell_silent_asks_for_nothing_any_more() -> None:
    asked = RequestedSizes()
    asked.add("gone", spec(100), 0.0)
    asked.add("here", spec(200), 0.9 * SILENCE_S)
    assert list(asked.sizes("front", 1.1 * SILENCE_S)) == ["200x200-stretch"]


def test_made_up_workers_take_a_bounded_place_and_keep_out_no_other() -> None:
    asked = RequestedSizes()
    heard = [asked.add(f"ghost{number}", spec(100), 0.0) for number in range(2 * MAX_MODELS)]
    assert sum(heard) == MAX_MODELS
    assert not asked.add("late", spec(200), 0.1)
    assert asked.add("late", spec(200), 0.2)
    assert list(asked.sizes("front", 0.2)) == ["100x100-stretch", "200x200-stretch"]


@pytest.mark.parametrize("camera", ["front", "wrist"])
def test_each_camera_has_the_sizes_that_are_asked_of_it(camera: str) -> None:
    asked = RequestedSizes()
    asked.add("a", spec(224, camera), 0.0)
    assert [camera for camera in ("front", "wrist") if asked.sizes(camera, 0.0)] == [camera]
