"""What a model declares.

`ModelSpec` is published before anything moves, and its hash travels in every chunk, so that steps
are never read with another meaning than the one agreed at activation.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from vla_zenoh.errors import SpecError, describe_faults
from vla_zenoh.policy.meaning import ROTATION_FORMS, GripperScale, RotationForm
from vla_zenoh.types import MAX_DEPTH_UNIT_M, MIN_DEPTH_UNIT_M

StatePart = Literal["joint", "pose", "gripper", "privileged", "wrench", "effort"]
Resize = Literal["none", "stretch", "pad", "crop"]
Frame = Literal["base", "tcp"]
Rotation = Literal["rpy", "rotvec", "quaternion", "rotation_6d"]
MotionKind = Literal["delta", "absolute", "velocity"]
ActionSpace = Literal["tcp", "joint"]
Anchor = Literal["goal", "measured"]
RelativeTo = Literal["previous", "start"]
GripperSemantics = Literal["none", "delta_m", "absolute_m", "open_fraction", "binary"]

ROTATION_SIZE: Mapping[Rotation, int] = {
    name: ROTATION_FORMS[name].size for name in get_args(Rotation)
}

MAX_CAMERAS = MAX_JOINTS = 16
MAX_PARTS = 4

MAX_HISTORY, MAX_HISTORY_S = 16, 2.0
"""Observations in one inference, and the time from the first to the last of them."""

BINARY_AWAY = 0.5
"""How far from its threshold a binary gripper's number is."""

STREAM_OF: Mapping[StatePart, StatePart] = {"wrench": "pose", "effort": "joint"}
"""Parts of the state that travel in the records of another one."""
FIELD_OF: Mapping[str, str] = {"effort": "effort_nm"}
"""Parts whose field, of that record and of an `Observation`, is not called as they are."""

Text = Annotated[str, Field(min_length=1, max_length=128)]


def _differ(values: tuple[Any, ...]) -> tuple[Any, ...]:
    if len(set(values)) != len(values):
        raise ValueError(f"every entry may be given once: {', '.join(map(str, values))}")
    return values


class _Spec(BaseModel):
    """Strict: neither ``"8"`` nor ``true`` is a number, so a typing error gets no meaning."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)

    LATER: ClassVar[tuple[str, ...]] = ()
    """Fields that are left out where they have their default, so that the hash and the wire form
    of a model without them stay as they were."""

    @model_serializer(mode="wrap")
    def _without_unused(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields = serialize(self)
        for name in self.LATER:
            if getattr(self, name) == type(self).model_fields[name].default:
                fields.pop(name, None)
        return fields

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        for why in self._faults():
            raise ValueError(why)
        return self

    def _faults(self) -> Iterator[str]:
        """Contradictions between fields, one sentence each."""
        yield from ()


def _no_joints(kind: Any) -> Any:
    if isinstance(kind, str) and "joint" in kind:
        raise ValueError(
            f"{kind!r} is not a kind of action; joints are declared as space='joint' with "
            "joints=(names in the order of the columns) and kind='absolute', 'delta' or 'velocity'"
        )
    return kind


class _ImageSpec(_Spec):
    camera: Text
    width: int | None = Field(default=None, ge=8, le=8192)
    height: int | None = Field(default=None, ge=8, le=8192)
    resize: Resize = "none"

    def _faults(self) -> Iterator[str]:
        if (self.width is None) != (self.height is None):
            yield "give both width and height, or neither"
        if self.resize != "none" and self.width is None:
            yield f"resize {self.resize!r} needs width and height"


class CameraSpec(_ImageSpec):
    """One camera image in the model's observation.

    Args:
        camera: name of the camera in the profile.
        width: pixels the model is given; None: as they come.
        height: pixels the model is given; None: as they come.
        resize: how other sizes become this one. ``stretch`` ignores the aspect ratio, ``pad`` keeps
            it and fills with black, ``crop`` keeps it and cuts the longer side.
        colour: channel order the model is given.
    """

    colour: Literal["rgb", "bgr"] = "rgb"


class DepthSpec(_ImageSpec):
    """One depth image in the model's observation: distances along the camera's optical axis.

    Args:
        camera: name of the camera in the profile, whose ``depth_unit_m`` is set.
        width: as of colour.
        height: as of colour.
        resize: as of colour; each pixel is the nearest one, no mean, and padding is `invalid`.
        unit_m: metres of one count the model is given.
        near_m: nearer distances become `invalid`.
        far_m: further distances become `invalid`; None: no bound but that of 65535 counts.
        invalid: count of a pixel that was not measured.
    """

    unit_m: float = Field(default=0.001, ge=MIN_DEPTH_UNIT_M, le=MAX_DEPTH_UNIT_M)
    near_m: float = Field(default=0.0, ge=0, le=1000)
    far_m: float | None = Field(default=None, gt=0, le=1000)
    invalid: Literal[0, 65535] = 0

    def _faults(self) -> Iterator[str]:
        yield from super()._faults()
        if self.far_m is not None and self.far_m <= self.near_m:
            yield f"far_m ({self.far_m:g}) must be more than near_m ({self.near_m:g})"


class ObservationSpec(_Spec):
    """What the model observes.

    Args:
        cameras: may be empty.
        depth: may be empty; a camera may be among both.
        state: which parts of the robot's state. ``wrench`` is what the surroundings exert on the
            arm, ``effort`` what its joints apply; a robot that does not measure them cannot serve
            this model.
        prompt: the model needs a prompt that is not empty.
        max_skew_s: the parts of one observation may lie this far apart in time.
        max_age_s: an older observation is not given to the model.
        history: n, observations that the model is given: this one and n - 1 before it.
        history_spacing_s: time from one to the next. An image or state further than `max_skew_s`,
            or half the spacing, from its time is not used.
        history_start: what stands for times before the episode: its first observation
            (``repeat``), or nothing, and the model is not asked until there are n (``wait``).
    """

    LATER = ("depth", "history", "history_spacing_s", "history_start")

    cameras: tuple[CameraSpec, ...] = Field(default=(), max_length=MAX_CAMERAS, strict=False)
    depth: tuple[DepthSpec, ...] = Field(default=(), max_length=MAX_CAMERAS, strict=False)
    state: Annotated[tuple[StatePart, ...], AfterValidator(_differ)] = Field(
        default=("pose", "gripper"), strict=False
    )
    prompt: bool = True
    max_skew_s: float = Field(default=0.1, gt=0, le=10)
    max_age_s: float = Field(default=0.5, gt=0, le=10)
    history: int = Field(default=1, ge=1, le=MAX_HISTORY)
    history_spacing_s: float | None = Field(default=None, ge=0.01, le=MAX_HISTORY_S)
    history_start: Literal["repeat", "wait"] = "repeat"

    def _faults(self) -> Iterator[str]:
        if (self.history > 1) != (self.history_spacing_s is not None):
            yield "history (more than 1) and history_spacing_s go together: give both, or neither"
        if self.history_span_s > MAX_HISTORY_S + 1e-9:
            yield (
                f"{self.history} observations {self.history_spacing_s:g} s apart span "
                f"{self.history_span_s:g} s, at most {MAX_HISTORY_S:g} s are kept"
            )
        if self.history > 1 and not (self.cameras or self.depth or self.state):
            yield "a history needs cameras or state: name some"
        _differ(tuple(camera.camera for camera in self.cameras))
        _differ(tuple(camera.camera for camera in self.depth))

    @property
    def history_span_s(self) -> float:
        """Time from the first to the last observation of one inference."""
        return (self.history - 1) * (self.history_spacing_s or 0.0)

    @property
    def state_streams(self) -> tuple[StatePart, ...]:
        """Parts whose records hold all parts of the state."""
        return tuple(dict.fromkeys(STREAM_OF.get(part, part) for part in self.state))

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Cameras that the model needs, for colour or depth, each once."""
        return tuple(dict.fromkeys(one.camera for one in (*self.cameras, *self.depth)))


class ControllerSpec(_Spec):
    """A controller that covers only a part of a delta within a step, as robosuite's OSC does.

    Its goal is the delta on where the arm is when the step begins, and the arm moves there as
    ``x'' = kp (goal - x) - 2 damping_ratio sqrt(kp) x'`` for `ActionSpec.dt_s`.

    Args:
        kp: stiffness per unit of mass, 1/s^2, of translation and rotation.
        damping_ratio: 1: critically damped.
    """

    kp: float = Field(gt=0, le=10_000)
    damping_ratio: float = Field(default=1.0, ge=0.1, le=10)


class ActionSpec(_Spec):
    """What the numbers of a chunk mean: ``[x y z | rotation | gripper]`` in each of H steps.

    In joint space ``[joint 1 .. joint n | gripper]``, in rad (m for a joint that slides): the arm
    follows the joints themselves, and `frame`, `rotation` and `position_scale_m` mean nothing.

    Args:
        horizon: H, steps in a chunk (at most; a shorter chunk is allowed).
        dt_s: duration of one step.
        kind: ``delta`` adds to the goal, ``absolute`` is the goal, ``velocity`` is a delta per
            second (m/s and rad/s, for `dt_s`).
        space: ``tcp`` poses of the TCP; ``joint`` positions of the arm's joints.
        joints: names of the joints, in the order of the columns.
        turns: positions of joints that turn without an end, in the state that the model observes
            and in its steps: ``wrapped`` within (-pi, pi], or ``counted`` over turns. Either way
            the arm goes to a target on the shortest way.
        frame: axes of a delta or velocity: the robot's ``base`` or the ``tcp`` at that moment. An
            absolute pose is always in the base frame.
        anchor: pose or joints that a chunk of deltas or velocities begins at: the ``goal`` in force
            at its observation, or those ``measured`` then.
        relative_to: each delta is added to the ``previous`` step, or every one of a chunk to its
            ``start``, which is the anchor (UMI; openpi's DeltaActions).
        controller: of the data, where that covers only a part of each delta; None: steps are
            covered whole.
        rotation: ``rpy`` extrinsic x, y, z in rad; ``rotvec`` axis times angle in rad;
            ``quaternion`` x, y, z, w; ``rotation_6d`` the first two columns of the matrix, one
            after the other (Zhou et al. 2019).
        position_scale_m: metres (m/s of a velocity) of one unit of x, y, z.
        gripper: ``none`` no such number; ``delta_m`` added to the width; ``absolute_m`` the width;
            ``open_fraction`` 0 shut to 1 open; ``binary`` above or below `gripper_threshold`.
        gripper_open_is_high: polarity of ``open_fraction`` and ``binary``: True: a large value
            means open (OpenVLA), False: it means closed.
        gripper_threshold: where ``binary`` switches.
        pace: ``steady``: a step lasts `dt_s`, and the arm neither stops nor rushes between steps
            that come in time; ``soonest``: it goes to each goal as fast as its limits allow.
        normalisation: key of the statistics that the output was scaled with, for information.
        parts: columns of each part of a robot of several parts, in order; the other fields, except
            `horizon` and `dt_s`, are then unused. See `of_parts`.
    """

    LATER = ("parts", "turns")

    horizon: int = Field(ge=1, le=1000)
    dt_s: float = Field(gt=0, le=60)
    kind: Annotated[MotionKind, BeforeValidator(_no_joints)] = "delta"
    frame: Frame = "base"
    anchor: Anchor = "goal"
    relative_to: RelativeTo = "previous"
    controller: ControllerSpec | None = None
    rotation: Rotation = "rpy"
    position_scale_m: float = Field(default=1.0, gt=0, le=10)
    gripper: GripperSemantics = "absolute_m"
    gripper_open_is_high: bool = True
    # Adding zero makes -0.0 zero: they mean the same, and must have the same hash.
    gripper_threshold: Annotated[float, AfterValidator(lambda value: value + 0.0)] = 0.5
    normalisation: Text | None = None
    pace: Literal["steady", "soonest"] = "steady"
    space: ActionSpace = "tcp"
    joints: Annotated[tuple[Text, ...], AfterValidator(_differ)] = Field(
        default=(), max_length=MAX_JOINTS, strict=False
    )
    turns: Literal["wrapped", "counted"] = "wrapped"
    parts: tuple[PartAction, ...] = Field(default=(), max_length=MAX_PARTS, strict=False)

    @staticmethod
    def of_parts(parts: Mapping[str, ActionSpec]) -> ActionSpec:
        """The actions of a robot of several parts: the columns of each, one after the other.

        Raises:
            ValueError: their `horizon` or `dt_s` differ.
        """
        first = next(iter(parts.values()))
        each = tuple(PartAction(part=name, action=action) for name, action in parts.items())
        return ActionSpec(horizon=first.horizon, dt_s=first.dt_s, parts=each)

    def of(self, part: str) -> ActionSpec:
        """Meaning of the columns of `part`; of a robot of one part, which has no name, all of it.

        Raises:
            SpecError: there are none.
        """
        if not part and not self.parts:
            return self
        for each in self.parts:
            if each.part == part:
                return each.action
        named = ", ".join(each.part for each in self.parts) or "no part by name"
        raise SpecError(f"the spec has no columns for part {part!r}; it names {named}", "parts")

    def columns(self, part: str) -> slice:
        """The columns of `part` in one step."""
        begin = 0
        for each in self.parts:
            if each.part == part:
                return slice(begin, begin + each.action.dimension)
            begin += each.action.dimension
        return slice(0, self.dimension)

    @property
    def arm_size(self) -> int:
        """Numbers of the arm in one step; that of the gripper follows."""
        return len(self.joints) if self.joints else 3 + ROTATION_SIZE[self.rotation]

    @property
    def rotation_form(self) -> RotationForm:
        """The form of the rotation numbers of a step."""
        return ROTATION_FORMS[self.rotation]

    @property
    def rotation_columns(self) -> slice:
        """The columns of the rotation numbers in one step."""
        return slice(3, 3 + self.rotation_form.size)

    def opens(self, number: float) -> bool:
        """Whether a ``binary`` number opens the gripper; one at the threshold is low."""
        return (number > self.gripper_threshold) == self.gripper_open_is_high

    def gripper_scale(self, max_width_m: float) -> GripperScale:
        """What the gripper's number says of the opening, where it is one.

        A ``binary`` number is told as the two that its threshold lies between.
        """
        if self.gripper == "absolute_m":
            return GripperScale(0.0, max_width_m)
        low, high = 0.0, 1.0
        if self.gripper == "binary":  # -1 and 1 where it switches at 0
            away = BINARY_AWAY if self.gripper_threshold else 1.0
            low, high = self.gripper_threshold - away, self.gripper_threshold + away
        return GripperScale(low, high) if self.gripper_open_is_high else GripperScale(high, low)

    @property
    def dimension(self) -> int:
        """D: numbers in one step."""
        if self.parts:
            return sum(each.action.dimension for each in self.parts)
        return self.arm_size + (self.gripper != "none")

    @property
    def targets(self) -> bool:
        """Each step is a pose itself, not added to the steps before it."""
        return self.kind == "absolute" or self.relative_to == "start"

    def _faults(self) -> Iterator[str]:
        joint = self.space == "joint"
        _differ(tuple(each.part for each in self.parts))
        for part, action in ((each.part, each.action) for each in self.parts):
            if action.parts:
                yield f"part {part!r} has parts of its own; name all of them at the top"
            if (action.horizon, action.dt_s) != (self.horizon, self.dt_s):
                yield (
                    f"part {part!r} has {action.horizon} steps of {action.dt_s:g} s, the chunk "
                    f"{self.horizon} of {self.dt_s:g} s; all parts of a chunk have the same"
                )
        if joint and not self.joints:
            yield "space 'joint' needs joints: the names of the arm's joints in column order"
        if self.joints and not joint:
            yield "joints are named, and space is 'tcp'; set space: joint"
        if joint and (self.frame != "base" or self.controller is not None):
            yield "joints have no frame and no controller; leave out both"
        if joint and self.position_scale_m != 1.0:
            yield (
                "position_scale_m scales x, y and z, which joints have not; leave it out, and "
                "give joints in rad (prismatic ones in m)"
            )
        if self.kind == "absolute" and self.frame != "base":
            yield "an absolute pose is given in the base frame; set frame: base"
        if self.kind == "absolute" and (self.anchor != "goal" or self.relative_to != "previous"):
            yield (
                "an absolute pose is added to nothing; leave out anchor and relative_to, or set "
                "kind: delta"
            )
        if self.kind == "velocity" and not joint and self.rotation != "rotvec":
            yield "an angular velocity is a vector in rad/s; set rotation: rotvec"
        if self.kind == "velocity" and self.relative_to != "previous":
            yield (
                "each velocity continues where the step before it ended; set relative_to: previous"
            )
        if self.controller is None:
            return
        if self.kind != "delta" or self.frame != "base" or self.relative_to != "previous":
            yield (
                "a controller covers deltas in the base frame, one after the other; set kind: "
                "delta, frame: base, relative_to: previous, or leave out controller"
            )
        if self.anchor != "goal":
            yield (
                "a controller adds each delta to where its own response is, which the goal "
                "follows; set anchor: goal"
            )


class PartAction(_Spec):
    """What the columns of one part of a robot mean.

    Args:
        part: its name in the profile.
        action: their meaning.
    """

    part: Text
    action: ActionSpec


ActionSpec.model_rebuild()


PERSON = "teleop"
"""Name in the spec of every worker that is a person; what it leads is an intervention."""


class ModelSpec(_Spec):
    """Everything a command node must know about a model before it executes its chunks.

    Args:
        every_step: the model counts inferences as steps of ``action.dt_s``: it keeps earlier
            observations itself, or averages its chunks. It is asked ``1 / dt_s`` times a second.
    """

    LATER = ("every_step",)

    name: Text
    observation: ObservationSpec = ObservationSpec()
    action: ActionSpec
    every_step: bool = False

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts that it moves and observes; of one arm one empty name."""
        return tuple(each.part for each in self.action.parts) or ("",)

    def to_dict(self) -> dict[str, Any]:
        """Plain types, ready for the wire."""
        return self.model_dump(mode="json")

    @property
    def hash(self) -> str:
        """16 hex digits that differ when any declared meaning differs."""
        return _digest(self)  # pyright: ignore[reportArgumentType]  # frozen, so it has a hash

    @staticmethod
    def from_dict(data: Any) -> ModelSpec:
        """Read what `to_dict` wrote.

        Raises:
            SpecError: names every wrong field.
        """
        try:
            return ModelSpec.model_validate(data)
        except ValidationError as error:
            why = describe_faults(error, "spec")
            raise SpecError(f"not a valid model spec: {why}") from error


@lru_cache(maxsize=256)
def _digest(spec: ModelSpec) -> str:
    # Not kept in the spec itself: a copy with other fields would inherit it.
    canonical = json.dumps(spec.to_dict(), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]
