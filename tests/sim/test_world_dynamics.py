"""One robot description feeds MuJoCo and Pinocchio: both have to compute the same robot."""

from __future__ import annotations

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from vla_zenoh import resources
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.simulation.scene import PREFIX, TCP_SITE, build_model

CONFIGURATIONS = 200
POSITION_ATOL_M = 1e-9
ROTATION_ATOL = 1e-7  # the URDF's angles go through quaternions on one side only
INERTIA_ATOL = 1e-7
BIAS_ATOL_NM = 1e-5
MASS_ATOL_KG = 1e-12


@pytest.fixture(scope="module")
def simulated() -> mujoco.MjModel:
    return build_model("table", [RobotModel()], joint_friction_nm=0.5)


@pytest.fixture(scope="module")
def described() -> pin.Model:
    return pin.buildModelFromUrdf(str(resources.robot_urdf(RobotModel().description)))


def test_kinematics_and_dynamics_agree_with_pinocchio_in_random_configurations(
    simulated: mujoco.MjModel, described: pin.Model
) -> None:
    robot = RobotModel()
    random = np.random.default_rng(0)
    data, other = mujoco.MjData(simulated), described.createData()
    joints = [simulated.joint(PREFIX + n) for n in robot.arm_joints + robot.finger_joints]
    addresses = [int(joint.qposadr[0]) for joint in joints]
    dofs = np.array([int(joint.dofadr[0]) for joint in joints])
    frame = described.getFrameId(robot.tcp_link)
    site = simulated.site(PREFIX + TCP_SITE).id
    inertia = np.zeros((simulated.nv, simulated.nv))
    for _ in range(CONFIGURATIONS):
        q = random.uniform(described.lowerPositionLimit, described.upperPositionLimit)
        v = random.uniform(-2.0, 2.0, described.nv)
        data.qpos[addresses], data.qvel[dofs] = q, v
        mujoco.mj_forward(simulated, data)
        mujoco.mj_fullM(simulated, data, inertia)
        pin.framesForwardKinematics(described, other, q)
        upper = np.triu(pin.crba(described, other, q))
        tcp = other.oMf[frame]

        np.testing.assert_allclose(data.site_xpos[site], tcp.translation, atol=POSITION_ATOL_M)
        np.testing.assert_allclose(
            data.site_xmat[site].reshape(3, 3), tcp.rotation, atol=ROTATION_ATOL
        )
        np.testing.assert_allclose(
            inertia[np.ix_(dofs, dofs)], upper + np.triu(upper, 1).T, atol=INERTIA_ATOL
        )
        bias = pin.nonLinearEffects(described, other, q, v)
        np.testing.assert_allclose(data.qfrc_bias[dofs], bias, atol=BIAS_ATOL_NM)


def test_mass_and_limits_are_those_of_the_description(
    simulated: mujoco.MjModel, described: pin.Model
) -> None:
    robot = RobotModel()
    links = [i for i in range(simulated.nbody) if simulated.body(i).name.startswith(PREFIX)]
    described_kg = sum(inertia.mass for inertia in described.inertias)
    assert sum(simulated.body_mass[links]) == pytest.approx(described_kg, abs=MASS_ATOL_KG)
    for index, name in enumerate(robot.arm_joints):
        joint = simulated.joint(PREFIX + name)
        assert joint.range[0] == described.lowerPositionLimit[index]
        assert joint.range[1] == described.upperPositionLimit[index]
        limit = simulated.actuator(PREFIX + name).ctrlrange[1]
        assert limit == described.upperEffortLimit[index]


def test_no_armature_is_added_and_friction_goes_to_the_arm_alone(
    simulated: mujoco.MjModel,
) -> None:
    arm = [int(simulated.joint(PREFIX + n).dofadr[0]) for n in RobotModel().arm_joints]
    assert not simulated.dof_armature.any()
    assert (simulated.dof_frictionloss[arm] == 0.5).all()
    assert simulated.dof_frictionloss.sum() == pytest.approx(0.5 * len(arm))
