"""Description of a robot for the simulator, beside its URDF. The defaults are a Franka Panda."""

from __future__ import annotations

from dataclasses import dataclass, replace

from vla_zenoh.profile import Profile, RobotProfile

Rgba = tuple[float, float, float, float]
Vector3 = tuple[float, float, float]


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


@dataclass(frozen=True, slots=True)
class RobotModel:
    """An arm with a gripper of parallel fingers, or of one jaw that turns.

    Kinematics, inertia and joint limits are those of the URDF, `description`, see
    `vla_zenoh.resources.robot_urdf`. Details of its meshes that are smaller than `mesh_grid_m` are
    merged, where they have too many faces to draw. Armature is the inertia of each motor, seen
    through its gear; without it Pinocchio and MuJoCo compute the same dynamics.
    """

    description: str = "example-robot-data:panda_description/urdf/panda.urdf"
    mesh_grid_m: float | None = None
    arm_joints: tuple[str, ...] = tuple(f"panda_joint{i}" for i in range(1, 8))  # base to tip
    armature_kg_m2: float = 0.0
    effort_nm: float | None = None  # limit of every joint; None: that of the URDF
    gains: JointGains = JointGains()
    finger_joints: tuple[str, ...] = ("panda_finger_joint1", "panda_finger_joint2")
    finger_scale_m: float = 1.0  # opening by the sum of their positions, in m or rad
    max_width_m: float = 0.08
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
    description="example-robot-data:so_arm_description/urdf/so101.urdf",
    mesh_grid_m=0.002,
    arm_joints=("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"),
    # The motors are geared 345 : 1; the URDF has neither their inertia nor their stall torque.
    armature_kg_m2=0.028,
    effort_nm=2.9,
    gains=JointGains(
        stiffness_nm_rad=(60.0, 60.0, 60.0, 40.0, 40.0), max_integral_nm=(1.5, 1.5, 1.5, 1.0, 1.0)
    ),
    finger_joints=("gripper",),
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


def robot_model(robot: RobotProfile) -> RobotModel:
    """The robot of a profile: the SO-101, else with camera, gripper and colours of a Panda."""
    found = SO101 if robot.description == SO101.description else RobotModel()
    ends = robot.gripper.joint_ends
    found = replace(
        found, description=robot.description, arm_joints=robot.arm_joints, tcp_link=robot.tcp_frame
    )
    if ends is None:
        return found
    width_m = robot.gripper.max_width_m
    return replace(found, finger_scale_m=width_m / (ends.open - ends.shut), max_width_m=width_m)


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
