"""An image that repeats while the arm moves is not given to a model, whatever its stamps say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.policy import Observation
from vla_zenoh.policy.frozen import MOVED_M, MOVED_RAD, FrozenImages
from vla_zenoh.profile import load_profile, override
from vla_zenoh.profile.schema import CameraProfile
from vla_zenoh.types import JointState, PoseState, Task

PERIOD_S, SAME_S = 0.2, 1.0
STILL = np.full((40, 6, 3), 7, np.uint8)


def seen(index: int, pixels: np.ndarray = STILL, x_m: float = 0.0) -> Observation:
    pose = PoseState(np.array([x_m, 0.0, 0.2]), np.eye(4)[3], np.zeros(6))
    task = Task(1, True, "go", "scripted", 5.0)
    stamp_ns = 10**18 + round(index * PERIOD_S * 1e9)
    return Observation(stamp_ns, index, task, images={"front": pixels}, pose=pose)


def noisy(index: int, row: int = 0) -> np.ndarray:
    pixels = STILL.copy()
    pixels[row, 0, 0] = index % 200
    return pixels


def watch(same_s: float = SAME_S, *, declared: bool = False) -> FrozenImages:
    return FrozenImages({"front": same_s}, frozenset({"front"} if declared else ()))


def test_one_image_with_new_stamps_is_noticed_while_the_arm_moves() -> None:
    found = watch()
    whys = [found.judge(seen(index, x_m=0.01 * index)) for index in range(12)]
    first = next(index for index, why in enumerate(whys) if why)
    assert first == round(SAME_S / PERIOD_S)
    assert "camera 'front' repeats one image for 1.0 s" in whys[first]
    assert "cameras.front.check.same_s" in whys[first]


def test_it_stays_noticed_when_the_arm_was_braked_until_the_image_changes() -> None:
    found = watch()
    for index in range(8):
        found.judge(seen(index, x_m=0.01 * index))
    assert found.judge(seen(30, x_m=0.08))
    assert not found.judge(seen(31, noisy(1), x_m=0.08))


@given(st.integers(1, 60), st.floats(0.0, MOVED_M * 0.99))
def test_an_arm_that_rests_sees_the_same_for_ever(times: int, way_m: float) -> None:
    found = watch()
    assert not any(found.judge(seen(index, x_m=way_m * (index % 2))) for index in range(times))


@given(st.floats(0.0, 1.0), st.integers(0, len(STILL) - 1))
def test_images_that_differ_in_one_level_are_never_frozen(speed_m: float, row: int) -> None:
    found = watch()
    assert not any(
        found.judge(seen(index, noisy(index, row), x_m=speed_m * index)) for index in range(40)
    )


def test_zero_switches_it_off() -> None:
    found = watch(0.0, declared=True)
    assert not any(found.judge(seen(index, x_m=0.1 * index)) for index in range(40))


@pytest.mark.parametrize("declared", [True, False])
def test_without_a_state_only_a_declared_limit_counts(declared: bool) -> None:
    found = watch(declared=declared)
    blind = [replace(seen(index), pose=None) for index in range(12)]
    assert any(map(found.judge, blind)) is declared


def test_joints_tell_that_the_arm_moves_as_well() -> None:
    found = watch()
    whys = []
    for index in range(12):
        joint = JointState(("a",), np.array([MOVED_RAD * index]), np.zeros(1), np.zeros(1))
        whys.append(found.judge(replace(seen(index), pose=None, joint=joint)))
    assert any(whys)


def test_depth_freezes_too_and_one_moving_part_is_enough() -> None:
    found = watch()
    whys = []
    for index in range(12):
        parts = {"left": seen(index), "right": seen(index, x_m=0.01 * index)}
        depth = {"front": np.full((4, 6), 500, np.uint16)}
        whole = replace(seen(index, noisy(index)), pose=None, depth=depth, parts=parts)
        whys.append(found.judge(whole))
    assert "depth image" in whys[-1]


@pytest.mark.parametrize(
    ("source", "seconds"),
    [("sim:front", 1.0), ("v4l2:0", 1.0), ("rtsp://a/b", 5.0), ("file:a.mp4", 0.0)],
)
def test_the_limit_is_that_of_the_source_unless_it_is_declared(source: str, seconds: float) -> None:
    camera = CameraProfile(source=source)
    assert camera.same_moving_s == seconds
    declared = override(
        load_profile("panda_sim"), {"cameras": {"front": {"check": {"same_s": 3.0}}}}
    )
    assert declared.cameras["front"].same_moving_s == 3.0
