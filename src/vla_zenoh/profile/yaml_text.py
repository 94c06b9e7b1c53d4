"""YAML to plain data with line numbers.

Scalars follow YAML 1.2's core schema: only ``true`` and ``false`` are booleans, ``1e3`` is a
number, ``12:30`` is text. Aliases are expanded within a budget, tags and merge keys are rejected.
"""

from __future__ import annotations

import re
from typing import Any

import yaml

from vla_zenoh.errors import ProfileError
from vla_zenoh.profile.section import Lines, Place
from vla_zenoh.types import shown

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
_MERGE_KEY = "<<"
_SPECIAL = re.compile("[\x85\u2028\u2029\ufeff]")


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


def write(data: Any) -> str:
    """`data` as YAML that `read` and other parsers restore exactly."""
    return yaml.dump(data, Dumper=_Writer, sort_keys=False, allow_unicode=True, width=100)


def read(raw: bytes, file: str) -> tuple[dict[str, Any], Lines]:
    """The map in a file, and place -> ``file:line``.

    Raises:
        ProfileError: invalid YAML; names `file` and line.
    """
    if len(raw) > MAX_PROFILE_BYTES:
        raise ProfileError(f"{file}: {len(raw)} bytes, a profile has at most {MAX_PROFILE_BYTES}")
    node = _compose(raw, file)
    lines: Lines = {}
    data = None if node is None else _Plain(file, lines).of(node, ())
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


class _Plain:
    """Converts nodes to plain data, and counts them: aliases can multiply a small file."""

    def __init__(self, file: str, lines: Lines) -> None:
        self._file, self._lines, self._made = file, lines, 0

    def of(self, node: yaml.Node, place: Place) -> Any:
        where = self._line(node)
        self._lines.setdefault(place, where)
        self._made += 1
        if self._made > MAX_NODES:
            raise ProfileError(f"{where}: more than {MAX_NODES} values, aliases counted in full")
        if len(place) > MAX_DEPTH:
            raise ProfileError(f"{where}: nested too deep")
        if isinstance(node, yaml.MappingNode):
            return self._map(node, place)
        if isinstance(node, yaml.SequenceNode):
            return [self.of(item, (*place, str(index))) for index, item in enumerate(node.value)]
        return self._scalar(node, where)

    def _line(self, node: yaml.Node) -> str:
        return f"{self._file}:{node.start_mark.line + 1}"

    def _map(self, node: yaml.MappingNode, place: Place) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for key_node, value_node in node.value:
            where, key = self._line(key_node), key_node.value
            if not isinstance(key_node, yaml.ScalarNode):
                raise ProfileError(f"{where}: a key must be a word")
            if key == _MERGE_KEY and key_node.style is None:
                raise ProfileError(f"{where}: merge keys (<<) are not read; use extends")
            if key in out:
                raise ProfileError(f"{where}: {'.'.join((*place, key))} is given twice")
            self._lines[(*place, key)] = where
            out[key] = self.of(value_node, (*place, key))
        return out

    def _scalar(self, node: yaml.Node, where: str) -> Any:
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
