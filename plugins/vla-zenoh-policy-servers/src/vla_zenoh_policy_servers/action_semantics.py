"""Meaning of an external policy's numbers, by options of the user.

The same options serve policy servers, LeRobot checkpoints and OpenVLA checkpoints, in both
directions: they say what its answers mean, how the steps in execution are told to it, and in which
units it wants the state (`vla_zenoh_policy_servers.state_vector`)::

    action     delta, absolute, velocity (of the TCP); joint_delta, joint_position, joint_velocity
    frame      base, tcp: axes of a delta or velocity
    anchor     goal, measured: the pose or joints that a chunk of deltas or velocities begins at
    relative_to  previous, start: what each delta of a chunk is added to
    controller none, or KP:DAMPING_RATIO of the data's controller, where that covers only a part of
               each delta (robosuite's and LIBERO's: 150:1)
    rotation   rpy, rotvec, quat_xyzw, quat_wxyz, rotation_6d (first two columns of the matrix),
               rotation_6d_rows (first two rows), none (of deltas and velocities of a hand that
               does not turn)
    rotation_reference  home, or x,y,z,w: of the numbers that one rotation has (both signs of a
               quaternion, angles that differ by a turn), the state has those nearest to this one;
               0,0,0,1: w >= 0 and angles within [-pi, pi]
    clip       numbers of the arm are clipped to [-clip, clip] first; empty: never
    position_scale_m, rotation_scale_rad   one unit of the numbers of a pose, default 1; of
               absolute poses also that of the state. Positions of deltas and velocities stay in
               this unit: a robot with the same one is given them to the last bit
    joint_scale_rad    one unit of the numbers of joints: 1 for radians, 0.0174533 for degrees,
               negative for a joint that turns the other way; or one for each joint, with commas, m
               for a joint that slides; of joint_position also that of `joint` in the state
    joint_zero its number where a joint of the profile is at 0, default 0; or one for each
    joint_turns        wrapped, counted: joints that turn without an end are within half a turn of
               the profile's zero, or counted over turns; also those in the state
    gripper    none, delta_m, absolute_m, open_fraction, binary
    gripper_open       high, low: which end of binary and open_fraction is open
    gripper_range      SHUT:OPEN, the numbers of open_fraction where it is shut and open, in place
               of gripper_open: 0:100 of LeRobot's SO-101, whose gripper is one of the joints; also
               those of `gripper_open` in the state
    gripper_threshold  of binary
    dt_s       duration of a step
    horizon    largest number of steps used from an answer

Missing options are an error, never guessed: a wrong guess moves a robot.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from vla_zenoh.errors import SpecError, describe_faults
from vla_zenoh.policy import ActionSpec, Anchor, ControllerSpec, Frame, GripperSemantics, RelativeTo
from vla_zenoh.policy.meaning import ROTATION_FORMS, SHARE, GripperScale
from vla_zenoh.policy.options import number, one_of, whole_number

Action = Literal["delta", "absolute", "velocity", "joint_delta", "joint_position", "joint_velocity"]
_JOINT_KINDS: Mapping[str, str] = {
    "joint_delta": "delta",
    "joint_position": "absolute",
    "joint_velocity": "velocity",
}
ForeignRotation = Literal[
    "rpy", "rotvec", "quat_xyzw", "quat_wxyz", "rotation_6d", "rotation_6d_rows", "none"
]
_SPEC_ROTATIONS: Mapping[str, str] = {
    "quat_xyzw": "quaternion",
    "quat_wxyz": "quaternion",
    "rotation_6d_rows": "rotation_6d",
    "none": "rotvec",
}
"""Forms that are another one in a spec."""
SCALED = ("rpy", "rotvec")
"""Forms whose numbers have a unit."""

ACTION_OPTIONS: Mapping[str, str] = {
    "action": "",
    "frame": "base",
    "anchor": "",
    "relative_to": "",
    "controller": "",
    "rotation": "",
    "rotation_reference": "home",
    "clip": "",
    "position_scale_m": "1",
    "rotation_scale_rad": "1",
    "joint_scale_rad": "",
    "joint_zero": "0",
    "joint_turns": "wrapped",
    "gripper": "",
    "gripper_open": "",
    "gripper_range": "",
    "gripper_threshold": "0.5",
    "dt_s": "",
    "horizon": "",
}
"""Every option with its default; empty: no default, except for `clip` and `gripper_range`."""
ADDED_TO = ("anchor", "relative_to", "controller")
"""What deltas are added to, and how much of them is covered."""
NO_CONTROLLER = "none"
HOME = "home"
"""Reference of rotations: the TCP's at `robot.home_rad`."""
_ALLOWED: Mapping[str, tuple[str, ...]] = {
    "action": get_args(Action),
    "rotation": get_args(ForeignRotation),
    "frame": get_args(Frame),
    "anchor": get_args(Anchor),
    "relative_to": get_args(RelativeTo),
    "joint_turns": ("wrapped", "counted"),
    "gripper": get_args(GripperSemantics),
    "gripper_open": ("high", "low"),
}
_ASKED: Mapping[str, str] = {
    "action": " or ".join(_ALLOWED["action"]),
    "controller": "none, or KP:DAMPING_RATIO where the data's controller covers only a part of a "
    "step: 150:1 for robosuite and LIBERO",
    "relative_to": "previous or start: is a delta added to the step before it, or to the start of "
    "its chunk?",
    "anchor": "goal or measured: what does a chunk begin at?",
    "rotation": " or ".join(_ALLOWED["rotation"]),
    "joint_scale_rad": "1 if the joints' numbers are radians, 0.0174533 if they are degrees",
    "gripper": " or ".join(_ALLOWED["gripper"]),
    "gripper_open": "high or low: is the gripper open where its number is large?",
    "dt_s": "seconds of a step, 1 / fps of the data",
    "horizon": "how many steps of an answer are taken",
}


@dataclass(frozen=True, slots=True)
class StateUnits:
    """Units of a policy's state, as far as its options say them.

    Args:
        joint_scales: one unit of `joint`, of all or of each, in rad, of one that slides in m.
        joint_zeros: its number where the joint is at 0, of all or of each.
        position_scale_m: one unit of a position.
        rotation_scale_rad: one unit of angles.
        gripper: the numbers of `gripper_open`.
        rotation_reference: home, or a quaternion x,y,z,w.
    """

    joint_scales: tuple[float, ...] = (1.0,)
    joint_zeros: tuple[float, ...] = (0.0,)
    position_scale_m: float = 1.0
    rotation_scale_rad: float = 1.0
    gripper: GripperScale = SHARE
    rotation_reference: str = HOME


METRIC = StateUnits()
"""Metres, radians, and a gripper from 0 to 1."""


@dataclass(frozen=True, slots=True)
class ActionSemantics:
    """Converts an external policy's numbers to action steps, and steps to its numbers.

    Made by `read_action_semantics`.

    Args:
        spec: of the converted steps, in radians, and metres where the spec has no other unit.
        action: kind of the arm's numbers.
        rotation: their representation of rotations, if they are poses.
        clip: bound of the arm's raw numbers; 0: none.
        units: of the numbers.
    """

    spec: ActionSpec
    action: Action
    rotation: ForeignRotation
    clip: float
    units: StateUnits

    @property
    def needs_joints(self) -> bool:
        """Whether its numbers are joints."""
        return self.spec.space == "joint"

    @property
    def state_units(self) -> StateUnits:
        """Units of the state: those of the actions, where both are of one kind.

        A unit of a delta or a velocity says nothing of the state, which is in m and rad then.
        """
        units = self.units
        if self.action != "joint_position":
            units = replace(units, joint_scales=(1.0,), joint_zeros=(0.0,))
        if self.action != "absolute":
            units = replace(units, position_scale_m=1.0, rotation_scale_rad=1.0)
        return units

    def parts(self) -> dict[str, int]:
        """Parts of a row in order, with their sizes."""
        size = 0 if self.rotation == "none" else ROTATION_FORMS[self.rotation].size
        arm = {"position": 3, self.rotation: size}
        if self.needs_joints:
            arm = {"joints": len(self.spec.joints)}
        return arm if self.spec.gripper == "none" else {**arm, "gripper": 1}

    def steps(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Action steps (H, D) as `spec` declares them.

        Args:
            rows: (H, C), laid out as in `parts`.

        Raises:
            SpecError: wrong number of columns, or numbers that are no rotation.
        """
        parts = self.parts()
        if rows.shape[1] != sum(parts.values()):
            wanted = " + ".join(f"{name} {count}" for name, count in parts.items())
            raise SpecError(
                f"the answer has {rows.shape[1]} columns, wanted {sum(parts.values())}: {wanted}",
                "shape",
            )
        arm, gripper = np.split(rows, [rows.shape[1] - ("gripper" in parts)], axis=1)
        gripper = np.vectorize(self.units.gripper.decode, otypes=[np.float64])(gripper)
        if self.clip:
            arm = arm.clip(-self.clip, self.clip)
        if self.needs_joints:
            arm = (arm - self._zeros) * np.array(self.units.joint_scales)
            return np.concatenate([arm, gripper], axis=1)
        position, turns = arm[:, :3] * self._unit, arm[:, 3:]
        if self.rotation == "none":
            turns = np.zeros((len(rows), 3))
        elif self.rotation in SCALED:
            turns = turns * self.units.rotation_scale_rad
        turns = _rewritten(turns, self.rotation, self.spec.rotation)
        return np.concatenate([position, turns, gripper], axis=1)

    def rows(self, steps: NDArray[Any]) -> NDArray[np.float64]:
        """The inverse of `steps`: action steps (K, D) as the policy's own numbers (K, C)."""
        split = steps.shape[1] - (self.spec.gripper != "none")
        arm, gripper = np.split(steps.astype(np.float64), [split], axis=1)
        gripper = np.vectorize(self.units.gripper.encode, otypes=[np.float64])(gripper)
        if self.needs_joints:
            arm = arm / np.array(self.units.joint_scales) + self._zeros
            return np.concatenate([arm, gripper], axis=1)
        position, turns = arm[:, :3] / self._unit, arm[:, 3:]
        if self.rotation == "none":
            return np.concatenate([position, gripper], axis=1)
        turns = _rewritten(turns, self.spec.rotation, self.rotation)
        if self.rotation in SCALED:
            turns = turns / self.units.rotation_scale_rad
        return np.concatenate([position, turns, gripper], axis=1)

    @property
    def _unit(self) -> float:
        """What one unit of a position is in the unit of the spec."""
        return self.units.position_scale_m / self.spec.position_scale_m

    @property
    def _zeros(self) -> NDArray[np.float64]:
        """Only positions have a zero; a change of them has none."""
        return np.array(self.units.joint_zeros if self.action == "joint_position" else (0.0,))


def _rewritten(numbers: NDArray[np.float64], before: str, after: str) -> NDArray[np.float64]:
    """Rotations (n, ...) in another form, with the sign that they have."""
    if before in (after, "none"):
        return numbers
    quats = [ROTATION_FORMS[before].decode(row) for row in numbers]
    rows = [ROTATION_FORMS[after].encode(quat, quat) for quat in quats]
    return np.array(rows).reshape(len(rows), ROTATION_FORMS[after].size)


def read_action_semantics(
    given: Mapping[str, str],
    known: Mapping[str, str] | None = None,
    whose: str = "",
    *,
    joints: Sequence[str] = (),
    normalisation: str | None = None,
) -> ActionSemantics:
    """The semantics that options define.

    Args:
        given: options of the user, any of `ACTION_OPTIONS`.
        known: options of a preset or data set; `given` overrides them. If `given` has another
            `action`, only the `horizon` of them is kept.
        whose: owner of `known`, for messages.
        joints: names of the arm's, in the order of the columns of an action of joints.
        normalisation: for the spec.

    Raises:
        SpecError: unknown, invalid or missing option; names what is allowed.
    """
    unknown = [name for name in given if name not in ACTION_OPTIONS]
    if unknown:
        raise SpecError(
            f"no option {', '.join(map(repr, unknown))}; known: {', '.join(ACTION_OPTIONS)}"
        )
    known = {name: value for name, value in (known or {}).items() if name in ACTION_OPTIONS}
    action = given.get("action") or known.get("action", "")
    other = bool(known.get("action")) and action != known["action"]
    if other:
        known = {name: value for name, value in known.items() if name == "horizon"}
    chosen = {**ACTION_OPTIONS, **known, **given, "action": action}
    for name, allowed in _ALLOWED.items():
        if chosen[name]:
            one_of(name, chosen[name], allowed)
    _ask_for_missing(chosen, f"action={action} is not that of {whose}, so " if other else "")
    if action in _JOINT_KINDS:
        chosen |= {"rotation": "rotvec", "frame": "base"}
    units = StateUnits(
        joint_scales=_of_joints("joint_scale_rad", chosen["joint_scale_rad"] or "1", joints),
        joint_zeros=_of_joints("joint_zero", chosen["joint_zero"], joints),
        position_scale_m=number("position_scale_m", chosen["position_scale_m"]),
        rotation_scale_rad=number("rotation_scale_rad", chosen["rotation_scale_rad"]),
        gripper=_gripper_range(chosen),
        rotation_reference=chosen["rotation_reference"],
    )
    scales = {
        "joint_scale_rad": units.joint_scales,
        "position_scale_m": (units.position_scale_m,),
        "rotation_scale_rad": (units.rotation_scale_rad,),
    }
    for name, values in scales.items():
        if 0.0 in values:
            raise SpecError(f"{name} is 0: every number would mean the same; give one unit's size")
    if chosen["rotation"] == "none" and action not in ("delta", "velocity"):
        raise SpecError("rotation=none goes with action=delta or velocity: a pose has a rotation")
    if any(units.joint_zeros) and action != "joint_position":
        raise SpecError("joint_zero goes with action=joint_position: a change has no zero")
    return ActionSemantics(
        spec=_spec(chosen, joints, normalisation),
        action=cast(Action, action),
        rotation=cast(ForeignRotation, chosen["rotation"]),
        clip=number("clip", chosen["clip"] or "0"),
        units=units,
    )


def _of_joints(name: str, text: str, joints: Sequence[str]) -> tuple[float, ...]:
    """One number for all joints, or one for each."""
    found = tuple(number(name, each.strip(), least=-math.inf) for each in text.split(","))
    if len(found) not in (1, len(joints)):
        raise SpecError(
            f"{name} has {len(found)} numbers for {len(joints)} joints: give one for all of them, "
            "or one each"
        )
    return found


def _ask_for_missing(chosen: Mapping[str, str], why: str) -> None:
    known = _not_asked(chosen)
    if chosen["action"] in _JOINT_KINDS:
        known |= {"rotation", "controller"}
    else:
        known |= {"joint_scale_rad"}
    if chosen["gripper"] not in ("", "open_fraction", "binary") or chosen["gripper_range"]:
        known |= {"gripper_open"}
    missing = [name for name in _ASKED if name not in known and not chosen[name]]
    if missing:
        raise SpecError(
            f"{why}the meaning of the numbers is missing: "
            + ", ".join(f"--set {name}=({_ASKED[name]})" for name in missing)
        )


def _gripper_range(chosen: Mapping[str, str]) -> GripperScale:
    """The gripper's number where it is shut, and where it is open."""
    text = chosen["gripper_range"]
    if not text:
        return SHARE
    if chosen["gripper"] != "open_fraction" or chosen["gripper_open"]:
        raise SpecError(
            "gripper_range goes with gripper=open_fraction, in place of gripper_open: leave out "
            "one of them"
        )
    shut, colon, opened = text.partition(":")
    ends = (
        [number("gripper_range", end, least=-math.inf) for end in (shut, opened)] if colon else []
    )
    if len(ends) != 2 or ends[0] == ends[1]:
        raise SpecError(f"gripper_range is {text!r}; wanted SHUT:OPEN, two numbers as 0:100")
    return GripperScale(*ends)


def _not_asked(chosen: Mapping[str, str]) -> set[str]:
    """Options of `ADDED_TO` for which the others leave only one meaning."""
    kind = _JOINT_KINDS.get(chosen["action"], chosen["action"])
    if kind == "velocity":
        return {"controller", "relative_to"}
    if kind != "delta":
        return set(ADDED_TO)
    if chosen["controller"] not in ("", NO_CONTROLLER):
        return {"anchor", "relative_to"}
    if chosen["relative_to"] == "start":
        return {"controller"}
    return {"relative_to"} if chosen["horizon"] == "1" else set()  # a single step has one start


def read_controller(text: str) -> ControllerSpec | None:
    """The controller that an option names: ``none``, or ``KP:DAMPING_RATIO``.

    Raises:
        SpecError: it is neither.
    """
    if text in ("", NO_CONTROLLER):
        return None
    kp, colon, ratio = text.partition(":")
    if not colon:
        raise SpecError(f"controller is {text!r}; wanted none, or KP:DAMPING_RATIO as 150:1")
    with as_spec_error():
        return ControllerSpec(
            kp=number("controller", kp), damping_ratio=number("controller", ratio)
        )


def _spec(
    chosen: Mapping[str, str], joints: Sequence[str], normalisation: str | None
) -> ActionSpec:
    action = chosen["action"]
    rotation, threshold = chosen["rotation"], chosen["gripper_threshold"]
    scale_m = number("position_scale_m", chosen["position_scale_m"])
    with as_spec_error():
        return ActionSpec.model_validate(
            {
                "horizon": whole_number("horizon", chosen["horizon"]),
                "dt_s": number("dt_s", chosen["dt_s"]),
                "kind": _JOINT_KINDS.get(action, action),
                "turns": chosen["joint_turns"],
                "space": "joint" if action in _JOINT_KINDS else "tcp",
                "joints": tuple(joints) if action in _JOINT_KINDS else (),
                "frame": chosen["frame"],
                "anchor": chosen["anchor"] or "goal",
                "relative_to": chosen["relative_to"] or "previous",
                "controller": read_controller(chosen["controller"]),
                "rotation": _SPEC_ROTATIONS.get(rotation, rotation),
                "position_scale_m": scale_m if action in ("delta", "velocity") else 1.0,
                "gripper": chosen["gripper"],
                "gripper_open_is_high": chosen["gripper_open"] != "low",
                "gripper_threshold": number("gripper_threshold", threshold, least=-math.inf),
                "normalisation": normalisation,
            }
        )


@contextmanager
def as_spec_error() -> Iterator[None]:
    """Turn pydantic's error of an invalid spec into one sentence that names each option.

    Raises:
        SpecError: a spec was invalid.
    """
    try:
        yield
    except ValidationError as error:
        why = describe_faults(error, "options")
        raise SpecError(f"the options give no valid spec: {why}") from error
