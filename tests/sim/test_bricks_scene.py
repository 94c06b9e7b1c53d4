"""The scene with four bricks: places with room between them, and looks that a seed changes."""

from __future__ import annotations

import math
from functools import cache

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motions import HOME_RAD

from vla_zenoh.errors import ResourceError
from vla_zenoh.lab.tasks.order import COLOURS, brick
from vla_zenoh.simulation.backend import Backend, why_no_opengl
from vla_zenoh.simulation.render import Renderer
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.simulation.scene import (
    CAMERA,
    DISTRACTORS,
    LIGHTS,
    MAX_SHIFT_M,
    MAX_TURN_RAD,
    TABLE,
    VARIATIONS,
    AppearanceSwitcher,
    build_model,
    check_variations,
    draw_appearance,
    draw_places,
    footprint_m,
    objects_of,
)
from vla_zenoh.simulation.world import World

SCENE = "bricks"
GAP_M = 0.045
SAME_PIXELS = 0.02
CHANGED_LEVELS = 4.0
SEEDS = st.integers(0, 1 << 31)
SHIPPED = {*map(brick, COLOURS), "box"}
DISTRACTING = {"can", "block", "puck"}


@cache
def model() -> mujoco.MjModel:
    return build_model(SCENE, [RobotModel()])


@given(SEEDS, st.booleans())
@settings(max_examples=40, deadline=None)
def test_nothing_stands_too_near_to_anything_else(seed: int, distractors: bool) -> None:
    places = draw_places(model(), seed, distractors=distractors)
    assert set(places) == SHIPPED | (DISTRACTING if distractors else set())
    radius = {name: footprint_m(model(), body) for name, body in objects_of(model()).items()}
    names = sorted(places)
    for index, name in enumerate(names):
        for other in names[:index]:
            a, b = places[name], places[other]
            apart = math.hypot(a.x_m - b.x_m, a.y_m - b.y_m)
            assert apart >= radius[name] + radius[other] + GAP_M


@given(SEEDS)
@settings(max_examples=20, deadline=None)
def test_distractors_do_not_change_where_the_bricks_are(seed: int) -> None:
    without = draw_places(model(), seed)
    assert {
        n: p for n, p in draw_places(model(), seed, distractors=True).items() if n in without
    } == (without)


@given(SEEDS)
def test_a_camera_shifts_and_turns_within_its_bounds(seed: int) -> None:
    look = draw_appearance(seed)
    assert np.linalg.norm(look.shift_m) <= MAX_SHIFT_M
    assert np.linalg.norm(look.turn_rad) <= MAX_TURN_RAD


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_each_part_of_a_look_is_the_same_whatever_else_is_varied(seed: int) -> None:
    every, single = build_model(SCENE, [RobotModel()]), build_model(SCENE, [RobotModel()])
    before = build_model(SCENE, [RobotModel()])
    AppearanceSwitcher(every).apply(seed, VARIATIONS)
    switcher = AppearanceSwitcher(single)
    changed = {LIGHTS: ("light_diffuse", "light_dir"), TABLE: ("mat_rgba",), CAMERA: ("cam_pos",)}
    for part in VARIATIONS:
        switcher.apply(seed, [part])
        for of, names in changed.items():
            wanted = every if of == part else before
            for name in names:
                np.testing.assert_array_equal(getattr(single, name), getattr(wanted, name))


def test_an_unknown_variation_is_refused_by_name() -> None:
    with pytest.raises(ResourceError, match="wind"):
        check_variations(["wind"])
    with pytest.raises(ResourceError, match="wind"):
        world(vary=["wind"])


def test_a_scene_that_cannot_be_varied_says_what_it_lacks() -> None:
    other = build_model("table", [RobotModel()])
    with pytest.raises(ResourceError, match="material 'table'"):
        AppearanceSwitcher(other).apply(0, [TABLE])


def world(vary: list[str] | None = None, seed: int | None = None) -> World:
    return World(
        SCENE,
        [RobotModel()],
        home_rad=[HOME_RAD],
        seed=seed,
        vary=vary or (),
    )


def test_distractors_stand_on_the_table_only_where_they_are_asked_for() -> None:
    for vary, there in (([], False), ([DISTRACTORS], True)):
        objects = world(vary, seed=3).objects()
        for name in DISTRACTING:
            assert (objects[name][0][0] > 0.2) == there


def test_bricks_rest_where_a_reset_has_put_them() -> None:
    here = world(seed=11)
    before = here.objects()
    reference = here.hold_reference()
    for _ in range(300):
        here.tick(reference)
    for name, (place, _) in here.objects().items():
        np.testing.assert_allclose(place, before[name][0], atol=5e-4)


def skip_without(backend: str) -> None:
    if backend != "raycast" and (why := why_no_opengl()):
        pytest.skip(f"{backend}: {why}")


@pytest.mark.parametrize("backend", ["raycast", pytest.param("egl", marks=pytest.mark.gl)])
def test_a_look_changes_the_picture_and_comes_off_again(backend: str) -> None:
    skip_without(backend)
    with Renderer(SCENE, [RobotModel()], Backend(backend)) as renderer:
        plain = renderer.render("front", 96, 72).astype(float)
        for part in (LIGHTS, TABLE, CAMERA):
            renderer.vary(5, [part])
            varied = renderer.render("front", 96, 72).astype(float)
            assert np.abs(varied - plain).mean() > CHANGED_LEVELS / 4
        renderer.vary(None, VARIATIONS)
        np.testing.assert_array_equal(renderer.render("front", 96, 72), plain)


@pytest.mark.gl
def test_both_ways_of_drawing_agree_on_a_varied_scene() -> None:
    skip_without("egl")
    pictures = []
    for backend in ("egl", "raycast"):
        with Renderer(SCENE, [RobotModel()], Backend(backend)) as renderer:
            renderer.vary(7, VARIATIONS)
            pictures.append(renderer.render("front", 160, 120).astype(int))
    differing = (np.abs(pictures[0] - pictures[1]).max(axis=2) > 12).mean()
    assert differing < SAME_PIXELS
