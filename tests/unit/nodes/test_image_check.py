"""A camera that lies is found out by its own pictures, and one that tells the truth is not."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vla_zenoh.nodes.camera.image_check import ImageCheck, ImageFault
from vla_zenoh.nodes.camera.opencv_sources import FileSource, V4l2Source, is_virtual
from vla_zenoh.profile.schema import CameraCheck, CameraProfile

RATE_HZ = 30
LATE_S = 0.2
"""It is looked ten times a second, and what lasts has to be seen to last."""
NOISE_LEVELS = 1.0
"""Of a good sensor in good light; a cheap one has several times as much."""
DARK_NOISE_LEVELS = 8.0
"""Of a cheap one that turns its gain up under a lens cap."""

Picture = np.ndarray
Shot = tuple[Picture, int | None]
DICE = np.random.default_rng(1)


def scene(shape: tuple[int, ...] = (480, 640, 3)) -> Picture:
    """A table in uneven light, with a few things on it."""
    height, width = shape[:2]
    light = np.linspace(90, 130, width)[None, :] + np.linspace(-15, 15, height)[:, None]
    out = np.repeat(light[:, :, None], 3, axis=2)
    out[height // 3 : height // 2, width // 4 : width // 3] = (180, 40, 30)
    return out.astype(np.uint8)[(...,) if len(shape) == 3 else (..., 0)]


def noisy(picture: Picture, levels: float = NOISE_LEVELS) -> Picture:
    noise = DICE.normal(0, levels, picture.shape)
    return np.clip(picture + noise, 0, 255).round().astype(np.uint8)


def covered() -> Picture:
    return noisy(np.full((480, 640, 3), 14.0), DARK_NOISE_LEVELS)


def judged(
    shots: Iterator[Shot], seconds: float = 3.0, same_s: float = 1.0, **limits: float
) -> tuple[float, ImageFault] | None:
    """When, in seconds from the first picture, what was found; None: nothing."""
    check = ImageCheck("wrist", CameraCheck(**limits), same_s)
    for nth in range(round(seconds * RATE_HZ)):
        picture, stamp_ns = next(shots)
        found = check.update(picture, round(nth * 1e9 / RATE_HZ), stamp_ns)
        if found is not None:
            return nth / RATE_HZ, found
    return None


def shown(make: Callable[[], Picture]) -> Iterator[Shot]:
    pool = [make() for _ in range(4)]
    return ((pool[nth % 4], nth) for nth in count(1))


def repeated(picture: Picture) -> Iterator[Shot]:
    return ((picture.copy(), nth) for nth in count(1))


# -- the truth ------------------------------------------------------------------------------------
@pytest.mark.parametrize("shape", [(480, 640, 3), (480, 640), (48, 64, 3), (17, 33, 3)])
def test_a_still_scene_with_a_sensors_noise_is_believed(shape: tuple[int, ...]) -> None:
    still = scene(shape)
    assert judged(shown(lambda: noisy(still))) is None


def test_a_dim_room_is_believed() -> None:
    dim = scene() // 6
    assert judged(shown(lambda: noisy(dim, 3.0))) is None


def test_a_still_scene_without_noise_is_believed_of_what_has_none() -> None:
    assert judged(repeated(scene()), 60.0, same_s=0.0) is None


def test_pictures_of_sixteen_bits_and_with_a_fourth_channel_are_believed() -> None:
    deep = [scene().astype(np.uint16) * 256 + nth for nth in range(4)]
    assert judged((deep[nth % 4], None) for nth in count()) is None
    four = [np.dstack([noisy(scene()), np.zeros((480, 640), np.uint8)]) for _ in range(4)]
    assert judged((four[nth % 4], None) for nth in count()) is None


def test_a_table_top_that_fills_most_of_the_picture_is_believed() -> None:
    picture = scene()
    picture[:, :520] = (150, 110, 100)
    assert judged(shown(lambda: noisy(picture))) is None


def test_a_hand_that_passes_by_is_no_covered_lens() -> None:
    clear, dark = [noisy(scene()) for _ in range(2)], [covered() for _ in range(2)]
    passing = range(30, 40)
    shots = (((dark if nth % 60 in passing else clear)[nth % 2], nth) for nth in count(1))
    assert judged(shots, 6.0) is None


def test_a_picture_that_comes_twice_of_a_slow_camera_is_no_lie() -> None:
    check = ImageCheck("wrist", CameraCheck(), 1.0)
    one, other = noisy(scene()), noisy(scene())
    for nth, picture in enumerate([one, one, other, other, one]):
        assert check.update(picture, nth * 2_000_000_000) is None
    assert check.update(one, 10_000_000_000) is None
    assert check.update(one, 12_000_000_000) is not None


# -- lies -----------------------------------------------------------------------------------------
LIES: dict[str, tuple[Callable[[], Iterator[Shot]], float, str]] = {
    # what it is called -> pictures, by when it is found, what is said
    "same": (
        lambda: repeated(noisy(scene())),
        1.0,
        r"shows the same image for 1\.\d s, less than 1 s is allowed "
        r"\(cameras\.wrist\.check\.same_s\)",
    ),
    "stamps": (
        lambda: ((picture, 7) for picture, _ in shown(lambda: noisy(scene()))),
        0.5,
        r"driver time stamp does not advance for 0\.\d s, .* 0\.5 s .*check\.stamp_s",
    ),
    "black": (
        lambda: shown(lambda: noisy(np.full((480, 640, 3), 1.0))),
        0.5,
        r"is black: 100\.0% of the image, at most 98\.0% .*check\.clipped_share",
    ),
    "white": (
        lambda: shown(lambda: noisy(np.full((480, 640, 3), 254.0))),
        0.5,
        r"is overexposed: 100\.0% of the image is white, at most 98\.0%",
    ),
    "flat": (
        lambda: shown(covered),
        0.5,
        r"shows no contrast: [0-4]\.\d of 255 levels, at least 5 .*check\.contrast_levels",
    ),
}


@pytest.mark.parametrize("what", LIES)
def test_each_lie_is_found_out_within_its_time_and_by_its_name(what: str) -> None:
    shots, time_s, said = LIES[what]
    found = judged(shots())
    assert found is not None
    when_s, finding = found
    assert finding.what == what
    assert time_s - 1 / RATE_HZ <= when_s <= time_s + LATE_S
    assert re.search(said, finding.why), finding.why
    assert len(finding.why) < 200


@pytest.mark.parametrize(
    ("what", "limits"),
    [
        ("same", {"same_s": 0.0}),
        ("stamps", {"stamp_s": 0.0}),
        ("black", {"clipped_share": 1.0, "contrast_levels": 0.0}),
        ("white", {"clipped_share": 1.0, "contrast_levels": 0.0}),
        ("flat", {"contrast_levels": 0.0}),
    ],
)
def test_each_check_can_be_switched_off(what: str, limits: dict[str, float]) -> None:
    assert judged(LIES[what][0](), **limits) is None


def test_stamps_that_go_back_are_found_out_and_a_clock_that_was_set_is_not() -> None:
    pool = [noisy(scene()) for _ in range(4)]
    backward = ((pool[nth % 4], 10**15 - nth * 1_000_000) for nth in count())
    found = judged(backward)
    assert found is not None
    assert found[1].what == "stamps"
    set_back = ((pool[nth % 4], (nth % 45 + 1) * 33_000_000) for nth in count())
    assert judged(set_back, 6.0) is None


def test_a_driver_that_says_no_time_is_not_judged_by_it() -> None:
    assert judged((picture, None) for picture, _ in shown(lambda: noisy(scene()))) is None


def test_a_camera_that_is_good_again_is_said_to_be() -> None:
    check = ImageCheck("wrist", CameraCheck(), 1.0)
    lie = noisy(scene())
    for nth in range(30):
        check.update(lie, nth * 100_000_000)
    assert check.finding is not None
    assert check.update(noisy(scene()), 3_000_000_000) is None
    assert check.finding is None


# -- which source has noise -----------------------------------------------------------------------
def test_a_file_may_show_one_picture_for_ever_and_a_device_may_not() -> None:
    assert FileSource("still.png", 30.0).same_s == 0
    profile = CameraProfile(source="v4l2:97")
    assert V4l2Source("97", profile).same_s == 1.0


def test_a_virtual_device_is_known_by_what_the_kernel_says(tmp_path: Path) -> None:
    sys, dev = tmp_path / "sys", tmp_path / "dev"
    sys.mkdir()
    dev.mkdir()
    (sys / "video0").symlink_to("/sys/devices/pci0000:00/0000:00:14.0/usb1/video4linux/video0")
    (sys / "video9").symlink_to("/sys/devices/virtual/video4linux/video9")
    for name in ("video0", "video9"):
        (dev / name).touch()
    by_id = dev / "usb-camera-index0"
    by_id.symlink_to(dev / "video9")
    assert not is_virtual(dev / "video0", sys)
    assert is_virtual(dev / "video9", sys)
    assert is_virtual(by_id, sys)
    assert not is_virtual(dev / "video5", sys)


@pytest.mark.parametrize(
    "limits", [{"same_s": -1.0}, {"clipped_share": 0.0}, {"contrast_levels": -1.0}, {"blur": 1.0}]
)
def test_limits_that_mean_nothing_are_refused(limits: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(limits))):
        CameraCheck(**limits)
