"""Loads profiles: finds their files, reads YAML, resolves ``extends``, and validates the result."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import ValidationError

from vla_zenoh import plugins
from vla_zenoh.errors import PluginError, ProfileError
from vla_zenoh.profile.profile import Profile
from vla_zenoh.profile.schema import names_file
from vla_zenoh.profile.section import WITH_REMOVABLE, Lines, Place, Section, explain, merge
from vla_zenoh.resources import PACKAGED, extended_profile, is_path, profile_file
from vla_zenoh.types import shown

MAX_EXTENDS = 8
MAX_PROFILE_BYTES = 100_000
MAX_NODES = 5_000
"""Values in a file after the expansion of aliases."""
MAX_DEPTH = 32

_PREFIX = "tag:yaml.org,2002:"
_SCALARS = {
    f"{_PREFIX}null": re.compile(r"(?:~|null|Null|NULL)?"),
    f"{_PREFIX}bool": re.compile(r"true|True|TRUE|false|False|FALSE"),
    f"{_PREFIX}int": re.compile(r"[-+]?[0-9]+"),
    f"{_PREFIX}float": re.compile(
        r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
    ),
}
_SPECIAL = re.compile("[\x85\u2028\u2029\ufeff]")


def load_profile(name: str) -> Profile:
    """The effective profile `name`, which may be a path.

    Raises:
        ProfileError: every fault, each with file, line, path and what is allowed.
    """
    return load_with_lines(name)[0]


def load_with_lines(name: str) -> tuple[Profile, Lines]:
    """The effective profile `name`, and where each value comes from; see `load_profile`."""
    path = profile_file(name)
    data, lines = read_file(path)
    data.setdefault("name", path.stem)
    return _checked(data, lines), lines


def read_file(path: Path, changes: Mapping[str, Any] | None = None) -> tuple[dict[str, Any], Lines]:
    """A file with what it extends and `changes`, and where each value comes from; not checked.

    Raises:
        ProfileError: it cannot be read.
    """
    data, lines = _read(path, ())
    return merge(data, lines, changes or {}, {}, ())


def followed(name: str) -> list[tuple[Path, str]]:
    """Files of a valid profile along ``extends``, each with its name in the previous one."""
    path, parent = profile_file(name), name
    out: list[tuple[Path, str]] = []
    while isinstance(parent, str):
        path = extended_profile(path, parent) if out else path
        out.append((path, parent))
        parent = read_yaml(_bytes(path), str(path))[0].get("extends")
    return out


def read_profile(text: str, where: str) -> Profile:
    """Parse a profile that `to_yaml` wrote; a `ProfileError` names its origin, `where`."""
    data, lines = read_yaml(text.encode(), where)
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


def simulated(profile: Profile) -> Profile:
    """The profile with a simulated robot and cameras in place of the real ones.

    Raises:
        ProfileError: the result is invalid.
    """
    if profile.robot.driver == "sim":
        return profile
    data = profile.model_dump()
    data["ros2"] = None
    data["robot"]["driver"] = "sim"
    views = {name: "wrist" if "wrist" in name else "front" for name in profile.cameras}
    data["cameras"] = {name: {"source": f"sim:{view}"} for name, view in views.items()}
    hosts = data["hosts"].values()
    serves = any("camera" in host["nodes"] for host in hosts)
    for host in hosts:
        kinds = ["sim" if kind in ("arm", "ros2") else kind for kind in host["nodes"]]
        if "sim" in kinds and views and not serves:
            kinds.append("camera")
        host["nodes"] = list(dict.fromkeys(kinds))
    return _checked(data, {})


def to_yaml(profile: Profile) -> str:
    """The profile with every default written out; `read_profile` restores it."""
    return write_yaml(profile.model_dump(mode="json", exclude_none=True))


def _checked(data: Mapping[str, Any], lines: Lines) -> Profile:
    given = {key: v for key, v in data.items() if v is not None or (key,) not in WITH_REMOVABLE}
    return checked(Profile, given, lines)


Checked = TypeVar("Checked", bound=Section)


def checked(model: type[Checked], data: Mapping[str, Any], lines: Lines) -> Checked:
    """`data` as a section. Raises ProfileError: every fault, with its line."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ProfileError("\n".join(explain(error, lines, model))) from error


def _read(path: Path, seen: tuple[Path, ...]) -> tuple[dict[str, Any], Lines]:
    if path.resolve() in seen or len(seen) >= MAX_EXTENDS:
        way = " -> ".join(str(p) for p in (*seen, path))
        raise ProfileError(f"{path}:1: profiles extend each other in a circle or too deep: {way}")
    data, lines = read_yaml(_bytes(path), str(path))
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
            return file.read(MAX_PROFILE_BYTES + 1)
    except OSError as error:
        raise ProfileError(f"{path} cannot be read: {error.strerror}") from error


def is_relative(text: str) -> bool:
    """Whether an option is clearly the path of a file."""
    return text in (".", "..") or text.startswith(("./", "../"))


PATHS: Mapping[str, Callable[[str], bool]] = {
    "robot.description": lambda text: not text.startswith(PACKAGED),
    "parts.*.robot.description": lambda text: not text.startswith(PACKAGED),
    "cameras.*.source": names_file,
    "cameras.*.intrinsics": lambda text: True,
    "cameras.*.check.reference": lambda text: True,
    "models.*": is_path,
    "ros2.messages.*": lambda text: True,
    # Of any other text only the model knows whether it is a path.
    "options.*.*": is_relative,
}
"""Place of texts in a profile, ``*`` for any name -> whether a text there is the path of a file."""


def paths_in(data: dict[str, Any]) -> Iterator[tuple[dict[str, Any], str, str]]:
    """Paths of files in `data`: (section, key, prefix of the path in the value)."""
    for place, is_file in PATHS.items():
        *above, last = place.split(".")
        sections: list[dict[str, Any]] = [data]
        for key in above:
            inside = [each.values() if key == "*" else [each.get(key)] for each in sections]
            sections = [each for each in chain(*inside) if isinstance(each, dict)]
        for section in sections:
            for name in list(section) if last == "*" else [last]:
                text = section.get(name)
                if isinstance(text, str) and is_file(text):
                    yield section, name, text[: text.index(":") + 1] if last == "source" else ""
    for name in data.keys() - Profile.model_fields.keys():
        if isinstance(data[name], dict):
            yield from _paths_of_driver(name, data[name])


def _paths_of_driver(
    driver: str, options: dict[str, Any]
) -> Iterator[tuple[dict[str, Any], str, str]]:
    """Paths in the section of a robot driver: declared by its plug-in, or clearly relative."""
    try:
        named = plugins.load(plugins.ROBOTS, driver).paths
    except PluginError:  # reported when the whole profile is checked
        named = ()
    waiting = [options]
    while waiting:
        section = waiting.pop()
        for name, value in section.items():
            if isinstance(value, dict):
                waiting.append(value)
            declared = section is options and name in named
            if isinstance(value, str) and (declared or is_relative(value)):
                yield section, name, ""


def below(folder: Path, path: str) -> str:
    """`path` relative to `folder`, absolute."""
    # An empty path is rejected later; ~ is the home of the user who loads the profile.
    if not path or path.startswith("~"):
        return path
    return os.path.normpath(folder.absolute() / path)


# -- YAML -----------------------------------------------------------------------------------------
class _Reader(yaml.SafeLoader):
    yaml_implicit_resolvers = {}  # noqa: RUF012 - PyYAML's own form


class _Writer(yaml.SafeDumper):
    """Quotes text that this reader or a YAML 1.1 one would parse as another type."""


def _text(writer: _Writer, text: str) -> yaml.ScalarNode:
    # Unicode line ends are lost unless they are escaped.
    style = '"' if _SPECIAL.search(text) else None
    return writer.represent_scalar(f"{_PREFIX}str", text, style)


_Writer.add_representer(str, _text)
for _tag, _form in _SCALARS.items():
    _whole = re.compile(f"(?:{_form.pattern})\\Z")
    _Reader.add_implicit_resolver(_tag, _whole, None)
    _Writer.add_implicit_resolver(_tag, _whole, None)


def write_yaml(data: Any) -> str:
    """`data` as YAML that `read_yaml` and other parsers restore exactly."""
    return yaml.dump(data, Dumper=_Writer, sort_keys=False, allow_unicode=True, width=100)


def read_yaml(raw: bytes, file: str) -> tuple[dict[str, Any], Lines]:
    """The map in a file, and place -> ``file:line``.

    Scalars follow YAML 1.2's core schema: only ``true`` and ``false`` are booleans, ``1e3`` is a
    number, ``12:30`` is text. Aliases are expanded within a budget, tags and merge keys rejected.

    Raises:
        ProfileError: invalid YAML; names `file` and line.
    """
    if len(raw) > MAX_PROFILE_BYTES:
        raise ProfileError(f"{file}: {len(raw)} bytes, a profile has at most {MAX_PROFILE_BYTES}")
    node = _compose(raw, file)
    lines: Lines = {}
    made = 0

    def plain(node: yaml.Node, place: Place) -> Any:
        nonlocal made
        where = f"{file}:{node.start_mark.line + 1}"
        lines.setdefault(place, where)
        made += 1  # aliases can multiply a small file
        if made > MAX_NODES:
            raise ProfileError(f"{where}: more than {MAX_NODES} values, aliases counted in full")
        if len(place) > MAX_DEPTH:
            raise ProfileError(f"{where}: nested too deep")
        if isinstance(node, yaml.SequenceNode):
            return [plain(item, (*place, str(index))) for index, item in enumerate(node.value)]
        if not isinstance(node, yaml.MappingNode):
            return _scalar(node, where)
        out: dict[str, Any] = {}
        for key_node, value_node in node.value:
            where, key = f"{file}:{key_node.start_mark.line + 1}", key_node.value
            if not isinstance(key_node, yaml.ScalarNode):
                raise ProfileError(f"{where}: a key must be a word")
            if key == "<<" and key_node.style is None:
                raise ProfileError(f"{where}: merge keys (<<) are not read; use extends")
            if key in out:
                raise ProfileError(f"{where}: {'.'.join((*place, key))} is given twice")
            lines[(*place, key)] = where
            out[key] = plain(value_node, (*place, key))
        return out

    data = None if node is None else plain(node, ())
    if data is None:
        return {}, {(): f"{file}:1"}
    if not isinstance(data, dict):
        what = "a list" if isinstance(data, list) else shown(data)
        raise ProfileError(f"{lines[()]}: a profile is a map of sections, this is {what}")
    return data, lines


def _compose(raw: bytes, file: str) -> yaml.Node | None:
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise ProfileError(f"{file}:{line}: not UTF-8 text: {error.reason}") from error
    try:
        return yaml.compose(text, Loader=_Reader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{file}:{mark.line + 1}" if mark else file
        why = ", ".join(part for part in (error.context, error.problem) if part)
        raise ProfileError(f"{where}: not valid YAML: {why}") from error
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise ProfileError(f"{file}:{line}: a character that YAML does not allow") from error
    except RecursionError as error:
        raise ProfileError(f"{file}: nested too deep") from error


def _scalar(node: yaml.Node, where: str) -> Any:
    kind, text = node.tag.removeprefix(_PREFIX), node.value
    if kind == "str":
        return text
    form = _SCALARS.get(node.tag)
    if form is None:
        raise ProfileError(f"{where}: the tag {node.tag.replace(_PREFIX, '!!')} is not read")
    if not form.fullmatch(text):
        raise ProfileError(f"{where}: {text[:40]!r} is not of the type {kind}")
    if kind == "null":
        return None
    if kind == "bool":
        return text.lower() == "true"
    try:
        return int(text) if kind == "int" else float(re.sub(r"\.(?=inf|nan)", "", text.lower()))
    except ValueError as error:  # more digits than Python reads
        raise ProfileError(f"{where}: a number of {len(text)} digits") from error
