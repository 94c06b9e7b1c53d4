"""Description of a robot for the simulator, beside its URDF. The defaults are a Franka Panda."""

from __future__ import annotations

from dataclasses import dataclass, field

Rgba = tuple[float, float, float, float]
Vector3 = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class MountedCamera:
    """A camera fixed to a link of the robot, described in that link's frame.

    Args:
        name: the camera's name.
        link: the link that carries it.
        position_m: (3,) of the lens.
        look_at_m: (3,) a point on the optical axis.
        up: (3,) direction that is up in the image.
        fovy_rad: vertical field of view.
    """

    name: str
    link: str
    position_m: Vector3
    look_at_m: Vector3
    up: Vector3
    fovy_rad: float


def _panda_wrist() -> MountedCamera:
    return MountedCamera(
        name="wrist",
        link="panda_hand",
        position_m=(0.085, 0.0, 0.03),
        look_at_m=(0.02, 0.0, 0.13),
        up=(1.0, 0.0, 0.0),
        fovy_rad=1.2,
    )


@dataclass(frozen=True, slots=True)
class RobotModel:
    """An arm with a two-finger parallel gripper.

    Kinematics, inertia, joint limits and effort limits are those of the URDF, without armature: so
    Pinocchio and MuJoCo compute the same dynamics.

    Args:
        description: the URDF, see `vla_zenoh.resources.robot_urdf`.
        arm_joints: the joints under torque control, base to tip.
        finger_joints: two prismatic joints; the opening is their sum.
        finger_links: links whose geoms touch the object.
        tcp_link: link whose frame is the TCP.
        camera: the camera mounted on the robot, or None.
        gripper_stiffness_n_m: of the width servo; the force bound of a command caps it.
        gripper_damping_ns_m: of the width servo.
        pad_friction: sliding, torsional, rolling friction of the fingers.
        colours: rgba of links by name.
        colour: rgba of every other link.
    """

    description: str = "example-robot-data:panda_description/urdf/panda.urdf"
    arm_joints: tuple[str, ...] = tuple(f"panda_joint{i}" for i in range(1, 8))
    finger_joints: tuple[str, str] = ("panda_finger_joint1", "panda_finger_joint2")
    finger_links: tuple[str, str] = ("panda_leftfinger", "panda_rightfinger")
    tcp_link: str = "panda_hand_tcp"
    camera: MountedCamera | None = field(default_factory=_panda_wrist)
    gripper_stiffness_n_m: float = 4000.0
    gripper_damping_ns_m: float = 25.0
    pad_friction: Vector3 = (1.5, 0.02, 0.001)
    colours: tuple[tuple[str, Rgba], ...] = (
        ("panda_link5", (0.80, 0.81, 0.83, 1.0)),
        ("panda_link7", (0.62, 0.64, 0.67, 1.0)),
        ("panda_hand", (0.80, 0.81, 0.83, 1.0)),
        ("panda_leftfinger", (0.16, 0.17, 0.19, 1.0)),
        ("panda_rightfinger", (0.16, 0.17, 0.19, 1.0)),
    )
    colour: Rgba = (0.88, 0.89, 0.90, 1.0)
