"""The simulated world: robot, its controllers, gripper and objects, one millisecond a tick."""

from __future__ import annotations

import math
from collections.abc import Collection

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_zenoh.errors import NodeError
from vla_zenoh.simulation.appearance import DISTRACTORS, draw_look
from vla_zenoh.simulation.cartesian_impedance import (
    ArmState,
    CartesianImpedance,
    ImpedanceGains,
    ImpedanceOutput,
)
from vla_zenoh.simulation.joint_impedance import (
    JointGains,
    JointImpedanceController,
    JointImpedanceOutput,
)
from vla_zenoh.simulation.pose_vector import read_pose_vector, write_pose_vector
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.simulation.scene import STEP_S, build_model
from vla_zenoh.simulation.simulated_arm import SimulatedArm
from vla_zenoh.simulation.simulated_hand import SimulatedHand
from vla_zenoh.simulation.simulated_objects import SimulatedObjects
from vla_zenoh.types import GripperState, JointState, PoseState, vector
from vla_zenoh.types.references import JointReference, PoseReference

FloatArray = NDArray[np.float64]

STEP_NS = round(STEP_S * 1e9)
WRENCH_FILTER_S = 0.01
"""A robot's estimate of forces is filtered likewise; a blow of one step means nothing."""


class World:
    """A scene with a robot under impedance control, of its TCP (`tick`) or joints (`tick_joint`).

    Either may follow the other while the arm stands: the next law takes over what the last one
    carried. Who changes between them in motion gets a jolt.

    Deterministic to the bit: the same seed, references and gripper commands give the same state.
    All poses are those of the TCP in the robot's base frame, which is the world frame.

    Args:
        scene: name of a folder of ``sim/``, or a path.
        robot: the robot in it.
        home_rad: (n,) arm joints after a reset; also the posture the nullspace prefers.
        gains: of the Cartesian impedance controller.
        joint_gains: of the joint impedance controller; None: the stiff ones.
        joint_friction_nm: dry friction in every arm joint, unknown to the controller.
        seed: see `reset`.
        vary: what else a seeded reset changes, names of `look.VARIATIONS`.

    Raises:
        ResourceError: scene or robot are not there or do not fit.
        RecordError: `home_rad` is not a vector of the arm's size.
    """

    def __init__(
        self,
        scene: str,
        robot: RobotModel,
        *,
        home_rad: ArrayLike,
        gains: ImpedanceGains,
        joint_gains: JointGains | None = None,
        joint_friction_nm: float = 0.0,
        seed: int | None = None,
        vary: Collection[str] = (),
    ) -> None:
        draw_look(0, vary)  # an unknown name is told here, not by the renderer
        self._vary = frozenset(vary)
        self.seed: int | None = None
        self.robot = robot
        self.model = build_model(scene, robot, joint_friction_nm=joint_friction_nm)
        self._data = mujoco.MjData(self.model)
        self._home_rad = vector("home_rad", home_rad, len(robot.arm_joints))
        self._arm = SimulatedArm(self.model, self._data, robot)
        self._hand = SimulatedHand(self.model, self._data, robot)
        self._objects = SimulatedObjects(self.model, self._data)
        self._controller = CartesianImpedance(
            gains,
            lower_rad=self._arm.lower_rad,
            upper_rad=self._arm.upper_rad,
            effort_nm=self._arm.effort_limit_nm,
            posture_rad=self._home_rad,
            period_s=STEP_S,
        )
        self._joint_controller = JointImpedanceController(
            joint_gains or JointGains.stiff(),
            effort_nm=self._arm.effort_limit_nm,
            period_s=STEP_S,
        )
        self._in_charge: CartesianImpedance | JointImpedanceController | None = None
        self._held_rad: FloatArray | None = None
        self._felt = np.zeros(6)
        self.saturated = 0
        self.reset(seed)

    # -- time ----------------------------------------------------------------------------------

    def reset(self, seed: int | None = None) -> None:
        """Back to the home pose, gripper open, clock at zero.

        Args:
            seed: places objects at random in the scene's regions, the same for the same number;
                None puts them where the scene file has them.
        """
        model, data = self.model, self._data
        self.seed = seed
        mujoco.mj_resetData(model, data)
        self._arm.position_rad[:] = self._home_rad
        self._hand.open()
        if seed is not None:
            self._objects.draw(seed, distractors=DISTRACTORS in self._vary)
        self._controller.reset(self._home_rad)
        self._forget_controllers()
        self._ticks = 0
        self._felt = np.zeros(6)
        self.saturated = 0
        mujoco.mj_forward(model, data)
        self._fresh = True

    def tick(self, reference: PoseReference) -> None:
        """Go on by exactly one millisecond towards `reference`.

        Raises:
            NodeError: the simulation blew up; `reset` makes it usable again.
        """
        mujoco.mj_step1(self.model, self._data)
        state = self._put_in_charge(self._controller)
        self._held_rad = None
        self._apply(self._controller.torque(reference, state), reference)

    def tick_joint(self, reference: JointReference) -> None:
        """Likewise towards joint positions.

        Raises:
            NodeError: the simulation blew up; `reset` makes it usable again.
        """
        mujoco.mj_step1(self.model, self._data)
        state = self._put_in_charge(self._joint_controller)
        self._held_rad = reference.position_rad
        self._apply(self._joint_controller.torque(reference, state), reference)

    def hold_joint_reference(self) -> JointReference:
        """The reference that keeps the joints where they are now."""
        return JointReference.at_rest(self._arm.position_rad)

    def hold_reference(self) -> PoseReference:
        """The reference that keeps the TCP where it is now."""
        position, rotation = self.tcp()
        return PoseReference(position, rotation, np.zeros(6), np.zeros(6))

    def set_gripper(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """Open or close to `width_m` at `speed_m_s`, pressing with at most `force_n`.

        Raises:
            RecordError: speed or force are not above zero.
        """
        self._hand.command(width_m, speed_m_s, force_n)

    # -- what a robot reports ------------------------------------------------------------------

    @property
    def joint_range_rad(self) -> tuple[FloatArray, FloatArray]:
        """Least and greatest position of every arm joint, (n,) each."""
        return self._arm.lower_rad.copy(), self._arm.upper_rad.copy()

    @property
    def time_ns(self) -> int:
        """Simulated time since the last reset."""
        return self._ticks * STEP_NS

    @property
    def wrench(self) -> FloatArray:
        """(6,) what the surroundings exert on the robot right now: N, Nm about the TCP, base axes.

        What it holds counts with its weight; what its parts exert on each other does not.
        """
        self._refresh()
        return self._arm.contact_wrench()

    def joint_state(self) -> JointState:
        """Arm joints; the effort is what the motors apply.

        The reference is that of `tick_joint`; under Cartesian control, which has none for joints,
        it is where they are.
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
        """Measured TCP pose, twist and wrench beside the reference held now.

        The wrench is `wrench` after a low-pass of the first order with `WRENCH_FILTER_S`.
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
            wrench=self._felt.copy(),
            reference_position_m=held_m,
            reference_quat_xyzw=_quat_xyzw(held_rotation),
        )

    def gripper_state(self) -> GripperState:
        """Opening between the fingers, and whether they move or hold something."""
        return self._hand.state()

    @property
    def grip_force_n(self) -> float:
        """What either finger presses with, inwards positive."""
        return self._hand.force_n

    # -- objects and pictures ------------------------------------------------------------------

    def objects(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Position (3,) and quaternion x, y, z, w (4,) of every object, copies."""
        self._refresh()
        return self._objects.poses()

    def place(self, name: str, position_m: ArrayLike, quat_xyzw: ArrayLike = (0, 0, 0, 1)) -> None:
        """Put an object somewhere, at rest.

        Raises:
            ResourceError: the scene has no such object.
        """
        self._objects.put(name, position_m, quat_xyzw)
        mujoco.mj_forward(self.model, self._data)
        self._fresh = True

    def qpos(self) -> FloatArray:
        """Every pose of the world in one flat vector, for a renderer of the same scene."""
        return read_pose_vector(self.model, self._data)

    def set_qpos(self, vector: FloatArray) -> None:
        """Take over poses from `qpos` of an equal world; everything stands still afterwards."""
        write_pose_vector(self.model, self._data, vector)
        self._data.qvel[:] = 0.0
        self._controller.reset()
        self._forget_controllers()
        self._hand.stand()
        mujoco.mj_forward(self.model, self._data)
        self._fresh = True

    # -- inside --------------------------------------------------------------------------------

    def _put_in_charge(self, law: CartesianImpedance | JointImpedanceController) -> ArmState:
        state = self._arm.state()
        if self._in_charge is not law:
            if self._in_charge is not None:
                law.take_over(self._data.ctrl[self._arm.actuators], state)
            self._in_charge = law
        return state

    def _forget_controllers(self) -> None:
        self._joint_controller.reset()
        self._in_charge = None
        self._held_rad = None

    def _apply(
        self,
        output: ImpedanceOutput | JointImpedanceOutput,
        reference: PoseReference | JointReference,
    ) -> None:
        data = self._data
        if not math.isfinite(output.torque_nm.sum()):
            raise NodeError(f"the impedance controller got a bad reference: {reference}")
        self.saturated += output.saturated
        data.ctrl[self._arm.actuators] = output.torque_nm
        self._hand.drive()
        mujoco.mj_step2(self.model, data)
        self._ticks += 1
        self._fresh = False
        self._felt += (STEP_S / WRENCH_FILTER_S) * (self._arm.contact_wrench() - self._felt)
        if data.warning.number.any():
            self._raise_blown_up()

    def _refresh(self) -> None:
        """Bring positions up to the last step; contacts and forces stay those of that step."""
        if not self._fresh:
            mujoco.mj_kinematics(self.model, self._data)
            mujoco.mj_comPos(self.model, self._data)
            self._fresh = True

    def _raise_blown_up(self) -> None:
        raised = [
            mujoco.mjtWarning(kind).name.removeprefix("mjWARN_").lower()
            for kind in np.flatnonzero(self._data.warning.number)
        ]
        raise NodeError(
            f"the simulation blew up after {self.time_ns / 1e9:.3f} s ({', '.join(raised)}); "
            "reset it, and look at gains, limits and the scene"
        )


def _quat_xyzw(rotation: FloatArray) -> FloatArray:
    quat_wxyz = np.empty(4)
    mujoco.mju_mat2Quat(quat_wxyz, np.ascontiguousarray(rotation).ravel())
    return np.roll(quat_wxyz, -1)
