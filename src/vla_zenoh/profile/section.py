"""Base class and types of profile sections, and the messages of invalid ones."""

from __future__ import annotations

import types
import typing
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from vla_zenoh.errors import describe_fault, nearest
from vla_zenoh.keys import key_chunk
from vla_zenoh.profile.former import former
from vla_zenoh.types import MAX_TEXT, shown

Place = tuple[str, ...]
"""Keys from the top of the profile down to a value."""
Fault = tuple[Place, str] | tuple[Place, str, "Sequence[Place]"]
"""Where something is wrong, a sentence that continues ``PLACE: ``, and, if that contradicts other
places, those: the line that is named is the one that the loaded file itself has, because the file
that it extends may be right."""
Lines = dict[Place, str]
"""Place -> ``file:line``."""


class Section(BaseModel):
    """A section of a profile: frozen, without unknown keys, with finite numbers only.

    Strict: neither ``"5"`` nor ``true`` is a number. Lists become tuples.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)

    @classmethod
    def keys_here(cls) -> Mapping[str, Any]:
        """Keys that a file may have here -> the types of their values."""
        return {name: field.annotation for name, field in cls.model_fields.items()}

    def contradictions(self) -> Iterable[Fault]:
        """Values that are valid by themselves but contradict each other, for subclasses."""
        return ()

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if faults := tuple(self.contradictions()):
            raise InconsistentSections(faults)
        return self


class InconsistentSections(ValueError):
    """Contradictions of a section; places are below it."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        self.faults = tuple(faults)
        super().__init__("; ".join(f"{'.'.join(fault[0])} {fault[1]}" for fault in faults))


def _differ(values: tuple[Any, ...]) -> tuple[Any, ...]:
    twice = sorted({str(value) for value in values if values.count(value) > 1})
    if twice:
        raise ValueError(f"{', '.join(twice)}: given more than once")
    return values


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] >= pair[1]:
        raise ValueError(f"[{pair[0]:g}, {pair[1]:g}] is empty: give [smallest, largest]")
    return pair


Name = Annotated[str, AfterValidator(partial(key_chunk, what="name"))]
Text = Annotated[str, Field(max_length=MAX_TEXT)]
Word = Annotated[str, Field(min_length=1, max_length=512)]
Names = Annotated[tuple[Name, ...], Field(strict=False, max_length=128), AfterValidator(_differ)]
Words = Annotated[tuple[Word, ...], Field(strict=False, max_length=64), AfterValidator(_differ)]
Range = Annotated[tuple[float, float], Field(strict=False), AfterValidator(_ordered)]
Vector3 = Annotated[tuple[float, float, float], Field(strict=False)]
REACH_M = 3.0
"""No table-top arm reaches further: larger lengths are in other units."""
Coordinate = Annotated[float, Field(ge=-REACH_M, le=REACH_M)]
Point = Annotated[tuple[Coordinate, Coordinate, Coordinate], Field(strict=False)]
Angle = Annotated[float, Field(ge=-6.3, le=6.3)]
"""A turn to either side at most: more is in degrees."""
Angles = Annotated[tuple[Angle, Angle, Angle], Field(strict=False)]
Distinct = AfterValidator(_differ)

REPLACED_WHOLE = {("hosts",)}
WITH_REMOVABLE = {("cameras",), ("ros2", "cameras"), ("models",), ("serves",), ("options",)}
"""Maps of which null removes an inherited entry; null in place of the map: all of them."""
NOT_MADE = {"depth": "depth images are published where depth_unit_m is set."}
"""Key that looks like a slip of another one but asks for more than exists -> what there is."""
_NO_VALUE_SHOWN = {"missing", "extra_forbidden", "too_long", "too_short", "value_error"}


def merge(
    base: Mapping[str, Any], base_lines: Lines, over: Mapping[str, Any], lines: Lines, at: Place
) -> tuple[dict[str, Any], Lines]:
    """Merge sections at `at`; `over` wins. Lists and hosts are replaced whole, null removes."""
    out, out_lines = dict(base), {**base_lines}
    if at in lines:
        out_lines[at] = lines[at]
    for key, value in over.items():
        place, inherited = (*at, key), out.get(key)
        merged = isinstance(value, Mapping) and place not in REPLACED_WHOLE
        if merged and isinstance(inherited, Mapping):
            out[key], out_lines = merge(inherited, out_lines, value, lines, place)
            continue
        if value is None and at in WITH_REMOVABLE and key in out:
            del out[key]
        else:
            out[key] = value
        # The lines at and below it are those of the file that replaced it.
        depth = len(place)
        out_lines = {known: line for known, line in out_lines.items() if known[:depth] != place}
        out_lines |= {known: line for known, line in lines.items() if known[:depth] == place}
    return out, out_lines


def explain(error: ValidationError, lines: Lines, model: type[Section]) -> list[str]:
    """One line for each fault: file, line, path, what is wrong and what is allowed."""
    lines_out: list[str] = []
    for fault in error.errors(include_url=False):
        place = tuple(str(part) for part in fault["loc"] if part != "[key]")
        cause = fault.get("ctx", {}).get("error")
        if isinstance(cause, InconsistentSections):
            lines_out += [located_fault(fault, lines, place) for fault in cause.faults]
        else:
            lines_out.append(located(place, _why(fault, place, model), lines))
    return lines_out


def located(place: Place, why: str, lines: Lines) -> str:
    """Sentence about a place, with file and line where they are known."""
    name = ".".join(place) or "the profile"
    where = _line_of(place, lines)
    return f"{where}: {name}: {why}" if where else f"{name}: {why}"


def located_fault(fault: Fault, lines: Lines, above: Place = ()) -> str:
    """Sentence about a fault, with the line of the first of its places in the loaded file."""
    below, why, *others = fault
    place = (*above, *below)
    own, line = _file(lines.get((), "")), _line_of(place, lines)
    if others and _file(line) != own:
        for other in others[0]:
            given = lines.get(other, "")
            if _file(given) == own:
                return f"{given}: {'.'.join(place)} ({line}): {why}"
    return located(place, why, lines)


def _line_of(place: Place, lines: Lines) -> str:
    """``file:line`` of a value, or of what it is in; empty if unknown."""
    while place not in lines and place:
        place = place[:-1]
    return lines.get(place, "")


def _file(where: str) -> str:
    return where.rpartition(":")[0]


def unlisted(
    place: Place, named: Iterable[str], section: str, known: Collection[str]
) -> Iterator[Fault]:
    """Faults of names at `place` that `section` does not list; of a map each entry's."""
    listed = ", ".join(known) or "none"
    for name in named:
        if name in known:
            continue
        at, remedy = place, ""
        if isinstance(named, Mapping):
            at = (*place, name)
            remedy = f". To remove it: {': {'.join(at)}: null{'}' * len(place)}"
        near = nearest(name, known) or "."
        why = f"{name!r} is not among {section}{near} Known: {listed}{remedy}"
        yield at, why, ((section, name), (section,))


def _why(fault: Any, place: Place, model: type[Section]) -> str:
    words, given = describe_fault(fault), fault.get("input")
    if remedy := former(place):
        return remedy
    if fault["type"] == "extra_forbidden":
        allowed = field_names(model, place[:-1])
        near = nearest(place[-1], allowed)
        return f"{NOT_MADE.get(place[-1], f'unknown key{near}')} Known here: {', '.join(allowed)}"
    if fault["type"] == "missing" and place == ("robot",):
        return "is missing: describe the robot, or start from another profile: extends: NAME"
    if fault["type"] == "missing" and place[-1].isdigit():
        return "is missing: the list is too short"
    if fault["type"] in ("dict_type", "model_type"):
        names = field_names(model, place)
        words = f"wants a map of: {', '.join(names)}" if names else words
        if given is None:
            words = f"is empty: {words}, or leave it out"
    if fault["type"] == "string_type" and isinstance(given, (bool, int, float)):
        words = "wants text; put it in quotes"
    if fault["type"] in _NO_VALUE_SHOWN or isinstance(given, (dict, BaseModel)):
        return words
    return f"{words} (given: {shown(given)})"


def field_names(model: Any, place: Place) -> list[str]:
    """Fields of the section at `place`; empty if its keys are free, or it is no section."""
    for part in place:
        if _is_section(model):
            model = _keys_here(model).get(part)
        elif typing.get_origin(model) is dict:
            model = typing.get_args(model)[1]
        else:
            model = None
        if typing.get_origin(model) in (typing.Union, types.UnionType):
            model = next((arg for arg in typing.get_args(model) if _is_section(arg)), None)
    return sorted(_keys_here(model)) if _is_section(model) else []


def _keys_here(model: type[BaseModel]) -> Mapping[str, Any]:
    if issubclass(model, Section):
        return model.keys_here()
    return {name: field.annotation for name, field in model.model_fields.items()}


def _is_section(model: Any) -> bool:
    return isinstance(model, type) and issubclass(model, BaseModel)
