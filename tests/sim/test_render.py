"""Pictures: by ray casting everywhere, by OpenGL where there is one, and both the same."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from motions import SCENE, make_world

from vla_zenoh.errors import NodeError, RecordError, ResourceError
from vla_zenoh.simulation.backend import (
    EGL,
    RAYCAST,
    VARIABLE,
    Backend,
    choose_backend,
    why_no_opengl,
)
from vla_zenoh.simulation.render import Renderer
from vla_zenoh.simulation.robot_model import RobotModel

SIZE = (640, 480)
CENTROID_LIMIT_PX = 1.0
ALIKE_LIMIT = 12  # levels of 255; silhouettes and curved links may differ by more
ALIKE_SHARE = 0.98
MIN_RED_PX = 80
MIN_GRAY_PX = 1500


@pytest.fixture(scope="module")
def rays():
    with Renderer(SCENE, [RobotModel()], choose_backend(RAYCAST)) as renderer:
        yield renderer


@pytest.fixture(scope="module")
def opengl():
    reason = why_no_opengl()
    if reason:
        pytest.skip(reason)
    if os.environ.get("PYOPENGL_PLATFORM", EGL) != EGL:
        pytest.skip("another OpenGL platform is already in use in this process")
    with Renderer(SCENE, [RobotModel()], Backend(EGL)) as renderer:
        yield renderer


def red(picture: np.ndarray) -> np.ndarray:
    r, g, b = (picture[..., i].astype(int) for i in range(3))
    return (r > 80) & (r > 3 * g) & (r > 3 * b)


def centroid(mask: np.ndarray) -> np.ndarray:
    return np.argwhere(mask).mean(axis=0)


def box_gray(picture: np.ndarray) -> np.ndarray:
    channels = picture.astype(int)
    spread = channels.max(axis=-1) - channels.min(axis=-1)
    return (spread < 8) & (channels[..., 0] > 50) & (channels[..., 0] < 150)


def test_the_front_picture_shows_the_red_brick_the_gray_box_and_is_well_exposed(
    rays: Renderer,
) -> None:
    rays.set_qpos(make_world(seed=4).qpos())
    picture = rays.render("front", *SIZE)
    assert picture.shape == (480, 640, 3)
    assert picture.dtype == np.uint8
    assert picture.flags.c_contiguous
    assert red(picture).sum() > MIN_RED_PX
    assert box_gray(picture).sum() > MIN_GRAY_PX
    assert (picture.min(axis=-1) > 250).mean() < 0.01
    assert 80 < picture.mean() < 180


def test_the_wrist_picture_shows_the_brick_below_it(rays: Renderer) -> None:
    world = make_world()
    world.place("brick", (0.45, 0.0, 0.0096))
    rays.set_qpos(world.qpos())
    assert red(rays.render("wrist", *SIZE)).sum() > 10 * MIN_RED_PX
    world.place("brick", (0.40, -0.5, 0.0096))
    rays.set_qpos(world.qpos())
    assert red(rays.render("wrist", *SIZE)).sum() == 0


def test_the_whole_arm_is_in_the_front_picture_when_it_is_raised(rays: Renderer) -> None:
    from scripts.home_pose import solve_home

    world = make_world()
    rays.set_qpos(world.qpos())
    before = rays.render("front", *SIZE)
    raised = world.qpos()
    first = world.model.joint("robot/panda_joint1").qposadr[0]
    raised[first : first + 7] = solve_home(SCENE, RobotModel(), (0.43, 0.0, 0.70))
    rays.set_qpos(raised)
    changed = (rays.render("front", *SIZE) != before).any(axis=-1)
    rows, columns = np.nonzero(changed)
    assert rows.min() > 5
    assert columns.min() > 5
    assert columns.max() < 634


def test_the_brick_moves_in_the_picture_as_it_moves_on_the_table(rays: Renderer) -> None:
    world = make_world()
    seen = []
    for y_m in (-0.15, 0.05):
        world.place("brick", (0.55, y_m, 0.0096))
        rays.set_qpos(world.qpos())
        seen.append(centroid(red(rays.render("front", *SIZE))))
    assert seen[1][1] - seen[0][1] > 30  # left of the robot is right in the picture


def test_ray_casting_only_what_moves_gives_the_picture_of_casting_everything(
    rays: Renderer,
) -> None:
    first, second = make_world(seed=1).qpos(), make_world(seed=2).qpos()
    rays.set_qpos(first)
    rays.render("front", *SIZE)
    rays.set_qpos(second)
    over_old_background = rays.render("front", *SIZE)
    with Renderer(SCENE, [RobotModel()], Backend(RAYCAST)) as fresh:
        fresh.set_qpos(second)
        assert np.array_equal(over_old_background, fresh.render("front", *SIZE))


@pytest.mark.gl
@pytest.mark.parametrize("camera", ["front", "wrist"])
@pytest.mark.parametrize("size", [SIZE, (224, 224)])
def test_opengl_and_ray_casting_give_the_same_picture(
    rays: Renderer, opengl: Renderer, camera: str, size: tuple[int, int]
) -> None:
    world = make_world()
    world.place("brick", (0.45, 0.01, 0.0096))
    pictures = []
    for renderer in (rays, opengl):
        renderer.set_qpos(world.qpos())
        pictures.append(renderer.render(camera, *size))
    assert np.abs(centroid(red(pictures[0])) - centroid(red(pictures[1]))).max() < (
        CENTROID_LIMIT_PX
    )
    difference = np.abs(pictures[0].astype(int) - pictures[1].astype(int)).max(axis=-1)
    assert (difference <= ALIKE_LIMIT).mean() > ALIKE_SHARE


@pytest.mark.gl
def test_opengl_draws_any_size_one_after_the_other(opengl: Renderer) -> None:
    for width, height in ((64, 48), (800, 600), (224, 224), (64, 48)):
        assert opengl.render("front", width, height).shape == (height, width, 3)


def test_a_camera_that_does_not_exist_is_refused_with_the_names_that_do(rays: Renderer) -> None:
    with pytest.raises(ResourceError, match="no camera 'left'; there are: front, wrist"):
        rays.render("left", *SIZE)


def test_poses_of_another_scene_are_refused(rays: Renderer) -> None:
    with pytest.raises(RecordError, match=r"shape \(23,\), got \(3,\)"):
        rays.set_qpos(np.zeros(3))


def test_poses_that_are_not_finite_are_refused(rays: Renderer) -> None:
    poses = make_world().qpos()
    poses[3] = np.nan
    with pytest.raises(RecordError, match="not finite"):
        rays.set_qpos(poses)


def test_ray_casting_can_be_asked_for_by_the_environment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(VARIABLE, RAYCAST)
    assert choose_backend() == Backend(RAYCAST)


def test_an_unknown_back_end_is_refused_with_the_names_that_exist() -> None:
    with pytest.raises(NodeError, match="'vulkan'; there are: auto, egl, raycast"):
        choose_backend("vulkan")


def test_without_the_libraries_ray_casting_is_chosen_and_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    chosen = choose_backend("auto")
    assert chosen.name == RAYCAST
    assert "libEGL is not installed" in chosen.reason
    assert "libegl1" in chosen.install
    with pytest.raises(NodeError, match="apt-get install libegl1"):
        choose_backend(EGL)


def test_a_driver_that_fails_is_noticed_in_a_process_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ctypes.util.find_library", lambda name: f"lib{name}.so")
    monkeypatch.setenv("LIBGL_DRIVERS_PATH", "/nonexistent")
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", "/nonexistent")
    assert why_no_opengl()


def test_choosing_a_back_end_does_not_import_mujoco() -> None:
    code = (
        "import sys; from vla_zenoh.simulation.backend import choose_backend; "
        "choose_backend('auto'); sys.exit('mujoco' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, timeout=120)
    assert done.returncode == 0
