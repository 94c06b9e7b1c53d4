"""The arm as MuJoCo computes it: the state a controller needs, and what pushes against it."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import ResourceError
from vla_zenoh.simulation.cartesian_impedance import ArmState
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.simulation.scene import PREFIX, TCP_SITE

FloatArray = NDArray[np.float64]


class SimulatedArm:
    """Views of the arm's part of a MuJoCo state. They stay valid as long as `data` lives.

    Args:
        model: the scene with the robot in it.
        data: its state; whoever steps it decides how fresh what is read here is.
        robot: names of joints.

    Raises:
        ResourceError: the arm's joints are not one chain.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, robot: RobotModel) -> None:
        self._model, self._data = model, data
        joints = [model.joint(PREFIX + name) for name in robot.arm_joints]
        first_dof, first_q = int(joints[0].dofadr[0]), int(joints[0].qposadr[0])
        if [int(joint.dofadr[0]) - first_dof for joint in joints] != list(range(len(joints))):
            raise ResourceError("the arm's joints do not follow each other in the URDF")
        self._dofs = slice(first_dof, first_dof + len(joints))
        self.lower_rad = np.array([joint.range[0] for joint in joints])
        self.upper_rad = np.array([joint.range[1] for joint in joints])
        self.actuators = [int(model.actuator(PREFIX + name).id) for name in robot.arm_joints]
        self.effort_limit_nm = model.actuator_ctrlrange[self.actuators, 1].copy()

        self._qpos = slice(first_q, first_q + len(joints))
        self.position_rad = data.qpos[self._qpos]
        self.velocity_rad_s = data.qvel[self._dofs]
        self.effort_nm = data.qfrc_actuator[self._dofs]
        self._bias_nm = data.qfrc_bias[self._dofs]
        self._tcp = int(model.site(PREFIX + TCP_SITE).id)
        self._tcp_body = int(model.site_bodyid[self._tcp])
        self.tcp_position_m = data.site_xpos[self._tcp]
        self.tcp_rotation = data.site_xmat[self._tcp].reshape(3, 3)
        root = model.body_rootid[self._tcp_body]
        # What stands on the ground presses against the ground, not against what moves.
        moves = model.body_weldid[model.geom_bodyid] != 0
        self._own_geom = moves & (model.body_rootid[model.geom_bodyid] == root)
        self._linear, self._angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        self._inertia = np.zeros((model.nv, model.nv))
        self._elsewhere = mujoco.MjData(model)

    def state(self) -> ArmState:
        """What the impedance law needs; views where MuJoCo has them, so use it at once."""
        mujoco.mj_fullM(self._model, self._data, self._inertia)
        return ArmState(
            position_rad=self.position_rad,
            velocity_rad_s=self.velocity_rad_s,
            tcp_position_m=self.tcp_position_m,
            tcp_rotation=self.tcp_rotation,
            jacobian=self.jacobian(),
            drift=self._jacobian_rate() @ self.velocity_rad_s,
            inertia=self._inertia[self._dofs, self._dofs],
            bias_nm=self._bias_nm,
        )

    def tcp_at(self, position_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where the TCP is with the joints at `position_rad` (n,): m (3,) and rotation (3, 3)."""
        data = self._elsewhere
        data.qpos[self._qpos] = position_rad
        mujoco.mj_kinematics(self._model, data)
        return data.site_xpos[self._tcp].copy(), data.site_xmat[self._tcp].reshape(3, 3).copy()

    def jacobian(self) -> FloatArray:
        """(6, n) of the TCP, linear rows first, base axes."""
        mujoco.mj_jacSite(self._model, self._data, self._linear, self._angular, self._tcp)
        return self._stacked()

    def _jacobian_rate(self) -> FloatArray:
        mujoco.mj_jacDot(
            self._model,
            self._data,
            self._linear,
            self._angular,
            self.tcp_position_m,
            self._tcp_body,
        )
        return self._stacked()

    def _stacked(self) -> FloatArray:
        return np.concatenate([self._linear[:, self._dofs], self._angular[:, self._dofs]])

    def contact_wrench(self) -> FloatArray:
        """(6,) what all that touches the robot exerts on it: N, and Nm about the TCP, base axes.

        The robot's parts against each other are left out; what the fingers squeeze presses on both
        of them and cancels, so that its weight is left.
        """
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
            lever = contact.pos - self.tcp_position_m
            total[:3] += force
            total[3:] += moment + np.cross(lever, force)
        return total
