"""Two cameras that were swapped are told by their references; moving arms are no swap."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_rig import camera_rig, until

from vla_zenoh.errors import NodeError
from vla_zenoh.profile import load_profile
from vla_zenoh.profile.schema import CameraCheck, CameraProfile
from vla_zenoh.simulation.render import Renderer
from vla_zenoh.simulation.robot_model import robot_models
from vla_zenoh.simulation.world import build_world

pytestmark = pytest.mark.long

NAMES = ("front", "top", "left_wrist")
POSES, TURN_RAD = 4, 0.25


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of images of each camera of a table with two arms, which move; 0.png at home."""
    folder = tmp_path_factory.mktemp("views")
    profile = load_profile("two_pandas_sim")
    world, random = build_world(profile), np.random.default_rng(0)
    home = world.qpos()
    with Renderer(profile.sim.scene, robot_models(profile)) as renderer:
        for pose in range(POSES):
            renderer.set_qpos(home + (pose > 0) * TURN_RAD * random.normal(size=len(home)))
            for name in NAMES:
                (folder / name).mkdir(exist_ok=True)
                image = renderer.render(name, 320, 240)
                assert cv2.imwrite(str(folder / name / f"{pose}.png"), image[..., ::-1])
    return folder


def cameras(views: Path, shown: dict[str, str]) -> dict[str, CameraProfile]:
    """Cameras whose sources are the folders of those in `shown`, each with its own reference."""
    return {
        name: CameraProfile(
            source=f"file:{views / source}",
            rate_hz=20,
            check=CameraCheck(reference=str(views / name / "0.png")),
        )
        for name, source in shown.items()
    }


def test_swapped_cameras_are_named(views: Path) -> None:
    shown = {"front": "top", "top": "front", "left_wrist": "left_wrist"}
    with camera_rig(cameras(views, shown)) as rig:
        for name, other in (("front", "top"), ("top", "front")):
            until("it is found", lambda name=name: "bad" in rig.camera(name))
            fault = rig.camera(name)["bad"]
            assert fault["check"] == "reference"
            assert f"shows what camera {other!r} should show" in fault["why"]
        assert "bad" not in rig.camera("left_wrist")


def test_cameras_at_their_places_are_trusted_while_the_arms_move(views: Path) -> None:
    with camera_rig(cameras(views, {name: name for name in NAMES})) as rig:
        heard = [rig.listen(rig.profile.keys.camera_jpeg(name)) for name in NAMES]
        until("images of every pose", lambda: all(len(images) > 40 for images, _ in heard))
        assert all("bad" not in rig.camera(name) for name in NAMES)


def test_a_reference_that_is_no_image_is_named(tmp_path: Path) -> None:
    (tmp_path / "front.jpg").write_text("not an image")
    check = CameraCheck(reference=str(tmp_path / "front.jpg"))
    wrong = {"front": CameraProfile(source=f"file:{tmp_path}", check=check)}
    with (
        pytest.raises(NodeError, match=r"cameras.front.check.reference: .*front.jpg is not an"),
        camera_rig(wrong),
    ):
        pass
