"""Reads profile files: YAML, with ``extends`` and errors that name file, line and nearest name."""

from __future__ import annotations

import difflib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from vla_zenoh import resources
from vla_zenoh.errors import ProfileError, ResourceError
from vla_zenoh.profile.schema import Profile

MAX_PROFILE_BYTES = 1_000_000
MAX_EXTENDS = 8

Place = tuple[str, ...]
Lines = dict[Place, str]


def profile_names() -> list[str]:
    """Names of all profiles that can be found."""
    return resources.names("profiles")


def load_profile(name: str) -> Profile:
    """The effective profile called `name` (or at that path).

    Raises:
        ProfileError: every fault, each with file, line, path and what is allowed.
    """
    try:
        path = resources.find("profiles", name)
    except ResourceError as error:
        raise ProfileError(str(error)) from error
    data, lines = _read(path, seen=())
    data.setdefault("name", path.stem)
    try:
        return Profile.model_validate(data)
    except ValidationError as error:
        faults = [_explain(fault, lines, path) for fault in error.errors()]
        raise ProfileError("\n".join(faults)) from error


def to_yaml(profile: Profile) -> str:
    """The profile with every default written out."""
    data = profile.model_dump(mode="json", exclude_none=True)
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=100)


def _read(path: Path, seen: tuple[Path, ...]) -> tuple[dict[str, Any], Lines]:
    if path in seen or len(seen) >= MAX_EXTENDS:
        raise ProfileError(f"{path}: profiles extend each other in a circle or too deep")
    try:
        raw = path.read_bytes()
        if len(raw) > MAX_PROFILE_BYTES:
            raise ProfileError(f"{path}: {len(raw)} bytes, at most {MAX_PROFILE_BYTES} are read")
        node = yaml.compose(raw.decode("utf-8"), Loader=yaml.SafeLoader)
    except OSError as error:
        raise ProfileError(f"{path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ProfileError(f"{path} is not UTF-8 text: {error.reason}") from error
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise ProfileError(f"{path} is not valid YAML: {error}") from error
    lines: Lines = {}
    data = _plain(node, path, (), lines) if node is not None else {}
    if not isinstance(data, dict):
        raise ProfileError(f"{path}: a profile is a map of sections, this is a {type(data).__name__}")
    parent = data.pop("extends", None)
    if parent is None:
        return data, lines
    if not isinstance(parent, str):
        raise ProfileError(f"{lines.get(('extends',), path)}: extends wants the name of a profile")
    try:
        beside = path.parent / f"{parent}.yaml"
        parent_path = beside if beside.is_file() and beside != path else resources.find("profiles", parent)
    except ResourceError as error:
        raise ProfileError(f"{lines.get(('extends',), path)}: {error}") from error
    base, base_lines = _read(parent_path, (*seen, path))
    base.pop("name", None)
    return _merge(base, data), {**base_lines, **lines}


def _plain(node: yaml.Node, path: Path, place: Place, lines: Lines) -> Any:
    lines[place] = f"{path}:{node.start_mark.line + 1}"
    if len(place) > 32:
        raise ProfileError(f"{lines[place]}: nested too deep")
    if isinstance(node, yaml.MappingNode):
        out: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key = key_node.value if isinstance(key_node, yaml.ScalarNode) else None
            if key is None:
                raise ProfileError(f"{path}:{key_node.start_mark.line + 1}: a key must be a word")
            if key in out:
                raise ProfileError(
                    f"{path}:{key_node.start_mark.line + 1}: "
                    f"{'.'.join((*place, key))} is given twice"
                )
            out[key] = _plain(value_node, path, (*place, key), lines)
            lines[(*place, key)] = f"{path}:{key_node.start_mark.line + 1}"
        return out
    if isinstance(node, yaml.SequenceNode):
        return [
            _plain(item, path, (*place, str(index)), lines) for index, item in enumerate(node.value)
        ]
    try:
        return yaml.SafeLoader("").construct_object(node)  # a scalar: text, number, bool, null
    except (yaml.YAMLError, ValueError) as error:
        raise ProfileError(f"{lines[place]}: {error}") from error


def _merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`over` wins; sections are merged, but `hosts` and lists are replaced whole."""
    out = dict(base)
    for key, value in over.items():
        if key != "hosts" and isinstance(value, dict) and isinstance(out.get(key), dict):
            out[key] = _merge(out[key], value)
        else:
            out[key] = value
    return out


def _explain(fault: Any, lines: Lines, path: Path) -> str:
    place = tuple(str(part) for part in fault["loc"] if part != "[key]")
    known = place
    while known and known not in lines:
        known = known[:-1]
    where = lines.get(known, str(path))
    dotted = ".".join(place) or "profile"
    if fault["type"] == "extra_forbidden":
        allowed = _allowed(place[:-1])
        near = difflib.get_close_matches(place[-1], allowed, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        return f"{where}: unknown key {dotted}{hint} Known here: {', '.join(allowed)}"
    if fault["type"] == "missing":
        return f"{where}: {dotted} is missing"
    message = fault["msg"].removeprefix("Value error, ")
    given = fault.get("input")
    shown = "" if isinstance(given, (dict, BaseModel)) else f" (given: {given!r})"
    return f"{where}: {dotted}: {message}{shown}"


def _allowed(place: Place) -> list[str]:
    """Field names of the section at `place`."""
    model: Any = Profile
    for part in place:
        if isinstance(model, type) and issubclass(model, BaseModel):
            field = model.model_fields.get(part)
            model = field.annotation if field else None
        elif typing.get_origin(model) is dict:
            model = typing.get_args(model)[1]
        if typing.get_origin(model) in (typing.Union, types.UnionType):
            model = next((arg for arg in typing.get_args(model) if arg is not type(None)), None)
    if isinstance(model, type) and issubclass(model, BaseModel):
        return sorted(model.model_fields)
    if typing.get_origin(model) is dict:
        inner = typing.get_args(model)[1]
        return sorted(inner.model_fields) if isinstance(inner, type) else []
    return []
