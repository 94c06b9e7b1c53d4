"""Any arm: a profile made of its description, and its simulated twin that moves by prompt."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from described_arms import TAKEN, urdf
from typer.testing import CliRunner
from vla_zenoh_benchmarks.lockstep.loop import Lockstep

from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.lab.profile.robot_check import singular_advice
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import ReachLimits, load_profile, override
from vla_zenoh.program.main import app
from vla_zenoh.simulation.scene import POSES, PREFIX, TCP_SITE
from vla_zenoh.simulation.world import World, build_world
from vla_zenoh.types import FloatArray

STEPS = 2
WAY_M = STEPS * 0.01
EXACT_M = 5e-4
SECONDS = 1.0
"""For the steps at 5 Hz, and to stand again."""
FOLLOWS = "which the description lets follow a joint of the arm (mimic)"


def new(folder: Path, text: str, *words: str) -> tuple[int, str, Path]:
    """Exit code and output of `profile new`, and the profile."""
    (folder / "arm.urdf").write_text(text)
    file = folder / "made.yaml"
    given = ["profile", "new", str(folder / "arm.urdf"), "--output", str(file), "--yes", *words]
    done = CliRunner().invoke(app, given)
    return done.exit_code, done.output, file


def loop_of(file: Path) -> tuple[Lockstep, World]:
    # Slow nodes, at whose rates the simulator computes control every 4 ms: only where the arm
    # ends up matters.
    slow = override(load_profile(str(file)), {"timing": {"command_hz": 50, "state_hz": 50}})
    world = build_world(slow)
    reach = ReachabilityFilter(slow)
    loop = Lockstep(
        slow, world, make_policy(find_model("scripted"), profile=str(file)), reach=reach, steps=4
    )
    return loop, world


def moved_m(file: Path) -> tuple[str, list[float]]:
    """Why the arm is not activated, or how far up it goes by two prompts."""
    loop, world = loop_of(file)
    ways_m: list[float] = []
    for motion in ("go up", "go down"):
        start_m = world.tcp()[0]
        loop.put("prompt", f"HARD: {motion} x{STEPS}")
        loop.run(0.2)
        if why := loop.activate(1.0, 0.2):
            return why, ways_m
        loop.run(SECONDS)
        end_m = world.tcp()[0]
        assert np.abs(end_m - start_m)[:2].max() < EXACT_M
        ways_m.append(float(end_m[2] - start_m[2]))
    return "", ways_m


REFUSED = {
    "a joint that keeps the hand level",
    "a joint that follows one that follows",
    "a joint that follows a locked one",
}
"""A joint follows another one between base and TCP."""
NO_WAY_UP = {"an arm on rails", "a SCARA", "one finger of negative range"}
"""Not every step up can be made from the home that is found, or there is none."""
MOVED = sorted(TAKEN.keys() - REFUSED - NO_WAY_UP)
AT_ONCE = {"a torso that lifts", "knuckles that turn against each other"}
"""The others take as long and are tried by ``make test-long``; six joints have a test below."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in AT_ONCE else pytest.mark.long) for name in MOVED],
)
def test_a_made_profile_moves_its_simulated_arm(tmp_path: Path, name: str) -> None:
    code, output, file = new(tmp_path, urdf(TAKEN[name].rows))
    assert code == 0, output
    why, ways_m = moved_m(file)
    assert why == ""
    assert ways_m == pytest.approx([WAY_M, -WAY_M], abs=EXACT_M)


@pytest.mark.parametrize("size", [0.3, 0.2])
def test_a_small_arm_has_limits_of_its_size_and_moves(tmp_path: Path, size: float) -> None:
    rows = [
        row._replace(at_m=tuple(size * each for each in row.at_m))
        for row in TAKEN["six joints"].rows
    ]
    shaped = urdf(rows).replace('radius="0.02"', f'radius="{0.02 * size}"')
    code, output, file = new(tmp_path, shaped)
    assert code == 0, output
    assert "no home was found" not in output
    profile = load_profile(str(file))
    assert list(singular_advice(profile)) == []
    reach, usual = profile.limits.reach, ReachLimits()
    assert reach.collision_stop_m < usual.collision_stop_m
    why, ways_m = moved_m(file)
    assert why == ""
    assert ways_m == pytest.approx([WAY_M, -WAY_M], abs=EXACT_M)


def test_an_arm_that_reaches_further_than_a_workspace_may_gets_the_largest(tmp_path: Path) -> None:
    rows = [row._replace(at_m=(0.0, 0.0, 5 * row.at_m[2])) for row in TAKEN["six joints"].rows]
    code, output, file = new(tmp_path, urdf(rows))
    assert code == 0, output
    assert load_profile(str(file)).limits.workspace.z_m[1] == 3.0


def test_an_arm_whose_description_has_weak_motors_does_not_fall(tmp_path: Path) -> None:
    weak = urdf(TAKEN["six joints"].rows).replace('effort="10"', 'effort="0.01"')
    code, output, file = new(tmp_path, weak)
    assert code == 0, output
    why, ways_m = moved_m(file)
    assert why == ""
    assert ways_m == pytest.approx([WAY_M, -WAY_M], abs=EXACT_M)


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_a_joint_that_follows_one_of_the_arm_is_refused_by_name(tmp_path: Path, name: str) -> None:
    code, output, _ = new(tmp_path, urdf(TAKEN[name].rows))
    assert code == 1
    said = " ".join(output.split())
    assert "the simulator" in said
    assert FOLLOWS in said


def in_picture(model: mujoco.MjModel, data: mujoco.MjData, name: str, at_m: FloatArray) -> bool:
    """Whether a point is in a square picture of a camera."""
    camera = data.camera(name)
    right, up, back = camera.xmat.reshape(3, 3).T @ (at_m - camera.xpos)
    edge = -back * np.tan(np.radians(model.camera(name).fovy[0]) / 2)
    return bool(max(abs(right), abs(up)) < edge)


@pytest.mark.parametrize("size", [0.3, 1.0, 1.8])
def test_the_cameras_see_arm_and_bricks_whatever_the_arms_size(tmp_path: Path, size: float) -> None:
    rows = [row._replace(at_m=(0.0, 0.0, size * row.at_m[2])) for row in TAKEN["six joints"].rows]
    code, output, file = new(tmp_path, urdf(rows))
    assert code == 0, output
    world = build_world(load_profile(str(file)))
    model, data = world.model, mujoco.MjData(world.model)
    mujoco.mj_setState(model, data, world.qpos(), POSES)
    mujoco.mj_forward(model, data)
    links = [model.body(n) for n in range(model.nbody) if model.body(n).name.startswith(PREFIX)]
    for body in [*links, *map(model.body, ("red_brick", "blue_brick", "yellow_brick", "box"))]:
        assert in_picture(model, data, "front", data.xpos[body.id]), body.name
    assert in_picture(model, data, "wrist", data.site(PREFIX + TCP_SITE).xpos)
