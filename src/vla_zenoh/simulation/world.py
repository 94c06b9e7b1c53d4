"""The simulated world: robots, controllers, grippers and objects, stepped by 1 ms per tick."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from vla_zenoh.errors import NodeError, ResourceError
from vla_zenoh.profile import Profile
from vla_zenoh.simulation.appearance import DISTRACTORS, check_variations
from vla_zenoh.simulation.impedance import ImpedanceGains
from vla_zenoh.simulation.objects import draw_places, objects_of
from vla_zenoh.simulation.robot_model import RobotModel, robot_models
from vla_zenoh.simulation.scene import POSES, STEP_S, build_model
from vla_zenoh.simulation.simulated_robot import SimulatedPart
from vla_zenoh.types import FloatArray, JointReference, PoseReference, vector

STEP_NS = round(STEP_S * 1e9)


class World:
    """A scene with a robot in it, of one part or several, stepped by `tick`.

    Deterministic to the bit: the same seed, references and gripper commands give the same state.
    Members about one arm are those of the first of `parts`. Poses are of its TCP in its base frame,
    those of objects in the world frame, which is the base frame of a robot of one part.

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
        self._warnings = self._data.warning.number  # a view
        one = isinstance(robot, RobotModel)
        homes: Sequence[Any] = [home_rad] if one else list(home_rad)  # pyright: ignore
        self.parts: dict[str, SimulatedPart] = {
            model.part: SimulatedPart(
                self.model,
                self._data,
                model,
                vector("home_rad", home, len(model.arm_joints)),
                gains or ImpedanceGains(),
                self._refresh,
            )
            for model, home in zip([robot] if one else robot, homes, strict=True)
        }
        arm = self._first = next(iter(self.parts.values()))
        self.robot, self.joint_range_rad, self.tcp = arm.robot, arm.joint_range_rad, arm.tcp
        self.hold_reference, self.set_gripper = arm.hold_reference, arm.set_gripper
        self.joint_state, self.pose_state = arm.joint_state, arm.pose_state
        self.gripper_state = arm.gripper_state
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

    @property
    def wrench(self) -> FloatArray:
        """See `SimulatedPart.wrench`."""
        return self._first.wrench

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
