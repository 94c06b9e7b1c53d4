"""Records that travel on keys: frozen, checked, units in their names.

A record that exists is valid: arrays have their shape, are finite, contiguous and read-only,
quaternions are unit. Who makes one from bad values gets a `RecordError` that names the field.
The stamp is not part of a record: it travels beside it as a `Header`.

Frames: poses are those of the tool centre point (TCP) in the robot's base frame. A twist is
``[linear m/s, angular rad/s]``, a wrench ``[force N, torque Nm]``, both with respect to the base
frame's axes and the TCP's origin. Quaternions are stored ``x, y, z, w``.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_zenoh.errors import RecordError

FloatArray = NDArray[np.float64]

QUATERNION_NORM_TOLERANCE = 1e-3
MAX_TEXT = 4096
MAX_SHOWN = 300
MAX_VECTOR = 10_000
MAX_CHUNK_NUMBERS = 100_000
MAX_NAMES = 1024
MAX_ENTRIES = 1024
MAX_DETAIL_TEXT = 65_536
MAX_DETAIL_DEPTH = 4
EVENT_LEVELS = ("info", "warning", "error")
EVENT_KINDS = ("refusal", "transition", "limit", "fault", "notice")
_NUMBER_KINDS = "iuf"


def shown(value: Any) -> str:
    """`value` in short, for an error message: it may be huge, nested, or refuse to be printed."""
    if isinstance(value, (str, bytes)):
        value = value[:80]
    return reprlib.repr(value)[:MAX_SHOWN]


def _numbers(name: str, value: ArrayLike) -> NDArray[Any]:
    """`value` as an array that numpy did not have to read out of text, truth values or objects."""
    if isinstance(value, np.ndarray) and value.dtype.kind in _NUMBER_KINDS:
        return value
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise RecordError(f"{name} is not a list of numbers: {error}") from error
    if array.dtype.kind not in _NUMBER_KINDS or _holds_bool(value):
        raise RecordError(f"{name} is not a list of numbers: {shown(value)}")
    return array


def _holds_bool(value: Any) -> bool:
    """Whether a list that became an array of numbers had a truth value among them."""
    if isinstance(value, (list, tuple)):
        return any(_holds_bool(item) for item in value)
    return isinstance(value, (bool, np.bool_))


def vector(name: str, value: ArrayLike, size: int | None) -> FloatArray:
    """Copy `value` into a finite, read-only float64 vector of `size` (None: any size)."""
    array = _numbers(name, value)
    if array.ndim != 1 or (size is not None and array.shape[0] != size):
        wanted = "(n,)" if size is None else f"({size},)"
        raise RecordError(f"{name} has shape {array.shape}, wanted {wanted}")
    if len(array) > MAX_VECTOR:
        raise RecordError(f"{name} has {len(array)} numbers, at most {MAX_VECTOR} are allowed")
    array = np.array(array, dtype=np.float64, order="C")
    # Records are made at every tick: on a few numbers this is five times as fast as numpy.
    if not all(map(math.isfinite, array.tolist())):
        raise RecordError(f"{name} is not finite: {shown(array.tolist())}")
    array.setflags(write=False)
    return array


def unit_quaternion(name: str, value: ArrayLike) -> FloatArray:
    """Like `vector` for four numbers x, y, z, w; normalised, refused when far from unit."""
    array = vector(name, value, 4)
    norm = math.hypot(*array.tolist())
    if abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE:
        raise RecordError(f"{name} has norm {norm:.6g}, wanted a unit quaternion x, y, z, w")
    array = array / norm
    array.setflags(write=False)
    return array


def number(name: str, value: Any, minimum: float = -math.inf, maximum: float = math.inf) -> float:
    """A finite float within ``[minimum, maximum]``."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise RecordError(f"{name} is not a number: {shown(value)}")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result) or not minimum <= result <= maximum:
        raise RecordError(
            f"{name} is {shown(value)}, wanted a number in [{minimum:g}, {maximum:g}]"
        )
    return result


def integer(name: str, value: Any, minimum: int = 0, maximum: int = 2**63 - 1) -> int:
    """An int within ``[minimum, maximum]``."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise RecordError(f"{name} is not a whole number: {shown(value)}")
    if not minimum <= value <= maximum:
        raise RecordError(
            f"{name} is {shown(value)}, wanted a whole number in [{minimum}, {maximum}]"
        )
    return int(value)


def text(name: str, value: Any, limit: int = MAX_TEXT) -> str:
    """A str of at most `limit` characters, all of which UTF-8 can carry."""
    if not isinstance(value, str):
        raise RecordError(f"{name} is not text: {type(value).__name__}")
    if len(value) > limit:
        raise RecordError(f"{name} has {len(value)} characters, at most {limit} are allowed")
    if not value.isascii():
        try:
            value.encode("utf-8")
        except UnicodeEncodeError as error:
            raise RecordError(f"{name} holds half a character (a surrogate)") from error
    return value


def texts(name: str, value: Any, limit: int) -> tuple[str, ...]:
    """A tuple of texts, of a list or tuple; a single str is not a list of its letters."""
    if not isinstance(value, (list, tuple)):
        raise RecordError(f"{name} is not a list of texts: {shown(value)}")
    if len(value) > MAX_NAMES:
        raise RecordError(f"{name} has {len(value)} entries, at most {MAX_NAMES} are allowed")
    return tuple(text(name, item, limit) for item in value)


def joint_names(value: Any) -> tuple[str, ...]:
    """Names of joints: at least one, none of them twice."""
    names = texts("names", value, 128)
    if not names or len(set(names)) != len(names):
        raise RecordError(f"joint names must be present and differ: {shown(names)}")
    return names


def boolean(name: str, value: Any) -> bool:
    """A bool, and nothing that merely looks like one."""
    if not isinstance(value, (bool, np.bool_)):
        raise RecordError(f"{name} is not true or false: {shown(value)}")
    return bool(value)


def entries(name: str, value: Any) -> dict[str, Any]:
    """A copy of a map from short names to anything."""
    if not isinstance(value, Mapping):
        raise RecordError(f"{name} is not a map: {shown(value)}")
    if len(value) > MAX_ENTRIES:
        raise RecordError(f"{name} has {len(value)} entries, at most {MAX_ENTRIES} are allowed")
    return {text(f"a name in {name}", key, 256): item for key, item in value.items()}


def details(name: str, value: Any, depth: int = MAX_DETAIL_DEPTH) -> Any:
    """Text, finite numbers, bools and None, in lists and maps that are not nested deep."""
    if value is None or isinstance(value, (bool, np.bool_)):
        return value if value is None else bool(value)
    if isinstance(value, str):
        return text(name, value, MAX_DETAIL_TEXT)
    if isinstance(value, (int, np.integer)):
        return integer(name, value, -(2**63))
    if isinstance(value, (float, np.floating)):
        return number(name, value)
    if depth == 0:
        raise RecordError(f"{name} is nested too deep")
    if isinstance(value, Mapping):
        return {
            key: details(f"{name}.{key}", item, depth - 1)
            for key, item in entries(name, value).items()
        }
    if isinstance(value, (list, tuple)) and len(value) <= MAX_ENTRIES:
        return [details(name, item, depth - 1) for item in value]
    raise RecordError(f"{name} is not text, a number, a bool, a list or a map: {shown(value)}")


def _set(record: Any, name: str, value: Any) -> None:
    object.__setattr__(record, name, value)


@dataclass(frozen=True, slots=True)
class Header:
    """What stands beside every streamed record.

    Args:
        stamp_wall_ns: time of capture, nanoseconds since the Unix epoch on the writer's clock.
        seq: counts up by one for every record this source writes on this key.
        source: who wrote it: node name and a number that differs after every restart.
    """

    stamp_wall_ns: int
    seq: int
    source: str

    def __post_init__(self) -> None:
        _set(self, "stamp_wall_ns", integer("stamp_wall_ns", self.stamp_wall_ns))
        _set(self, "seq", integer("seq", self.seq))
        text("source", self.source, 128)


Record = TypeVar("Record")


@dataclass(frozen=True, slots=True)
class Stamped(Generic[Record]):
    """A record as it arrived.

    Args:
        header: what its writer said of it.
        record: the record.
        received_ns: when it arrived here, same clock as the caller's ``now_ns``.
    """

    header: Header
    record: Record
    received_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Image:
    """A picture: RGB, uint8, ``(height, width, 3)``, row by row from the top left."""

    rgb: NDArray[np.uint8]

    def __post_init__(self) -> None:
        rgb = self.rgb
        if not isinstance(rgb, np.ndarray) or rgb.dtype != np.uint8:
            raise RecordError("an image must be a uint8 array (H, W, 3) in RGB order")
        if rgb.ndim != 3 or rgb.shape[2] != 3 or 0 in rgb.shape:
            raise RecordError(f"an image has shape {rgb.shape}, wanted (H, W, 3)")
        rgb = np.ascontiguousarray(rgb).view()  # the maker's own array stays as writable as it was
        rgb.setflags(write=False)
        _set(self, "rgb", rgb)


@dataclass(frozen=True, slots=True, eq=False)
class JointState:
    """Arm joints, without the fingers: all arrays have one entry per name.

    Args:
        names: of the joints.
        position_rad: (n,) measured.
        velocity_rad_s: (n,) measured.
        effort_nm: (n,) what the motors apply.
        reference_rad: (n,) positions the robot's controller holds right now, or None where it
            holds none, or the robot does not tell.
    """

    names: tuple[str, ...]
    position_rad: FloatArray
    velocity_rad_s: FloatArray
    effort_nm: FloatArray
    reference_rad: FloatArray | None = None

    def __post_init__(self) -> None:
        names = joint_names(self.names)
        _set(self, "names", names)
        for name in ("position_rad", "velocity_rad_s", "effort_nm"):
            _set(self, name, vector(name, getattr(self, name), len(names)))
        if self.reference_rad is not None:
            _set(self, "reference_rad", vector("reference_rad", self.reference_rad, len(names)))


@dataclass(frozen=True, slots=True, eq=False)
class PoseState:
    """Measured TCP pose in the base frame.

    Args:
        position_m: (3,).
        quat_xyzw: (4,) unit.
        twist: (6,) m/s and rad/s, base axes.
        wrench: (6,) external N and Nm, or None where the robot does not know it.
        reference_position_m: (3,) pose the robot's controller holds right now, or None.
        reference_quat_xyzw: (4,), or None. Both or neither.
    """

    position_m: FloatArray
    quat_xyzw: FloatArray
    twist: FloatArray
    wrench: FloatArray | None = None
    reference_position_m: FloatArray | None = None
    reference_quat_xyzw: FloatArray | None = None

    def __post_init__(self) -> None:
        _set(self, "position_m", vector("position_m", self.position_m, 3))
        _set(self, "quat_xyzw", unit_quaternion("quat_xyzw", self.quat_xyzw))
        _set(self, "twist", vector("twist", self.twist, 6))
        if self.wrench is not None:
            _set(self, "wrench", vector("wrench", self.wrench, 6))
        if (self.reference_position_m is None) != (self.reference_quat_xyzw is None):
            raise RecordError("a reference pose needs both position and quaternion")
        if self.reference_position_m is not None and self.reference_quat_xyzw is not None:
            _set(
                self,
                "reference_position_m",
                vector("reference_position_m", self.reference_position_m, 3),
            )
            _set(
                self,
                "reference_quat_xyzw",
                unit_quaternion("reference_quat_xyzw", self.reference_quat_xyzw),
            )


@dataclass(frozen=True, slots=True)
class GripperState:
    """Gripper and robot condition.

    Args:
        width_m: opening between the fingers.
        moving: the fingers move.
        holding: an object is held.
        mode: the robot's own word for its mode, ``ready`` when it will move.
        faults: what the robot complains of, empty when well.
    """

    width_m: float
    moving: bool
    holding: bool
    mode: str = "ready"
    faults: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _set(self, "width_m", number("width_m", self.width_m, -0.01, 1.0))
        _set(self, "moving", boolean("moving", self.moving))
        _set(self, "holding", boolean("holding", self.holding))
        text("mode", self.mode, 128)
        _set(self, "faults", texts("faults", self.faults, 512))


@dataclass(frozen=True, slots=True, eq=False)
class ActionChunk:
    """What a model asks for: `H` steps of `D` numbers whose meaning its spec declares.

    Args:
        worker: name of the worker.
        spec_hash: hash of the spec its steps are to be read with.
        episode: the episode (see `Task`) the policy was reset for.
        observation_stamp_ns: capture time of the observation, wall clock.
        observation_seq: its sequence number.
        valid_until_ns: after this wall time the chunk must not be started.
        steps: (H, D) float32.
        observed_ns: wall time at which the worker took the observation.
        inference_start_ns: wall time.
        inference_end_ns: wall time.
        done: the policy says its task is finished when these steps are.
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
        text("worker", self.worker, 128)
        text("spec_hash", self.spec_hash, 128)
        for name in (
            "episode",
            "observation_stamp_ns",
            "observation_seq",
            "valid_until_ns",
            "observed_ns",
            "inference_start_ns",
            "inference_end_ns",
        ):
            _set(self, name, integer(name, getattr(self, name)))
        _set(self, "done", boolean("done", self.done))
        steps = _numbers("steps", self.steps)
        if steps.ndim != 2 or 0 in steps.shape:
            raise RecordError(f"steps has shape {steps.shape}, wanted (H, D)")
        if steps.size > MAX_CHUNK_NUMBERS:
            raise RecordError(f"steps has {steps.size} numbers, at most {MAX_CHUNK_NUMBERS}")
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, seen below
            steps = np.array(steps, dtype=np.float32, order="C")
        if not np.isfinite(steps).all():
            raise RecordError("steps holds NaN or infinity")
        steps.setflags(write=False)
        _set(self, "steps", steps)


@dataclass(frozen=True, slots=True)
class Cause:
    """Which chunk a command carries out, and when that chunk passed each stage (wall clock)."""

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
                _set(self, name, integer(name, getattr(self, name)))


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
        cause: the chunk carried out, None while nothing is.
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
            _set(self, name, vector(name, getattr(self, name), size))
        for name in ("quat_xyzw", "goal_quat_xyzw"):
            _set(self, name, unit_quaternion(name, getattr(self, name)))
        for name in ("twist", "acceleration"):
            _set(self, name, vector(name, getattr(self, name), 6))
        text("state", self.state, 32)
        _check_cause(self.cause)


@dataclass(frozen=True, slots=True, eq=False)
class JointCommand:
    """Where the joints have to be now, with feed-forward; all arrays have one entry per name.

    Args:
        names: of the arm's joints, in any order.
        position_rad: (n,).
        velocity_rad_s: (n,).
        acceleration_rad_s2: (n,).
        state: the command node's state.
        cause: the chunk carried out, None while nothing is.
    """

    names: tuple[str, ...]
    position_rad: FloatArray
    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray
    state: str
    cause: Cause | None = None

    def __post_init__(self) -> None:
        names = joint_names(self.names)
        _set(self, "names", names)
        for name in ("position_rad", "velocity_rad_s", "acceleration_rad_s2"):
            _set(self, name, vector(name, getattr(self, name), len(names)))
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
        _set(self, "width_m", number("width_m", self.width_m, 0.0, 1.0))
        _set(self, "speed_m_s", number("speed_m_s", self.speed_m_s, 1e-4, 10.0))
        _set(self, "force_n", number("force_n", self.force_n, 0.0, 1000.0))


@dataclass(frozen=True, slots=True)
class Task:
    """What is to be done now, as the command node has agreed to it.

    Args:
        episode: grows with every activation and every change of prompt or worker; a policy
            starts afresh with it and a chunk of an older episode is refused.
        active: the arm obeys the worker.
        prompt: plain text.
        worker: name of the worker whose chunks are obeyed.
        rate_hz: chunks per second asked of the workers.
    """

    episode: int
    active: bool
    prompt: str
    worker: str
    rate_hz: float

    def __post_init__(self) -> None:
        _set(self, "episode", integer("episode", self.episode))
        _set(self, "active", boolean("active", self.active))
        text("prompt", self.prompt)
        text("worker", self.worker, 128)
        _set(self, "rate_hz", number("rate_hz", self.rate_hz, 0.01, 1000.0))


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """A node's word on itself.

    Args:
        node: its name.
        state: one word.
        host: where it runs.
        pid: process number.
        started_wall_ns: when it started; tells a restart.
        ages_s: age of the newest of every input.
        rates_hz: of what it writes and loops.
        latency_ms: stage -> ``[p50, p95]``.
        counters: everything counted; refusals as ``refused.<reason>``.
        detail: whatever else a person wants to know: text, finite numbers, bools and None, in
            lists and maps that are not nested deep.
    """

    node: str
    state: str
    host: str
    pid: int
    started_wall_ns: int
    ages_s: Mapping[str, float] = field(default_factory=dict)
    rates_hz: Mapping[str, float] = field(default_factory=dict)
    latency_ms: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    counters: Mapping[str, int] = field(default_factory=dict)
    detail: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("node", "state", "host"):
            text(name, getattr(self, name), 256)
        _set(self, "pid", integer("pid", self.pid))
        _set(self, "started_wall_ns", integer("started_wall_ns", self.started_wall_ns))
        for name in ("ages_s", "rates_hz"):
            given = entries(name, getattr(self, name))
            _set(self, name, {key: number(f"{name}.{key}", v) for key, v in given.items()})
        given = entries("counters", self.counters)
        _set(self, "counters", {key: integer(f"counters.{key}", v) for key, v in given.items()})
        given = entries("latency_ms", self.latency_ms)
        _set(self, "latency_ms", {key: _pair(f"latency_ms.{key}", v) for key, v in given.items()})
        _set(self, "detail", details("detail", entries("detail", self.detail)))


def _pair(name: str, value: Any) -> tuple[float, float]:
    low, high = vector(name, value, 2).tolist()
    return low, high


@dataclass(frozen=True, slots=True)
class Event:
    """Something happened that a person may ask about later.

    Args:
        level: ``info``, ``warning`` or ``error``.
        kind: ``refusal``, ``transition``, ``limit``, ``fault`` or ``notice``.
        what: short stable name, for example ``stale_chunk``.
        why: a sentence.
        value: the value that led to it, where there is one.
        limit: the bound it met, where there is one.
        count: how many of the same this stands for.
    """

    level: str
    kind: str
    what: str
    why: str = ""
    value: float | None = None
    limit: float | None = None
    count: int = 1

    def __post_init__(self) -> None:
        for name in ("level", "kind", "what", "why"):
            text(name, getattr(self, name))
        for name, allowed in (("level", EVENT_LEVELS), ("kind", EVENT_KINDS)):
            if getattr(self, name) not in allowed:
                given = shown(getattr(self, name))
                raise RecordError(f"{name} is {given}, allowed: {', '.join(allowed)}")
        _set(self, "count", integer("count", self.count, 1))
        for name in ("value", "limit"):
            if getattr(self, name) is not None:
                _set(self, name, number(name, getattr(self, name)))


@dataclass(frozen=True, slots=True, eq=False)
class SceneState:
    """All generalised positions of a simulation, enough for a renderer to draw it.

    Args:
        scene: name of the scene.
        qpos: (nq,), the simulator's own order and units, then what it can place by hand.
        seed: of the last reset, which says how the scene looks where its look is varied; or None.
    """

    scene: str
    qpos: FloatArray
    seed: int | None = None

    def __post_init__(self) -> None:
        text("scene", self.scene, 512)
        _set(self, "qpos", vector("qpos", self.qpos, None))
        if self.seed is not None:
            _set(self, "seed", integer("seed", self.seed))


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPoses:
    """True poses of a simulation's objects in the base frame.

    Args:
        names: one per object.
        position_m: (n, 3).
        quat_xyzw: (n, 4).
    """

    names: tuple[str, ...]
    position_m: FloatArray
    quat_xyzw: FloatArray

    def __post_init__(self) -> None:
        names = texts("names", self.names, 128)
        _set(self, "names", names)
        for name, size in (("position_m", 3), ("quat_xyzw", 4)):
            rows = _numbers(name, getattr(self, name))
            if not names and rows.size == 0:  # an empty list does not say how wide it is
                rows = rows.reshape(0, size)
            if rows.shape != (len(names), size):
                raise RecordError(f"{name} has shape {rows.shape}, wanted ({len(names)}, {size})")
            check = unit_quaternion if name == "quat_xyzw" else _point
            array = np.array([check(name, row) for row in rows]).reshape(len(names), size)
            array.setflags(write=False)
            _set(self, name, array)


def _point(name: str, value: ArrayLike) -> FloatArray:
    return vector(name, value, 3)
