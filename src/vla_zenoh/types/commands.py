"""Commands to an arm and a gripper, and the set-points a controller holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vla_zenoh.errors import RecordError
from vla_zenoh.types.arrays import FloatArray, unit_quaternion, vector
from vla_zenoh.types.checks import (
    integer,
    joint_names,
    number,
    set_field,
    shown,
    text,
)

LATENCY_STAGES = (
    "capture_to_worker",
    "inference",
    "worker_to_command",
    "command_to_pose",
    "end_to_end",
)
"""Stages between the capture of an image and the first command of its chunk."""


@dataclass(frozen=True, slots=True)
class Cause:
    """Which chunk a command executes, and when that chunk passed each stage (wall clock)."""

    worker: str
    chunk_seq: int
    observation_stamp_ns: int
    observed_ns: int
    inference_start_ns: int
    inference_end_ns: int
    published_ns: int
    received_ns: int

    def __post_init__(self) -> None:
        text("worker", self.worker, 128)
        for name in self.__dataclass_fields__:
            if name != "worker":
                set_field(self, name, integer(name, getattr(self, name)))

    def latency_ms(self, command_ns: int) -> dict[str, float]:
        """Duration of each of `LATENCY_STAGES` for a command stamped `command_ns` (wall clock)."""
        stages_ns = (
            self.observed_ns - self.observation_stamp_ns,
            self.inference_end_ns - self.inference_start_ns,
            self.received_ns - self.inference_end_ns,
            command_ns - self.received_ns,
            command_ns - self.observation_stamp_ns,
        )
        return {name: ns / 1e6 for name, ns in zip(LATENCY_STAGES, stages_ns, strict=True)}


@dataclass(frozen=True, slots=True, eq=False)
class PoseCommand:
    """Where the TCP has to be now, in the base frame, with feed-forward.

    Args:
        position_m: (3,).
        quat_xyzw: (4,) unit.
        twist: (6,) m/s and rad/s.
        acceleration: (6,) m/s^2 and rad/s^2.
        goal_position_m: (3,) where the smoothed motion is heading.
        goal_quat_xyzw: (4,) unit.
        state: the command node's state.
        cause: the chunk being executed, None: none is.
    """

    position_m: FloatArray
    quat_xyzw: FloatArray
    twist: FloatArray
    acceleration: FloatArray
    goal_position_m: FloatArray
    goal_quat_xyzw: FloatArray
    state: str
    cause: Cause | None = None

    def __post_init__(self) -> None:
        for name, size in (("position_m", 3), ("goal_position_m", 3)):
            set_field(self, name, vector(name, getattr(self, name), size))
        for name in ("quat_xyzw", "goal_quat_xyzw"):
            set_field(self, name, unit_quaternion(name, getattr(self, name)))
        for name in ("twist", "acceleration"):
            set_field(self, name, vector(name, getattr(self, name), 6))
        text("state", self.state, 32)
        _check_cause(self.cause)


@dataclass(frozen=True, slots=True, eq=False)
class JointCommand:
    """Where the joints have to be now, with feed-forward; all arrays have one entry per name.

    In rad, of a joint that slides in m.

    Args:
        names: of the arm's joints, in any order.
        position_rad: (n,).
        velocity_rad_s: (n,).
        acceleration_rad_s2: (n,).
        state: the command node's state.
        cause: the chunk being executed, None: none is.
    """

    names: tuple[str, ...]
    position_rad: FloatArray
    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray
    state: str
    cause: Cause | None = None

    def __post_init__(self) -> None:
        names = joint_names(self.names)
        set_field(self, "names", names)
        for name in ("position_rad", "velocity_rad_s", "acceleration_rad_s2"):
            set_field(self, name, vector(name, getattr(self, name), len(names)))
        text("state", self.state, 32)
        _check_cause(self.cause)


def _check_cause(cause: Any) -> None:
    if cause is not None and not isinstance(cause, Cause):
        raise RecordError(f"cause is not a Cause: {shown(cause)}")


@dataclass(frozen=True, slots=True)
class GripperCommand:
    """An absolute opening to go to; a newer one replaces it."""

    width_m: float
    speed_m_s: float
    force_n: float

    def __post_init__(self) -> None:
        set_field(self, "width_m", number("width_m", self.width_m, 0.0, 1.0))
        set_field(self, "speed_m_s", number("speed_m_s", self.speed_m_s, 1e-4, 10.0))
        set_field(self, "force_n", number("force_n", self.force_n, 0.0, 1000.0))


class PoseReference(NamedTuple):
    """Where the TCP has to be now, in the base frame, and how it moves there.

    Args:
        position_m: (3,).
        rotation: (3, 3), columns are the TCP's axes.
        twist: (6,) m/s and rad/s.
        acceleration: (6,) m/s^2 and rad/s^2.
    """

    position_m: FloatArray
    rotation: FloatArray
    twist: FloatArray
    acceleration: FloatArray


class JointReference(NamedTuple):
    """Where the joints have to be now, in the order along the arm.

    Args:
        position_rad: (n,).
        velocity_rad_s: (n,).
        acceleration_rad_s2: (n,).
    """

    position_rad: FloatArray
    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray

    @classmethod
    def at_rest(cls, position_rad: FloatArray) -> JointReference:
        """Standing at `position_rad`, of which it keeps a copy."""
        zeros = np.zeros(len(position_rad))
        return cls(np.array(position_rad, float), zeros, zeros)
