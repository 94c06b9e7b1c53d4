"""What moves a robot: action chunks of a model worker, commands of the command node, set-points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import RecordError
from vla_zenoh.types.arrays import FloatArray, float32_table, unit_quaternion, vector
from vla_zenoh.types.checks import (
    MAX_ENTRIES,
    MAX_TEXT,
    boolean,
    details,
    entries,
    integer,
    joint_names,
    keep,
    keep_given,
    number,
    shown,
    text,
)

MAX_RAW_NUMBERS = 4096
LATENCY_STAGES = (
    "capture_to_worker",
    "inference",
    "worker_to_command",
    "command_to_pose",
    "end_to_end",
)
"""Stages between the capture of an image and the first command of its chunk."""


@dataclass(frozen=True, slots=True, eq=False)
class ActionChunk:
    """What a model asks for: `H` steps of `D` numbers whose meaning its spec declares.

    Args:
        spec_hash: of the spec its steps are to be read with.
        episode: the episode (see `Task`) the policy was reset for.
        observation_stamp_ns: capture time of the observation, wall clock, as all times here.
        valid_until_ns: after this time the chunk must not be started.
        steps: (H, D) float32.
        observed_ns: when the worker took the observation.
        done: the policy reports that its task is finished when these steps are.
    """

    worker: str
    spec_hash: str
    episode: int
    observation_stamp_ns: int
    observation_seq: int
    valid_until_ns: int
    steps: NDArray[np.float32]
    observed_ns: int
    inference_start_ns: int
    inference_end_ns: int
    done: bool = False

    def __post_init__(self) -> None:
        keep(self, text, "worker", "spec_hash", limit=128)
        keep(self, integer, "episode", "observation_stamp_ns", "observation_seq", "valid_until_ns")
        keep(self, integer, "observed_ns", "inference_start_ns", "inference_end_ns")
        keep(self, boolean, "done")
        keep(self, float32_table, "steps")


@dataclass(frozen=True, slots=True, eq=False)
class InferenceDebug:
    """One inference, for debugging; fields of its `ActionChunk` are as there.

    Its images travel beside it, one key per camera, with the same stamp and number.

    Args:
        chunk_seq: number of the chunk.
        raw: output before the steps: tokens, normalised action, whatever the model reports.
    """

    worker: str
    chunk_seq: int
    spec_hash: str
    episode: int
    observation_stamp_ns: int
    prompt: str
    steps: NDArray[np.float32]
    inference_ms: float
    raw: Mapping[str, Any] = field(default_factory=dict)
    done: bool = False

    def __post_init__(self) -> None:
        keep(self, text, "worker", "spec_hash", limit=128)
        keep(self, text, "prompt")
        keep(self, integer, "chunk_seq", "episode", "observation_stamp_ns")
        keep(self, number, "inference_ms", minimum=0.0)
        keep(self, float32_table, "steps")
        keep(self, entries, "raw", of=details)


def plain_values(raw: Mapping[str, Any] | None) -> dict[str, Any]:
    """Raw output of a model as plain text, numbers and lists, of arrays of any library too; what is
    too large or has no such form is described."""
    return {str(name)[:256]: _plain(value, 2) for name, value in list((raw or {}).items())[:64]}


def _plain(value: Any, depth: int) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, str):
        return value[:MAX_TEXT].encode("utf-8", "replace").decode()
    if isinstance(value, Mapping) and depth:
        return {str(key)[:256]: _plain(item, depth - 1) for key, item in list(value.items())[:64]}
    try:
        array = np.asarray(value)
    except Exception:  # tensors of other devices raise anything
        return shown(value)
    if array.dtype.kind not in "biuf" or array.ndim > 2:
        return shown(value)
    if array.size > MAX_RAW_NUMBERS or max(array.shape, default=0) > MAX_ENTRIES:
        return f"{array.dtype} of shape {array.shape}"
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        return shown(array.tolist())
    return array.tolist()


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
        worker, *numbers = self.__match_args__
        keep(self, text, worker, limit=128)
        keep(self, integer, *numbers)

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
        position_m, quat_xyzw: (3,), (4,) unit.
        twist, acceleration: (6,) m/s and rad/s, m/s^2 and rad/s^2.
        goal_position_m, goal_quat_xyzw: where the smoothed motion is heading.
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
        keep(self, vector, "position_m", "goal_position_m", size=3)
        keep(self, unit_quaternion, "quat_xyzw", "goal_quat_xyzw")
        keep(self, vector, "twist", "acceleration", size=6)
        keep(self, text, "state", limit=32)
        keep_given(self, _cause, "cause")


@dataclass(frozen=True, slots=True, eq=False)
class JointCommand:
    """Where the joints have to be now, with feed-forward; all arrays have one entry per name.

    In rad, of a joint that slides in m.

    Args:
        names: of the arm's joints, in any order.
        position_rad, velocity_rad_s, acceleration_rad_s2: (n,).
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
        keep(self, joint_names, "names")
        fields = ("position_rad", "velocity_rad_s", "acceleration_rad_s2")
        keep(self, vector, *fields, size=len(self.names))
        keep(self, text, "state", limit=32)
        keep_given(self, _cause, "cause")


def _cause(name: str, value: Any) -> Cause:
    if not isinstance(value, Cause):
        raise RecordError(f"{name} is not a Cause: {shown(value)}")
    return value


@dataclass(frozen=True, slots=True)
class GripperCommand:
    """An absolute opening to go to; a newer one replaces it."""

    width_m: float
    speed_m_s: float
    force_n: float

    def __post_init__(self) -> None:
        keep(self, number, "width_m", minimum=0.0, maximum=1.0)
        keep(self, number, "speed_m_s", minimum=1e-4, maximum=10.0)
        keep(self, number, "force_n", minimum=0.0, maximum=1000.0)


class PoseReference(NamedTuple):
    """Where the TCP has to be now, in the base frame, and how it moves there.

    Args:
        position_m: (3,).
        rotation: (3, 3), columns are the TCP's axes.
        twist, acceleration: (6,) m/s and rad/s, m/s^2 and rad/s^2.
    """

    position_m: FloatArray
    rotation: FloatArray
    twist: FloatArray
    acceleration: FloatArray


class JointReference(NamedTuple):
    """Where the joints have to be now, in the order along the arm: (n,) each."""

    position_rad: FloatArray
    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray

    @classmethod
    def at_rest(cls, position_rad: FloatArray) -> JointReference:
        """Standing at `position_rad`, of which it keeps a copy."""
        zeros = np.zeros(len(position_rad))
        return cls(np.array(position_rad, float), zeros, zeros)
