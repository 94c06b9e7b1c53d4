"""Builds the MuJoCo model of a scene in ``sim/`` with the robot in it.

The process that steps the world and those that render it build their models with `build_model` from
the same arguments, so that a pose vector of one fits the other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from vla_zenoh import resources
from vla_zenoh.errors import ResourceError
from vla_zenoh.simulation.robot_model import MountedCamera, RobotModel
from vla_zenoh.types import FloatArray

STEP_S = 1e-3
PREFIX, TCP_SITE, GRIPPER = "robot/", "tcp", "gripper"
_MOCAP = mujoco.mjtState.mjSTATE_MOCAP_POS.value | mujoco.mjtState.mjSTATE_MOCAP_QUAT.value
POSES = mujoco.mjtState.mjSTATE_QPOS.value | _MOCAP
"""MuJoCo's state of every pose: joint coordinates, then 7 numbers per mocap body."""
STATIC_GROUP = 0
MOVING_GROUP = 1
HIDDEN_GROUP = 3  # MuJoCo's own convention: groups from here on are not drawn

# Creep of a held brick in 10 s, measured: 1.06 mm with a pyramidal cone and impratio 1, 0.03 mm so.
IMPRATIO = 10.0
STIFF_SOLREF = (0.004, 1.0)
PAD_FRICTION = (1.5, 0.02, 0.001)  # sliding, torsional, rolling
PAD_CONDIM = 4
PAD_SOLIMP = (0.99, 0.999, 0.001, 0.5, 2.0)  # the fingers are light, hence soft otherwise


def scene_file(scene: str) -> Path:
    """MJCF file of `scene`, a name below ``sim/`` or a path; a `ResourceError` without one."""
    folder = resources.find("sim", scene)
    path = folder / "scene.xml" if folder.is_dir() else folder
    if not path.is_file():
        raise ResourceError(f"scene {scene!r} has no scene.xml in {folder}")
    return path


def prefix_of(robot: RobotModel) -> str:
    """Prefix of every name in the robot's description, so that a scene may use any name."""
    return f"{robot.part}/" if robot.part else PREFIX


def build_model(
    scene: str, robots: Sequence[RobotModel], *, joint_friction_nm: float = 0.0
) -> mujoco.MjModel:
    """Compile `scene` with a robot in it: its parts, or the only one.

    Raises:
        ResourceError: scene or robot are missing, or MuJoCo rejects them.
    """
    path = scene_file(scene)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        for index, robot in enumerate(robots):
            arm = _robot_spec(robot, joint_friction_nm)
            # A part meets the scene (1) and the other parts, but not itself.
            masks = [2 << other for other in range(len(robots))] if len(robots) > 1 else [0]
            for geom in arm.geoms:
                geom.contype, geom.conaffinity = 1 | masks[index], sum(masks) - masks[index]
            half_rad = robot.base_yaw_rad / 2
            frame = spec.worldbody.add_frame(
                pos=robot.base_m, quat=(math.cos(half_rad), 0.0, 0.0, math.sin(half_rad))
            )
            frame.attach_body(arm.bodies[1], prefix_of(robot), "")
            if robot.camera is not None:
                camera = f"{robot.part}_{robot.camera.name}" if robot.part else robot.camera.name
                spec.camera(prefix_of(robot) + robot.camera.name).name = camera
        _set_solver(spec)
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        described = " and ".join(dict.fromkeys(robot.description for robot in robots))
        raise ResourceError(f"MuJoCo rejects scene {path} with {described}: {error}") from error
    _sort_groups(model)
    return model


def _robot_spec(robot: RobotModel, joint_friction_nm: float) -> mujoco.MjSpec:
    urdf = resources.robot_urdf(robot.description)
    spec = mujoco.MjSpec.from_file(str(urdf))
    meshes = resources.meshes_of(urdf)
    for mesh in spec.meshes:
        file = meshes / Path(mesh.file).name
        if robot.mesh_grid_m is None:
            mesh.file = str(file)
        else:
            vertices, faces = coarse_stl(file, robot.mesh_grid_m)
            mesh.file, mesh.uservert, mesh.userface = "", vertices.ravel(), faces.ravel()
    # Fusing would merge the TCP and the base into their parents and lose their frames.
    spec.compiler.fusestatic = False
    for light in list(spec.lights):
        spec.delete(light)

    colours = dict(robot.colours)
    for geom in spec.geoms:
        link = geom.parent.name
        geom.rgba = colours.get(link, robot.colour)
        if link in robot.finger_links:
            geom.priority = 1  # the pads' friction counts, not the object's
            geom.friction = PAD_FRICTION
            geom.condim = PAD_CONDIM
            geom.solref, geom.solimp = STIFF_SOLREF, PAD_SOLIMP
    for equality in spec.equalities:
        equality.solref = STIFF_SOLREF
    for name in robot.arm_joints:
        joint = _named(spec.joint(name), "joint", name, [joint.name for joint in spec.joints])
        joint.frictionloss, joint.armature = joint_friction_nm, robot.armature_kg_m2

    links = [body.name for body in spec.bodies]
    tcp = _named(spec.body(robot.tcp_link), "link", robot.tcp_link, links)
    tcp.add_site(name=TCP_SITE, group=HIDDEN_GROUP)
    if robot.camera is not None:
        link = _named(spec.body(robot.camera.link), "link", robot.camera.link, links)
        _add_camera(link, robot.camera)
    _add_actuators(spec, robot)
    return spec


def coarse_stl(file: Path, grid_m: float) -> tuple[FloatArray, NDArray[np.int32]]:
    """Vertices (n, 3) and faces (m, 3) of a binary STL, with one vertex in each cell of a grid."""
    triangle = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    corners = np.fromfile(file, triangle, offset=84)["corners"].reshape(-1, 3)
    _, cell = np.unique(np.round(corners / grid_m).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.ravel()
    total = [np.bincount(cell, corners[:, axis]) for axis in range(3)]
    vertices = np.column_stack(total) / np.bincount(cell)[:, None]
    faces = cell.reshape(-1, 3).astype(np.int32)
    a, b, c = faces.T
    return vertices, np.unique(faces[(a != b) & (b != c) & (c != a)], axis=0)


def _named(element: Any, kind: str, name: str, known: list[str]) -> Any:
    if element is None:
        has = ", ".join(known)
        raise ResourceError(f"the robot description has no {kind} {name!r}; it has: {has}")
    return element


def _add_camera(link: mujoco.MjsBody, camera: MountedCamera) -> None:
    eye = np.array(camera.position_m)
    back = eye - np.array(camera.look_at_m)  # a MuJoCo camera looks along its own -z
    back /= np.linalg.norm(back)
    right = np.cross(np.array(camera.up), back)
    right /= np.linalg.norm(right)
    rotation = np.column_stack([right, np.cross(back, right), back])
    quat_wxyz = np.empty(4)
    mujoco.mju_mat2Quat(quat_wxyz, rotation.ravel())
    link.add_camera(name=camera.name, pos=eye, quat=quat_wxyz, fovy=math.degrees(camera.fovy_rad))


def _add_actuators(spec: mujoco.MjSpec, robot: RobotModel) -> None:
    for name in robot.arm_joints:
        limit = spec.joint(name).actfrcrange  # the URDF's effort limit
        if robot.effort_nm is not None:
            limit = (-robot.effort_nm, robot.effort_nm)
        motor = spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
        motor.ctrllimited, motor.ctrlrange = True, limit
    width = spec.add_tendon(name=GRIPPER)
    for name in robot.finger_joints:
        width.wrap_joint(name, robot.finger_scale_m)
    # A servo of the opening; its whole force acts on either finger.
    servo = spec.add_actuator(name=GRIPPER, trntype=mujoco.mjtTrn.mjTRN_TENDON, target=GRIPPER)
    servo.set_to_position(kp=robot.gripper_stiffness_n_m, kv=robot.gripper_damping_ns_m)
    servo.forcelimited, servo.forcerange = True, (-1.0, 1.0)


def _set_solver(spec: mujoco.MjSpec) -> None:
    option = spec.option
    option.timestep = STEP_S
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = IMPRATIO
    # A state that diverged must stay visible; MuJoCo would reset it silently.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    # Multisampling costs ten times the rest of a software-rendered frame.
    spec.visual.quality.offsamples = 0
    spec.visual.quality.shadowsize = 0


def _sort_groups(model: mujoco.MjModel) -> None:
    """Sort visible geoms into two groups, moving and static, for ray casting."""
    moving = model.body_weldid[model.geom_bodyid] != 0
    visible = model.geom_group < HIDDEN_GROUP
    model.geom_group[visible & moving] = MOVING_GROUP
    model.geom_group[visible & ~moving] = STATIC_GROUP
