"""One arm as MuJoCo simulates it, under impedance control, and its gripper."""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np

from vla_zenoh.errors import NodeError, RecordError, ResourceError
from vla_zenoh.kinematics.so3 import rotation_from_rpy
from vla_zenoh.simulation.impedance import (
    ArmDynamics,
    CartesianImpedance,
    ImpedanceGains,
    JointImpedance,
)
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.simulation.scene import GRIPPER, STEP_S, TCP_SITE, prefix_of
from vla_zenoh.types import FloatArray, GripperState, JointState, PoseState
from vla_zenoh.types.records import JointReference, PoseReference

WRENCH_FILTER_S = 0.01
"""Time constant of the reported wrench: a robot's own estimate is filtered too."""
AT_REST_M_S = 2e-3
AT_REST_TICKS = 50  # milliseconds of standstill before the gripper reports "holding"
HELD_MARGIN_M = 5e-4  # set narrower than measured by this much: an object is in between
DEFAULT_FORCE_N = 20.0
MAX_FORCE_N = 70.0


class SimulatedPart:
    """One arm with its gripper in a `World`, under impedance control of its TCP or joints.

    At rest either law takes over from the other with the same torque; a change between them in
    motion jolts the arm. All poses are of the TCP in the base frame of the arm. `refresh` computes
    positions after a step; see `World` for the others.

    Raises:
        ResourceError: the arm's joints are not one chain.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        robot: RobotModel,
        home_rad: FloatArray,
        gains: ImpedanceGains,
        refresh: Callable[[], None],
    ) -> None:
        self.robot, self._home_rad, self._refresh = robot, home_rad, refresh
        self._model, self._data = model, data
        self.gripper = SimulatedGripper(model, data, robot)
        self.set_gripper, self.gripper_state = self.gripper.command, self.gripper.state
        joints = [model.joint(prefix_of(robot) + name) for name in robot.arm_joints]
        first_dof, first_q = int(joints[0].dofadr[0]), int(joints[0].qposadr[0])
        if [int(joint.dofadr[0]) - first_dof for joint in joints] != list(range(len(joints))):
            raise ResourceError("the arm's joints do not follow each other in the URDF")
        self._dofs = slice(first_dof, first_dof + len(joints))
        self._actuators = np.array(
            [model.actuator(prefix_of(robot) + name).id for name in robot.arm_joints]
        )
        # Views of the state: as fresh as the last MuJoCo call of the code that steps it.
        self._qpos = slice(first_q, first_q + len(joints))
        self._position_rad = data.qpos[self._qpos]
        self._velocity_rad_s = data.qvel[self._dofs]
        self._effort_nm = data.qfrc_actuator[self._dofs]
        self._bias_nm = data.qfrc_bias[self._dofs]
        self._tcp = int(model.site(prefix_of(robot) + TCP_SITE).id)
        self._tcp_body = int(model.site_bodyid[self._tcp])
        self._world_m = data.site_xpos[self._tcp]
        self._world_rotation = data.site_xmat[self._tcp].reshape(3, 3)
        self._base: tuple[FloatArray, FloatArray] | None = None
        if any(robot.base_m) or robot.base_yaw_rad:
            turn = rotation_from_rpy(np.array([0.0, 0.0, robot.base_yaw_rad]))
            self._base = np.array(robot.base_m), turn
        root = model.body_rootid[self._tcp_body]
        # The fixed base presses against the ground it stands on, which is no contact of the arm.
        moves = model.body_weldid[model.geom_bodyid] != 0
        self._own_geom = moves & (model.body_rootid[model.geom_bodyid] == root)
        # (6, nv): of the TCP and its rate; MuJoCo writes both halves of each.
        self._jacobian, self._rate = np.zeros((6, model.nv)), np.zeros((6, model.nv))
        self._halves = [(rows[:3], rows[3:]) for rows in (self._jacobian, self._rate)]
        self._inertia = np.zeros((model.nv, model.nv))
        self._scratch = mujoco.MjData(model)

        lower_rad, upper_rad = np.array([joint.range for joint in joints]).T
        self.joint_range_rad = lower_rad, upper_rad  # (n,) each
        effort_nm = model.actuator_ctrlrange[self._actuators, 1]
        limits = {"lower_rad": lower_rad, "upper_rad": upper_rad, "effort_nm": effort_nm}
        self._cartesian = CartesianImpedance(gains, **limits, posture_rad=home_rad, period_s=STEP_S)
        self._joint = JointImpedance(robot.gains, effort_nm=effort_nm, period_s=STEP_S)
        self._active_law: CartesianImpedance | JointImpedance | None = None
        self._held_rad: FloatArray | None = None
        self._filtered_wrench = np.zeros(6)

    def reset(self) -> None:
        """Put the joints at home, at rest, with the gripper open."""
        self._position_rad[:] = self._home_rad
        self.gripper.open()
        self.reset_laws()

    def reset_laws(self) -> None:
        """Forget what the controllers have accumulated and measured."""
        self._cartesian.reset(self._home_rad)
        self._joint.reset()
        self._active_law = self._held_rad = None
        self._filtered_wrench = np.zeros(6)

    def torque(self, reference: PoseReference | JointReference) -> bool:
        """Set the torques of this tick; whether an effort limit cut them.

        Raises:
            NodeError: the reference is not finite.
        """
        state = self._dynamics()
        if isinstance(reference, JointReference):
            law, self._held_rad = self._joint, reference.position_rad
        else:
            law, self._held_rad = self._cartesian, None
        if self._active_law not in (None, law):
            law.take_over(self._data.ctrl[self._actuators], state)
        self._active_law = law
        output = law.torque(reference, state)  # pyright: ignore[reportArgumentType]  # of its law
        if not math.isfinite(sum(output.torque_nm.tolist())):
            raise NodeError(f"the reference is not finite: {reference}")
        self._data.ctrl[self._actuators] = output.torque_nm
        self.gripper.step()
        return output.saturated

    def _dynamics(self) -> ArmDynamics:
        """State for an impedance law; some arrays are views, valid until the next step."""
        mujoco.mj_fullM(self._model, self._data, self._inertia)
        tcp_m, tcp_rotation = self._in_base(self._world_m, self._world_rotation)
        mujoco.mj_jacDot(self._model, self._data, *self._halves[1], self._world_m, self._tcp_body)
        return ArmDynamics(
            position_rad=self._position_rad,
            velocity_rad_s=self._velocity_rad_s,
            tcp_position_m=tcp_m,
            tcp_rotation=tcp_rotation,
            jacobian=self._tcp_jacobian(),
            drift=self._axes_of_base(self._rate[:, self._dofs] @ self._velocity_rad_s),
            inertia=self._inertia[self._dofs, self._dofs],
            bias_nm=self._bias_nm,
        )

    def filter_wrench(self) -> None:
        """Follow the wrench of the last step."""
        error = self._contact_wrench() - self._filtered_wrench
        self._filtered_wrench += (STEP_S / WRENCH_FILTER_S) * error

    # -- geometry -----------------------------------------------------------------------------
    def _in_base(
        self, position_m: FloatArray, rotation: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        if self._base is None:
            return position_m, rotation
        base_m, turn = self._base
        return turn.T @ (position_m - base_m), turn.T @ rotation

    def _axes_of_base(self, world: FloatArray) -> FloatArray:
        """Rows (6, ...) in world axes, linear ones first, in the axes of the base."""
        if self._base is None:
            return world
        turn = self._base[1].T
        return np.concatenate([turn @ world[:3], turn @ world[3:]])

    def _tcp_jacobian(self) -> FloatArray:
        mujoco.mj_jacSite(self._model, self._data, *self._halves[0], self._tcp)
        return self._axes_of_base(self._jacobian[:, self._dofs])

    def _contact_wrench(self) -> FloatArray:
        model, data = self._model, self._data
        total, local = np.zeros(6), np.zeros(6)
        if data.ncon == 0:
            return total
        own = self._own_geom[data.contact.geom]
        for index in np.flatnonzero(own[:, 0] != own[:, 1]):
            contact, second = data.contact[index], own[index, 1]
            mujoco.mj_contactForce(model, data, index, local)
            axes = contact.frame.reshape(3, 3)  # rows; the force acts on the second geom
            sign = 1.0 if second else -1.0
            force, moment = sign * (local[:3] @ axes), sign * (local[3:] @ axes)
            lever = contact.pos - self._world_m
            total[:3] += force
            total[3:] += moment + np.cross(lever, force)
        return self._axes_of_base(total)

    # -- measurements -------------------------------------------------------------------------
    def hold_reference(self) -> PoseReference:
        """Reference at the measured TCP, at rest."""
        return PoseReference(*self.tcp(), np.zeros(6), np.zeros(6))

    @property
    def wrench(self) -> FloatArray:
        """(6,) external contact wrench of the last step: N, Nm about the TCP, base axes.

        Contacts between the robot's own parts are left out. What the fingers squeeze presses on
        both of them and cancels, so that its weight remains.
        """
        self._refresh()
        return self._contact_wrench()

    def joint_state(self) -> JointState:
        """Arm joints; the effort is that of the motors.

        The reference is that of the joints; under Cartesian control the measured position.
        """
        measured_rad = self._position_rad
        held_rad = measured_rad if self._held_rad is None else self._held_rad
        return JointState(
            self.robot.arm_joints, measured_rad, self._velocity_rad_s, self._effort_nm, held_rad
        )

    def tcp(self) -> tuple[FloatArray, FloatArray]:
        """Measured TCP: position (3,) in metres and rotation (3, 3), copies."""
        self._refresh()
        position_m, rotation = self._in_base(self._world_m, self._world_rotation)
        return position_m.copy(), rotation.copy()

    def pose_state(self, reference: PoseReference | JointReference) -> PoseState:
        """Measured TCP pose, twist and wrench, with `reference`.

        The wrench is `wrench` behind a first-order low-pass of `WRENCH_FILTER_S`.
        """
        position, rotation = self.tcp()
        if isinstance(reference, JointReference):
            data, tcp = self._scratch, self._tcp
            data.qpos[self._qpos] = reference.position_rad
            mujoco.mj_kinematics(self._model, data)
            held = self._in_base(data.site_xpos[tcp], data.site_xmat[tcp].reshape(3, 3))
        else:
            held = reference.position_m, reference.rotation
        return PoseState(
            position_m=position,
            quat_xyzw=_quat_xyzw(rotation),
            twist=self._tcp_jacobian() @ self._velocity_rad_s,
            wrench=self._filtered_wrench.copy(),
            reference_position_m=held[0],
            reference_quat_xyzw=_quat_xyzw(held[1]),
        )


def _quat_xyzw(rotation: FloatArray) -> FloatArray:
    quat_wxyz = np.empty(4)
    mujoco.mju_mat2Quat(quat_wxyz, np.ascontiguousarray(rotation).ravel())
    return quat_wxyz[[1, 2, 3, 0]]


class SimulatedGripper:
    """Fingers with a width servo: the set width changes at a given speed, under a bounded force."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, robot: RobotModel) -> None:
        self._model, self._data = model, data
        fingers = [model.joint(prefix_of(robot) + name) for name in robot.finger_joints]
        self._q = [data.qpos[joint.qposadr[0] :][:1] for joint in fingers]
        self._v = [data.qvel[joint.dofadr[0] :][:1] for joint in fingers]
        self._scale_m, self._max_width_m = robot.finger_scale_m, robot.max_width_m
        # Each opens as far as the others.
        self._open = self._max_width_m / self._scale_m / len(fingers)
        self._actuator = int(model.actuator(prefix_of(robot) + GRIPPER).id)
        self.open()

    def open(self) -> None:
        """Put the fingers at their widest, as after a reset."""
        for joint in self._q:
            joint[:] = self._open
        self._target_m = self._set_m = self._measured_m = self._max_width_m
        self._step_m = 0.0
        self._rest_ticks = AT_REST_TICKS
        self._bound_force(DEFAULT_FORCE_N)

    def command(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """Go to `width_m` at `speed_m_s`, pressing with at most `force_n`; both above zero."""
        if not speed_m_s > 0.0 or not force_n > 0.0:
            why = f"a gripper needs speed and force above 0, got {speed_m_s} and {force_n}"
            raise RecordError(why)
        target = min(max(width_m, 0.0), self._max_width_m)
        # Squeezing continues from the ramp, else a repeated command would release for a moment; a
        # reversal starts at the fingers, else it would lag by the whole squeeze.
        if (target - self._measured_m) * (self._set_m - self._measured_m) <= 0.0:
            self._set_m = self._measured_m
        self._target_m = target
        self._step_m = speed_m_s * STEP_S
        if abs(target - self._measured_m) > HELD_MARGIN_M and not self._holding:
            self._rest_ticks = 0
        self._bound_force(force_n)

    def step(self) -> None:
        """Set the actuator for this tick."""
        self._measured_m, rate_m_s = self._opening()
        self._rest_ticks = self._rest_ticks + 1 if abs(rate_m_s) < AT_REST_M_S else 0
        left = self._target_m - self._set_m
        self._set_m += min(max(left, -self._step_m), self._step_m)
        self._data.ctrl[self._actuator] = self._set_m

    def state(self) -> GripperState:
        """Opening between the fingers, and whether they move or hold an object."""
        return GripperState(self._opening()[0], moving=self._moving, holding=self._holding)

    @property
    def force_n(self) -> float:
        """Force of either finger, inwards positive."""
        return -float(self._data.actuator_force[self._actuator])

    @property
    def _moving(self) -> bool:
        return self._rest_ticks < AT_REST_TICKS

    @property
    def _holding(self) -> bool:
        """The fingers stand still wider than set: an object keeps them apart."""
        return self._measured_m - self._set_m > HELD_MARGIN_M and not self._moving

    def _opening(self) -> tuple[float, float]:
        q, v = (sum(at.item() for at in joints) for joints in (self._q, self._v))
        return q * self._scale_m, v * self._scale_m

    def _bound_force(self, force_n: float) -> None:
        limit_n = min(force_n, MAX_FORCE_N)
        self._model.actuator_forcerange[self._actuator] = (-limit_n, limit_n)
