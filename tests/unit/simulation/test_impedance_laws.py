"""The impedance laws as equations, on the dynamics Pinocchio computes."""

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
WRENCH_ATOL = 1e-9
DAMPING_RTOL = 0.05
MIN_POSTURE_NM = 0.3  # less would say nothing about where it goes
NULL_ACCELERATION = 1e-9  # m/s^2, rad/s^2
POSTURE_RAD = np.array([0.0, -0.05, 0.0, -2.6, 0.0, 2.6, 0.8])
PAYLOAD_NM = np.array([0.0, 1.5, 0.0, 1.0, 0.0, -0.4, 0.0])
FRANKA_NM_RAD = (600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0)

COMPLIANT = ImpedanceGains(
    translational_n_m=400.0, rotational_nm_rad=20.0, max_error_m=0.06, max_error_rad=0.5
)
COMPLIANT_JOINTS = JointGains(
    stiffness_nm_rad=(150.0, 150.0, 150.0, 150.0, 60.0, 40.0, 15.0), max_error_rad=0.15
)


class Arm:
    """A Panda's arm, fingers locked."""

    def __init__(self) -> None:
        whole = pin.buildModelFromUrdf(str(resources.robot_urdf(URDF)))
        fingers = [whole.getJointId(f"panda_finger_joint{i}") for i in (1, 2)]
        self.model = pin.buildReducedModel(whole, fingers, np.zeros(whole.nq))
        self.data = self.model.createData()
        self.tcp = self.model.getFrameId("panda_hand_tcp")

    def state(self, q: np.ndarray, v: np.ndarray) -> ArmDynamics:
        model, data, axes = self.model, self.data, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        pin.computeAllTerms(model, data, q, v)
        pin.updateFramePlacements(model, data)
        pin.forwardKinematics(model, data, q, v, np.zeros(JOINTS))
        drift = pin.getFrameClassicalAcceleration(model, data, self.tcp, axes).vector
        upper = np.triu(data.M)
        return ArmDynamics(
            position_rad=q,
            velocity_rad_s=v,
            tcp_position_m=data.oMf[self.tcp].translation.copy(),
            tcp_rotation=data.oMf[self.tcp].rotation.copy(),
            jacobian=pin.getFrameJacobian(model, data, self.tcp, axes),
            drift=drift,
            inertia=upper + np.triu(upper, 1).T,
            bias_nm=data.nle.copy(),
        )


@pytest.fixture(scope="module")
def arm() -> Arm:
    return Arm()


def resting(arm: Arm) -> ArmDynamics:
    return arm.state(POSTURE_RAD, np.zeros(JOINTS))


def controller(arm: Arm, gains: ImpedanceGains, **changes: np.ndarray) -> CartesianImpedance:
    settings = {
        "lower_rad": arm.model.lowerPositionLimit,
        "upper_rad": arm.model.upperPositionLimit,
        "effort_nm": np.full(JOINTS, 1e6),
        "posture_rad": POSTURE_RAD,
    }
    return CartesianImpedance(gains, **(settings | changes), period_s=PERIOD_S)


def reference_at(state: ArmDynamics) -> PoseReference:
    return PoseReference(state.tcp_position_m, state.tcp_rotation, np.zeros(6), np.zeros(6))


def moved(state: ArmDynamics, by_m: tuple[float, float, float]) -> PoseReference:
    return reference_at(state)._replace(position_m=state.tcp_position_m + by_m)


def test_at_rest_on_the_reference_the_torque_is_gravity_alone(arm: Arm) -> None:
    state = resting(arm)
    output = controller(arm, ImpedanceGains()).torque(reference_at(state), state)
    np.testing.assert_allclose(output.torque_nm, state.bias_nm, atol=TORQUE_ATOL_NM)
    assert not output.saturated


def test_a_small_error_pulls_like_a_spring(arm: Arm) -> None:
    gains = ImpedanceGains(translational_n_m=1000.0)
    state = resting(arm)
    output = controller(arm, gains).torque(moved(state, (0.004, 0.0, -0.003)), state)
    np.testing.assert_allclose(output.wrench, (4.0, 0, -3.0, 0, 0, 0), atol=WRENCH_ATOL)
    np.testing.assert_allclose(
        output.torque_nm - state.bias_nm, state.jacobian.T @ output.wrench, atol=TORQUE_ATOL_NM
    )


def test_a_turned_reference_pulls_about_its_axis_in_the_base_frame(arm: Arm) -> None:
    gains = ImpedanceGains(rotational_nm_rad=50.0)
    state = resting(arm)
    turned = pin.exp3(np.array([0.0, 0.05, 0.0])) @ state.tcp_rotation
    output = controller(arm, gains).torque(reference_at(state)._replace(rotation=turned), state)
    np.testing.assert_allclose(output.wrench, (0, 0, 0, 0, 2.5, 0), atol=WRENCH_ATOL)


@pytest.mark.parametrize("gains", [ImpedanceGains(), COMPLIANT])
def test_however_far_the_reference_the_pull_is_bounded(arm: Arm, gains: ImpedanceGains) -> None:
    state = resting(arm)
    far = moved(state, (0.3, -0.4, 0.5))._replace(twist=np.full(6, 0.5), acceleration=np.ones(6))
    output = controller(arm, gains).torque(far, state)
    pull = gains.translational_n_m * gains.max_error_m
    assert np.linalg.norm(output.wrench[:3]) == pytest.approx(pull)
    assert np.linalg.norm(output.error[:3]) == pytest.approx(np.sqrt(0.5))


@pytest.mark.parametrize("zeta", [0.7, 1.0])
def test_the_damping_ratio_is_the_same_in_every_pose(arm: Arm, zeta: float) -> None:
    gains = ImpedanceGains(damping_ratio=zeta)
    stiffness = np.diag([gains.translational_n_m] * 3 + [gains.rotational_nm_rad] * 3)
    random = np.random.default_rng(0)
    for _ in range(20):
        q = POSTURE_RAD + random.uniform(-0.6, 0.6, JOINTS)
        state = arm.state(q, np.zeros(JOINTS))
        columns = []
        for axis in np.eye(6):
            law = controller(arm, gains, posture_rad=q)
            moving = reference_at(state)._replace(twist=axis)
            columns.append(law.torque(moving, state).wrench)
        damping = np.array(columns).T
        inertia = np.linalg.inv(state.jacobian @ np.linalg.solve(state.inertia, state.jacobian.T))
        system = np.block(
            [
                [np.zeros((6, 6)), np.eye(6)],
                [-np.linalg.solve(inertia, stiffness), -np.linalg.solve(inertia, damping)],
            ]
        )
        poles = np.linalg.eigvals(system)
        assert (-poles.real / np.abs(poles)).min() > zeta * (1.0 - DAMPING_RTOL)


def test_the_posture_torque_does_not_move_the_tcp(arm: Arm) -> None:
    state = resting(arm)
    away = POSTURE_RAD + (0.3, -0.2, 0.4, 0.1, -0.3, 0.2, 0.5)
    law = controller(arm, ImpedanceGains(), posture_rad=away)
    torque = law.torque(reference_at(state), state).torque_nm - state.bias_nm
    assert np.abs(torque).max() > MIN_POSTURE_NM
    acceleration = state.jacobian @ np.linalg.solve(state.inertia, torque)
    assert np.abs(acceleration).max() < NULL_ACCELERATION


def test_with_feed_forward_a_moving_reference_is_matched_exactly(arm: Arm) -> None:
    velocity = np.array([0.3, -0.2, 0.4, 0.5, -0.3, 0.2, 0.6])
    state = arm.state(POSTURE_RAD, velocity)
    wanted = np.array([0.5, -0.4, 0.3, 0.8, -0.6, 0.7])
    reference = reference_at(state)._replace(twist=state.jacobian @ velocity, acceleration=wanted)
    law = controller(arm, ImpedanceGains())
    torque = law.torque(reference, state).torque_nm
    joints = np.linalg.solve(state.inertia, torque - state.bias_nm)
    np.testing.assert_allclose(state.jacobian @ joints + state.drift, wanted, atol=1e-8)


def test_the_integral_grows_to_its_bound(arm: Arm) -> None:
    gains = ImpedanceGains()
    state = resting(arm)
    law = controller(arm, gains)
    off = moved(state, (0.0, 0.0, 0.005))
    law.torque(off, state)
    one_tick = gains.integral_1_s * gains.translational_n_m * 0.005 * PERIOD_S
    np.testing.assert_allclose(law.integral, (0, 0, one_tick, 0, 0, 0), atol=1e-12)
    for _ in range(2000):
        law.torque(off, state)
    assert law.integral[2] == gains.max_integral_n


def test_a_blocked_arm_winds_nothing_up_but_unwinds(arm: Arm) -> None:
    state = resting(arm)
    law = controller(arm, ImpedanceGains())
    for _ in range(100):
        law.torque(moved(state, (0.0, 0.0, 0.2)), state)
    assert not law.integral.any()
    for _ in range(100):
        law.torque(moved(state, (0.0, 0.0, 0.005)), state)
    wound = law.integral[2]
    law.torque(moved(state, (0.0, 0.0, -0.2)), state)
    assert 0.0 < law.integral[2] < wound


def test_a_torque_never_exceeds_the_effort_limit(arm: Arm) -> None:
    limit = np.array([5.0, 5.0, 5.0, 5.0, 1.0, 1.0, 1.0])
    state = resting(arm)
    law = controller(arm, ImpedanceGains(), effort_nm=limit)
    output = law.torque(moved(state, (0.02, 0.02, 0.02)), state)
    assert output.saturated
    assert (np.abs(output.torque_nm) <= limit).all()


def test_near_a_joint_limit_the_nullspace_pushes_back(arm: Arm) -> None:
    q = POSTURE_RAD.copy()
    q[0] = arm.model.upperPositionLimit[0] - 0.02
    state = arm.state(q, np.zeros(JOINTS))
    near = controller(arm, ImpedanceGains(), posture_rad=q)
    push = near.torque(reference_at(state), state).torque_nm - state.bias_nm
    assert push @ np.linalg.solve(state.inertia, np.eye(JOINTS)[0]) < 0.0  # joint 1 goes back
    inside = q.copy()
    inside[0] = 0.0
    state = arm.state(inside, np.zeros(JOINTS))
    free = controller(arm, ImpedanceGains(), posture_rad=inside)
    still = free.torque(reference_at(state), state).torque_nm - state.bias_nm
    np.testing.assert_allclose(still, 0.0, atol=TORQUE_ATOL_NM)


# -- in joints --------------------------------------------------------------------------------
def joint_law(gains: JointGains | None = None, effort_nm: float = 1e6) -> JointImpedance:
    effort = np.full(JOINTS, effort_nm)
    return JointImpedance(gains or JointGains(), effort_nm=effort, period_s=PERIOD_S)


def ahead(by_rad: FloatArray) -> JointReference:
    return JointReference.at_rest(POSTURE_RAD + by_rad)


def test_in_joints_at_rest_on_the_reference_the_torque_is_gravity_alone(arm: Arm) -> None:
    state = resting(arm)
    output = joint_law().torque(ahead(np.zeros(JOINTS)), state)
    np.testing.assert_allclose(output.torque_nm, state.bias_nm, atol=TORQUE_ATOL_NM)
    assert not output.saturated


def test_a_small_error_pulls_each_joint_like_a_spring_of_its_own(arm: Arm) -> None:
    state, off = resting(arm), np.linspace(-0.01, 0.02, JOINTS)
    output = joint_law().torque(ahead(off), state)
    pull = output.torque_nm - state.bias_nm
    np.testing.assert_allclose(pull, off * FRANKA_NM_RAD, atol=TORQUE_ATOL_NM)
    np.testing.assert_allclose(output.error, off, atol=1e-15)


def test_in_joints_with_feed_forward_a_moving_reference_is_matched_exactly(arm: Arm) -> None:
    velocity = np.array([0.3, -0.2, 0.4, 0.5, -0.3, 0.2, 0.6])
    wanted = np.array([1.0, -2.0, 0.5, 1.5, -1.0, 2.0, 3.0])
    state = arm.state(POSTURE_RAD, velocity)
    torque = joint_law().torque(JointReference(POSTURE_RAD, velocity, wanted), state).torque_nm
    got = np.linalg.solve(state.inertia, torque - state.bias_nm)
    np.testing.assert_allclose(got, wanted, atol=1e-8)


@pytest.mark.parametrize("zeta", [0.7, 1.0])
def test_in_joints_the_damping_ratio_is_the_same_in_every_pose(arm: Arm, zeta: float) -> None:
    law = joint_law(JointGains(damping_ratio=zeta))
    random = np.random.default_rng(0)
    for _ in range(20):
        q = POSTURE_RAD + random.uniform(-0.6, 0.6, JOINTS)
        state = arm.state(q, np.zeros(JOINTS))
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


@pytest.mark.parametrize("gains", [JointGains(), COMPLIANT_JOINTS])
def test_in_joints_however_far_the_reference_the_pull_is_bounded(
    arm: Arm, gains: JointGains
) -> None:
    state = resting(arm)
    far = JointReference(POSTURE_RAD + 1.0, np.full(JOINTS, 2.0), np.full(JOINTS, 9.0))
    pull = joint_law(gains).torque(far, state).torque_nm - state.bias_nm
    most = np.array(gains.stiffness_nm_rad) * gains.max_error_rad
    np.testing.assert_allclose(pull, most, atol=TORQUE_ATOL_NM)


def test_feed_forward_fades_as_the_arm_falls_behind(arm: Arm) -> None:
    state, gains = resting(arm), JointGains()
    moving = np.full(JOINTS, 0.1)
    pushes = []
    for share in (0.4, 0.75, 1.0):
        off = np.eye(JOINTS)[0] * share * gains.max_error_rad
        with_feed = JointReference(POSTURE_RAD + off, moving, np.zeros(JOINTS))
        torque = joint_law().torque(with_feed, state).torque_nm
        pushes.append(torque - joint_law().torque(ahead(off), state).torque_nm)
    whole = pushes[0]
    np.testing.assert_allclose(pushes[1], 0.5 * whole, atol=1e-6)
    np.testing.assert_allclose(pushes[2], 0.0, atol=1e-6)
    assert np.abs(whole).max() > 1.0


def test_in_joints_the_integral_grows_to_its_bound(arm: Arm) -> None:
    law, state, gains = joint_law(), resting(arm), JointGains()
    off = np.full(JOINTS, 0.01)
    law.torque(ahead(off), state)
    one_tick = gains.integral_1_s * PERIOD_S * 0.01 * np.array(FRANKA_NM_RAD)
    np.testing.assert_allclose(law.integral, one_tick, atol=1e-12)
    for _ in range(3000):
        law.torque(ahead(off), state)
    np.testing.assert_array_equal(law.integral, gains.max_integral_nm)


def test_a_blocked_joint_winds_nothing_up_but_unwinds_and_its_neighbours_go_on(
    arm: Arm,
) -> None:
    law, state = joint_law(), resting(arm)
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


def test_a_joint_at_its_torque_limit_winds_nothing_up(arm: Arm) -> None:
    state = resting(arm)
    law = joint_law(effort_nm=5.0)
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
def test_what_another_law_carried_goes_on_being_carried(arm: Arm) -> None:
    state = resting(arm)
    held = state.bias_nm + PAYLOAD_NM
    law = joint_law()
    law.take_over(held, state)
    first = law.torque(ahead(np.zeros(JOINTS)), state).torque_nm
    np.testing.assert_allclose(first, held, atol=TORQUE_ATOL_NM)


def test_the_cartesian_law_takes_over_a_load_at_the_tcp_and_the_posture(arm: Arm) -> None:
    state = resting(arm)
    held = state.bias_nm + state.jacobian.T @ np.array([1.0, -2.0, 6.0, 0.2, -0.1, 0.3])
    law = controller(arm, ImpedanceGains(), posture_rad=POSTURE_RAD + 0.5)
    law.take_over(held, state)
    np.testing.assert_allclose(law.torque(reference_at(state), state).torque_nm, held, atol=1e-8)


def test_what_is_taken_over_stays_within_the_integrals_bounds(arm: Arm) -> None:
    state, law = resting(arm), joint_law()
    law.take_over(state.bias_nm + 50.0, state)
    np.testing.assert_array_equal(law.integral, JointGains().max_integral_nm)
    of_tcp, gains = controller(arm, ImpedanceGains()), ImpedanceGains()
    of_tcp.take_over(state.bias_nm + state.jacobian.T @ np.repeat([-50.0, 10.0], 3), state)
    most = np.repeat([-gains.max_integral_n, gains.max_integral_nm], 3)
    np.testing.assert_allclose(of_tcp.integral, most)
