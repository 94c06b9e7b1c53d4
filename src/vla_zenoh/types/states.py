"""What is measured or known: robot state, camera images, and the simulated scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_zenoh.errors import RecordError
from vla_zenoh.types.arrays import FloatArray, numbers, unit_quaternion, vector
from vla_zenoh.types.checks import (
    boolean,
    entries,
    integer,
    joint_names,
    keep,
    keep_given,
    number,
    set_field,
    text,
    texts,
)

MIN_DEPTH_UNIT_M, MAX_DEPTH_UNIT_M = 1e-5, 0.1
"""Metres of one count of a depth image: from 0.65 m to 6.5 km in all."""
MAX_COUNT = 2**16 - 1


@dataclass(frozen=True, slots=True, eq=False)
class JointState:
    """Arm joints, without the fingers: all arrays have one entry per name.

    In rad and Nm, of a joint that slides in m and N.

    Args:
        position_rad, velocity_rad_s: (n,) measured.
        effort_nm: (n,) motor effort: of the simulator and of ROS 2's joint states the total,
            including the arm's own weight. A robot class may report the external torque instead,
            and its profile then bounds it (``limits.contact.effort_stop_nm``). None if the robot
            does not measure it.
        reference_rad: (n,) positions the robot's controller holds right now, or None if it holds
            none or the robot does not report them.
    """

    names: tuple[str, ...]
    position_rad: FloatArray
    velocity_rad_s: FloatArray
    effort_nm: FloatArray | None
    reference_rad: FloatArray | None = None

    def __post_init__(self) -> None:
        keep(self, joint_names, "names")
        joints = len(self.names)
        keep(self, vector, "position_rad", "velocity_rad_s", size=joints)
        keep_given(self, vector, "effort_nm", "reference_rad", size=joints)


@dataclass(frozen=True, slots=True, eq=False)
class PoseState:
    """Measured TCP pose in the base frame.

    Args:
        position_m: (3,).
        quat_xyzw: (4,) unit.
        twist: (6,) m/s and rad/s, base axes.
        wrench: (6,) N and Nm that the surroundings exert on the arm, as if they did at the TCP,
            base axes; without the weight of arm and tool. None where the robot does not know it.
        reference_position_m, reference_quat_xyzw: pose the robot's controller holds right now, or
            neither.
    """

    position_m: FloatArray
    quat_xyzw: FloatArray
    twist: FloatArray
    wrench: FloatArray | None = None
    reference_position_m: FloatArray | None = None
    reference_quat_xyzw: FloatArray | None = None

    def __post_init__(self) -> None:
        keep(self, vector, "position_m", size=3)
        keep(self, unit_quaternion, "quat_xyzw")
        keep(self, vector, "twist", size=6)
        keep_given(self, vector, "wrench", size=6)
        if (self.reference_position_m is None) != (self.reference_quat_xyzw is None):
            raise RecordError("a reference pose needs both position and quaternion")
        keep_given(self, vector, "reference_position_m", size=3)
        keep_given(self, unit_quaternion, "reference_quat_xyzw")


@dataclass(frozen=True, slots=True)
class GripperState:
    """Gripper and robot condition.

    Args:
        width_m: opening between the fingers.
        mode: the robot's name for its mode, ``ready`` when it will move.
        faults: reported by the robot.
    """

    width_m: float
    moving: bool
    holding: bool
    mode: str = "ready"
    faults: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        keep(self, number, "width_m", minimum=-0.01, maximum=1.0)
        keep(self, boolean, "moving", "holding")
        keep(self, text, "mode", limit=128)
        keep(self, texts, "faults", limit=512)


@dataclass(frozen=True, slots=True, eq=False)
class PrivilegedState:
    """What only a simulation can know, for a benchmark's own expert: name -> (n,) numbers."""

    values: Mapping[str, FloatArray]

    def __post_init__(self) -> None:
        keep(self, entries, "values", of=vector)


@dataclass(frozen=True, slots=True, eq=False)
class SceneState:
    """All generalised positions of a simulation, enough for a renderer to draw it.

    Args:
        qpos: (nq,), the simulator's own, then positions and quaternions of mocap bodies.
        seed: of the last reset, which determines how a scene with a varied look appears; or None.
    """

    scene: str
    qpos: FloatArray
    seed: int | None = None

    def __post_init__(self) -> None:
        keep(self, text, "scene", limit=512)
        keep(self, vector, "qpos")
        keep_given(self, integer, "seed")


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPoses:
    """True poses of a simulation's objects in the base frame: (n, 3) and (n, 4)."""

    names: tuple[str, ...]
    position_m: FloatArray
    quat_xyzw: FloatArray

    def __post_init__(self) -> None:
        keep(self, texts, "names", limit=128)
        for name, size, check in (("position_m", 3, vector), ("quat_xyzw", 4, unit_quaternion)):
            rows, shape = numbers(name, getattr(self, name)), (len(self.names), size)
            if not self.names and rows.size == 0:  # an empty list does not say how wide it is
                rows = rows.reshape(shape)
            if rows.shape != shape:
                raise RecordError(f"{name} has shape {rows.shape}, wanted {shape}")
            checked = np.array([check(name, row) for row in rows], np.float64)
            set_field(self, name, _locked(checked.reshape(shape)))


@dataclass(frozen=True, slots=True, eq=False)
class Image:
    """An image: RGB, uint8, ``(height, width, 3)``, row by row from the top left."""

    rgb: NDArray[np.uint8]

    def __post_init__(self) -> None:
        rgb = self.rgb
        if not isinstance(rgb, np.ndarray) or rgb.dtype != np.uint8:
            raise RecordError("an image must be a uint8 array (H, W, 3) in RGB order")
        if rgb.ndim != 3 or rgb.shape[2] != 3 or 0 in rgb.shape:
            raise RecordError(f"an image has shape {rgb.shape}, wanted (H, W, 3)")
        set_field(self, "rgb", _locked(rgb))


def _locked(array: NDArray[Any]) -> NDArray[Any]:
    """A read-only view, row by row; the maker's own array stays as writable as it was."""
    view = np.ascontiguousarray(array).view()
    view.setflags(write=False)
    return view


@dataclass(frozen=True, slots=True, eq=False)
class Depth:
    """A depth image: distance of what each pixel shows, along the camera's optical axis, in counts
    of `unit_m`, (height, width) uint16, row by row from the top left; 0: not measured."""

    counts: NDArray[np.uint16]
    unit_m: float

    def __post_init__(self) -> None:
        counts = self.counts
        if not isinstance(counts, np.ndarray) or counts.dtype != np.uint16 or counts.ndim != 2:
            raise RecordError("a depth image must be a uint16 array (H, W)")
        if 0 in counts.shape:
            raise RecordError(f"a depth image has shape {counts.shape}, wanted (H, W)")
        set_field(self, "counts", _locked(counts))
        keep(self, number, "unit_m", minimum=MIN_DEPTH_UNIT_M, maximum=MAX_DEPTH_UNIT_M)

    @staticmethod
    def of_metres(depth_m: ArrayLike, unit_m: float) -> Depth:
        """The image of distances in m, (H, W); what no count can represent is not measured."""
        with np.errstate(invalid="ignore"):
            counts = np.rint(np.asarray(depth_m, np.float64) / unit_m)
            counts = np.where((counts >= 1) & (counts <= MAX_COUNT), counts, 0)
        return Depth(counts.astype(np.uint16), unit_m)

    def metres(self) -> NDArray[np.float32]:
        """(H, W) distance in m; 0: not measured."""
        return (self.counts * self.unit_m).astype(np.float32)
