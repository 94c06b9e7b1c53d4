"""Contents of ROS 2 messages, before joints and cameras are told apart.

Numbers are as they came: finiteness and meaning are checked where a record is made of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.types import FloatArray

SECOND_NS = 1_000_000_000


class Joints(NamedTuple):
    """A sensor_msgs/JointState of any n joints, in rad or m.

    `stamp_ns` is 0 where the robot did not stamp it; velocity and effort (n,) are None where it
    does not report them.
    """

    stamp_ns: int
    names: tuple[str, ...]
    position: FloatArray
    velocity: FloatArray | None
    effort: FloatArray | None


class RosImage(NamedTuple):
    """Image of a camera, with stamp and frame of its header; `rgb` may be a read-only view."""

    stamp_ns: int
    frame: str
    rgb: NDArray[np.uint8]


class Wrench(NamedTuple):
    """A geometry_msgs/WrenchStamped: (6,) N and Nm in the axes of `frame`."""

    stamp_ns: int
    frame: str
    wrench: FloatArray


class Stamp(NamedTuple):
    """Stamp and frame for the header of a message."""

    stamp_ns: int
    frame: str
