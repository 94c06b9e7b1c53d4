"""A scene in ``sim/``: its MuJoCo model with the robot in it, and what a seed changes in it.

The process that steps the world and those that render it build their models with `build_model` from
the same arguments, so that a pose vector of one fits the other.

A seed changes the places of the objects, and the appearance. A scene declares in its MJCF where an
object may stand::

    <custom>
      <numeric name="place/brick" data="x_min x_max y_min y_max yaw_min yaw_max"/>
      <numeric name="place_gap_m" data="0.05"/>
    </custom>

``distract/NAME`` is the same for a distractor, which is placed only on request. With an entry
``fit/front`` the camera ``front`` goes back or forth until it just sees an arm that is made of its
description, at home, and these places. Appearance (lights, colour of the table, pose of the front
camera) changes images alone, so only a renderer uses it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from vla_zenoh import resources
from vla_zenoh.errors import ResourceError
from vla_zenoh.kinematics.fingers import Fingers
from vla_zenoh.kinematics.kinematics import arm_kinematics
from vla_zenoh.simulation.any_arm import arm_spec
from vla_zenoh.simulation.framing import axes_of, beside_hand, step_back
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
# Between the jaws of an SO-101, which pinch at an angle, it crept 2.6 mm so, and 0.1 mm with these.
JAW_NOSLIP_ITERATIONS = 5
STIFF_SOLREF = (0.004, 1.0)
FINGER_KG = 0.05
"""What the servo of the opening moves at least, with its gear; thin fingers would shake."""
PAD_FRICTION = (1.5, 0.02, 0.001)  # sliding, torsional, rolling
PAD_CONDIM = 4
PAD_SOLIMP = (0.99, 0.999, 0.001, 0.5, 2.0)  # the fingers are light, hence soft otherwise

REGION_PREFIX = "place/"
DISTRACTOR_PREFIX = "distract/"
GAP = "place_gap_m"
FITS = "fit/front"
MAX_DRAWS = 1000

LIGHTS, TABLE, CAMERA, DISTRACTORS = "lights", "table", "camera", "distractors"
VARIATIONS = (LIGHTS, TABLE, CAMERA, DISTRACTORS)

KEY_LIGHT, TABLE_MATERIAL, FRONT_CAMERA = "key", "table", "front"
MAX_SHIFT_M = 0.03
MAX_TURN_RAD = math.radians(5.0)
AMBIENT, HEAD, KEY = (0.24, 0.44), (0.15, 0.38), (0.25, 0.65)
MAX_TINT = 0.12
MAX_LIGHT_TURN_RAD = 0.8
TABLE_BRIGHTNESS, TABLE_SATURATION = (0.35, 0.95), 0.35
_STREAM = 0x100C
"""Second seed of the random generator: appearance and places of objects are independent."""


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


def _camera_name(robot: RobotModel) -> str:
    name = robot.camera.name if robot.camera is not None else ""
    return f"{robot.part}_{name}" if robot.part else name


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
                spec.camera(prefix_of(robot) + robot.camera.name).name = _camera_name(robot)
        _set_solver(spec, jaw=any(len(robot.finger_joints) == 1 for robot in robots))
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        described = " and ".join(dict.fromkeys(robot.description for robot in robots))
        raise ResourceError(f"MuJoCo rejects scene {path} with {described}: {error}") from error
    if any(robot.robot is not None for robot in robots):
        _fit(model, robots)
    # Two groups for ray casting.
    moving = model.body_weldid[model.geom_bodyid] != 0
    visible = model.geom_group < HIDDEN_GROUP
    model.geom_group[visible & moving] = MOVING_GROUP
    model.geom_group[visible & ~moving] = STATIC_GROUP
    return model


def _fit(model: mujoco.MjModel, robots: Sequence[RobotModel]) -> None:
    """Fit a scene to arms that are made of their descriptions: contacts and cameras."""
    data = mujoco.MjData(model)
    own_arms = [robot for robot in robots if robot.robot is not None]
    for robot in own_arms:
        home_rad = robot.robot.home_rad if robot.robot is not None else ()
        for name, position in zip(robot.arm_joints, home_rad, strict=True):
            data.joint(prefix_of(robot) + name).qpos[0] = position
    mujoco.mj_forward(model, data)
    for robot in own_arms:
        own = _moving(model, robot)
        _let_through(model, data, own)
        if robot.camera is not None:
            camera = model.camera(_camera_name(robot)).id
            beside_hand(
                *(model, data, camera, own),
                np.array(robot.camera.look_at_m),
                np.array(robot.camera.up),
            )
    fits = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, FITS) >= 0
    if fits and len(own_arms) == len(robots):
        places = [
            (x_m, y_m, 0.0)
            for low, high in regions_of(model).values()
            for x_m, y_m in product((low.x_m, high.x_m), (low.y_m, high.y_m))
        ]
        arms = [_corners_m(model, data, _moving(model, robot)) for robot in robots]
        bases = [robot.base_m for robot in robots]
        camera = model.camera(FRONT_CAMERA).id
        step_back(model, data, camera, np.concatenate([*arms, places, bases]))


def _let_through(model: mujoco.MjModel, data: mujoco.MjData, own: NDArray[np.bool_]) -> None:
    """Let shapes of the arm that are inside the table at home, as a shoulder's, touch nothing."""
    moves = model.body_weldid[model.geom_bodyid] != 0
    for pair in data.contact.geom[data.contact.dist < 0]:
        if not moves[pair].all():
            model.geom_contype[pair[own[pair]]] = 0


def _moving(model: mujoco.MjModel, robot: RobotModel) -> NDArray[np.bool_]:
    """Which geoms are of the robot, but for those that stand still."""
    moves = model.body_weldid[model.geom_bodyid] != 0
    bodies = [model.body(int(body)).name for body in model.geom_bodyid]
    return np.array([name.startswith(prefix_of(robot)) for name in bodies]) & moves


def _robot_spec(robot: RobotModel, joint_friction_nm: float) -> mujoco.MjSpec:
    if robot.robot is None:
        spec = _shipped_spec(robot)
    else:
        spec = arm_spec(arm_kinematics(robot.robot), robot.finger_joints)
    # Fusing would merge the TCP and the base into their parents and lose their frames.
    spec.compiler.fusestatic = False
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
    if robot.robot is not None:
        for name, share in zip(robot.finger_joints, finger_shares(robot), strict=True):
            spec.joint(name).armature = FINGER_KG * share * share
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


def _shipped_spec(robot: RobotModel) -> mujoco.MjSpec:
    """Of shapes, or with the meshes as they are, or coarse."""
    urdf = resources.robot_urdf(robot.description)
    spec = mujoco.MjSpec.from_file(str(urdf))
    for mesh in spec.meshes:
        file = resources.meshes_of(urdf) / Path(mesh.file).name
        if robot.mesh_grid_m is None:
            mesh.file = str(file)
        else:
            vertices, faces = coarse_stl(file, robot.mesh_grid_m)
            mesh.file, mesh.uservert, mesh.userface = "", vertices.ravel(), faces.ravel()
    for light in list(spec.lights):
        spec.delete(light)
    return spec


def coarse_stl(file: Path, grid_m: float) -> tuple[FloatArray, NDArray[np.int32]]:
    """Vertices (n, 3) and faces (m, 3) of a binary STL, with one vertex in each cell of a grid."""
    triangle = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    corners = np.fromfile(file, triangle, offset=84)["corners"].reshape(-1, 3)
    cells = np.round(corners / grid_m).astype(np.int64)
    cells -= cells.min(axis=0)
    _, cell = np.unique(np.ravel_multi_index(cells.T, cells.max(axis=0) + 1), return_inverse=True)
    total = [np.bincount(cell, corners[:, axis]) for axis in range(3)]
    vertices = np.column_stack(total) / np.bincount(cell)[:, None]
    faces = cell.reshape(-1, 3).astype(np.int32)
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, once = np.unique(np.ravel_multi_index(faces.T, [len(vertices)] * 3), return_index=True)
    return vertices, faces[once]


def _named(element: Any, kind: str, name: str, known: list[str]) -> Any:
    if element is None:
        has = ", ".join(known)
        raise ResourceError(f"the robot description has no {kind} {name!r}; it has: {has}")
    return element


def _add_camera(link: mujoco.MjsBody, camera: MountedCamera) -> None:
    eye = np.array(camera.position_m)
    quat_wxyz = np.empty(4)
    axes = axes_of(eye, np.array(camera.look_at_m), np.array(camera.up))
    mujoco.mju_mat2Quat(quat_wxyz, axes.ravel())
    link.add_camera(name=camera.name, pos=eye, quat=quat_wxyz, fovy=math.degrees(camera.fovy_rad))


def _add_actuators(spec: mujoco.MjSpec, robot: RobotModel) -> None:
    for name in robot.arm_joints:
        limit = spec.joint(name).actfrcrange  # the URDF's effort limit
        if robot.effort_nm is not None:
            limit = (-robot.effort_nm, robot.effort_nm)
        motor = spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
        motor.ctrllimited, motor.ctrlrange = True, limit
    if not robot.finger_joints:
        return
    width = spec.add_tendon(name=GRIPPER)
    for name, share in zip(robot.finger_joints, finger_shares(robot), strict=True):
        width.wrap_joint(name, share)
    # A servo of the opening; its whole force acts on either finger.
    servo = spec.add_actuator(name=GRIPPER, trntype=mujoco.mjtTrn.mjTRN_TENDON, target=GRIPPER)
    servo.set_to_position(kp=robot.gripper_stiffness_n_m, kv=robot.gripper_damping_ns_m)
    servo.forcelimited, servo.forcerange = True, (-1.0, 1.0)


def finger_shares(robot: RobotModel) -> FloatArray:
    """(k,) m of opening per m or rad of each finger joint."""
    count = len(robot.finger_joints)
    if robot.gripper is None:
        return np.zeros(0)
    slope = Fingers(robot.gripper, count).slope
    return np.array(robot.finger_signs) * slope / count


def _set_solver(spec: mujoco.MjSpec, *, jaw: bool) -> None:
    option = spec.option
    option.timestep = STEP_S
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = IMPRATIO
    option.noslip_iterations = JAW_NOSLIP_ITERATIONS if jaw else 0
    # A state that diverged must stay visible; MuJoCo would reset it silently.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    # Multisampling costs ten times the rest of a software-rendered frame.
    spec.visual.quality.offsamples = 0
    spec.visual.quality.shadowsize = 0
    # Arms of capsules and cylinders: with MuJoCo's 28 and 16 a frame takes half as long again.
    spec.visual.quality.numslices = 16
    spec.visual.quality.numstacks = 8


# -- places of objects ----------------------------------------------------------------------------
class Place(NamedTuple):
    """Where an object stands, in the base frame, and its turn about the vertical."""

    x_m: float
    y_m: float
    yaw_rad: float


class Region(NamedTuple):
    """Bounds of the places of an object."""

    low: Place
    high: Place


def objects_of(model: mujoco.MjModel) -> dict[str, int]:
    """Name -> body id of every object that can be placed: free bodies and mocap bodies."""
    free = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE].tolist()
    placed = np.flatnonzero(model.body_mocapid >= 0).tolist()
    return {model.body(i).name: i for i in sorted(free + placed)}


def regions_of(model: mujoco.MjModel, prefix: str = REGION_PREFIX) -> dict[str, Region]:
    """Regions by name of the object, from the entries that begin with `prefix`.

    Raises:
        ResourceError: a region is malformed, or of an object the scene does not have.
    """
    known = objects_of(model)
    regions: dict[str, Region] = {}
    entries = [model.numeric(index) for index in range(model.nnumeric)]
    for entry in (entry for entry in entries if entry.name.startswith(prefix)):
        name = entry.name.removeprefix(prefix)
        if name not in known:
            can = ", ".join(known) or "nothing"
            raise ResourceError(f"the scene places {name!r}, but can only place: {can}")
        data = entry.data.tolist()
        if len(data) != 6 or not all(data[i] <= data[i + 1] for i in (0, 2, 4)):
            wanted = "x_min x_max y_min y_max yaw_min yaw_max"
            raise ResourceError(f"{entry.name} is {data}, wanted {wanted}")
        regions[name] = Region(Place(*data[0::2]), Place(*data[1::2]))
    return regions


def footprint_m(model: mujoco.MjModel, body: int) -> float:
    """Radius of the upright cylinder about the body's origin that holds all its geoms."""
    radius = 0.0
    for geom in np.flatnonzero(model.geom_bodyid == body):
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        corners = box_corners(model, int(geom)) @ rotation.reshape(3, 3).T + model.geom_pos[geom]
        radius = max(radius, float(np.hypot(corners[:, 0], corners[:, 1]).max()))
    return radius


def _corners_m(model: mujoco.MjModel, data: mujoco.MjData, geoms: NDArray[np.bool_]) -> FloatArray:
    """(m, 3) corners of the bounding boxes of geoms, in the world."""
    found = [np.zeros((0, 3))]
    for geom in np.flatnonzero(geoms):
        turn = data.geom_xmat[geom].reshape(3, 3)
        found.append(box_corners(model, int(geom)) @ turn.T + data.geom_xpos[geom])
    return np.concatenate(found)


def box_corners(model: mujoco.MjModel, geom: int) -> FloatArray:
    """(8, 3) corners of a geom's bounding box, in the geom's frame."""
    centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    return centre + signs * half


def draw_places(model: mujoco.MjModel, seed: int, *, distractors: bool = False) -> dict[str, Place]:
    """Draw a place without overlaps for every object that has a region.

    Objects without a region stay where the scene file has them, and the drawn ones keep clear of
    them. Distractors do not change the places of the other objects.

    Raises:
        ResourceError: the regions are too small for the objects.
    """
    random = np.random.default_rng(seed)
    regions, bodies = regions_of(model), objects_of(model)
    radii = {name: footprint_m(model, body) for name, body in bodies.items()}
    has_gap = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, GAP) >= 0
    gap_m = float(model.numeric(GAP).data[0]) if has_gap else 0.0
    fixed = {
        name: Place(float(model.body_pos[body, 0]), float(model.body_pos[body, 1]), 0.0)
        for name, body in bodies.items()
        if name not in regions
    }

    def draw(wanted: dict[str, Region], beside: dict[str, Place]) -> dict[str, Place]:
        for _ in range(MAX_DRAWS):
            drawn = {
                name: Place(*random.uniform(region.low, region.high).tolist())
                for name, region in wanted.items()
            }
            if all(
                math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) >= radii[one] + radii[other] + gap_m
                for (one, a), (other, b) in combinations((beside | drawn).items(), 2)
            ):
                return drawn
        raise ResourceError(
            f"no room for {', '.join(wanted)} in their regions with {gap_m:g} m between them; "
            f"make the regions of the scene larger or {GAP} smaller"
        )

    places = draw(regions, fixed)
    if distractors:
        for name, region in regions_of(model, DISTRACTOR_PREFIX).items():
            del fixed[name]
            places |= draw({name: region}, fixed | places)
    return places


# -- appearance -----------------------------------------------------------------------------------
class Appearance(NamedTuple):
    """Differences from the scene file, (3,) each; a reset applies those that are varied.

    Offset and rotation vectors are in the world frame.
    """

    ambient: FloatArray  # colour of the head light
    head: FloatArray  # its diffuse colour
    key: FloatArray  # diffuse colour of the scene's light
    key_turn_rad: FloatArray  # of the direction of that light
    table: FloatArray  # colour
    shift_m: FloatArray  # of the front camera
    turn_rad: FloatArray  # of the front camera


def draw_appearance(seed: int) -> Appearance:
    """The appearance of a reset with `seed`; offsets and rotations are uniform in a ball."""
    random = np.random.default_rng((_STREAM, seed))
    ambient, head, key = (
        random.uniform(low, high) * (1.0 + MAX_TINT * random.uniform(-1.0, 1.0, 3))
        for low, high in (AMBIENT, HEAD, KEY)
    )
    key_turn_rad = _in_ball(random, MAX_LIGHT_TURN_RAD)
    table = random.uniform(*TABLE_BRIGHTNESS) * (1.0 - TABLE_SATURATION * random.uniform(size=3))
    shift_m, turn_rad = _in_ball(random, MAX_SHIFT_M), _in_ball(random, MAX_TURN_RAD)
    return Appearance(ambient, head, key, key_turn_rad, table, shift_m, turn_rad)


def check_variations(vary: Collection[str]) -> None:
    """Raise a `ResourceError` unless everything in `vary` is one of `VARIATIONS`."""
    unknown = sorted(set(vary) - set(VARIATIONS))
    if unknown:
        raise ResourceError(f"nothing called {unknown[0]!r} to vary; {', '.join(VARIATIONS)}")


class AppearanceSwitcher:
    """Applies appearances to a compiled scene, which it modifies, each in place of the last."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        head = model.vis.headlight
        self._changed = (
            *(head.ambient, head.diffuse, model.light_diffuse, model.light_dir),
            *(model.mat_rgba, model.cam_pos, model.cam_quat),
        )
        self._original = tuple(np.array(values) for values in self._changed)

    def apply(self, seed: int | None, vary: Collection[str]) -> None:
        """Apply what `vary` names of the appearance of `seed`; None: that of the scene file.

        Raises:
            ResourceError: an unknown name in `vary`, or the scene lacks what it varies.
        """
        check_variations(vary)
        for values, original in zip(self._changed, self._original, strict=True):
            values[:] = original
        if seed is None:
            return
        model, look = self._model, draw_appearance(seed)
        if LIGHTS in vary:
            light = self._index("light", KEY_LIGHT)
            model.vis.headlight.ambient[:] = look.ambient
            model.vis.headlight.diffuse[:] = look.head
            model.light_diffuse[light] = look.key
            direction = model.light_dir[light].copy()
            mujoco.mju_rotVecQuat(model.light_dir[light], direction, _quat_wxyz(look.key_turn_rad))
        if TABLE in vary:
            model.mat_rgba[self._index("material", TABLE_MATERIAL), :3] = look.table
        if CAMERA in vary:
            camera = self._index("camera", FRONT_CAMERA)
            model.cam_pos[camera] += look.shift_m
            quat = model.cam_quat[camera].copy()
            mujoco.mju_mulQuat(model.cam_quat[camera], _quat_wxyz(look.turn_rad), quat)

    def _index(self, kind: str, name: str) -> int:
        try:
            return int(getattr(self._model, kind)(name).id)
        except KeyError as error:
            why = f"the scene has no {kind} {name!r} that could be varied"
            raise ResourceError(f"{why}; see sim/bricks/README.md") from error


def _in_ball(random: np.random.Generator, radius: float) -> FloatArray:
    direction = random.normal(size=3)
    return direction * radius * random.uniform() ** (1 / 3) / np.linalg.norm(direction)


def _quat_wxyz(rotvec: FloatArray) -> FloatArray:
    quat = np.array([1.0, 0.0, 0.0, 0.0])
    mujoco.mju_quatIntegrate(quat, rotvec, 1.0)
    return quat
