"""The simulated world: robot, controllers, gripper and objects, stepped by 1 ms per tick."""

from __future__ import annotations

import math
from collections.abc import Collection

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from vla_zenoh.errors import NodeError
from vla_zenoh.profile import Profile
from vla_zenoh.simulation.appearance import DISTRACTORS, check_variations
from vla_zenoh.simulation.cartesian_impedance import (
    ArmDynamics,
    CartesianImpedance,
    ImpedanceGains,
    ImpedanceOutput,
)
from vla_zenoh.simulation.joint_impedance import JointImpedance, JointImpedanceOutput
from vla_zenoh.simulation.objects import SimulatedObjects
from vla_zenoh.simulation.robot_model import RobotModel, robot_model
from vla_zenoh.simulation.scene import STEP_S, build_model, read_pose_vector, write_pose_vector
from vla_zenoh.simulation.simulated_robot import SimulatedArm, SimulatedGripper
from vla_zenoh.types import FloatArray, GripperState, JointState, PoseState, vector
from vla_zenoh.types.commands import JointReference, PoseReference

STEP_NS = round(STEP_S * 1e9)
WRENCH_FILTER_S = 0.01
"""Time constant of the reported wrench: a robot's own estimate is filtered too."""


class World:
    """A scene with a robot under impedance control of its TCP or joints, as `tick` is given.

    At rest either law takes over from the other with the same torque; a change between them in
    motion jolts the arm.

    Deterministic to the bit: the same seed, references and gripper commands give the same state.
    All poses are of the TCP in the robot's base frame, which is the world frame.

    Args:
        scene: name of a folder of ``sim/``, or a path.
        robot: the robot in it.
        home_rad: (n,) arm joints after a reset; also the posture that the nullspace prefers.
        gains: of the Cartesian impedance controller; None: the default ones.
        joint_friction_nm: dry friction in every arm joint, which the controller does not model.
        seed: see `reset`.
        vary: what else a seeded reset changes, names of `appearance.VARIATIONS`.

    Raises:
        ResourceError: scene or robot are missing or do not fit.
        RecordError: `home_rad` does not have one number per arm joint.
    """

    def __init__(
        self,
        scene: str,
        robot: RobotModel,
        *,
        home_rad: ArrayLike,
        gains: ImpedanceGains | None = None,
        joint_friction_nm: float = 0.0,
        seed: int | None = None,
        vary: Collection[str] = (),
    ) -> None:
        check_variations(vary)  # an unknown name fails here, not in the renderer
        self._vary = frozenset(vary)
        self.seed: int | None = None
        self.robot = robot
        self.model = build_model(scene, robot, joint_friction_nm=joint_friction_nm)
        self._data = mujoco.MjData(self.model)
        self._home_rad = vector("home_rad", home_rad, len(robot.arm_joints))
        self._arm = SimulatedArm(self.model, self._data, robot)
        self._gripper = SimulatedGripper(self.model, self._data, robot)
        self._objects = SimulatedObjects(self.model, self._data)
        self._controller = CartesianImpedance(
            gains or ImpedanceGains(),
            lower_rad=self._arm.lower_rad,
            upper_rad=self._arm.upper_rad,
            effort_nm=self._arm.effort_limit_nm,
            posture_rad=self._home_rad,
            period_s=STEP_S,
        )
        self._joint_controller = JointImpedance(
            robot.gains, effort_nm=self._arm.effort_limit_nm, period_s=STEP_S
        )
        self._active_law: CartesianImpedance | JointImpedance | None = None
        self._held_rad: FloatArray | None = None
        self._filtered_wrench = np.zeros(6)
        self.saturated = 0
        self.reset(seed)

    # -- time ----------------------------------------------------------------------------------

    def reset(self, seed: int | None = None) -> None:
        """Return to the home pose with the gripper open and the clock at zero.

        Args:
            seed: places objects at random in the scene's regions; None: as in the scene file.
        """
        model, data = self.model, self._data
        self.seed = seed
        mujoco.mj_resetData(model, data)
        self._arm.position_rad[:] = self._home_rad
        self._gripper.open()
        if seed is not None:
            self._objects.draw(seed, distractors=DISTRACTORS in self._vary)
        self._controller.reset(self._home_rad)
        self._reset_laws()
        self._ticks = 0
        self._filtered_wrench = np.zeros(6)
        self.saturated = 0
        mujoco.mj_forward(model, data)
        self._fresh = True

    def tick(self, reference: PoseReference | JointReference) -> None:
        """Step by one millisecond towards a reference of the TCP or the joints.

        Raises:
            NodeError: the simulation diverged; `reset` makes it usable again.
        """
        mujoco.mj_step1(self.model, self._data)
        if isinstance(reference, JointReference):
            self._held_rad, law = reference.position_rad, self._joint_controller
            output = law.torque(reference, self._switch_to(law))
        else:
            self._held_rad, law = None, self._controller
            output = law.torque(reference, self._switch_to(law))
        self._apply(output, reference)

    def hold_reference(self) -> PoseReference:
        """Reference at the measured TCP, at rest."""
        position, rotation = self.tcp()
        return PoseReference(position, rotation, np.zeros(6), np.zeros(6))

    def set_gripper(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """Open or close to `width_m` at `speed_m_s`, pressing with at most `force_n` (N).

        Raises:
            RecordError: speed or force are not above zero.
        """
        self._gripper.command(width_m, speed_m_s, force_n)

    # -- measurements ------------------------------------------------------------------

    @property
    def joint_range_rad(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limit of every arm joint, (n,) each."""
        return self._arm.lower_rad.copy(), self._arm.upper_rad.copy()

    @property
    def time_ns(self) -> int:
        """Simulated time since the last reset."""
        return self._ticks * STEP_NS

    @property
    def wrench(self) -> FloatArray:
        """(6,) external contact wrench of the last step: N, Nm about the TCP, base axes.

        A held object counts with its weight; contacts between parts of the robot do not.
        """
        self._refresh()
        return self._arm.contact_wrench()

    def joint_state(self) -> JointState:
        """Arm joints; the effort is that of the motors.

        The reference is that of the joints; under Cartesian control the measured position.
        """
        arm = self._arm
        return JointState(
            self.robot.arm_joints,
            arm.position_rad,
            arm.velocity_rad_s,
            arm.effort_nm,
            arm.position_rad if self._held_rad is None else self._held_rad,
        )

    def tcp(self) -> tuple[FloatArray, FloatArray]:
        """Measured TCP: position (3,) in metres and rotation (3, 3), copies."""
        self._refresh()
        return self._arm.tcp_position_m.copy(), self._arm.tcp_rotation.copy()

    def pose_state(self, reference: PoseReference | JointReference) -> PoseState:
        """Measured TCP pose, twist and wrench, with `reference`.

        The wrench is `wrench` behind a first-order low-pass of `WRENCH_FILTER_S`.
        """
        position, rotation = self.tcp()
        if isinstance(reference, JointReference):
            held_m, held_rotation = self._arm.tcp_at(reference.position_rad)
        else:
            held_m, held_rotation = reference.position_m, reference.rotation
        return PoseState(
            position_m=position,
            quat_xyzw=_quat_xyzw(rotation),
            twist=self._arm.jacobian() @ self._arm.velocity_rad_s,
            wrench=self._filtered_wrench.copy(),
            reference_position_m=held_m,
            reference_quat_xyzw=_quat_xyzw(held_rotation),
        )

    def gripper_state(self) -> GripperState:
        """Opening between the fingers, and whether they move or hold an object."""
        return self._gripper.state()

    @property
    def grip_force_n(self) -> float:
        """Force of either finger, inwards positive."""
        return self._gripper.force_n

    # -- objects and poses of all bodies ------------------------------------------------------

    def objects(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Position (3,) and quaternion x, y, z, w (4,) of every object, copies."""
        self._refresh()
        return self._objects.poses()

    def place(self, name: str, position_m: ArrayLike, quat_xyzw: ArrayLike = (0, 0, 0, 1)) -> None:
        """Put an object at a pose, at rest.

        Raises:
            ResourceError: the scene has no such object.
        """
        self._objects.place(name, position_m, quat_xyzw)
        mujoco.mj_forward(self.model, self._data)
        self._fresh = True

    def qpos(self) -> FloatArray:
        """Every pose of the world in one vector, for a renderer of the same scene."""
        return read_pose_vector(self._data)

    def set_qpos(self, vector: FloatArray) -> None:
        """Set all poses from `qpos` of a world of the same scene, at rest."""
        write_pose_vector(self.model, self._data, vector)
        self._data.qvel[:] = 0.0
        self._controller.reset()
        self._reset_laws()
        self._gripper.stand()
        mujoco.mj_forward(self.model, self._data)
        self._fresh = True

    # -- inside --------------------------------------------------------------------------------

    def _switch_to(self, law: CartesianImpedance | JointImpedance) -> ArmDynamics:
        state = self._arm.state()
        if self._active_law is not law:
            if self._active_law is not None:
                law.take_over(self._data.ctrl[self._arm.actuators], state)
            self._active_law = law
        return state

    def _reset_laws(self) -> None:
        self._joint_controller.reset()
        self._active_law = None
        self._held_rad = None

    def _apply(
        self,
        output: ImpedanceOutput | JointImpedanceOutput,
        reference: PoseReference | JointReference,
    ) -> None:
        data = self._data
        if not math.isfinite(output.torque_nm.sum()):
            raise NodeError(f"the reference is not finite: {reference}")
        self.saturated += output.saturated
        data.ctrl[self._arm.actuators] = output.torque_nm
        self._gripper.step()
        mujoco.mj_step2(self.model, data)
        self._ticks += 1
        self._fresh = False
        error = self._arm.contact_wrench() - self._filtered_wrench
        self._filtered_wrench += (STEP_S / WRENCH_FILTER_S) * error
        if data.warning.number.any():
            self._raise_diverged()

    def _refresh(self) -> None:
        """Compute positions after the last step; contacts and forces stay those of that step."""
        if not self._fresh:
            mujoco.mj_kinematics(self.model, self._data)
            mujoco.mj_comPos(self.model, self._data)
            self._fresh = True

    def _raise_diverged(self) -> None:
        raised = [
            mujoco.mjtWarning(kind).name.removeprefix("mjWARN_").lower()
            for kind in np.flatnonzero(self._data.warning.number)
        ]
        raise NodeError(
            f"the simulation diverged after {self.time_ns / 1e9:.3f} s ({', '.join(raised)}); "
            "reset it, and check gains, limits and the scene"
        )


def build_world(profile: Profile) -> World:
    """The world that a profile describes.

    Raises:
        ResourceError: scene or robot description are missing.
    """
    return World(
        profile.sim.scene,
        robot_model(profile.robot),
        home_rad=profile.robot.home_rad,
        joint_friction_nm=profile.sim.joint_friction_nm,
        seed=profile.sim.seed,
        vary=profile.sim.vary,
    )


def _quat_xyzw(rotation: FloatArray) -> FloatArray:
    quat_wxyz = np.empty(4)
    mujoco.mju_mat2Quat(quat_wxyz, np.ascontiguousarray(rotation).ravel())
    return np.roll(quat_wxyz, -1)
