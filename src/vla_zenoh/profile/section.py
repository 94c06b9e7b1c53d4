"""Base class and types of profile sections, and the messages of invalid ones."""

from __future__ import annotations

import types
import typing
from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from vla_zenoh import keys
from vla_zenoh.errors import ProfileError, describe_fault, nearest
from vla_zenoh.types import MAX_TEXT, shown

Place = tuple[str, ...]
"""Keys from the top of the profile down to a value."""
Fault = tuple[Place, str]
"""Where something is wrong, and a sentence that continues ``PLACE: ``."""
Lines = dict[Place, str]
"""Place -> ``file:line``."""


class Section(BaseModel):
    """A section of a profile: frozen, without unknown keys, with finite numbers only.

    Strict: neither ``"5"`` nor ``true`` is a number. Lists become tuples.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


class InconsistentSections(ValueError):
    """Values that are valid by themselves but contradict each other.

    Args:
        faults: (place below the section that raises this, sentence).
    """

    def __init__(self, faults: Sequence[Fault]) -> None:
        self.faults = tuple(faults)
        super().__init__("; ".join(f"{'.'.join(place)} {why}" for place, why in faults))


def reject(faults: Sequence[Fault]) -> None:
    """Raise `InconsistentSections` if there are faults."""
    if faults:
        raise InconsistentSections(faults)


def _key_part(value: str) -> str:
    try:
        return keys.key_chunk(value, "name")
    except ProfileError as error:
        raise ValueError(str(error)) from error


def _differ(values: tuple[Any, ...]) -> tuple[Any, ...]:
    twice = sorted({str(value) for value in values if values.count(value) > 1})
    if twice:
        raise ValueError(f"{', '.join(twice)}: given more than once")
    return values


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] >= pair[1]:
        raise ValueError(f"[{pair[0]:g}, {pair[1]:g}] is empty: give [smallest, largest]")
    return pair


Name = Annotated[str, AfterValidator(_key_part)]
Text = Annotated[str, Field(max_length=MAX_TEXT)]
Word = Annotated[str, Field(min_length=1, max_length=512)]
Names = Annotated[tuple[Name, ...], Field(strict=False, max_length=64), AfterValidator(_differ)]
Words = Annotated[tuple[Word, ...], Field(strict=False, max_length=64), AfterValidator(_differ)]
Range = Annotated[tuple[float, float], Field(strict=False), AfterValidator(_ordered)]
Distinct = AfterValidator(_differ)


_NO_VALUE_SHOWN = {"missing", "extra_forbidden", "too_long", "too_short", "value_error"}


def explain(error: ValidationError, lines: Lines, model: type[Section]) -> list[str]:
    """One line for each fault: file, line, path, what is wrong and what is allowed."""
    lines_out: list[str] = []
    for fault in error.errors(include_url=False):
        place = tuple(str(part) for part in fault["loc"] if part != "[key]")
        cause = fault.get("ctx", {}).get("error")
        if isinstance(cause, InconsistentSections):
            lines_out += [_line((*place, *below), why, lines) for below, why in cause.faults]
        else:
            lines_out.append(_line(place, _why(fault, place, model), lines))
    return lines_out


def _line(place: Place, why: str, lines: Lines) -> str:
    known = place
    while known not in lines and known:
        known = known[:-1]
    name = ".".join(place) or "the profile"
    where = lines.get(known)
    return f"{where}: {name}: {why}" if where else f"{name}: {why}"


def _why(fault: Any, place: Place, model: type[Section]) -> str:
    words, given = describe_fault(fault), fault.get("input")
    if fault["type"] == "extra_forbidden":
        allowed = field_names(model, place[:-1])
        return f"unknown key{nearest(place[-1], allowed)} Known here: {', '.join(allowed)}"
    if fault["type"] == "missing" and place == ("robot",):
        return "is missing: describe the robot, or start from another profile: extends: NAME"
    if fault["type"] == "missing" and place[-1].isdigit():
        return "is missing: the list is too short"
    if fault["type"] in ("dict_type", "model_type"):
        names = field_names(model, place)
        words = f"wants a map of: {', '.join(names)}" if names else words
    if fault["type"] == "string_type" and isinstance(given, (bool, int, float)):
        words = "wants text; put it in quotes"
    if fault["type"] in _NO_VALUE_SHOWN or isinstance(given, (dict, BaseModel)):
        return words
    return f"{words} (given: {shown(given)})"


def field_names(model: Any, place: Place) -> list[str]:
    """Fields of the section at `place`; empty if its keys are free, or it is no section."""
    for part in place:
        if _is_section(model):
            field = model.model_fields.get(part)
            model = field.annotation if field else None
        elif typing.get_origin(model) is dict:
            model = typing.get_args(model)[1]
        else:
            model = None
        if typing.get_origin(model) in (typing.Union, types.UnionType):
            model = next((arg for arg in typing.get_args(model) if _is_section(arg)), None)
    return sorted(model.model_fields) if _is_section(model) else []


def _is_section(model: Any) -> bool:
    return isinstance(model, type) and issubclass(model, BaseModel)
