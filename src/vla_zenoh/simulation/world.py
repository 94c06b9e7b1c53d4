"""The simulated world: robots, controllers, grippers and objects, stepped by 1 ms per tick."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

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
from vla_zenoh.simulation.robot_model import RobotModel, robot_models
from vla_zenoh.simulation.scene import STEP_S, build_model, read_pose_vector, write_pose_vector
from vla_zenoh.simulation.simulated_robot import SimulatedArm, SimulatedGripper
from vla_zenoh.types import FloatArray, GripperState, JointState, PoseState, vector
from vla_zenoh.types.commands import JointReference, PoseReference

STEP_NS = round(STEP_S * 1e9)
WRENCH_FILTER_S = 0.01
"""Time constant of the reported wrench: a robot's own estimate is filtered too."""


class SimulatedPart:
    """One arm with its gripper in a `World`, under impedance control of its TCP or joints.

    At rest either law takes over from the other with the same torque; a change between them in
    motion jolts the arm. All poses are of the TCP in the base frame of the arm.

    Args:
        model: the scene with the robot in it.
        data: its state.
        robot: the arm.
        home_rad: (n,) joints after a reset; also the posture that the nullspace prefers.
        gains: of the Cartesian impedance controller; None: the default ones.
        refresh: computes positions after a step.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        robot: RobotModel,
        home_rad: FloatArray,
        gains: ImpedanceGains | None,
        refresh: Callable[[], None],
    ) -> None:
        self.robot, self._data, self._home_rad, self._refresh = robot, data, home_rad, refresh
        self._arm = SimulatedArm(model, data, robot)
        self.gripper = SimulatedGripper(model, data, robot)
        self._controller = CartesianImpedance(
            gains or ImpedanceGains(),
            lower_rad=self._arm.lower_rad,
            upper_rad=self._arm.upper_rad,
            effort_nm=self._arm.effort_limit_nm,
            posture_rad=home_rad,
            period_s=STEP_S,
        )
        self._joint_controller = JointImpedance(
            robot.gains, effort_nm=self._arm.effort_limit_nm, period_s=STEP_S
        )
        self._active_law: CartesianImpedance | JointImpedance | None = None
        self._held_rad: FloatArray | None = None
        self._filtered_wrench = np.zeros(6)

    # -- time ----------------------------------------------------------------------------------
    def go_home(self) -> None:
        """Put the joints at home and open the gripper."""
        self._arm.position_rad[:] = self._home_rad
        self.gripper.open()

    def reset_laws(self, *, home: bool) -> None:
        """Forget what the controllers have accumulated, and with `home` what was measured."""
        if home:
            self._controller.reset(self._home_rad)
            self._filtered_wrench = np.zeros(6)
        else:
            self._controller.reset()
            self.gripper.stand()
        self._joint_controller.reset()
        self._active_law = None
        self._held_rad = None

    def torque(self, reference: PoseReference | JointReference) -> bool:
        """Set the torques of this tick; whether an effort limit cut them.

        Raises:
            NodeError: the reference is not finite.
        """
        output: ImpedanceOutput | JointImpedanceOutput
        if isinstance(reference, JointReference):
            self._held_rad, law = reference.position_rad, self._joint_controller
            output = law.torque(reference, self._switch_to(law))
        else:
            self._held_rad, law = None, self._controller
            output = law.torque(reference, self._switch_to(law))
        if not math.isfinite(sum(output.torque_nm.tolist())):
            raise NodeError(f"the reference is not finite: {reference}")
        self._data.ctrl[self._arm.actuators] = output.torque_nm
        self.gripper.step()
        return output.saturated

    def filter_wrench(self) -> None:
        """Follow the wrench of the last step."""
        error = self._arm.contact_wrench() - self._filtered_wrench
        self._filtered_wrench += (STEP_S / WRENCH_FILTER_S) * error

    def _switch_to(self, law: CartesianImpedance | JointImpedance) -> ArmDynamics:
        state = self._arm.state()
        if self._active_law is not law:
            if self._active_law is not None:
                law.take_over(self._data.ctrl[self._arm.actuators], state)
            self._active_law = law
        return state

    # -- measurements --------------------------------------------------------------------------
    def hold_reference(self) -> PoseReference:
        """Reference at the measured TCP, at rest."""
        position, rotation = self.tcp()
        return PoseReference(position, rotation, np.zeros(6), np.zeros(6))

    @property
    def joint_range_rad(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limit of every arm joint, (n,) each."""
        return self._arm.lower_rad.copy(), self._arm.upper_rad.copy()

    def set_gripper(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """Open or close to `width_m` at `speed_m_s`, pressing with at most `force_n` (N).

        Raises:
            RecordError: speed or force are not above zero.
        """
        self.gripper.command(width_m, speed_m_s, force_n)

    def gripper_state(self) -> GripperState:
        """Opening between the fingers, and whether they move or hold an object."""
        return self.gripper.state()

    @property
    def wrench(self) -> FloatArray:
        """(6,) external contact wrench of the last step: N, Nm about the TCP, base axes.

        A held object counts with its weight; contacts between parts of the arm do not.
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


class World:
    """A scene with a robot in it, of one part or several, stepped by `tick`.

    Deterministic to the bit: the same seed, references and gripper commands give the same state.
    Members about one arm are those of the first part; see `part`. Poses are of its TCP in its base
    frame, those of objects in the world frame, which is the base frame of a robot of one part.

    Args:
        scene: name of a folder of ``sim/``, or a path.
        robot: the robot in it, or its parts.
        home_rad: (n,) arm joints after a reset, or those of each part; also the posture that the
            nullspace prefers.
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
        robot: RobotModel | Sequence[RobotModel],
        *,
        home_rad: ArrayLike | Sequence[ArrayLike],
        gains: ImpedanceGains | None = None,
        joint_friction_nm: float = 0.0,
        seed: int | None = None,
        vary: Collection[str] = (),
    ) -> None:
        check_variations(vary)  # an unknown name fails here, not in the renderer
        self._vary = frozenset(vary)
        self.seed: int | None = None
        self.model = build_model(scene, robot, joint_friction_nm=joint_friction_nm)
        self._data = mujoco.MjData(self.model)
        one = isinstance(robot, RobotModel)
        homes: Sequence[Any] = [home_rad] if one else list(home_rad)  # pyright: ignore
        self.parts: dict[str, SimulatedPart] = {
            model.part: SimulatedPart(
                self.model,
                self._data,
                model,
                vector("home_rad", home, len(model.arm_joints)),
                gains,
                self._refresh,
            )
            for model, home in zip([robot] if one else robot, homes, strict=True)
        }
        self._first = next(iter(self.parts.values()))
        self.robot = self._first.robot
        self._objects = SimulatedObjects(self.model, self._data)
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
        for part in self.parts.values():
            part.go_home()
        if seed is not None:
            self._objects.draw(seed, distractors=DISTRACTORS in self._vary)
        for part in self.parts.values():
            part.reset_laws(home=True)
        self._ticks = 0
        self.saturated = 0
        mujoco.mj_forward(model, data)
        self._fresh = True

    def tick(
        self,
        reference: PoseReference | JointReference | Mapping[str, PoseReference | JointReference],
    ) -> None:
        """Step by one millisecond towards a reference of the TCP or joints, or one of each part.

        Raises:
            NodeError: the simulation diverged; `reset` makes it usable again.
        """
        mujoco.mj_step1(self.model, self._data)
        for name, part in self.parts.items():
            self.saturated += part.torque(
                reference[name] if isinstance(reference, Mapping) else reference
            )
        mujoco.mj_step2(self.model, self._data)
        self._ticks += 1
        self._fresh = False
        for part in self.parts.values():
            part.filter_wrench()
        if self._data.warning.number.any():
            self._raise_diverged()

    def hold_reference(self) -> PoseReference:
        """Reference at the measured TCP, at rest."""
        return self._first.hold_reference()

    def set_gripper(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """See `SimulatedPart.set_gripper`."""
        self._first.set_gripper(width_m, speed_m_s, force_n)

    # -- measurements ------------------------------------------------------------------

    @property
    def joint_range_rad(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limit of every arm joint, (n,) each."""
        return self._first.joint_range_rad

    @property
    def time_ns(self) -> int:
        """Simulated time since the last reset."""
        return self._ticks * STEP_NS

    @property
    def wrench(self) -> FloatArray:
        """See `SimulatedPart.wrench`."""
        return self._first.wrench

    def joint_state(self) -> JointState:
        """See `SimulatedPart.joint_state`."""
        return self._first.joint_state()

    def tcp(self) -> tuple[FloatArray, FloatArray]:
        """Measured TCP: position (3,) in metres and rotation (3, 3), copies."""
        return self._first.tcp()

    def pose_state(self, reference: PoseReference | JointReference) -> PoseState:
        """See `SimulatedPart.pose_state`."""
        return self._first.pose_state(reference)

    def gripper_state(self) -> GripperState:
        """Opening between the fingers, and whether they move or hold an object."""
        return self._first.gripper.state()

    @property
    def grip_force_n(self) -> float:
        """Force of either finger, inwards positive."""
        return self._first.gripper.force_n

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
        for part in self.parts.values():
            part.reset_laws(home=False)
        mujoco.mj_forward(self.model, self._data)
        self._fresh = True

    # -- inside --------------------------------------------------------------------------------

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
    homes = [profile.of_part(name).robot.home_rad for name in profile.part_names]
    return World(
        profile.sim.scene,
        robot_models(profile),
        home_rad=homes,
        joint_friction_nm=profile.sim.joint_friction_nm,
        seed=profile.sim.seed,
        vary=profile.sim.vary,
    )


_XYZW = [1, 2, 3, 0]


def _quat_xyzw(rotation: FloatArray) -> FloatArray:
    quat_wxyz = np.empty(4)
    mujoco.mju_mat2Quat(quat_wxyz, np.ascontiguousarray(rotation).ravel())
    return quat_wxyz[_XYZW]
