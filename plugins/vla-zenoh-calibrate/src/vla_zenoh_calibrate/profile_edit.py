"""Sets keys in the text of a profile; comments, order and everything else stay as they are."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import yaml

from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import load_profile
from vla_zenoh.profile.load import read_yaml
from vla_zenoh_calibrate.errors import CalibrationError


def with_keys(text: str, place: Sequence[str], values: Mapping[str, Any]) -> str:
    """`text` with ``place.key: value`` for each of `values`, at what is there already or beside it.

    Args:
        text: of a profile.
        place: keys from the top down to the map that gets the values.

    Raises:
        CalibrationError: what is at `place` is no map, or an alias of another one.
    """
    for key, value in values.items():
        text = _with_key(text, [*place, key], value)
    return text


def _with_key(text: str, path: Sequence[str], value: Any) -> str:
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    if root is None:
        return text + _block(path, value, 0)
    node: yaml.Node = root
    for depth, key in enumerate(path):
        if not isinstance(node, yaml.MappingNode):
            empty = isinstance(node, yaml.ScalarNode) and node.value in ("", "null", "~")
            if not empty:
                raise CalibrationError(f"{'.'.join(path[:depth])} in the profile is no map")
            return _replaced(text, node, _flow(path[depth:], value))
        here = {one.value: inside for one, inside in node.value}
        if key not in here:
            return _inserted(text, node, path[depth:], value)
        node = here[key]
    return _replaced(text, node, _flow([], value))


def _replaced(text: str, node: yaml.Node, new: str) -> str:
    start, end = node.start_mark.index, _end(node)
    space = "" if text[start - 1 : start].isspace() else " "
    return text[:start] + space + new + text[end:]


def _end(node: yaml.Node) -> int:
    """Where a node's own text ends; a block's mark is behind the comments that follow it."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    return node.end_mark.index


def _inserted(text: str, node: yaml.MappingNode, path: Sequence[str], value: Any) -> str:
    if node.flow_style:
        end = node.end_mark.index - 1
        before = text[:end].rstrip()
        comma = "" if not node.value or before.endswith(",") else ","
        space = "" if not node.value else " "
        inside = _flow(path, value)[1:-1]
        return f"{before}{comma}{space}{inside}{text[end:]}"
    end = _end(node)
    line = text.find("\n", end)
    end = len(text) if line < 0 else line + 1
    before = text[:end] if text[:end].endswith("\n") else text[:end] + "\n"
    return before + _block(path, value, node.start_mark.column) + text[end:]


def _flow(path: Sequence[str], value: Any) -> str:
    """One line in braces."""
    for key in reversed(path):
        value = {key: value}
    written = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**9)
    return written.removesuffix("...\n").strip()


def _block(path: Sequence[str], value: Any, column: int) -> str:
    """Lines: a key on each, the value behind the last."""
    out = ""
    for depth, key in enumerate(path):
        last = depth == len(path) - 1
        behind = f" {_flow([], value)}" if last else ""
        out += f"{' ' * (column + 2 * depth)}{_flow([], key)}:{behind}\n"
    return out


def write_profile(path: Path, place: Sequence[str], values: Mapping[str, Any]) -> Path:
    """Set keys in a profile; returns the backup of what it was.

    Raises:
        CalibrationError, ProfileError: it cannot be written, or the result is no valid profile.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise CalibrationError(f"{path} cannot be read: {error.strerror}") from error
    before, _ = read_yaml(raw, str(path))
    text = with_keys(raw.decode("utf-8"), place, values)
    after, _ = read_yaml(text.encode(), str(path))
    expected = _merged(before, place, values)
    if after != expected:
        raise CalibrationError(
            f"{path} has a form that cannot be changed safely (anchors, or keys in quotes): copy "
            "the fragment into it yourself"
        )
    trial = path.with_name(f"{path.stem}_trial_{os.getpid()}{path.suffix}")
    try:
        trial.write_text(text, "utf-8")
        load_profile(str(trial))
        older = backup(path)
        shutil.copystat(path, trial)
        os.replace(trial, path)
    except ProfileError as error:
        named = str(error).replace(str(trial), str(path))
        raise CalibrationError(f"the profile would be wrong with it: {named}") from error
    except OSError as error:
        raise CalibrationError(f"{path} cannot be written: {error.strerror}") from error
    finally:
        trial.unlink(missing_ok=True)
    return older


def _merged(data: Any, place: Sequence[str], values: Mapping[str, Any]) -> Any:
    if not place:
        return {**(data or {}), **values}
    first, *rest = place
    inside = (data or {}).get(first)
    return {**(data or {}), first: _merged(inside, rest, values)}


def backup(path: Path) -> Path:
    """A copy beside it under a name that is free."""
    for number in count(1):
        copy = path.with_name(f"{path.name}.{number}.bak")
        if not copy.exists():
            shutil.copy2(path, copy)
            return copy
    raise AssertionError
