"""The options that make a `FieldMapping`.

Everything is given as text options (``--set name=value``), and a preset is no more than such
options for a known robot, each of which can be overridden; the preset ``none`` has none::

    map        observation/image=camera:front, observation/state=position+rotvec+fingers_m,
               prompt=prompt; also NAME=blank:HxW (black), NAME= (leave it out of the preset)
    size       WIDTHxHEIGHT of every picture, empty: as the camera gives it
    resize     none, stretch, pad, crop
    colour     rgb, bgr
    keys       names in the answer, stood side by side (groot: x,y,z,...)
    columns    which of its columns, as 0:7 or 0,1,2,6

and what the numbers of an answer mean, see `vla_zenoh.interop.action_semantics`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Literal, cast

from vla_zenoh.errors import SpecError
from vla_zenoh.interop.action_semantics import ACTION_OPTIONS, as_spec_error, read_action_semantics
from vla_zenoh.interop.field_mapping import FieldMapping, FieldSource
from vla_zenoh.policy import CameraSpec, ModelSpec, ObservationSpec, Resize, StatePart
from vla_zenoh.policy.model_options import number
from vla_zenoh.policy.state_vector import parts_of, read_parts

DEFAULTS: Mapping[str, str] = {
    "map": "",
    "size": "224x224",
    "resize": "pad",
    "colour": "rgb",
    "keys": "actions",
    "columns": "",
    **ACTION_OPTIONS,
}
NONE = "none"
"""The preset that says nothing."""
_SIZE = re.compile(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})")
_SLICE = re.compile(r"([0-9]{1,4}):([0-9]{1,4})")
MAX_KEYS = 256


def read_field_mapping(
    name: str,
    presets: Mapping[str, Mapping[str, str]],
    preset: str,
    options: Mapping[str, str],
    *,
    max_width_m: float,
    normalisation: str | None = None,
) -> FieldMapping:
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
    presets = {**presets, NONE: {}}
    if preset not in presets:
        raise SpecError(
            f"preset is {preset!r}, allowed: {', '.join(presets)} (--set preset=...); "
            f"{NONE}: of a server of your own, every option is told"
        )
    unknown = [option for option in options if option not in DEFAULTS]
    if unknown:
        raise SpecError(f"no option {', '.join(map(repr, unknown))}; known: {', '.join(DEFAULTS)}")
    chosen = {**DEFAULTS, **presets[preset], **options}
    entries = {**read_map(presets[preset].get("map", "")), **read_map(options.get("map", ""))}
    fields = {theirs: source for theirs, source in entries.items() if source is not None}
    if not fields:
        raise SpecError("map is empty: say which of the server's names is filled with what")
    told = {name: value for name, value in options.items() if name in ACTION_OPTIONS}
    whose = f"preset {preset}"
    semantics = read_action_semantics(told, presets[preset], whose, normalisation=normalisation)
    with as_spec_error():
        observation = _observation(fields, chosen, semantics.needs_joints)
    return FieldMapping(
        fields=fields,
        spec=ModelSpec(name=name, observation=observation, action=semantics.spec),
        keys=_keys(chosen["keys"]),
        columns=read_columns(chosen["columns"]),
        semantics=semantics,
        max_width_m=max_width_m,
    )


def _observation(
    fields: Mapping[str, FieldSource], chosen: Mapping[str, str], joints: bool
) -> ObservationSpec:
    size = read_size(chosen["size"])
    parts = {part for source in fields.values() for part in parts_of(source.parts)}
    parts |= {"joint"} if joints else set()
    order: tuple[StatePart, ...] = ("joint", "pose", "gripper")
    cameras = dict.fromkeys(source.camera for source in fields.values() if source.camera)
    return ObservationSpec(
        cameras=tuple(
            CameraSpec(
                camera=camera,
                width=size[0] if size else None,
                height=size[1] if size else None,
                resize=cast(Resize, chosen["resize"] if size else "none"),
                colour=cast(Literal["rgb", "bgr"], chosen["colour"]),
            )
            for camera in cameras
        ),
        state=tuple(part for part in order if part in parts),
        prompt=any(source.prompt for source in fields.values()),
    )


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


def read_size(text: str) -> tuple[int, int] | None:
    """Width and height of the option `size`; None: as the camera gives it.

    Raises:
        SpecError: it is neither 224x224 nor empty.
    """
    size = _SIZE.fullmatch(text)
    if text and size is None:
        raise SpecError(f"size is {text!r}, wanted WIDTHxHEIGHT, or nothing")
    return (int(size[1]), int(size[2])) if size else None


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


def read_map(text: str) -> dict[str, FieldSource | None]:
    """The option `map`; None: this name is left out.

    Raises:
        SpecError: it cannot be read; says what is allowed.
    """
    out: dict[str, FieldSource | None] = {}
    for entry in filter(None, (part.strip() for part in text.split(","))):
        theirs, equals, ours = (part.strip() for part in entry.partition("="))
        if not equals or not theirs:
            raise SpecError(f"map wants NAME=SOURCE, not {entry!r}")
        if theirs in out:
            raise SpecError(f"map names {theirs!r} twice")
        out[theirs] = _source(ours) if ours else None
    return out


def _source(text: str) -> FieldSource:
    kind, colon, rest = text.partition(":")
    if kind == "camera" and rest:
        return FieldSource(camera=rest)
    if kind == "blank" and (size := _SIZE.fullmatch(rest)):
        return FieldSource(blank=(int(size[1]), int(size[2])))
    if text == "prompt":
        return FieldSource(prompt=True)
    if colon:
        raise SpecError(f"a source is camera:NAME, blank:HxW, prompt or parts, not {text!r}")
    return FieldSource(parts=read_parts(text))
