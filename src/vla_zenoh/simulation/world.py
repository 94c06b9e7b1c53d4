"""The simulated world: arms under impedance control, grippers and objects, 1 ms per tick."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from vla_zenoh.errors import NodeError, RecordError, ResourceError
from vla_zenoh.kinematics.fingers import Fingers
from vla_zenoh.kinematics.so3 import cross3, quat_from_rotation, rotation_from_rpy
from vla_zenoh.policy.meaning import reference as as_reference
from vla_zenoh.policy.meaning import toward
from vla_zenoh.profile import GripperProfile, Profile
from vla_zenoh.simulation.impedance import (
    ArmDynamics,
    CartesianImpedance,
    ImpedanceGains,
    JointImpedance,
)
from vla_zenoh.simulation.robot_model import RobotModel, robot_models
from vla_zenoh.simulation.scene import (
    DISTRACTORS,
    GRIPPER,
    POSES,
    STEP_S,
    TCP_SITE,
    build_model,
    check_variations,
    draw_places,
    finger_shares,
    objects_of,
    prefix_of,
)
from vla_zenoh.types import (
    FloatArray,
    GripperState,
    JointReference,
    JointState,
    PoseReference,
    PoseState,
)

STEP_NS = round(STEP_S * 1e9)
WRENCH_FILTER_S = 0.01
"""Time constant of the reported wrench: a robot's own estimate is filtered too."""
AT_REST_M_S = 2e-3
AT_REST_TICKS = 50  # milliseconds of standstill before the gripper reports "holding"
HELD_MARGIN_M = 5e-4  # set narrower than measured by this much: an object is in between
DEFAULT_FORCE_N = 20.0
MAX_FORCE_N = 70.0


class World:
    """A scene with a robot in it, of one part or several, stepped by `tick`.

    Deterministic to the bit: the same seed, references and gripper commands give the same state.
    Members about one arm are those of the first of `parts`. Poses are of its TCP in its base frame,
    those of objects in the world frame, which is the base frame of a robot of one part.

    Args:
        scene: name of a folder of ``sim/``, or a path.
        robots: the parts of the robot in it, or the only one.
        home_rad: (n,) arm joints of each after a reset, and the posture its nullspace prefers.
        gains: of the Cartesian impedance controller; None: the default ones.
        joint_friction_nm: dry friction in every arm joint, which the controller does not model.
        seed: see `reset`.
        vary: what else a seeded reset changes, names of `VARIATIONS`.

    Raises:
        ResourceError: scene or robot are missing or do not fit.
        RecordError: a home does not have one number per arm joint.
    """

    def __init__(
        self,
        scene: str,
        robots: Sequence[RobotModel],
        *,
        home_rad: Sequence[ArrayLike],
        gains: ImpedanceGains | None = None,
        joint_friction_nm: float = 0.0,
        seed: int | None = None,
        vary: Collection[str] = (),
    ) -> None:
        check_variations(vary)  # an unknown name fails here, not in the renderer
        self._vary = frozenset(vary)
        self.seed: int | None = None
        self.model = build_model(scene, robots, joint_friction_nm=joint_friction_nm)
        self._data = mujoco.MjData(self.model)
        self._warnings = self._data.warning.number  # a view
        self.parts: dict[str, SimulatedPart] = {
            model.part: SimulatedPart(
                self.model,
                self._data,
                model,
                _home_rad(model, home),
                gains or ImpedanceGains(),
                self._refresh,
            )
            for model, home in zip(robots, home_rad, strict=True)
        }
        arm = next(iter(self.parts.values()))
        self.joint_range_rad, self.tcp = arm.joint_range_rad, arm.tcp
        self.slides = arm.slides
        self.hold_reference, self.set_gripper = arm.hold_reference, arm.set_gripper
        self.joint_state, self.pose_state = arm.joint_state, arm.pose_state
        self.gripper_state, self.wrench = arm.gripper_state, arm.wrench
        self._bodies = objects_of(self.model)
        self.reset(seed)

    def reset(self, seed: int | None = None) -> None:
        """Return home, gripper open, clock at zero; with a `seed` objects are placed at random."""
        model, data = self.model, self._data
        self.seed = seed
        mujoco.mj_resetData(model, data)
        for part in self.parts.values():
            part.reset()
        if seed is not None:
            places = draw_places(model, seed, distractors=DISTRACTORS in self._vary)
            for name, place in places.items():
                height_m = float(model.body_pos[self._bodies[name], 2])
                half_rad = place.yaw_rad / 2.0
                turn = (0.0, 0.0, math.sin(half_rad), math.cos(half_rad))
                self._put(self._bodies[name], (place.x_m, place.y_m, height_m), turn)
        self._ticks = self.saturated = 0
        mujoco.mj_forward(model, data)
        self._fresh = True

    def tick(
        self,
        reference: PoseReference | JointReference | Mapping[str, PoseReference | JointReference],
        steps: int = 1,
    ) -> None:
        """Step by milliseconds towards a reference of the TCP or joints, or one of each part.

        The controllers compute their torque once, for the reference of the first step, and it stays
        for all `steps`.

        Raises:
            NodeError: the simulation diverged; `reset` makes it usable again.
        """
        mujoco.mj_step1(self.model, self._data)
        for name, part in self.parts.items():
            self.saturated += part.torque(
                reference[name] if isinstance(reference, Mapping) else reference, steps
            )
        mujoco.mj_step2(self.model, self._data)
        if steps > 1:
            mujoco.mj_step(self.model, self._data, steps - 1)
        self._ticks += steps
        self._fresh = False
        for part in self.parts.values():
            part.filter_wrench(steps)
        if self._warnings.any():
            raised = [
                mujoco.mjtWarning(kind).name.removeprefix("mjWARN_").lower()
                for kind in np.flatnonzero(self._warnings)
            ]
            raise NodeError(
                f"the simulation diverged after {self.time_ns / 1e9:.3f} s ({', '.join(raised)}); "
                "reset it, and check gains, limits and the scene"
            )

    @property
    def time_ns(self) -> int:
        """Simulated time since the last reset."""
        return self._ticks * STEP_NS

    def objects(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Position (3,) and quaternion x, y, z, w (4,) of every object, copies."""
        self._refresh()
        data = self._data
        return {
            name: (data.xpos[body].copy(), np.roll(data.xquat[body], -1))
            for name, body in self._bodies.items()
        }

    def place(self, name: str, position_m: ArrayLike, quat_xyzw: ArrayLike = (0, 0, 0, 1)) -> None:
        """Put an object at a pose, at rest; a `ResourceError` if the scene has no such object."""
        if name not in self._bodies:
            raise ResourceError(
                f"the scene has no object {name!r}; it has: {', '.join(self._bodies) or 'none'}"
            )
        self._put(self._bodies[name], position_m, quat_xyzw)
        mujoco.mj_forward(self.model, self._data)
        self._fresh = True

    def _put(self, body: int, position_m: ArrayLike, quat_xyzw: ArrayLike) -> None:
        model, data = self.model, self._data
        quat_wxyz = np.roll(np.asarray(quat_xyzw, float), 1)
        mocap = model.body_mocapid[body]
        if mocap >= 0:
            data.mocap_pos[mocap], data.mocap_quat[mocap] = position_m, quat_wxyz
            return
        joint = model.body_jntadr[body]
        q, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        data.qpos[q : q + 3], data.qpos[q + 3 : q + 7] = position_m, quat_wxyz
        data.qvel[dof : dof + 6] = 0.0

    def qpos(self) -> FloatArray:
        """Every pose of the world in one vector, for a renderer of the same scene."""
        vector = np.empty(mujoco.mj_stateSize(self.model, POSES))
        mujoco.mj_getState(self.model, self._data, vector, POSES)
        return vector

    def _refresh(self) -> None:
        """Compute positions after the last step; contacts and forces stay those of that step."""
        if not self._fresh:
            mujoco.mj_kinematics(self.model, self._data)
            mujoco.mj_comPos(self.model, self._data)
            self._fresh = True


def _home_rad(robot: RobotModel, home_rad: ArrayLike) -> FloatArray:
    home, joints = np.array(home_rad, float), len(robot.arm_joints)
    if home.shape != (joints,) or not np.isfinite(home).all():
        raise RecordError(f"home_rad is {home_rad}, allowed: {joints} finite numbers")
    return home


def build_world(profile: Profile) -> World:
    """The world that a profile describes; a `ResourceError` if scene or description are missing."""
    return World(
        profile.sim.scene,
        robot_models(profile),
        home_rad=[profile.of_part(name).robot.home_rad for name in profile.part_names],
        joint_friction_nm=profile.sim.joint_friction_nm,
        seed=profile.sim.seed,
        vary=profile.sim.vary,
    )


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
        self.robot, self._home_rad, self._gains, self._refresh = robot, home_rad, gains, refresh
        self._model, self._data = model, data
        self.gripper: SimulatedGripper | None = None
        if robot.gripper is not None:
            self.gripper = SimulatedGripper(model, data, robot, robot.gripper)
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

        dofs = np.array([joint.id for joint in joints])
        endless = model.jnt_limited[dofs] == 0
        lower_rad, upper_rad = model.jnt_range[dofs].T
        self.joint_range_rad = (  # (n,) each
            np.where(endless, -np.inf, lower_rad),
            np.where(endless, np.inf, upper_rad),
        )
        self._endless = tuple(itertools.compress(robot.arm_joints, endless))
        self.slides = model.jnt_type[dofs] == mujoco.mjtJoint.mjJNT_SLIDE
        """(n,) joints that slide."""
        self._sliding = tuple(itertools.compress(robot.arm_joints, self.slides))

    def reset(self) -> None:
        """Put the joints at home, at rest, with the gripper open."""
        self._position_rad[:] = self._home_rad
        if self.gripper is not None:
            self.gripper.open()
        self.reset_laws()

    def reset_laws(self) -> None:
        """Forget what the controllers have accumulated and measured: begin with new ones."""
        lower_rad, upper_rad = self.joint_range_rad
        effort_nm = self._model.actuator_ctrlrange[self._actuators, 1]
        limits = {"lower_rad": lower_rad, "upper_rad": upper_rad, "effort_nm": effort_nm}
        self._cartesian = CartesianImpedance(
            self._gains, **limits, posture_rad=self._home_rad, period_s=STEP_S
        )
        self._joint = JointImpedance(self.robot.gains, effort_nm=effort_nm, period_s=STEP_S)
        self._active_law: CartesianImpedance | JointImpedance | None = None
        self._held_rad: FloatArray | None = None
        self._filtered_wrench = np.zeros(6)

    def torque(self, reference: PoseReference | JointReference, steps: int = 1) -> bool:
        """Set the torques of the next steps; whether an effort limit cut them.

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
        law.set_period(steps * STEP_S)
        output = law.torque(reference, state)  # pyright: ignore[reportArgumentType]  # of its law
        if not math.isfinite(sum(output.torque_nm.tolist())):
            raise NodeError(f"the reference is not finite: {reference}")
        self._data.ctrl[self._actuators] = output.torque_nm
        if self.gripper is not None:
            self.gripper.step(steps)
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

    def filter_wrench(self, steps: int = 1) -> None:
        """Follow the wrench of the last step, which stands for all `steps`."""
        error = self._contact_wrench() - self._filtered_wrench
        left = (1.0 - STEP_S / WRENCH_FILTER_S) ** steps
        self._filtered_wrench += (1.0 - left) * error

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
            total[3:] += moment + cross3(lever, force)
        return self._axes_of_base(total)

    # -- measurements -------------------------------------------------------------------------
    def hold_reference(self) -> PoseReference:
        """Reference at the measured TCP, at rest."""
        return PoseReference(*self.tcp(), np.zeros(6), np.zeros(6))

    def gripper_state(self) -> GripperState:
        """That of the gripper; without a width where the robot has none."""
        if self.gripper is None:
            return GripperState(None, moving=False, holding=False)
        return self.gripper.state()

    def set_gripper(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """Command the gripper, see `SimulatedGripper.command`; a `RecordError` without one."""
        if self.gripper is None:
            raise RecordError("this robot has no gripper")
        self.gripper.command(width_m, speed_m_s, force_n)

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
            self.robot.arm_joints,
            measured_rad,
            self._velocity_rad_s,
            self._effort_nm,
            held_rad,
            self._endless,
            self._sliding,
        )

    def tcp(self) -> tuple[FloatArray, FloatArray]:
        """Measured TCP: position (3,) in metres and rotation (3, 3), copies."""
        self._refresh()
        position_m, rotation = self._in_base(self._world_m, self._world_rotation)
        return position_m.copy(), rotation.copy()

    def _tcp_at(self, joints_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The TCP with the joints elsewhere, as copies: the scratch data is used again."""
        data, tcp = self._scratch, self._tcp
        data.qpos[self._qpos] = joints_rad
        mujoco.mj_kinematics(self._model, data)
        return self._in_base(data.site_xpos[tcp].copy(), data.site_xmat[tcp].reshape(3, 3).copy())

    @cached_property
    def _home_quat(self) -> tuple[float, ...]:
        """Its sign is that of every orientation near it."""
        return as_reference(quat_from_rotation(self._tcp_at(self._home_rad)[1]))

    def pose_state(self, reference: PoseReference | JointReference) -> PoseState:
        """Measured TCP pose, twist and wrench, with `reference`.

        The wrench is `wrench` behind a first-order low-pass of `WRENCH_FILTER_S`.
        """
        position, rotation = self.tcp()
        if isinstance(reference, JointReference):
            held = self._tcp_at(reference.position_rad)
        else:
            held = reference.position_m, reference.rotation
        return PoseState(
            position_m=position,
            quat_xyzw=np.array(toward(quat_from_rotation(rotation), self._home_quat)),
            twist=self._tcp_jacobian() @ self._velocity_rad_s,
            wrench=self._filtered_wrench.copy(),
            reference_position_m=held[0],
            reference_quat_xyzw=quat_from_rotation(held[1]),
        )


class SimulatedGripper:
    """Fingers with a width servo: the set width changes at a given speed, under a bounded force.

    A robot without finger joints has one in name: its width is the set one.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        robot: RobotModel,
        gripper: GripperProfile,
    ) -> None:
        self._model, self._data = model, data
        fingers = [model.joint(prefix_of(robot) + name) for name in robot.finger_joints]
        self._q = [data.qpos[joint.qposadr[0] :][:1] for joint in fingers]
        self._v = [data.qvel[joint.dofadr[0] :][:1] for joint in fingers]
        self._shares = finger_shares(robot).tolist() if fingers else []
        self._signs, self._max_width_m = robot.finger_signs, gripper.max_width_m
        self._widths = Fingers(gripper, len(fingers))
        # The actuator's opening is without the constant part of the width.
        self._shut_m = self._widths.width_m(0.0)
        self._actuator = int(model.actuator(prefix_of(robot) + GRIPPER).id) if fingers else None

    def open(self) -> None:
        """Put the fingers at their widest, as after a reset."""
        opened = self._widths.position(self._max_width_m)
        for joint, sign in zip(self._q, self._signs, strict=False):
            joint[:] = sign * opened
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
        self._target_m, self._step_m = target, speed_m_s * STEP_S  # of one millisecond
        if abs(target - self._measured_m) > HELD_MARGIN_M and not self._holding:
            self._rest_ticks = 0
        self._bound_force(force_n)

    def step(self, steps: int = 1) -> None:
        """Set the actuator for the next steps."""
        self._measured_m, rate_m_s = self._opening()
        self._rest_ticks = self._rest_ticks + steps if abs(rate_m_s) < AT_REST_M_S else 0
        left, most = self._target_m - self._set_m, self._step_m * steps
        self._set_m += min(max(left, -most), most)
        if self._actuator is not None:
            self._data.ctrl[self._actuator] = self._set_m - self._shut_m

    def state(self) -> GripperState:
        """Opening between the fingers, and whether they move or hold an object."""
        return GripperState(self._opening()[0], moving=self._moving, holding=self._holding)

    @property
    def force_n(self) -> float:
        """Force of either finger, inwards positive."""
        if self._actuator is None:
            return 0.0
        return -float(self._data.actuator_force[self._actuator])

    @property
    def _moving(self) -> bool:
        return self._rest_ticks < AT_REST_TICKS

    @property
    def _holding(self) -> bool:
        """The fingers stand still wider than set: an object keeps them apart."""
        return self._measured_m - self._set_m > HELD_MARGIN_M and not self._moving

    def _opening(self) -> tuple[float, float]:
        if not self._q:
            return self._set_m, 0.0
        width_m, rate_m_s = self._shut_m, 0.0
        for share, at, rate in zip(self._shares, self._q, self._v, strict=True):
            width_m += share * at.item()
            rate_m_s += share * rate.item()
        return width_m, rate_m_s

    def _bound_force(self, force_n: float) -> None:
        limit_n = min(force_n, MAX_FORCE_N)
        if self._actuator is not None:
            self._model.actuator_forcerange[self._actuator] = (-limit_n, limit_n)
