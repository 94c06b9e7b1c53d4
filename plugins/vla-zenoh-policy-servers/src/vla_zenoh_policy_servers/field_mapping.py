"""Maps our observations to fields of an external policy server, and its answers to action steps.

The mapping is made of text options (``--set name=value``). A preset is a set of such options for a
known robot, each of which can be overridden; the preset ``none`` is empty::

    map        observation/image=camera:front, observation/state=position+rotvec+fingers_m,
               prompt=prompt; also NAME=blank:HxW (black), NAME= (leave it out of the preset)
    size       WIDTHxHEIGHT of every image, empty: as the camera gives it
    resize     none, stretch, pad, crop
    colour     rgb, bgr
    keys       names in the answer, concatenated column-wise (groot: x,y,z,...)
    columns    which of its columns, as 0:7 or 0,1,2,6

For the meaning of the numbers see `vla_zenoh_policy_servers.action_semantics`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import PeerError, SpecError
from vla_zenoh.policy import (
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
    StatePart,
)
from vla_zenoh.profile import Profile
from vla_zenoh.types import shown
from vla_zenoh_policy_servers.action_semantics import (
    ACTION_OPTIONS,
    ActionSemantics,
    as_spec_error,
    read_action_semantics,
)
from vla_zenoh_policy_servers.state_vector import (
    StateNumbers,
    parts_of,
    read_parts,
    state_numbers,
)


@dataclass(frozen=True, slots=True)
class FieldSource:
    """Content of one field of a request.

    Args:
        camera: image of this camera, or empty.
        parts: of the robot state, see `vla_zenoh_policy_servers.state_vector`.
        blank: height and width of a black image.
    """

    camera: str = ""
    parts: tuple[str, ...] = ()
    prompt: bool = False
    blank: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class FieldMapping:
    """Mapping between our records and one server, made by `read_field_mapping`.

    Args:
        fields: field of the request -> its content.
        spec: of the model, on our side.
        keys: names in the answer.
        columns: of the answer; None: all.
        states: field of the request -> the numbers of its state.
    """

    fields: Mapping[str, FieldSource]
    states: Mapping[str, StateNumbers]
    spec: ModelSpec
    keys: tuple[str, ...]
    columns: tuple[int, ...] | None
    semantics: ActionSemantics

    def wrong_columns(self, given: Any) -> list[str]:
        """Why an answer of `given` columns does not fit, if it is a number at all."""
        if not isinstance(given, int):
            return []
        if self.columns is not None:
            last = max(self.columns)
            return [f"it gives {given} columns, column {last} is wanted"] if last >= given else []
        wanted = sum(self.semantics.parts().values())
        if given == wanted:
            return []
        return [f"it gives {given} columns, {wanted} are wanted (columns=)"]

    # -- out ----------------------------------------------------------------------------------
    def request(self, observation: Observation) -> dict[str, Any]:
        """Fields of a request: images (H, W, 3) uint8, numbers (n,) float32 and text."""
        out: dict[str, Any] = {}
        for theirs, source in self.fields.items():
            if source.camera:
                out[theirs] = observation.images[source.camera]
            elif source.blank:
                out[theirs] = np.zeros((*source.blank, 3), np.uint8)
            elif source.prompt:
                out[theirs] = observation.prompt
            else:
                out[theirs] = self.states[theirs].encode(observation)
        return out

    # -- in -----------------------------------------------------------------------------------
    def gather(self, answer: Any) -> NDArray[np.float64]:
        """Numbers of an answer (H, C); the answer is an array, or a map of arrays under `keys`.

        Raises:
            PeerError: missing names, incompatible shapes, or a number that is not finite.
        """
        if isinstance(answer, Mapping):
            missing = [key for key in self.keys if key not in answer]
            if missing:
                raise PeerError(
                    "peer_reply",
                    f"the answer has no {', '.join(map(repr, missing))}; it has: "
                    + ", ".join(map(str, list(answer)[:20])),
                )
            parts = [_matrix(key, answer[key], len(self.keys) > 1) for key in self.keys]
        else:
            parts = [_matrix("actions", answer, False)]
        if len({len(part) for part in parts}) != 1:
            counts = ", ".join(f"{k} {len(p)}" for k, p in zip(self.keys, parts, strict=True))
            raise PeerError("peer_reply", f"parts of the answer differ in their steps: {counts}")
        rows = np.concatenate(parts, axis=1)
        if self.columns is not None:
            if max(self.columns) >= rows.shape[1]:
                raise PeerError(
                    "peer_reply",
                    f"the answer has {rows.shape[1]} columns, column {max(self.columns)} is wanted",
                )
            rows = rows[:, list(self.columns)]
        if len(rows) == 0:
            raise PeerError("peer_reply", "the answer has no steps")
        if not np.isfinite(rows).all():
            raise PeerError("peer_reply", "the answer holds NaN or infinity")
        return rows[: self.spec.action.horizon]

    def read(self, answer: Any) -> ActionSteps:
        """Action steps of an answer as `spec` declares them, with its first row as raw output.

        Raises:
            PeerError: see `gather`; also a wrong number of columns.
        """
        rows = self.gather(answer)
        try:
            return ActionSteps(self.semantics.steps(rows), raw={"first_step": rows[0].tolist()})
        except SpecError as error:
            hint = "; choose them with columns=" if error.reason == "shape" else ""
            raise PeerError("peer_reply", f"{error}{hint}") from error


def _matrix(name: str, value: Any, named: bool) -> NDArray[np.float64]:
    """(H, C); a batch of one is unpacked. A vector is a column if it is `named`, else a row."""
    try:
        array = np.asarray(value)
    except (ValueError, OverflowError, TypeError) as error:
        raise PeerError("peer_reply", f"{name} is not a table of numbers: {error}") from error
    if array.dtype.kind not in "iuf":
        raise PeerError("peer_reply", f"{name} is not numbers but {shown(value)}")
    if array.ndim == 3 and array.shape[0] == 1:
        array = array[0]
    if array.ndim == 1:
        array = array[:, None] if named else array[None]
    if array.ndim != 2:
        raise PeerError("peer_reply", f"{name} has shape {array.shape}, wanted (H, D)")
    return array.astype(np.float64)


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
"""The empty preset."""
_SIZE = re.compile(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})")
_SLICE = re.compile(r"([0-9]{1,4}):([0-9]{1,4})")
MAX_KEYS = 256


def read_field_mapping(
    name: str,
    presets: Mapping[str, Mapping[str, str]],
    preset: str,
    options: Mapping[str, str],
    *,
    profile: Profile,
    normalisation: str | None = None,
) -> FieldMapping:
    """The mapping that a preset and options define.

    Args:
        name: of the model, for its spec.
        presets: name -> options.
        options: of the user; they override the preset.
        profile: of the robot, one arm.
        normalisation: for the spec.

    Raises:
        SpecError: unknown or invalid option; names what is allowed.
    """
    presets = {**presets, NONE: {}}
    if preset not in presets:
        raise SpecError(
            f"preset is {preset!r}, allowed: {', '.join(presets)} (--set preset=...); "
            f"{NONE}: for a server of your own, with every option given"
        )
    unknown = [option for option in options if option not in DEFAULTS]
    if unknown:
        raise SpecError(f"no option {', '.join(map(repr, unknown))}; known: {', '.join(DEFAULTS)}")
    chosen = {**DEFAULTS, **presets[preset], **options}
    entries = {**read_map(presets[preset].get("map", "")), **read_map(options.get("map", ""))}
    fields = {theirs: source for theirs, source in entries.items() if source is not None}
    if not fields:
        raise SpecError("map is empty: give the content of each field of a request, as NAME=SOURCE")
    given = {name: value for name, value in options.items() if name in ACTION_OPTIONS}
    whose = f"preset {preset}"
    semantics = read_action_semantics(
        given,
        presets[preset],
        whose,
        joints=profile.robot.arm_joints,
        normalisation=normalisation,
    )
    with as_spec_error():
        observation = _observation(fields, chosen)
    return FieldMapping(
        fields=fields,
        states={
            theirs: state_numbers(source.parts, profile, semantics.state_units)
            for theirs, source in fields.items()
            if source.parts
        },
        spec=ModelSpec(name=name, observation=observation, action=semantics.spec),
        keys=_keys(chosen["keys"]),
        columns=read_columns(chosen["columns"]),
        semantics=semantics,
    )


def _observation(fields: Mapping[str, FieldSource], chosen: Mapping[str, str]) -> ObservationSpec:
    form: dict[str, Any] = {"colour": chosen["colour"]}
    if size := read_size(chosen["size"]):
        form |= {"width": size[0], "height": size[1], "resize": chosen["resize"]}
    parts = {part for source in fields.values() for part in parts_of(source.parts)}
    cameras = dict.fromkeys(source.camera for source in fields.values() if source.camera)
    return ObservationSpec(
        cameras=tuple(CameraSpec(camera=camera, **form) for camera in cameras),
        state=tuple(part for part in get_args(StatePart) if part in parts),
        prompt=any(source.prompt for source in fields.values()),
    )


def _keys(text: str) -> tuple[str, ...]:
    keys = tuple(key.strip() for key in text.split(","))
    if not all(keys) or len(set(keys)) != len(keys) or len(keys) > MAX_KEYS:
        raise SpecError(f"keys is {text!r}, wanted different names with a comma between them")
    return keys


def read_size(text: str) -> tuple[int, int] | None:
    """Width and height of the option ``size``; None: as the camera gives it.

    Raises:
        SpecError: not of the form 224x224.
    """
    size = _SIZE.fullmatch(text)
    if text and size is None:
        raise SpecError(f"size is {text!r}, wanted WIDTHxHEIGHT, or nothing")
    return (int(size[1]), int(size[2])) if size else None


def read_columns(text: str) -> tuple[int, ...] | None:
    """Columns of the option ``columns``; None: all of them.

    Raises:
        SpecError: not of the form 0:7 or 0,1,2.
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
    """Fields of the option ``map``; None: the field is left out.

    Raises:
        SpecError: invalid; says what is allowed.
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
