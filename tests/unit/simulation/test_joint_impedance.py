"""The joint impedance law as an equation, on the dynamics Pinocchio computes."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from vla_zenoh import resources
from vla_zenoh.simulation.impedance import (
    ArmDynamics,
    CartesianImpedance,
    ImpedanceGains,
    JointImpedance,
)
from vla_zenoh.simulation.robot_model import JointGains
from vla_zenoh.types import FloatArray, JointReference, PoseReference

URDF = "example-robot-data:panda_description/urdf/panda.urdf"
JOINTS = 7
PERIOD_S = 1e-3
TORQUE_ATOL_NM = 1e-9
DAMPING_RTOL = 0.05
PAYLOAD_NM = np.array([0.0, 1.5, 0.0, 1.0, 0.0, -0.4, 0.0])
HOME_RAD = np.array([0.0, -0.05, 0.0, -2.6, 0.0, 2.6, 0.8])
FRANKA_NM_RAD = (600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0)

COMPLIANT = JointGains(
    stiffness_nm_rad=(150.0, 150.0, 150.0, 150.0, 60.0, 40.0, 15.0), max_error_rad=0.15
)


@pytest.fixture(scope="module")
def model() -> pin.Model:
    whole = pin.buildModelFromUrdf(str(resources.robot_urdf(URDF)))
    fingers = [whole.getJointId(f"panda_finger_joint{i}") for i in (1, 2)]
    return pin.buildReducedModel(whole, fingers, np.zeros(whole.nq))


def state_at(model: pin.Model, q: FloatArray, v: FloatArray) -> ArmDynamics:
    data, axes = model.createData(), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    tcp = model.getFrameId("panda_hand_tcp")
    pin.computeAllTerms(model, data, q, v)
    pin.updateFramePlacements(model, data)
    upper = np.triu(data.M)
    return ArmDynamics(
        position_rad=q,
        velocity_rad_s=v,
        tcp_position_m=data.oMf[tcp].translation.copy(),
        tcp_rotation=data.oMf[tcp].rotation.copy(),
        jacobian=pin.getFrameJacobian(model, data, tcp, axes),
        drift=np.zeros(6),
        inertia=upper + np.triu(upper, 1).T,
        bias_nm=data.nle.copy(),
    )


def resting(model: pin.Model) -> ArmDynamics:
    return state_at(model, HOME_RAD, np.zeros(JOINTS))


def controller(gains: JointGains | None = None, effort_nm: float = 1e6) -> JointImpedance:
    effort = np.full(JOINTS, effort_nm)
    return JointImpedance(gains or JointGains(), effort_nm=effort, period_s=PERIOD_S)


def ahead(by_rad: FloatArray) -> JointReference:
    return JointReference.at_rest(HOME_RAD + by_rad)


def test_at_rest_on_the_reference_the_torque_is_gravity_alone(model: pin.Model) -> None:
    state = resting(model)
    output = controller().torque(ahead(np.zeros(JOINTS)), state)
    np.testing.assert_allclose(output.torque_nm, state.bias_nm, atol=TORQUE_ATOL_NM)
    assert not output.saturated


def test_a_small_error_pulls_each_joint_like_a_spring_of_its_own(model: pin.Model) -> None:
    state, off = resting(model), np.linspace(-0.01, 0.02, JOINTS)
    output = controller().torque(ahead(off), state)
    pull = output.torque_nm - state.bias_nm
    np.testing.assert_allclose(pull, off * FRANKA_NM_RAD, atol=TORQUE_ATOL_NM)
    np.testing.assert_allclose(output.error, off, atol=1e-15)


def test_with_feed_forward_a_moving_reference_is_matched_exactly(model: pin.Model) -> None:
    velocity = np.array([0.3, -0.2, 0.4, 0.5, -0.3, 0.2, 0.6])
    wanted = np.array([1.0, -2.0, 0.5, 1.5, -1.0, 2.0, 3.0])
    state = state_at(model, HOME_RAD, velocity)
    torque = controller().torque(JointReference(HOME_RAD, velocity, wanted), state).torque_nm
    got = np.linalg.solve(state.inertia, torque - state.bias_nm)
    np.testing.assert_allclose(got, wanted, atol=1e-8)


@pytest.mark.parametrize("zeta", [0.7, 1.0])
def test_the_damping_ratio_is_the_same_in_every_pose(model: pin.Model, zeta: float) -> None:
    law = controller(JointGains(damping_ratio=zeta))
    random = np.random.default_rng(0)
    for _ in range(20):
        q = HOME_RAD + random.uniform(-0.6, 0.6, JOINTS)
        state = state_at(model, q, np.zeros(JOINTS))
        pulls = []
        for axis in np.eye(JOINTS):
            moving = JointReference(q, axis, np.zeros(JOINTS))
            pulls.append(law.torque(moving, state).torque_nm - state.bias_nm)
        damping = np.array(pulls).T
        system = np.block(
            [
                [np.zeros((JOINTS, JOINTS)), np.eye(JOINTS)],
                [
                    -np.linalg.solve(state.inertia, np.diag(FRANKA_NM_RAD)),
                    -np.linalg.solve(state.inertia, damping),
                ],
            ]
        )
        poles = np.linalg.eigvals(system)
        # Joints of different inertia pull at each other: no pole is damped less than asked.
        assert (-poles.real / np.abs(poles)).min() > zeta * (1.0 - DAMPING_RTOL)
        np.testing.assert_allclose(damping, damping.T, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("gains", [JointGains(), COMPLIANT])
def test_however_far_the_reference_the_pull_is_bounded(model: pin.Model, gains: JointGains) -> None:
    state = resting(model)
    far = JointReference(HOME_RAD + 1.0, np.full(JOINTS, 2.0), np.full(JOINTS, 9.0))
    pull = controller(gains).torque(far, state).torque_nm - state.bias_nm
    most = np.array(gains.stiffness_nm_rad) * gains.max_error_rad
    np.testing.assert_allclose(pull, most, atol=TORQUE_ATOL_NM)


def test_feed_forward_fades_as_the_arm_falls_behind(model: pin.Model) -> None:
    state, gains = resting(model), JointGains()
    moving = np.full(JOINTS, 0.1)
    pushes = []
    for share in (0.4, 0.75, 1.0):
        off = np.eye(JOINTS)[0] * share * gains.max_error_rad
        with_feed = JointReference(HOME_RAD + off, moving, np.zeros(JOINTS))
        torque = controller().torque(with_feed, state).torque_nm
        pushes.append(torque - controller().torque(ahead(off), state).torque_nm)
    whole = pushes[0]
    np.testing.assert_allclose(pushes[1], 0.5 * whole, atol=1e-6)
    np.testing.assert_allclose(pushes[2], 0.0, atol=1e-6)
    assert np.abs(whole).max() > 1.0


def test_the_integral_grows_to_its_bound(model: pin.Model) -> None:
    law, state, gains = controller(), resting(model), JointGains()
    off = np.full(JOINTS, 0.01)
    law.torque(ahead(off), state)
    one_tick = gains.integral_1_s * PERIOD_S * 0.01 * np.array(FRANKA_NM_RAD)
    np.testing.assert_allclose(law.integral, one_tick, atol=1e-12)
    for _ in range(3000):
        law.torque(ahead(off), state)
    np.testing.assert_array_equal(law.integral, gains.max_integral_nm)


def test_a_blocked_joint_winds_nothing_up_but_unwinds_and_its_neighbours_go_on(
    model: pin.Model,
) -> None:
    law, state = controller(), resting(model)
    off = np.array([0.2, 0.01, 0, 0, 0, 0, 0])
    for _ in range(100):
        law.torque(ahead(off), state)
    assert law.integral[0] == 0.0
    assert law.integral[1] > 1.0
    for _ in range(100):
        law.torque(ahead(off * [0.05, 1, 1, 1, 1, 1, 1]), state)
    wound = law.integral[0]
    law.torque(ahead(-off), state)
    assert 0.0 < law.integral[0] < wound


def test_a_joint_at_its_torque_limit_winds_nothing_up(model: pin.Model) -> None:
    state = resting(model)
    law = controller(effort_nm=5.0)
    off = np.array([0.02, 0, 0, 0, 0, 0, 0.02])
    output = law.torque(ahead(off), state)
    assert output.saturated
    assert (np.abs(output.torque_nm) <= 5.0).all()
    assert law.integral[0] == 0.0
    assert law.integral[6] > 0.0


@pytest.mark.parametrize(
    ("joints", "last"), [(6, FRANKA_NM_RAD[5]), (7, FRANKA_NM_RAD[6]), (8, FRANKA_NM_RAD[6])]
)
def test_arms_with_fewer_or_more_joints_have_gains(joints: int, last: float) -> None:
    law = JointImpedance(JointGains(), effort_nm=np.full(joints, 100.0), period_s=PERIOD_S)
    zeros = np.zeros(joints)
    state = ArmDynamics(
        zeros, zeros, np.zeros(3), np.eye(3), np.zeros((6, joints)), np.zeros(6), np.eye(joints),
        zeros,
    )  # fmt: skip
    off = np.full(joints, 0.01)
    torque = law.torque(JointReference.at_rest(off), state).torque_nm
    assert torque[0] == pytest.approx(6.0)
    assert torque[-1] == pytest.approx(0.01 * last)


# -- one law after the other ------------------------------------------------------------------
def test_what_another_law_carried_goes_on_being_carried(model: pin.Model) -> None:
    state = resting(model)
    held = state.bias_nm + PAYLOAD_NM
    joint_law = controller()
    joint_law.take_over(held, state)
    first = joint_law.torque(ahead(np.zeros(JOINTS)), state).torque_nm
    np.testing.assert_allclose(first, held, atol=TORQUE_ATOL_NM)


def test_the_cartesian_law_takes_over_a_load_at_the_tcp_and_the_posture(model: pin.Model) -> None:
    state = resting(model)
    held = state.bias_nm + state.jacobian.T @ np.array([1.0, -2.0, 6.0, 0.2, -0.1, 0.3])
    law = CartesianImpedance(
        ImpedanceGains(),
        lower_rad=model.lowerPositionLimit,
        upper_rad=model.upperPositionLimit,
        effort_nm=np.full(JOINTS, 1e6),
        posture_rad=HOME_RAD + 0.5,
        period_s=PERIOD_S,
    )
    law.take_over(held, state)
    here = PoseReference(state.tcp_position_m, state.tcp_rotation, np.zeros(6), np.zeros(6))
    np.testing.assert_allclose(law.torque(here, state).torque_nm, held, atol=1e-8)


def test_what_is_taken_over_stays_within_the_integrals_bounds(model: pin.Model) -> None:
    state, law = resting(model), controller()
    law.take_over(state.bias_nm + 50.0, state)
    np.testing.assert_array_equal(law.integral, JointGains().max_integral_nm)
