"""The options that make a `Layout`.

Everything is given as text options (``--set name=value``), and a preset is no more than such
options for a known robot, each of which can be overridden::

    map        observation/image=camera:front, observation/state=position+rotvec+fingers_m,
               prompt=prompt; also NAME=blank:HxW (black), NAME= (leave it out of the preset)
    size       WIDTHxHEIGHT of every picture, empty: as the camera gives it
    resize     none, stretch, pad, crop
    colour     rgb, bgr
    keys       names in the answer, stood side by side (groot: x,y,z,...)
    columns    which of its columns, as 0:7 or 0,1,2,6
    action     delta, absolute (of the TCP); joint_delta, joint_position (become absolute poses
               by the arm's forward kinematics)
    frame      base, tcp
    rotation   rpy, rotvec, quat_xyzw, quat_wxyz
    clip       numbers of the arm are clipped to [-clip, clip] first; empty: not
    position_scale_m, rotation_scale_rad, joint_scale_rad   one unit of the answer
    gripper    none, delta_m, absolute_m, open_fraction, binary
    gripper_open       high, low: which end of binary and open_fraction is open
    gripper_threshold  of binary
    dt_s       duration of a step
    horizon    steps taken from an answer, at most
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Literal, cast, get_args

from pydantic import ValidationError

from vla_zenoh.errors import SpecError
from vla_zenoh.faults import in_words
from vla_zenoh.interop.layout import Action, Layout, Source, TheirRotation
from vla_zenoh.model_options import number, one_of, whole_number
from vla_zenoh.policy import (
    ActionSpec,
    CameraSpec,
    Frame,
    GripperMeaning,
    ModelSpec,
    ObservationSpec,
    Resize,
    Rotation,
    StatePart,
)
from vla_zenoh.state_vector import parts_of, read_parts

DEFAULTS: Mapping[str, str] = {
    "map": "",
    "size": "224x224",
    "resize": "pad",
    "colour": "rgb",
    "keys": "actions",
    "columns": "",
    "action": "delta",
    "frame": "base",
    "rotation": "rpy",
    "clip": "",
    "position_scale_m": "1",
    "rotation_scale_rad": "1",
    "joint_scale_rad": "1",
    "gripper": "binary",
    "gripper_open": "high",
    "gripper_threshold": "0.5",
    "dt_s": "0.1",
    "horizon": "1",
}
_SIZE = re.compile(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})")
_SLICE = re.compile(r"([0-9]{1,4}):([0-9]{1,4})")
MAX_KEYS = 256
OPEN = ("high", "low")


def read_layout(
    name: str,
    presets: Mapping[str, Mapping[str, str]],
    preset: str,
    options: Mapping[str, str],
    *,
    max_width_m: float,
    normalisation: str | None = None,
) -> Layout:
    """A layout of a preset and the options that override it.

    Args:
        name: of the worker's model, for its spec.
        presets: name -> options.
        preset: which of them.
        options: as given by a person.
        max_width_m: of our gripper.
        normalisation: for the spec.

    Raises:
        SpecError: an option is not known or cannot be read; names what is allowed.
    """
    if preset not in presets:
        raise SpecError(f"no preset {preset!r}; known: {', '.join(presets)}")
    unknown = [option for option in options if option not in DEFAULTS]
    if unknown:
        raise SpecError(f"no option {', '.join(map(repr, unknown))}; known: {', '.join(DEFAULTS)}")
    chosen = {**DEFAULTS, **presets[preset], **options}
    entries = {**read_map(presets[preset].get("map", "")), **read_map(options.get("map", ""))}
    fields = {theirs: source for theirs, source in entries.items() if source is not None}
    if not fields:
        raise SpecError("map is empty: say which of the server's names is filled with what")
    action = one_of("action", chosen["action"], get_args(Action))
    rotation = one_of("rotation", chosen["rotation"], get_args(TheirRotation))
    joints = action.startswith("joint")
    try:
        spec = ModelSpec(
            name=name,
            observation=_observation(fields, chosen, joints),
            action=ActionSpec(
                horizon=whole_number("horizon", chosen["horizon"]),
                dt_s=number("dt_s", chosen["dt_s"]),
                kind="delta" if action == "delta" else "absolute",
                frame=cast(Frame, "base" if joints else chosen["frame"]),
                rotation=_our_rotation(rotation, joints),
                gripper=cast(GripperMeaning, chosen["gripper"]),
                gripper_open_is_high=one_of("gripper_open", chosen["gripper_open"], OPEN) == "high",
                gripper_threshold=number(
                    "gripper_threshold", chosen["gripper_threshold"], least=-math.inf
                ),
                normalisation=normalisation,
            ),
        )
    except ValidationError as error:
        faults = "; ".join(
            f"{'.'.join(map(str, fault['loc'])) or 'options'}: {in_words(fault)}"
            for fault in error.errors(include_url=False)
        )
        raise SpecError(f"the options give no valid spec: {faults}") from error
    return Layout(
        fields=fields,
        spec=spec,
        keys=_keys(chosen["keys"]),
        columns=read_columns(chosen["columns"]),
        action=cast(Action, action),
        rotation=cast(TheirRotation, rotation),
        clip=number("clip", chosen["clip"] or "0"),
        scales=(
            number("position_scale_m", chosen["position_scale_m"]),
            number("rotation_scale_rad", chosen["rotation_scale_rad"]),
            number("joint_scale_rad", chosen["joint_scale_rad"]),
        ),
        max_width_m=max_width_m,
    )


def _observation(
    fields: Mapping[str, Source], chosen: Mapping[str, str], joints: bool
) -> ObservationSpec:
    size = _SIZE.fullmatch(chosen["size"])
    if chosen["size"] and size is None:
        raise SpecError(f"size is {chosen['size']!r}, wanted WIDTHxHEIGHT, or nothing")
    parts = {part for source in fields.values() for part in parts_of(source.parts)}
    parts |= {"joint"} if joints else set()
    order: tuple[StatePart, ...] = ("joint", "pose", "gripper")
    cameras = dict.fromkeys(source.camera for source in fields.values() if source.camera)
    return ObservationSpec(
        cameras=tuple(
            CameraSpec(
                camera=camera,
                width=int(size[1]) if size else None,
                height=int(size[2]) if size else None,
                resize=cast(Resize, chosen["resize"] if size else "none"),
                colour=cast(Literal["rgb", "bgr"], chosen["colour"]),
            )
            for camera in cameras
        ),
        state=tuple(part for part in order if part in parts),
        prompt=any(source.prompt for source in fields.values()),
    )


def _our_rotation(theirs: str, joints: bool) -> Rotation:
    return "quaternion" if joints or theirs.startswith("quat") else cast(Rotation, theirs)


def read_timeout(text: str) -> float:
    """The option `timeout_s`.

    Raises:
        SpecError: it is no number of seconds up to a minute.
    """
    value = number("timeout_s", text)
    if not 0.01 <= value <= 60:
        raise SpecError(f"timeout_s is {text!r}, wanted 0.01 to 60: a late answer is of no use")
    return value


def _keys(text: str) -> tuple[str, ...]:
    keys = tuple(key.strip() for key in text.split(","))
    if not all(keys) or len(set(keys)) != len(keys) or len(keys) > MAX_KEYS:
        raise SpecError(f"keys is {text!r}, wanted different names with a comma between them")
    return keys


def read_columns(text: str) -> tuple[int, ...] | None:
    """The option `columns`; None: all of them.

    Raises:
        SpecError: it is neither 0:7 nor 0,1,2.
    """
    if not text:
        return None
    if (found := _SLICE.fullmatch(text)) and int(found[1]) < int(found[2]):
        return tuple(range(int(found[1]), int(found[2])))
    entries = text.split(",")
    if all(re.fullmatch(r"[0-9]{1,4}", entry) for entry in entries):
        return tuple(map(int, entries))
    raise SpecError(f"columns is {text!r}, wanted 0:7 or 0,1,2,6")


def read_map(text: str) -> dict[str, Source | None]:
    """The option `map`; None: this name is left out.

    Raises:
        SpecError: it cannot be read; says what is allowed.
    """
    out: dict[str, Source | None] = {}
    for entry in filter(None, (part.strip() for part in text.split(","))):
        theirs, equals, ours = (part.strip() for part in entry.partition("="))
        if not equals or not theirs:
            raise SpecError(f"map wants NAME=SOURCE, not {entry!r}")
        if theirs in out:
            raise SpecError(f"map names {theirs!r} twice")
        out[theirs] = _source(ours) if ours else None
    return out


def _source(text: str) -> Source:
    kind, colon, rest = text.partition(":")
    if kind == "camera" and rest:
        return Source(camera=rest)
    if kind == "blank" and (size := _SIZE.fullmatch(rest)):
        return Source(blank=(int(size[1]), int(size[2])))
    if text == "prompt":
        return Source(prompt=True)
    if colon:
        raise SpecError(f"a source is camera:NAME, blank:HxW, prompt or parts, not {text!r}")
    return Source(parts=read_parts(text))
