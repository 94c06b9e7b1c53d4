"""Descriptions that ship with the package: the makers' kinematics and masses, shapes of our own."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from vla_zenoh.errors import MissingExtraError
from vla_zenoh.kinematics.fingers import Fingers
from vla_zenoh.profile import load_profile
from vla_zenoh.resources import robot_urdf, shipped
from vla_zenoh.simulation.robot_model import SO101, WITH_MESHES, RobotModel
from vla_zenoh.simulation.scene import build_model

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "descriptions.py"
WRITTEN: dict[str, str] = runpy.run_path(str(SCRIPT))["DESCRIPTIONS"]

CONFIGURATIONS = 100
MEET_M = 0.006
"""Shapes of our own are up to 2 mm thinner than the makers' meshes."""
FRAME_ATOL = 1e-6  # the maker of the SO-101 gives right angles with six digits
INERTIA_ATOL = 1e-8
THEIRS = sorted(WITH_MESHES)


@pytest.fixture(params=THEIRS)
def models(request: pytest.FixtureRequest) -> tuple[pin.Model, pin.Model]:
    """The description with meshes, and ours."""
    try:
        theirs = robot_urdf(request.param)
    except MissingExtraError as error:
        pytest.skip(str(error))
    ours = robot_urdf(WITH_MESHES[request.param])
    return pin.buildModelFromUrdf(str(theirs)), pin.buildModelFromUrdf(str(ours))


@pytest.mark.parametrize("name", WRITTEN)
def test_a_shipped_description_is_what_the_script_writes(name: str) -> None:
    assert (shipped("profiles") / name).read_text() == WRITTEN[name]


def test_every_frame_is_where_the_maker_has_it(models: tuple[pin.Model, pin.Model]) -> None:
    theirs, ours = models
    random = np.random.default_rng(0)
    data, other = theirs.createData(), ours.createData()
    assert list(ours.names) == list(theirs.names)
    for _ in range(CONFIGURATIONS):
        q = random.uniform(theirs.lowerPositionLimit, theirs.upperPositionLimit)
        pin.framesForwardKinematics(theirs, data, q)
        pin.framesForwardKinematics(ours, other, q)
        for index, frame in enumerate(theirs.frames):
            there = other.oMf[ours.getFrameId(frame.name)].homogeneous
            np.testing.assert_allclose(
                there, data.oMf[index].homogeneous, atol=FRAME_ATOL, err_msg=frame.name
            )


def test_ranges_masses_and_inertia_are_those_of_the_maker(
    models: tuple[pin.Model, pin.Model],
) -> None:
    theirs, ours = models
    for what in ("lowerPositionLimit", "upperPositionLimit", "velocityLimit", "effortLimit"):
        np.testing.assert_array_equal(getattr(ours, what), getattr(theirs, what), err_msg=what)
    random = np.random.default_rng(0)
    data, other = theirs.createData(), ours.createData()
    for _ in range(CONFIGURATIONS):
        q = random.uniform(theirs.lowerPositionLimit, theirs.upperPositionLimit)
        inertia, gravity = pin.crba(theirs, data, q), pin.computeGeneralizedGravity(theirs, data, q)
        np.testing.assert_allclose(pin.crba(ours, other, q), inertia, atol=INERTIA_ATOL)
        mine = pin.computeGeneralizedGravity(ours, other, q)
        np.testing.assert_allclose(mine, gravity, atol=1e-6)


@pytest.mark.parametrize("robot", [RobotModel(), SO101], ids=["panda", "so101"])
def test_the_simulator_needs_no_mesh_of_a_shipped_description(robot: RobotModel) -> None:
    assert build_model("table", [robot]).nmesh == 0


@pytest.mark.parametrize(
    ("name", "tips"),
    [
        ("panda_sim", ("panda_leftfinger_2", "panda_rightfinger_2")),
        ("so101_sim", ("gripper_link_5", "moving_jaw_so101_v1_link_4")),
        ("widowx_ai", ("carriage_left_0", "carriage_right_0")),
    ],
)
def test_the_tips_of_the_fingers_meet_where_the_profile_says(
    name: str, tips: tuple[str, str]
) -> None:
    robot = load_profile(name).robot
    assert robot.gripper is not None
    urdf = str(robot_urdf(robot.description))
    model = pin.buildModelFromUrdf(urdf)
    shapes = pin.buildGeomFromUrdf(model, urdf, pin.GeometryType.COLLISION)
    shapes.addCollisionPair(pin.CollisionPair(*map(shapes.getGeometryId, tips)))
    q, fingers = pin.neutral(model), Fingers(robot.gripper, len(robot.finger_joints))
    for joint in robot.finger_joints:
        q[model.joints[model.getJointId(joint)].idx_q] = fingers.position(0.0)
    data, found = model.createData(), shapes.createData()
    pin.computeDistances(model, data, shapes, found, q)
    assert found.distanceResults[0].min_distance < MEET_M
