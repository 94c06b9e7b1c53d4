"""A camera that lies ends what the arm does: real camera node, real command node, a real arm."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_rig import free_endpoint
from chain import Chain, command_line, running_chain

from vla_zenoh.errors import SessionError
from vla_zenoh.types import Event

pytestmark = pytest.mark.long

SAME_S = 0.6
FOUND_S = 15.0
"""Until it is found, told and obeyed, on a busy computer; itself it takes `SAME_S` and 0.2 s."""
PICTURES = 40
PROFILE = """\
extends: panda_sim
cameras:
  front:
    source: "file:{show}"
    width: 160
    height: 120
    rate_hz: 20
    check: {{same_s: {same_s}}}
  wrist: {{source: "file:{still}", width: 160, height: 120, rate_hz: 20}}
task: {{prompt: hold, rate_hz: 10, worker: scripted}}
session: {{listen: [{endpoint}], connect: [{endpoint}]}}
timing: {{command_timeout_s: 0.25, state_timeout_s: 0.35}}
"""
DICE = np.random.default_rng(3)
NUMBERS = count()


def noisy(picture: np.ndarray, levels: float = 2.0) -> np.ndarray:
    return np.clip(picture + DICE.normal(0, levels, picture.shape), 0, 255).astype(np.uint8)


def scene() -> np.ndarray:
    slope = np.linspace(60, 160, 160)[None, :, None]
    return np.repeat(np.repeat(slope, 120, axis=0), 3, axis=2)


def show(folder: Path, pictures: list[np.ndarray]) -> None:
    """Put these in the place of what the camera shows."""
    made = folder.with_name(f"made-{next(NUMBERS)}")
    made.mkdir()
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(made / f"{number}.png"), picture)
    old = folder.with_name(f"{made.name}-old")
    if folder.exists():
        folder.rename(old)
    made.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def true_pictures() -> list[np.ndarray]:
    return [noisy(scene()) for _ in range(PICTURES)]


@pytest.fixture(scope="module")
def shared_chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    """Its camera shows the folder ``show``, as a sensor would see a scene that stands still."""
    folder = tmp_path_factory.mktemp("lies")
    show(folder / "show", true_pictures())
    show(folder / "still", [scene().astype(np.uint8)])
    file = folder / "lab.yaml"
    places = {"show": folder / "show", "still": folder / "still"}
    file.write_text(PROFILE.format(**places, same_s=SAME_S, endpoint=free_endpoint()))
    with running_chain(folder, profile_file=file) as chain:
        chain.activate_when_ready()
        yield chain


def endings(chain: Chain) -> list[Event]:
    """Ends of the activation, also one that held because a busy computer made the worker late."""
    return chain.events("active->inactive") or chain.events("holding->inactive")


LIES = {
    "frozen": (
        lambda: [noisy(scene())],
        r"camera 'front' shows the same image for \d+\.\d s, less than 0\.6 s is allowed "
        r"\(cameras\.front\.check\.same_s\)",
        "same_s",
    ),
    "covered": (
        lambda: [noisy(np.full((120, 160, 3), 20.0)) for _ in range(PICTURES)],
        r"camera 'front' shows no contrast: \d\.\d of 255 levels, at least 5",
        "contrast_levels",
    ),
}


@pytest.mark.parametrize("what", LIES)
def test_a_camera_that_lies_ends_the_activation_by_name(chain: Chain, what: str) -> None:
    lie, said, check = LIES[what]
    folder = chain.profile_file.with_name("show")
    show(folder, true_pictures())
    chain.move()
    chain.client.pop_events()
    try:
        show(folder, lie())
        (ended,) = chain.until("it ends", lambda: endings(chain), FOUND_S)
        chain.wait_still()
        with pytest.raises(SessionError, match=said):
            chain.client.activate()
        (told,) = (event for event in chain.events("front:same") + chain.events("front:flat"))
        assert told.value is not None
        assert told.limit is not None
        bad = chain.detail("cameras", "camera")["front"]["bad"]
        assert (bad["check"], bad["limit"]) == (check, told.limit)
        assert chain.state("camera") == "degraded"
        assert "camera 'front' sh" in command_line(
            "status", "--once", profile=chain.profile_file
        ).stdout.replace("\n", "")
    finally:
        show(folder, true_pictures())
    chain.until("it is good", lambda: chain.events("front:good"))
    chain.activate_when_ready()
    assert ended.why.startswith("camera 'front' sh"), ended.why


def test_a_file_may_show_a_still_picture_and_a_sensors_still_scene_is_believed(
    chain: Chain,
) -> None:
    chain.activate_when_ready()
    chain.until("pictures", lambda: chain.detail("cameras", "camera")["wrist"]["state"] == "ok")
    with pytest.raises(AssertionError, match="waited"):
        chain.until("an end", lambda: chain.state() != "active", 4 * SAME_S)
    cameras = chain.detail("cameras", "camera")
    assert not any("bad" in camera for camera in cameras.values())
