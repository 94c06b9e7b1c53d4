"""Faults of a profile as sentences that name file, line, path and the nearest valid name."""

from __future__ import annotations

import types
import typing
from typing import Any

from pydantic import BaseModel, ValidationError

from vla_zenoh.profile.profile import Profile
from vla_zenoh.profile.section import Misfit, Place
from vla_zenoh.profile.yaml_text import Lines
from vla_zenoh.pydantic_errors import describe_fault, nearest
from vla_zenoh.types import shown

_NO_VALUE_SHOWN = {"missing", "extra_forbidden", "too_long", "too_short", "value_error"}


def explain(error: ValidationError, lines: Lines) -> list[str]:
    """One line for each fault."""
    said: list[str] = []
    for fault in error.errors(include_url=False):
        place = tuple(str(part) for part in fault["loc"] if part != "[key]")
        cause = fault.get("ctx", {}).get("error")
        if isinstance(cause, Misfit):
            said += [_line((*place, *below), why, lines) for below, why in cause.faults]
        else:
            said.append(_line(place, _why(fault, place), lines))
    return said


def _line(place: Place, why: str, lines: Lines) -> str:
    known = place
    while known not in lines and known:
        known = known[:-1]
    name = ".".join(place) or "the profile"
    where = lines.get(known)
    return f"{where}: {name}: {why}" if where else f"{name}: {why}"


def _why(fault: Any, place: Place) -> str:
    words, given = describe_fault(fault), fault.get("input")
    if fault["type"] == "extra_forbidden":
        allowed = field_names(place[:-1])
        return f"unknown key{nearest(place[-1], allowed)} Known here: {', '.join(allowed)}"
    if fault["type"] == "missing" and place == ("robot",):
        return "is missing: describe the robot, or begin with another profile: extends: NAME"
    if fault["type"] == "missing" and place[-1].isdigit():
        return "is missing: the list is too short"
    if fault["type"] in ("dict_type", "model_type"):
        names = field_names(place)
        words = f"wants a map of: {', '.join(names)}" if names else words
    if fault["type"] == "string_type" and isinstance(given, (bool, int, float)):
        words = "wants text; put it in quotes"
    if fault["type"] in _NO_VALUE_SHOWN or isinstance(given, (dict, BaseModel)):
        return words
    return f"{words} (given: {shown(given)})"


def field_names(place: Place) -> list[str]:
    """What the section at `place` may hold; empty where that is free or not a section."""
    model: Any = Profile
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
