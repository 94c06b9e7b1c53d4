"""Description of a robot for the simulator, beside its URDF. The defaults are a Franka Panda.

The Panda and the SO-101 have numbers of their own here; any other arm is made of its profile and
its URDF, see `vla_zenoh.simulation.any_arm`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vla_zenoh.profile import GripperProfile, Profile, RobotProfile
from vla_zenoh.types import FloatArray

Rgba = tuple[float, float, float, float]
Vector3 = tuple[float, float, float]

MIN_TOOL_M = 0.01


@dataclass(frozen=True, slots=True)
class MountedCamera:
    """A camera fixed to a link of the robot, described in that link's frame."""

    name: str
    link: str
    position_m: Vector3
    look_at_m: Vector3  # on the optical axis
    up: Vector3  # in the image
    fovy_rad: float  # vertical


@dataclass(frozen=True, slots=True)
class JointGains:
    """Gains of the joint impedance controller, per joint from the base outwards.

    By default it follows within a milliradian; a blocked joint exerts at most 40 Nm, at the stretch
    `max_error_rad` of its spring. A longer arm repeats the last number, a shorter one ignores the
    surplus. See `ImpedanceGains` for the other fields.
    """

    stiffness_nm_rad: tuple[float, ...] = (600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0)
    damping_ratio: float = 1.0
    integral_1_s: float = 4.0
    max_integral_nm: tuple[float, ...] = (10.0, 10.0, 10.0, 10.0, 4.0, 4.0, 2.0)
    max_error_rad: float = 0.05


PANDA_WRIST = MountedCamera(
    name="wrist",
    link="panda_hand",
    position_m=(0.085, 0.0, 0.03),
    look_at_m=(0.02, 0.0, 0.13),
    up=(1.0, 0.0, 0.0),
    fovy_rad=1.2,
)

PANDA_HAND = GripperProfile(max_width_m=0.08)


@dataclass(frozen=True, slots=True)
class RobotModel:
    """An arm with a gripper of parallel fingers, or of one jaw that turns.

    Kinematics, inertia and joint limits are those of the URDF, `description`, see
    `vla_zenoh.resources.robot_urdf`; of an arm that has no numbers here also those of `robot`.
    Details of its meshes that are smaller than `mesh_grid_m` are merged, where they have too many
    faces to draw. Armature is the inertia of each motor, seen through its gear; without it
    Pinocchio and MuJoCo compute the same dynamics. A finger whose sign is -1 goes backwards to
    open.
    """

    description: str = "shipped:panda.urdf"
    robot: RobotProfile | None = None  # None: the Panda or the SO-101
    mesh_grid_m: float | None = None
    arm_joints: tuple[str, ...] = tuple(f"panda_joint{i}" for i in range(1, 8))  # base to tip
    armature_kg_m2: float = 0.0
    effort_nm: float | None = None  # limit of every joint; None: that of the URDF
    gains: JointGains = JointGains()
    finger_joints: tuple[str, ...] = ("panda_finger_joint1", "panda_finger_joint2")
    finger_signs: tuple[float, ...] = (1.0, 1.0)  # -1: it goes backwards to open
    gripper: GripperProfile | None = PANDA_HAND  # None: it has none
    finger_links: tuple[str, ...] = ("panda_leftfinger", "panda_rightfinger")  # touch the object
    tcp_link: str = "panda_hand_tcp"
    camera: MountedCamera | None = PANDA_WRIST
    gripper_stiffness_n_m: float = 4000.0  # of the width servo, capped by a command's force
    gripper_damping_ns_m: float = 25.0
    colours: tuple[tuple[str, Rgba], ...] = (
        ("panda_link5", (0.80, 0.81, 0.83, 1.0)),
        ("panda_link7", (0.62, 0.64, 0.67, 1.0)),
        ("panda_hand", (0.80, 0.81, 0.83, 1.0)),
        ("panda_leftfinger", (0.16, 0.17, 0.19, 1.0)),
        ("panda_rightfinger", (0.16, 0.17, 0.19, 1.0)),
    )
    colour: Rgba = (0.88, 0.89, 0.90, 1.0)  # of every other link
    part: str = ""  # of a robot; empty: all of it
    base_m: Vector3 = (0.0, 0.0, 0.0)  # in the world
    base_yaw_rad: float = 0.0


SO101 = RobotModel(
    description="shipped:so101.urdf",
    mesh_grid_m=0.002,
    arm_joints=("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"),
    # The motors are geared 345 : 1; the URDF has neither their inertia nor their stall torque.
    armature_kg_m2=0.028,
    effort_nm=2.9,
    gains=JointGains(
        stiffness_nm_rad=(60.0, 60.0, 60.0, 40.0, 40.0), max_integral_nm=(1.5, 1.5, 1.5, 1.0, 1.0)
    ),
    finger_joints=("gripper",),
    finger_signs=(1.0,),
    gripper=GripperProfile(max_width_m=0.1, joint_open_rad=1.7, joint_shut_rad=-0.17),
    finger_links=("gripper_link", "moving_jaw_so101_v1_link"),
    tcp_link="gripper_frame_link",
    camera=MountedCamera(
        name="wrist",
        link="gripper_link",
        position_m=(0.0, -0.075, -0.01),
        look_at_m=(-0.005, 0.0, -0.105),
        up=(0.0, 1.0, 0.0),
        fovy_rad=1.2,
    ),
    gripper_stiffness_n_m=1500.0,
    gripper_damping_ns_m=40.0,
    colours=(("moving_jaw_so101_v1_link", (0.35, 0.36, 0.38, 1.0)),),
    colour=(0.90, 0.90, 0.88, 1.0),
)

WITH_MESHES = {
    "example-robot-data:panda_description/urdf/panda.urdf": RobotModel().description,
    "example-robot-data:so_arm_description/urdf/so101.urdf": SO101.description,
}
"""The same arms as they look, of the extra ``meshes``: their description, and that of ours."""


def robot_model(robot: RobotProfile) -> RobotModel:
    """The robot of a profile.

    Raises:
        ResourceError, ProfileError: it is neither a Panda nor an SO-101, and its description is
            missing or does not fit.
    """
    shipped = {model.description: model for model in (RobotModel(), SO101)}
    described = WITH_MESHES.get(robot.description, robot.description)
    # Of a shipped description the fingers move, whatever the profile names.
    found = (shipped.get(described) if robot.gripper else None) or _any_arm(robot)
    return replace(
        found,
        description=robot.description,
        arm_joints=robot.arm_joints,
        tcp_link=robot.tcp_frame,
        gripper=robot.gripper,
    )


def _any_arm(robot: RobotProfile) -> RobotModel:
    """An arm that has no numbers here."""
    from vla_zenoh.kinematics.kinematics import arm_kinematics  # a camera node needs no Pinocchio

    kinematics = arm_kinematics(robot)
    described = kinematics.described
    fingers = set(described.led_by(robot.finger_joints))
    return RobotModel(
        robot=robot,
        armature_kg_m2=0.03,  # of geared motors: many descriptions have hardly any at the wrist
        effort_nm=1e5,  # that of descriptions is often wrong; the gains bound what it presses with
        finger_joints=robot.finger_joints,
        finger_signs=tuple(kinematics.finger_signs.tolist()),
        finger_links=tuple(
            link
            for link in described.links
            if any(joint.name in fingers for joint in described.chain(described.root, link))
        ),
        camera=_at_tool(robot.tcp_frame, kinematics.tool_m),
        colours=(),
    )


def _at_tool(link: str, tool_m: FloatArray) -> MountedCamera:
    """A camera at the TCP that looks along the tool, until its scene puts it beside the hand.

    Args:
        link: of the TCP.
        tool_m: (3,) from the last joint to the TCP, in its frame; of no length: along z.
    """
    length_m = float(np.linalg.norm(tool_m))
    ahead = tool_m / length_m if length_m > MIN_TOOL_M else np.array([0.0, 0.0, 1.0])
    # Whichever axis is most across the tool.
    across = np.eye(3)[int(np.argmin(np.abs(ahead)))]
    up = across - ahead * float(across @ ahead)
    up /= np.linalg.norm(up)
    return MountedCamera("wrist", link, (0.0, 0.0, 0.0), _vector(ahead), _vector(up), fovy_rad=1.2)


def _vector(values: FloatArray) -> Vector3:
    x, y, z = values.tolist()
    return x, y, z


def robot_models(profile: Profile) -> tuple[RobotModel, ...]:
    """The robot of a profile, part by part."""
    if not profile.parts:
        return (robot_model(profile.robot),)
    return tuple(
        replace(
            robot_model(profile.of_part(name).robot),
            part=name,
            base_m=part.base.position_m,
            base_yaw_rad=part.base.yaw_rad,
        )
        for name, part in profile.parts.items()
    )
