"""Joint ranges and limits that Franka publishes for its arms.

Source: "Robot and interface specifications" of the Franka Control Interface documentation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

JOINTS = 7


@dataclass(frozen=True)
class Published:
    """Limits of one kind of arm, joint 1 to 7.

    Args:
        fci: version of the interface that the robot speaks.
        velocity_rad_s: of the joints; the FR3's are smaller near the ends of the ranges.
        translation: of the end effector: m/s, m/s^2, m/s^3.
        rotation: of the end effector: rad/s, rad/s^2, rad/s^3.
        near_end: offset (rad/s) and deceleration (rad/s^2) of each joint: a joint this far from an
            end of its range (rad) may move at ``sqrt(2 * deceleration * far) - offset``, no more;
            empty: everywhere at `velocity_rad_s`.
    """

    fci: int
    lower_rad: tuple[float, ...]
    upper_rad: tuple[float, ...]
    velocity_rad_s: tuple[float, ...]
    acceleration_rad_s2: tuple[float, ...]
    jerk_rad_s3: tuple[float, ...]
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float]
    torque_nm: tuple[float, ...] = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
    near_end: tuple[tuple[float, float], ...] = ()


PANDA = Published(
    fci=5,
    lower_rad=(-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
    upper_rad=(2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
    velocity_rad_s=(2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
    acceleration_rad_s2=(15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
    jerk_rad_s3=(7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0),
    translation=(1.7, 13.0, 6500.0),
    rotation=(2.5, 25.0, 12500.0),
)
FR3 = Published(
    fci=10,
    lower_rad=(-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159),
    upper_rad=(2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159),
    velocity_rad_s=(2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26),
    acceleration_rad_s2=(10.0,) * JOINTS,
    jerk_rad_s3=(5000.0,) * JOINTS,
    translation=(3.0, 9.0, 4500.0),
    rotation=(2.5, 17.0, 8500.0),
    near_end=(
        (0.30, 6.0),
        (0.20, 2.585),
        (0.20, 3.5),
        (0.30, 4.0),
        (0.35, 17.0),
        (0.35, 5.5),
        (0.35, 17.0),
    ),
)
BY_FCI: Mapping[int, Published] = {limits.fci: limits for limits in (PANDA, FR3)}
