"""What a robot measures and what moves it: states, images, action chunks, commands, set-points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike, NDArray

from vla_zenoh.errors import RecordError
from vla_zenoh.types.arrays import (
    FloatArray,
    PerJoint,
    Positions,
    Quaternion,
    Quaternions,
    Steps,
    Vector,
    Vector3,
    Vector6,
    Vectors,
    check_per_joint,
)
from vla_zenoh.types.form import (
    MAX_ENTRIES,
    MAX_TEXT,
    Count,
    Details,
    Name,
    Names,
    Record,
    Text,
    shown,
)
from vla_zenoh.types.stream import MAX_DEPTH_UNIT_M, MIN_DEPTH_UNIT_M

_LongText = Annotated[str, Meta(max_length=512)]
_State = Annotated[str, Meta(max_length=32)]

"""Metres of one count of a depth image: from 0.65 m to 6.5 km in all."""
MAX_COUNT = 2**16 - 1
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
class JointState(Record):
    """Arm joints, without the fingers: all arrays have one entry per name, in rad and Nm.

    Args:
        position_rad, velocity_rad_s: (n,) measured.
        effort_nm: (n,) motor effort: of the simulator and of ROS 2's joint states the total,
            including the arm's own weight. A robot class may report the external torque instead,
            and its profile then bounds it (``limits.contact.effort_stop_nm``). None if the robot
            does not measure it.
        reference_rad: (n,) positions the robot's controller holds right now, or None if it holds
            none or the robot does not report them.
        endless: those of `names` that turn without an end. Their positions are counted over turns,
            from within (-pi, pi] at the start of the robot's node.
        sliding: those of `names` that slide, whose numbers are in m and N.
    """

    names: Names
    position_rad: PerJoint
    velocity_rad_s: PerJoint
    effort_nm: PerJoint | None
    reference_rad: PerJoint | None = None
    endless: Names = ()
    sliding: Names = ()

    def _check(self) -> None:
        check_per_joint(self)
        for kind in ("endless", "sliding"):
            if unknown := set(getattr(self, kind)) - set(self.names):
                raise RecordError(f"{kind} has {', '.join(unknown)}, allowed: some of names")

    @property
    def slides(self) -> NDArray[np.bool_]:
        """(n,) which joints slide."""
        return np.isin(self.names, self.sliding)


@dataclass(frozen=True, slots=True, eq=False)
class PoseState(Record):
    """Measured TCP pose in the base frame.

    Args:
        position_m: (3,).
        quat_xyzw: (4,) unit; of its two signs that nearer to the home orientation.
        twist: (6,) m/s and rad/s, base axes.
        wrench: (6,) N and Nm that the surroundings exert on the arm, as if they did at the TCP,
            base axes; without the weight of arm and tool. None where the robot does not know it.
        reference_position_m, reference_quat_xyzw: pose the robot's controller holds right now, or
            neither.
    """

    position_m: Vector3
    quat_xyzw: Quaternion
    twist: Vector6
    wrench: Vector6 | None = None
    reference_position_m: Vector3 | None = None
    reference_quat_xyzw: Quaternion | None = None

    def _check(self) -> None:
        if (self.reference_position_m is None) != (self.reference_quat_xyzw is None):
            raise RecordError("a reference pose needs both position and quaternion")


@dataclass(frozen=True, slots=True)
class GripperState(Record):
    """Gripper and robot condition.

    Args:
        width_m: opening between the fingers; None: the robot has no gripper.
        mode: the robot's name for its mode, ``ready`` when it will move.
        faults: reported by the robot.
    """

    width_m: Annotated[float, Meta(ge=-0.01, le=1.0)] | None
    moving: bool
    holding: bool
    mode: Name = "ready"
    faults: Annotated[tuple[_LongText, ...], Meta(max_length=MAX_ENTRIES)] = ()

    @property
    def opening_m(self) -> float:
        """The width, as a number: NaN without a gripper."""
        return math.nan if self.width_m is None else self.width_m

    @property
    def kept_width_m(self) -> float:
        """The width (m) to command so that nothing changes: shut, where an object is held.

        NaN without a gripper.
        """
        return 0.0 if self.holding else max(self.opening_m, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class PrivilegedState(Record):
    """What only a simulation can know, for a benchmark's own expert: name -> (n,) numbers."""

    values: Vectors


@dataclass(frozen=True, slots=True, eq=False)
class SceneState(Record):
    """All generalised positions of a simulation, enough for a renderer to draw it.

    Args:
        qpos: (nq,), the simulator's own, then positions and quaternions of mocap bodies.
        seed: of the last reset, which determines how a scene with a varied look appears; or None.
    """

    scene: _LongText
    qpos: Vector
    seed: Count | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPoses(Record):
    """True poses of a simulation's objects in the base frame: (n, 3) and (n, 4)."""

    names: Names
    position_m: Positions
    quat_xyzw: Quaternions

    def _check(self) -> None:
        for name in ("position_m", "quat_xyzw"):
            if len(getattr(self, name)) != len(self.names):
                raise RecordError(
                    f"{name} has {len(getattr(self, name))} rows, allowed: one for each of the "
                    f"{len(self.names)} names"
                )


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
        object.__setattr__(self, "rgb", _locked(rgb))


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
        object.__setattr__(self, "counts", _locked(counts))
        if not MIN_DEPTH_UNIT_M <= self.unit_m <= MAX_DEPTH_UNIT_M:
            raise RecordError(
                f"unit_m is {shown(self.unit_m)}, allowed: {MIN_DEPTH_UNIT_M:g} to "
                f"{MAX_DEPTH_UNIT_M:g} m a count"
            )

    @staticmethod
    def of_metres(depth_m: ArrayLike, unit_m: float) -> Depth:
        """The image of distances in m, (H, W); what no count can represent is not measured."""
        with np.errstate(invalid="ignore"):
            counts = np.rint(np.asarray(depth_m, np.float64) / unit_m)
            counts = np.where((counts >= 1) & (counts <= MAX_COUNT), counts, 0)
        return Depth(counts.astype(np.uint16), unit_m)


@dataclass(frozen=True, slots=True, eq=False)
class ActionChunk(Record):
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

    worker: Name
    spec_hash: Name
    episode: Count
    observation_stamp_ns: Count
    observation_seq: Count
    valid_until_ns: Count
    steps: Steps
    observed_ns: Count
    inference_start_ns: Count
    inference_end_ns: Count
    done: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class InferenceDebug(Record):
    """One inference, for debugging; fields of its `ActionChunk` are as there.

    Its images travel beside it, one key per camera, with the same stamp and number.

    Args:
        chunk_seq: number of the chunk.
        raw: output before the steps: tokens, normalised action, whatever the model reports.
    """

    worker: Name
    chunk_seq: Count
    spec_hash: Name
    episode: Count
    observation_stamp_ns: Count
    prompt: Text
    steps: Steps
    inference_ms: Annotated[float, Meta(ge=0.0, le=1e9)]
    raw: Details = field(default_factory=dict)
    done: bool = False


def plain_values(given: Any) -> dict[str, Any]:
    """What a model or a robot's class tells of itself as plain text, numbers and lists, of arrays
    of any library too; what is too large or has no such form is described."""
    if given is None:
        return {}
    named = given if isinstance(given, Mapping) else {"value": given}
    return {str(name)[:256]: _plain(value, 2) for name, value in list(named.items())[:64]}


def _plain(value: Any, depth: int) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or (isinstance(value, int) and value.bit_length() < 64):
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
class Cause(Record):
    """Which chunk a command executes, and when that chunk passed each stage (wall clock)."""

    worker: Name
    chunk_seq: Count
    observation_stamp_ns: Count
    observed_ns: Count
    inference_start_ns: Count
    inference_end_ns: Count
    published_ns: Count
    received_ns: Count

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
class PoseCommand(Record):
    """Where the TCP has to be now, in the base frame, with feed-forward.

    Args:
        position_m, quat_xyzw: (3,), (4,) unit. A robot class gets that of the quaternion's two
            signs which is nearer to the home orientation; on the wire it may be either.
        twist, acceleration: (6,) m/s and rad/s, m/s^2 and rad/s^2.
        goal_position_m, goal_quat_xyzw: where the smoothed motion is heading.
        state: the command node's state.
        cause: the chunk being executed, None: none is.
    """

    position_m: Vector3
    quat_xyzw: Quaternion
    twist: Vector6
    acceleration: Vector6
    goal_position_m: Vector3
    goal_quat_xyzw: Quaternion
    state: _State
    cause: Cause | None = None


@dataclass(frozen=True, slots=True, eq=False)
class JointCommand(Record):
    """Where the joints have to be now, with feed-forward; all arrays have one entry per name.

    In rad, of a joint that slides in m.

    Args:
        names: of the arm's joints, in any order.
        position_rad, velocity_rad_s, acceleration_rad_s2: (n,).
        state: the command node's state.
        cause: the chunk being executed, None: none is.
    """

    names: Names
    position_rad: PerJoint
    velocity_rad_s: PerJoint
    acceleration_rad_s2: PerJoint
    state: _State
    cause: Cause | None = None

    def _check(self) -> None:
        check_per_joint(self)


@dataclass(frozen=True, slots=True)
class GripperCommand(Record):
    """An absolute opening to go to; a newer one replaces it."""

    width_m: Annotated[float, Meta(ge=0.0, le=1.0)]
    speed_m_s: Annotated[float, Meta(ge=1e-4, le=10.0)]
    force_n: Annotated[float, Meta(ge=0.0, le=1000.0)]


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


class Joints(NamedTuple):
    """Any n joints as a robot reports them, in rad or m, before arm and fingers are told apart.

    Numbers are as they came: finiteness and meaning are checked where a record is made of them.
    `stamp_ns` is 0 where the robot did not stamp it; velocity and effort (n,) are None where it
    does not report them.
    """

    stamp_ns: int
    names: tuple[str, ...]
    position: FloatArray
    velocity: FloatArray | None
    effort: FloatArray | None
