"""Loads profiles: finds their files, resolves ``extends``, and validates the result."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from vla_zenoh import resources
from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import yaml_text
from vla_zenoh.profile.profile import Profile
from vla_zenoh.profile.section import Lines, Place, explain
from vla_zenoh.resources import ROBOT_DATA_PREFIX, extended_profile, is_path, profile_file

MAX_EXTENDS = 8
REPLACED_WHOLE = {("hosts",)}
WITH_REMOVABLE = {("cameras",), ("ros2", "cameras"), ("models",), ("serves",), ("options",)}
"""Maps of which null removes an inherited entry; null in place of the map: all of them."""


def profile_names() -> list[str]:
    """Names of all profiles on the search path."""
    return resources.names("profiles")


def load_profile(name: str) -> Profile:
    """The effective profile `name`, which may be a path.

    Raises:
        ProfileError: every fault, each with file, line, path and what is allowed.
    """
    return load_with_lines(name)[0]


def load_with_lines(name: str) -> tuple[Profile, Lines]:
    """The effective profile `name`, and where each value comes from; see `load_profile`."""
    path = profile_file(name)
    data, lines = _read(path, ())
    data.setdefault("name", path.stem)
    return _checked(data, lines), lines


def followed(name: str) -> list[tuple[Path, str]]:
    """Files of a profile along ``extends``, each with its name in the previous one.

    Args:
        name: of a valid profile, or its path.
    """
    out = [(profile_file(name), name)]
    while True:
        path = out[-1][0]
        parent = yaml_text.read(_bytes(path), str(path))[0].get("extends")
        if not isinstance(parent, str):
            return out
        out.append((extended_profile(path, parent), parent))


def read_profile(text: str, where: str) -> Profile:
    """Parse a profile that `to_yaml` wrote.

    Args:
        text: YAML without ``extends``.
        where: origin, for messages.

    Raises:
        ProfileError: every fault, each with `where`, line, path and what is allowed.
    """
    data, lines = yaml_text.read(text.encode(), where)
    return _checked(data, lines)


def override(profile: Profile, changes: Mapping[str, Any]) -> Profile:
    """A copy of `profile` with some values replaced, validated.

    Args:
        profile: the original.
        changes: as in a profile file: ``{"session": {"connect": [...]}}``.

    Raises:
        ProfileError: the result is invalid.
    """
    data, _ = _merge(profile.model_dump(), {}, changes, {}, ())
    return _checked(data, {})


def as_robot(profile: Profile, name: str) -> Profile:
    """The profile of another robot of the same kind.

    A worker of several robots serves it only if its list in ``serves`` contains it.

    Raises:
        ProfileError: invalid name.
    """
    others = [worker for worker, robots in profile.serves.items() if name not in robots]
    return override(profile, {"robot": {"name": name}, "serves": dict.fromkeys(others)})


def to_yaml(profile: Profile) -> str:
    """The profile with every default written out; `read_profile` restores it."""
    return yaml_text.write(profile.model_dump(mode="json", exclude_none=True))


def _checked(data: Mapping[str, Any], lines: Lines) -> Profile:
    empty = {place[0] for place in WITH_REMOVABLE if len(place) == 1}
    given = {key: value for key, value in data.items() if value is not None or key not in empty}
    try:
        return Profile.model_validate(given)
    except ValidationError as error:
        raise ProfileError("\n".join(explain(error, lines, Profile))) from error


def _read(path: Path, seen: tuple[Path, ...]) -> tuple[dict[str, Any], Lines]:
    if path.resolve() in seen or len(seen) >= MAX_EXTENDS:
        way = " -> ".join(str(p) for p in (*seen, path))
        raise ProfileError(f"{path}:1: profiles extend each other in a circle or too deep: {way}")
    data, lines = yaml_text.read(_bytes(path), str(path))
    anchor(data, path.parent)
    if "extends" not in data:
        return data, lines
    where, parent = lines["extends",], data.pop("extends")
    if not isinstance(parent, str) or not parent:
        raise ProfileError(f"{where}: extends: wants the name of one profile")
    try:
        parent_path = extended_profile(path, parent)
    except ProfileError as error:
        raise ProfileError(f"{where}: extends: {error}") from error
    base, base_lines = _read(parent_path, (*seen, path.resolve()))
    base.pop("name", None)
    return _merge(base, base_lines, data, lines, ())


def _bytes(path: Path) -> bytes:
    try:
        if not path.is_file():
            raise ProfileError(f"{path} is not a file")
        with path.open("rb") as file:
            return file.read(yaml_text.MAX_PROFILE_BYTES + 1)
    except OSError as error:
        raise ProfileError(f"{path} cannot be read: {error.strerror}") from error


def _merge(
    base: Mapping[str, Any], base_lines: Lines, over: Mapping[str, Any], lines: Lines, at: Place
) -> tuple[dict[str, Any], Lines]:
    """Merge sections; `over` wins. Lists and hosts are replaced as a whole, null removes."""
    out, out_lines = dict(base), {**base_lines}
    if at in lines:
        out_lines[at] = lines[at]
    for key, value in over.items():
        place, inherited = (*at, key), out.get(key)
        merged = isinstance(value, Mapping) and place not in REPLACED_WHOLE
        if merged and isinstance(inherited, Mapping):
            out[key], out_lines = _merge(inherited, out_lines, value, lines, place)
            continue
        if value is None and at in WITH_REMOVABLE and key in out:
            del out[key]
        else:
            out[key] = value
        _move(place, lines, out_lines)
    return out, out_lines


def _move(place: Place, lines: Lines, out: Lines) -> None:
    """Take the lines at and below `place` from the file that replaced it."""
    depth = len(place)
    for known in [known for known in out if known[:depth] == place]:
        del out[known]
    out.update({known: line for known, line in lines.items() if known[:depth] == place})


FILE_SOURCE = "file:"
BESIDE = ("./", "../")


def anchor(data: dict[str, Any], folder: Path) -> None:
    """Make relative paths in `data` absolute, in place.

    Args:
        data: of a profile file, not validated yet.
        folder: of that file.
    """
    for section, name, prefix in list(paths_in(data)):
        section[name] = prefix + below(folder, section[name].removeprefix(prefix))


def paths_in(data: dict[str, Any]) -> Iterator[tuple[dict[str, Any], str, str]]:
    """Paths of files in `data`: (section, key, prefix of the path in the value).

    These are ``robot.description`` and that of parts, ``arm.file``, ``ros2.messages.*``, paths in
    ``models.*``, ``cameras.*.source`` of the form ``file:PATH``, ``cameras.*.intrinsics``,
    ``cameras.*.check.reference``, and options of models and of the arm that start with ``./`` or
    ``../``: for any other text only the model knows whether it is a path.
    """
    robot, arm, ros2 = (_map(data.get(name)) for name in ("robot", "arm", "ros2"))
    description = robot.get("description")
    if isinstance(description, str) and not description.startswith(ROBOT_DATA_PREFIX):
        yield robot, "description", ""
    for part in map(_map, _map(data.get("parts")).values()):
        described = _map(part.get("robot"))
        description = described.get("description")
        if isinstance(description, str) and not description.startswith(ROBOT_DATA_PREFIX):
            yield described, "description", ""
    for camera in map(_map, _map(data.get("cameras")).values()):
        source = camera.get("source")
        if isinstance(source, str) and source.startswith(FILE_SOURCE):
            yield camera, "source", FILE_SOURCE
        if isinstance(camera.get("intrinsics"), str):
            yield camera, "intrinsics", ""
        if isinstance(_map(camera.get("check")).get("reference"), str):
            yield _map(camera["check"]), "reference", ""
    if isinstance(arm.get("file"), str):
        yield arm, "file", ""
    models, messages = _map(data.get("models")), _map(ros2.get("messages"))
    for name, model in models.items():
        if isinstance(model, str) and is_path(model):
            yield models, name, ""
    for name, path in messages.items():
        if isinstance(path, str):
            yield messages, name, ""
    for options in (*_map(data.get("options")).values(), arm.get("options")):
        for name, value in _map(options).items():
            if isinstance(value, str) and (value in (".", "..") or value.startswith(BESIDE)):
                yield _map(options), name, ""


def below(folder: Path, path: str) -> str:
    """`path` relative to `folder`, absolute."""
    # An empty path is rejected later; ~ is the home of the user who loads the profile.
    if not path or path.startswith("~"):
        return path
    return os.path.normpath(folder.absolute() / path)


def _map(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
