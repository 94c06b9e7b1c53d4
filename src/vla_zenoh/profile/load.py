"""Loads profiles: finds their files, resolves ``extends``, and validates the result."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import yaml_text
from vla_zenoh.profile.profile import Profile
from vla_zenoh.profile.schema import PATH_SOURCES
from vla_zenoh.profile.section import WITH_REMOVABLE, Lines, explain, merge
from vla_zenoh.resources import ROBOT_DATA_PREFIX, extended_profile, is_path, profile_file

MAX_EXTENDS = 8


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
    """Files of a valid profile along ``extends``, each with its name in the previous one."""
    path, parent = profile_file(name), name
    out: list[tuple[Path, str]] = []
    while isinstance(parent, str):
        path = extended_profile(path, parent) if out else path
        out.append((path, parent))
        parent = yaml_text.read(_bytes(path), str(path))[0].get("extends")
    return out


def read_profile(text: str, where: str) -> Profile:
    """Parse a profile that `to_yaml` wrote; a `ProfileError` names its origin, `where`."""
    data, lines = yaml_text.read(text.encode(), where)
    return _checked(data, lines)


def override(profile: Profile, changes: Mapping[str, Any]) -> Profile:
    """A copy of `profile` with `changes`, as in a profile file: ``{"session": {...}}``.

    Raises:
        ProfileError: the result is invalid.
    """
    data, _ = merge(profile.model_dump(), {}, changes, {}, ())
    return _checked(data, {})


def as_robot(profile: Profile, name: str) -> Profile:
    """The profile of another robot of the same kind, or a `ProfileError`: an invalid name.

    A worker of several robots serves it only if its list in ``serves`` contains it.
    """
    others = [worker for worker, robots in profile.serves.items() if name not in robots]
    return override(profile, {"robot": {"name": name}, "serves": dict.fromkeys(others)})


def to_yaml(profile: Profile) -> str:
    """The profile with every default written out; `read_profile` restores it."""
    return yaml_text.write(profile.model_dump(mode="json", exclude_none=True))


def _checked(data: Mapping[str, Any], lines: Lines) -> Profile:
    given = {key: v for key, v in data.items() if v is not None or (key,) not in WITH_REMOVABLE}
    try:
        return Profile.model_validate(given)
    except ValidationError as error:
        raise ProfileError("\n".join(explain(error, lines, Profile))) from error


def _read(path: Path, seen: tuple[Path, ...]) -> tuple[dict[str, Any], Lines]:
    if path.resolve() in seen or len(seen) >= MAX_EXTENDS:
        way = " -> ".join(str(p) for p in (*seen, path))
        raise ProfileError(f"{path}:1: profiles extend each other in a circle or too deep: {way}")
    data, lines = yaml_text.read(_bytes(path), str(path))
    for section, name, prefix in list(paths_in(data)):
        section[name] = prefix + below(path.parent, section[name].removeprefix(prefix))
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
    return merge(base, base_lines, data, lines, ())


def _bytes(path: Path) -> bytes:
    try:
        if not path.is_file():
            raise ProfileError(f"{path} is not a file")
        with path.open("rb") as file:
            return file.read(yaml_text.MAX_PROFILE_BYTES + 1)
    except OSError as error:
        raise ProfileError(f"{path} cannot be read: {error.strerror}") from error


PATHS: Mapping[str, Callable[[str], bool]] = {
    "robot.description": lambda text: not text.startswith(ROBOT_DATA_PREFIX),
    "parts.*.robot.description": lambda text: not text.startswith(ROBOT_DATA_PREFIX),
    "cameras.*.source": lambda text: text.startswith(PATH_SOURCES),
    "cameras.*.intrinsics": lambda text: True,
    "cameras.*.check.reference": lambda text: True,
    "arm.file": lambda text: True,
    "models.*": is_path,
    "ros2.messages.*": lambda text: True,
    # Of any other text only the model, or the arm, knows whether it is a path.
    "options.*.*": lambda text: text in (".", "..") or text.startswith(("./", "../")),
    "arm.options.*": lambda text: text in (".", "..") or text.startswith(("./", "../")),
}
"""Place of texts in a profile, ``*`` for any name -> whether a text there is the path of a file."""


def paths_in(data: dict[str, Any]) -> Iterator[tuple[dict[str, Any], str, str]]:
    """Paths of files in `data`: (section, key, prefix of the path in the value)."""
    for place, names_file in PATHS.items():
        *above, last = place.split(".")
        sections: list[dict[str, Any]] = [data]
        for key in above:
            inside = [each.values() if key == "*" else [each.get(key)] for each in sections]
            sections = [each for each in chain(*inside) if isinstance(each, dict)]
        for section in sections:
            for name in list(section) if last == "*" else [last]:
                text = section.get(name)
                if isinstance(text, str) and names_file(text):
                    yield section, name, text[: text.index(":") + 1] if last == "source" else ""


def below(folder: Path, path: str) -> str:
    """`path` relative to `folder`, absolute."""
    # An empty path is rejected later; ~ is the home of the user who loads the profile.
    if not path or path.startswith("~"):
        return path
    return os.path.normpath(folder.absolute() / path)
