"""Meaning of an external policy's output, by options of the user.

The same options serve policy servers, LeRobot checkpoints and OpenVLA checkpoints::

    action     delta, absolute, velocity (of the TCP); joint_delta, joint_position, joint_velocity
    frame      base, tcp: axes of a delta or velocity
    anchor     goal, measured: the pose or joints that a chunk of deltas or velocities begins at
    relative_to  previous, start: what each delta of a chunk is added to
    controller none, or KP:DAMPING_RATIO of the data's controller, where that covers only a part of
               each delta (robosuite's and LIBERO's: 150:1)
    rotation   rpy, rotvec, quat_xyzw, quat_wxyz
    clip       numbers of the arm are clipped to [-clip, clip] first; empty: never
    position_scale_m, rotation_scale_rad   one unit of the numbers of a pose, default 1
    joint_scale_rad    one unit of the numbers of joints: 1 for radians, 0.0174533 for degrees; or
               one for each joint, with commas, m for a joint that slides
    gripper    none, delta_m, absolute_m, open_fraction, binary
    gripper_open       high, low: which end of binary and open_fraction is open
    gripper_range      SHUT:OPEN, the numbers of open_fraction where it is shut and open, in place
               of gripper_open: 0:100 of LeRobot's SO-101, whose gripper is one of the joints
    gripper_threshold  of binary
    dt_s       duration of a step
    horizon    largest number of steps used from an answer

Missing options are an error, never guessed: a wrong guess moves a robot.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from vla_zenoh.errors import SpecError, describe_faults
from vla_zenoh.lab.policy_servers.model_options import number, one_of, whole_number
from vla_zenoh.policy import ActionSpec, Anchor, ControllerSpec, Frame, GripperSemantics, RelativeTo

Action = Literal["delta", "absolute", "velocity", "joint_delta", "joint_position", "joint_velocity"]
_JOINT_KINDS: Mapping[str, str] = {
    "joint_delta": "delta",
    "joint_position": "absolute",
    "joint_velocity": "velocity",
}
ForeignRotation = Literal["rpy", "rotvec", "quat_xyzw", "quat_wxyz"]

ACTION_OPTIONS: Mapping[str, str] = {
    "action": "",
    "frame": "base",
    "anchor": "",
    "relative_to": "",
    "controller": "",
    "rotation": "",
    "clip": "",
    "position_scale_m": "1",
    "rotation_scale_rad": "1",
    "joint_scale_rad": "",
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
QUATERNION_SLACK = 0.1
"""A quaternion this far from unit length is normalised; further off it is rejected."""
_ALLOWED: Mapping[str, tuple[str, ...]] = {
    "action": get_args(Action),
    "rotation": get_args(ForeignRotation),
    "frame": get_args(Frame),
    "anchor": get_args(Anchor),
    "relative_to": get_args(RelativeTo),
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
class ActionSemantics:
    """Converts an external policy's output to action steps; made by `read_action_semantics`.

    Args:
        spec: of the converted steps, in metres and radians.
        action: kind of the arm's numbers.
        rotation: their representation of rotations, if they are poses.
        clip: bound of the arm's raw numbers; 0: none.
        scales: (position, rotation) one unit in m, rad.
        gripper_range: the gripper's number where it is shut, and open, which are 0 and 1 then.
        joint_scales: one unit of all joints, or of each, in rad, of a joint that slides in m.
    """

    spec: ActionSpec
    action: Action
    rotation: ForeignRotation
    clip: float
    scales: tuple[float, float]
    joint_scales: tuple[float, ...] = (1.0,)
    gripper_range: tuple[float, float] = (0.0, 1.0)

    @property
    def needs_joints(self) -> bool:
        """Whether its numbers are joints."""
        return self.spec.space == "joint"

    def parts(self) -> dict[str, int]:
        """Parts of a row in order, with their sizes."""
        turns = 4 if self.rotation.startswith("quat") else 3
        arm = {"position": 3, self.rotation: turns}
        if self.needs_joints:
            arm = {"joints": len(self.spec.joints)}
        return arm if self.spec.gripper == "none" else {**arm, "gripper": 1}

    def steps(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Action steps (H, D) as `spec` declares them.

        Args:
            rows: (H, C), laid out as in `parts`.

        Raises:
            SpecError: wrong number of columns, or a quaternion without unit length.
        """
        parts = self.parts()
        if rows.shape[1] != sum(parts.values()):
            wanted = " + ".join(f"{name} {count}" for name, count in parts.items())
            raise SpecError(
                f"the answer has {rows.shape[1]} columns, wanted {sum(parts.values())}: {wanted}",
                "shape",
            )
        arm, gripper = np.split(rows, [rows.shape[1] - ("gripper" in parts)], axis=1)
        shut, opened = self.gripper_range
        gripper = (gripper - shut) / (opened - shut)
        if self.clip:
            arm = arm.clip(-self.clip, self.clip)
        if self.needs_joints:
            return np.concatenate([arm * np.array(self.joint_scales), gripper], axis=1)
        return np.concatenate([arm[:, :3] * self.scales[0], self._turns(arm), gripper], axis=1)

    def rows(self, steps: NDArray[Any]) -> NDArray[np.float64]:
        """The inverse of `steps`: action steps (K, D) as the policy's own numbers (K, C)."""
        split = steps.shape[1] - (self.spec.gripper != "none")
        arm, gripper = np.split(steps.astype(np.float64), [split], axis=1)
        if self.needs_joints:
            return np.concatenate([arm / np.array(self.joint_scales), gripper], axis=1)
        turns = arm[:, 3:]
        if self.rotation.startswith("quat"):
            turns = np.roll(turns, 0 if self.rotation == "quat_xyzw" else 1, axis=1)
        else:
            turns = turns / self.scales[1]
        return np.concatenate([arm[:, :3] / self.scales[0], turns, gripper], axis=1)

    def _turns(self, arm: NDArray[np.float64]) -> NDArray[np.float64]:
        rotation = arm[:, 3:]
        if not self.rotation.startswith("quat"):
            return rotation * self.scales[1]
        norm = np.linalg.norm(rotation, axis=1, keepdims=True)
        if (abs(norm - 1.0) > QUATERNION_SLACK).any():
            raise SpecError(f"a quaternion of norm {norm.min():.3g}; wanted 1", "quaternion")
        return np.roll(rotation / norm, 0 if self.rotation == "quat_xyzw" else -1, axis=1)


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
    position, rotation = (
        number(name, chosen[name]) for name in ("position_scale_m", "rotation_scale_rad")
    )
    given_scales = (chosen["joint_scale_rad"] or "1").split(",")
    joint_scales = tuple(number("joint_scale_rad", text.strip()) for text in given_scales)
    if len(joint_scales) not in (1, len(joints)):
        raise SpecError(
            f"joint_scale_rad has {len(joint_scales)} numbers for {len(joints)} joints: give one "
            "for all of them, or one each"
        )
    return ActionSemantics(
        spec=_spec(chosen, joints, normalisation),
        action=cast(Action, action),
        rotation=cast(ForeignRotation, chosen["rotation"]),
        clip=number("clip", chosen["clip"] or "0"),
        scales=(position, rotation),
        joint_scales=joint_scales,
        gripper_range=_gripper_range(chosen),
    )


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


def _gripper_range(chosen: Mapping[str, str]) -> tuple[float, float]:
    """The gripper's number where it is shut, and where it is open."""
    text = chosen["gripper_range"]
    if not text:
        return 0.0, 1.0
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
    return ends[0], ends[1]


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
    with as_spec_error():
        return ActionSpec.model_validate(
            {
                "horizon": whole_number("horizon", chosen["horizon"]),
                "dt_s": number("dt_s", chosen["dt_s"]),
                "kind": _JOINT_KINDS.get(action, action),
                "space": "joint" if action in _JOINT_KINDS else "tcp",
                "joints": tuple(joints) if action in _JOINT_KINDS else (),
                "frame": chosen["frame"],
                "anchor": chosen["anchor"] or "goal",
                "relative_to": chosen["relative_to"] or "previous",
                "controller": read_controller(chosen["controller"]),
                "rotation": "quaternion" if rotation.startswith("quat") else rotation,
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
