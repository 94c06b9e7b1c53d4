"""Robot descriptions that ship with the package: ``python scripts/descriptions.py`` writes them.

Kinematics, ranges and masses are the makers' numbers, as their descriptions in example-robot-data
have them; shapes are cylinders, balls and boxes of our own.
`tests/contract/test_shipped_descriptions.py` compares them with the makers' files, where the extra
``meshes`` is installed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

FOLDER = Path(__file__).resolve().parent.parent / "profiles"
TURN = math.pi / 2
Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)


class Inertia(NamedTuple):
    """Mass in kg, its centre in m, and ixx, ixy, ixz, iyy, iyz, izz about that in kg m^2."""

    mass_kg: float
    centre_m: Vector
    about_kg_m2: Sequence[float]


class Link(NamedTuple):
    """A link and its shapes, each as text of a URDF."""

    name: str
    shapes: Sequence[str] = ()
    inertia: Inertia | None = None


class Joint(NamedTuple):
    """A joint: fixed without a range; it slides with `slides`, else it turns."""

    name: str
    parent: str
    child: str
    xyz_m: Vector = ZERO
    rpy_rad: Vector = ZERO
    range: tuple[float, float] | None = None
    velocity: float = 0.0
    effort: float = 0.0
    axis: Vector = (0.0, 0.0, 1.0)
    damping: float = 0.0
    slides: bool = False
    mimic: str = ""


def shape(geometry: str, centre_m: Sequence[float], rpy_rad: Sequence[float] = ZERO) -> str:
    """A collision shape."""
    origin = f'<origin xyz="{numbers(centre_m)}" rpy="{numbers(rpy_rad)}"/>'
    return f"<collision>{origin}<geometry><{geometry}/></geometry></collision>"


def cylinder(start_m: Vector, end_m: Vector, radius_m: float) -> str:
    """A cylinder from the centre of one end to that of the other."""
    x, y, z = (b - a for a, b in zip(start_m, end_m, strict=True))
    length_m = math.hypot(x, y, z)
    centre_m = [(a + b) / 2 for a, b in zip(start_m, end_m, strict=True)]
    rpy_rad = (0.0, math.acos(z / length_m), math.atan2(y, x))
    size = f'cylinder radius="{number(radius_m)}" length="{number(length_m)}"'
    return shape(size, centre_m, rpy_rad)


def sphere(centre_m: Vector, radius_m: float) -> str:
    """A ball."""
    return shape(f'sphere radius="{number(radius_m)}"', centre_m)


def capsule(start_m: Vector, end_m: Vector, radius_m: float) -> list[str]:
    """A cylinder with a ball at each end."""
    ends = [sphere(start_m, radius_m), sphere(end_m, radius_m)]
    return [cylinder(start_m, end_m, radius_m), *ends]


def box(
    x_m: tuple[float, float],
    y_m: tuple[float, float],
    z_m: tuple[float, float],
    rpy_rad: Sequence[float] = ZERO,
) -> str:
    """A box between bounds, turned about its centre."""
    sides = (x_m, y_m, z_m)
    size = numbers([high - low for low, high in sides])
    return shape(f'box size="{size}"', [(low + high) / 2 for low, high in sides], rpy_rad)


def number(value: float) -> str:
    """A number without needless digits."""
    return f"{round(value, 10) + 0.0:.10g}"


def numbers(values: Sequence[float]) -> str:
    """Several of them."""
    return " ".join(map(number, values))


def urdf(name: str, about: str, links: Sequence[Link], joints: Sequence[Joint]) -> str:
    """The description as text."""
    lines = ['<?xml version="1.0"?>', f"<!-- {about} -->", f'<robot name="{name}">']
    for link in links:
        inside = [f"    {each}" for each in link.shapes]
        if link.inertia is not None:
            inside.insert(0, f"    {inertial(link.inertia)}")
        lines += [f'  <link name="{link.name}">', *inside, "  </link>"]
    for joint in joints:
        lines += joint_lines(joint)
    return "\n".join([*lines, "</robot>", ""])


def inertial(inertia: Inertia) -> str:
    """Mass, its centre, and its inertia."""
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    about = " ".join(
        f'{name}="{value:.10g}"' for name, value in zip(names, inertia.about_kg_m2, strict=True)
    )
    origin = f'<origin xyz="{numbers(inertia.centre_m)}"/>'
    return f'<inertial>{origin}<mass value="{inertia.mass_kg}"/><inertia {about}/></inertial>'


def joint_lines(joint: Joint) -> list[str]:
    """A joint, line by line."""
    kind = "fixed" if joint.range is None else "prismatic" if joint.slides else "revolute"
    lines = [
        f'  <joint name="{joint.name}" type="{kind}">',
        f'    <parent link="{joint.parent}"/><child link="{joint.child}"/>',
        f'    <origin xyz="{numbers(joint.xyz_m)}" rpy="{numbers(joint.rpy_rad)}"/>',
    ]
    if joint.range is not None:
        low, high = map(number, joint.range)
        lines += [
            f'    <axis xyz="{numbers(joint.axis)}"/>',
            f'    <limit lower="{low}" upper="{high}" velocity="{number(joint.velocity)}" '
            f'effort="{number(joint.effort)}"/>',
        ]
    if joint.damping:
        lines.append(f'    <dynamics damping="{number(joint.damping)}"/>')
    if joint.mimic:
        lines.append(f'    <mimic joint="{joint.mimic}"/>')
    return [*lines, "  </joint>"]


# -- Franka Panda ---------------------------------------------------------------------------------
R = 0.055


def panda_finger(side: str, way: float) -> Link:
    """A finger on one side; `way` is the direction in which it opens, 1 or -1 along y."""

    def across(near_m: float, far_m: float) -> tuple[float, float]:
        low, high = sorted((way * near_m, way * far_m))
        return low, high

    shapes = [
        box((-0.0105, 0.0105), across(0.011, 0.026), (0.0, 0.021)),
        box((-0.0085, 0.0085), across(0.012, 0.02), (0.016, 0.041), (way * 0.5, 0.0, 0.0)),
        box((-0.009, 0.009), across(0.0, 0.015), (0.0365, 0.0545)),
    ]
    inertia = Inertia(0.015, ZERO, (2.375e-6, 0, 0, 2.375e-6, 0, 7.5e-7))
    return Link(f"panda_{side}finger", shapes, inertia)


PANDA_LINKS = [
    Link(
        "panda_link0",
        [
            cylinder(ZERO, (0.0, 0.0, 0.06), 0.071),
            cylinder(ZERO, (0.0, 0.0, 0.14), R),
            box((-0.153, 0.0), (-0.035, 0.035), (0.0, 0.045)),
            box((-0.11, 0.0), (-0.05, 0.05), (0.05, 0.1)),
            box((-0.1, 0.0), (-0.094, 0.094), (0.0, 0.02)),
        ],
        Inertia(
            0.629769,
            (-0.041018, -0.00014, 0.049974),
            (0.00315, 8.2904e-7, 0.00015, 0.00388, 8.2299e-6, 0.004285),
        ),
    ),
    Link(
        "panda_link1",
        [
            cylinder((0.0, 0.0, -0.192), (0.0, 0.0, -0.13), R),
            cylinder(ZERO, (0.0, -0.074, 0.0), R),
            sphere((0.0, -0.074, 0.0), R),
            *capsule((0.0, -0.003, -0.13), (0.0, -0.04, -0.02), 0.053),
        ],
        Inertia(
            4.970684,
            (0.003875, 0.002081, -0.04762),
            (0.70337, -0.000139, 0.006772, 0.70661, 0.019169, 0.009117),
        ),
    ),
    Link(
        "panda_link2",
        [
            cylinder((0.0, -0.194, 0.0), (0.0, -0.13, 0.0), R),
            cylinder(ZERO, (0.0, 0.0, 0.074), R),
            sphere((0.0, 0.0, 0.074), R),
            *capsule((0.0, -0.13, 0.003), (0.0, -0.02, 0.04), 0.053),
        ],
        Inertia(
            0.646926,
            (-0.003141, -0.02872, 0.003495),
            (0.007962, -0.003925, 0.010254, 0.02811, 0.000704, 0.025995),
        ),
    ),
    Link(
        "panda_link3",
        [
            cylinder((0.0, 0.0, -0.121), (0.0, 0.0, -0.045), R),
            cylinder((0.0825, 0.0, 0.0), (0.0825, 0.056, 0.0), R),
            sphere((0.0825, 0.056, 0.0), R),
            *capsule((0.004, 0.004, -0.075), (0.075, 0.04, -0.005), 0.05),
        ],
        Inertia(
            3.228604,
            (0.027518, 0.039252, -0.066502),
            (0.037242, -0.004761, -0.011396, 0.036155, -0.012805, 0.01083),
        ),
    ),
    Link(
        "panda_link4",
        [
            cylinder((-0.0825, 0.045, 0.0), (-0.0825, 0.124, 0.0), R),
            cylinder(ZERO, (0.0, 0.0, 0.056), R),
            sphere((0.0, 0.0, 0.056), R),
            *capsule((-0.078, 0.075, 0.004), (-0.008, 0.005, 0.04), 0.05),
        ],
        Inertia(
            3.587895,
            (-0.05317, 0.104419, 0.027454),
            (0.025853, 0.007796, -0.001332, 0.019552, 0.008641, 0.028323),
        ),
    ),
    Link(
        "panda_link5",
        [
            cylinder((0.0, 0.0, -0.262), (0.0, 0.0, -0.2), 0.054),
            *capsule((0.0, 0.036, -0.2), (0.0, 0.076, -0.02), 0.05),
            cylinder((0.0, 0.025, 0.0), (0.0, 0.08, 0.0), 0.051),
            sphere((0.0, 0.08, 0.0), 0.05),
        ],
        Inertia(
            1.225946,
            (-0.011953, 0.041065, -0.038437),
            (0.035549, -0.002117, -0.004037, 0.029474, 0.000229, 0.008627),
        ),
    ),
    Link(
        "panda_link6",
        [
            cylinder((0.0, 0.0, -0.015), (0.0, 0.0, 0.056), 0.047),
            cylinder((0.088, -0.05, 0.0), (0.088, 0.036, 0.0), 0.043),
            sphere((0.088, 0.038, 0.0), 0.043),
            box((0.02, 0.088), (-0.034, 0.034), (-0.036, 0.048)),
        ],
        Inertia(
            1.666555,
            (0.060149, -0.014117, -0.010517),
            (0.001964, 0.000109, -0.001158, 0.004354, 0.000341, 0.005433),
        ),
    ),
    Link(
        "panda_link7",
        [
            cylinder((0.0, 0.0, 0.052), (0.0, 0.0, 0.095), 0.044),
            cylinder((0.0, 0.0, 0.095), (0.0, 0.0, 0.107), 0.0316),
            cylinder((0.0495, 0.0495, 0.075), (0.0495, 0.0495, 0.094), 0.031),
            box((-0.006, 0.056), (-0.01, 0.06), (0.07, 0.094), (0.0, 0.0, -math.pi / 4)),
        ],
        Inertia(
            0.735522,
            (0.010517, -0.004252, 0.061597),
            (0.012516, -0.000428, -0.001196, 0.010027, -0.000741, 0.004815),
        ),
    ),
    Link("panda_link8"),
    Link(
        "panda_hand",
        [
            cylinder((0.0, 0.0, -0.012), (0.0, 0.0, 0.01), 0.03),
            box((-0.015, 0.015), (-0.09, -0.03), (-0.022, 0.0)),
            box((-0.029, 0.029), (-0.102, 0.096), (0.0, 0.03)),
            box((-0.021, 0.021), (-0.1, 0.099), (0.03, 0.064)),
        ],
        Inertia(0.73, (-0.01, 0.0, 0.03), (0.001, 0, 0, 0.0025, 0, 0.0017)),
    ),
    Link("panda_hand_tcp"),
    panda_finger("left", 1.0),
    panda_finger("right", -1.0),
]


def panda_joint(
    index: int, xyz_m: Vector, roll_rad: float, low_rad: float, high_rad: float
) -> Joint:
    """A joint of the arm, from 1 to 7: the first four and the last three have the same motors."""
    velocity_rad_s, effort_nm = (2.175, 87.0) if index <= 4 else (2.61, 12.0)
    return Joint(
        f"panda_joint{index}",
        f"panda_link{index - 1}",
        f"panda_link{index}",
        xyz_m,
        (roll_rad, 0.0, 0.0),
        (low_rad, high_rad),
        velocity_rad_s,
        effort_nm,
        damping=0.003,
    )


FINGER_Z_M = (0.0, 0.0, 0.0584)
PANDA_JOINTS = [
    panda_joint(1, (0.0, 0.0, 0.333), 0.0, -2.8973, 2.8973),
    panda_joint(2, ZERO, -TURN, -1.7628, 1.7628),
    panda_joint(3, (0.0, -0.316, 0.0), TURN, -2.8973, 2.8973),
    panda_joint(4, (0.0825, 0.0, 0.0), TURN, -3.0718, -0.0698),
    panda_joint(5, (-0.0825, 0.384, 0.0), -TURN, -2.8973, 2.8973),
    panda_joint(6, ZERO, TURN, -0.0175, 3.7525),
    panda_joint(7, (0.088, 0.0, 0.0), TURN, -2.8973, 2.8973),
    Joint("panda_joint8", "panda_link7", "panda_link8", (0.0, 0.0, 0.107)),
    Joint("panda_hand_joint", "panda_link8", "panda_hand", rpy_rad=(0.0, 0.0, -math.pi / 4)),
    Joint("panda_hand_tcp_joint", "panda_hand", "panda_hand_tcp", (0.0, 0.0, 0.1034)),
    Joint(
        "panda_finger_joint1",
        "panda_hand",
        "panda_leftfinger",
        FINGER_Z_M,
        range=(0.0, 0.04),
        velocity=0.2,
        effort=100.0,
        axis=(0.0, 1.0, 0.0),
        slides=True,
    ),
    Joint(
        "panda_finger_joint2",
        "panda_hand",
        "panda_rightfinger",
        FINGER_Z_M,
        range=(0.0, 0.04),
        velocity=0.2,
        effort=100.0,
        axis=(0.0, -1.0, 0.0),
        slides=True,
        mimic="panda_finger_joint1",
    ),
]
PANDA = """A Franka Panda with its hand, written by scripts/descriptions.py.
     Frames, ranges and masses are Franka's numbers, as its public description (franka_description,
     Apache-2.0) has them. The shapes are cylinders, balls and boxes of our own, in places two
     centimetres off."""

# -- SO-101 ---------------------------------------------------------------------------------------
MOTOR_Z_M = (-0.0015, 0.0375)
SO101_LINKS = [
    Link(
        "base_link",
        [
            box((-0.0224, 0.0646), (-0.0555, 0.0555), (-0.0024, 0.0067)),
            box((-0.0224, 0.0194), (-0.0224, 0.0224), (0.0067, 0.034)),
            box((-0.0272, 0.053), (-0.0224, 0.0224), (0.0357, 0.0575)),
            box((-0.0265, 0.02), (-0.022, 0.022), (0.0575, 0.069)),
            box((0.0036, 0.049), (-0.0124, 0.0124), (0.0243, 0.061)),
            box((-0.031, -0.0234), (-0.0255, 0.0252), (0.0264, 0.0684)),
        ],
        Inertia(
            0.147,
            (0.0137179, -5.19711e-5, 0.0334843),
            (0.000114686, -4.59787e-7, 4.97151e-6, 0.000136117, 9.75275e-8, 0.000130364),
        ),
    ),
    Link(
        "shoulder_link",
        [
            box((-0.0428, -0.018), (-0.0185, 0.0182), (-0.0644, -0.019)),
            box((-0.0506, -0.0135), (-0.0264, 0.0265), (-0.038, -0.01)),
            box((-0.0476, -0.0228), (-0.0197, 0.0197), (-0.01, 0.0462)),
            box((-0.0476, 0.0122), (-0.0197, 0.0197), (-0.0085, -0.0045)),
            box((-0.036, 0.0122), (-0.0197, 0.0197), (0.042, 0.0462)),
        ],
        Inertia(
            0.100006,
            (-0.0307604, -1.66727e-5, -0.0252713),
            (8.3759e-5, 7.55525e-8, -1.16342e-6, 8.10403e-5, 1.54663e-7, 2.39783e-5),
        ),
    ),
    Link(
        "upper_arm_link",
        [
            box((-0.125, -0.1002), (-0.0382, 0.0072), MOTOR_Z_M),
            box((-0.13, -0.06), (-0.012, 0.012), (-0.0085, 0.0448)),
            box((-0.06, 0.0), (-0.012, 0.012), (-0.0135, 0.0505)),
            cylinder((0.0, 0.0, -0.0135), (0.0, 0.0, 0.0505), 0.012),
        ],
        Inertia(
            0.103,
            (-0.0898471, -0.00838224, 0.0184089),
            (4.08002e-5, -1.97819e-5, -4.03016e-8, 0.000147318, 8.97326e-9, 0.000142487),
        ),
    ),
    Link(
        "lower_arm_link",
        [
            box((-0.1187, -0.04), (-0.012, 0.012), (-0.0078, 0.0442)),
            box((-0.04, 0.0), (-0.012, 0.012), (-0.012, 0.0484)),
            cylinder((0.0, 0.0, -0.012), (0.0, 0.0, 0.0484), 0.012),
            box((-0.1187, -0.0907), (-0.015, 0.0219), (-0.0082, 0.0442)),
            box((-0.1451, -0.0997), (-0.0072, 0.0176), MOTOR_Z_M),
        ],
        Inertia(
            0.104,
            (-0.0980701, 0.00324376, 0.0182831),
            (2.87438e-5, 7.41152e-6, 1.26409e-6, 0.000159844, -4.90188e-8, 0.00014529),
        ),
    ),
    Link(
        "wrist_link",
        [
            box((-0.0155, 0.0155), (-0.0626, -0.0269), (0.0, 0.0533)),
            box((-0.012, 0.012), (-0.028, 0.0), (-0.009, 0.0458)),
            cylinder((0.0, 0.0, -0.009), (0.0, 0.0, 0.0455), 0.012),
        ],
        Inertia(
            0.079,
            (-0.000103312, -0.0386143, 0.0281156),
            (3.68263e-5, 1.7893e-8, -5.28128e-8, 2.5391e-5, 3.6412e-6, 2.1e-5),
        ),
    ),
    Link(
        "gripper_link",
        [
            box((-0.015, 0.0304), (-0.0193, 0.0192), (-0.0358, -0.011)),
            box((-0.0352, 0.0143), (-0.024, 0.024), (-0.027, -0.001)),
            # The jaw that stands: straight inside, and thinner towards its tip.
            box((-0.0345, -0.0145), (-0.0145, 0.0145), (-0.045, -0.027)),
            box((-0.03, -0.0125), (-0.0095, 0.0095), (-0.066, -0.045)),
            box((-0.0225, -0.0112), (-0.0078, 0.0078), (-0.086, -0.066)),
            box((-0.0175, -0.0095), (-0.0055, 0.0055), (-0.1043, -0.086)),
        ],
        Inertia(
            0.087,
            (0.000213627, 0.000245138, -0.025187),
            (2.75087e-5, -3.35241e-7, -5.7352e-6, 4.33657e-5, -5.17847e-8, 3.45059e-5),
        ),
    ),
    Link("gripper_frame_link"),
    Link(
        "moving_jaw_so101_v1_link",
        [
            cylinder((0.0, 0.0, -0.005), (0.0, 0.0, 0.0428), 0.01),
            box((-0.0083, 0.008), (-0.03, 0.0), (0.0, 0.038)),
            box((-0.0083, 0.0055), (-0.052, -0.03), (0.0095, 0.0283)),
            box((-0.0088, 0.001), (-0.07, -0.052), (0.0115, 0.0263)),
            box((-0.0112, -0.004), (-0.082, -0.07), (0.0145, 0.0235)),
        ],
        Inertia(
            0.012,
            (-0.00157495, -0.0300244, 0.0192755),
            (6.61427e-6, -3.19807e-7, -5.90717e-9, 1.89032e-6, -1.09945e-7, 5.28738e-6),
        ),
    ),
]


def so101_joint(
    name: str,
    parent: str,
    child: str,
    xyz_m: Vector,
    rpy_rad: Vector,
    range_rad: tuple[float, float],
) -> Joint:
    """A joint of the arm: all have the same motor."""
    return Joint(name, parent, child, xyz_m, rpy_rad, range_rad, 10.0, 10.0)


SO101_JOINTS = [
    so101_joint(
        "shoulder_pan",
        "base_link",
        "shoulder_link",
        (0.0388353, 0.0, 0.0624),
        (3.14159, 0.0, -3.14159),
        (-1.91986, 1.91986),
    ),
    so101_joint(
        "shoulder_lift",
        "shoulder_link",
        "upper_arm_link",
        (-0.0303992, -0.0182778, -0.0542),
        (-1.5708, -1.5708, 0.0),
        (-1.74533, 1.74533),
    ),
    so101_joint(
        "elbow_flex",
        "upper_arm_link",
        "lower_arm_link",
        (-0.11257, -0.028, 0.0),
        (0.0, 0.0, 1.5708),
        (-1.69, 1.69),
    ),
    so101_joint(
        "wrist_flex",
        "lower_arm_link",
        "wrist_link",
        (-0.1349, 0.0052, 0.0),
        (0.0, 0.0, -1.5708),
        (-1.65806, 1.65806),
    ),
    so101_joint(
        "wrist_roll",
        "wrist_link",
        "gripper_link",
        (0.0, -0.0611, 0.0181),
        (1.5708, 0.0486795, 3.14159),
        (-2.74385, 2.84121),
    ),
    Joint(
        "gripper_frame_joint",
        "gripper_link",
        "gripper_frame_link",
        (-0.0079, -0.000218121, -0.0981274),
        (0.0, 3.14159, 0.0),
    ),
    so101_joint(
        "gripper",
        "gripper_link",
        "moving_jaw_so101_v1_link",
        (0.0202, 0.0188, -0.0234),
        (1.5708, 0.0, 0.0),
        (-0.174533, 1.74533),
    ),
]
SO101 = """An SO-101, written by scripts/descriptions.py.
     Frames, ranges and masses are The Robot Studio's numbers, as its public description (SO-ARM100,
     Apache-2.0) has them. The shapes are boxes and cylinders of our own, in places two centimetres
     off."""

DESCRIPTIONS = {
    "panda.urdf": urdf("panda", PANDA, PANDA_LINKS, PANDA_JOINTS),
    "so101.urdf": urdf("so101", SO101, SO101_LINKS, SO101_JOINTS),
}


def main() -> None:
    """Write the files."""
    for name, text in DESCRIPTIONS.items():
        (FOLDER / name).write_text(text)


if __name__ == "__main__":
    main()
