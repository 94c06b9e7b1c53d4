"""Outlines of profiles, so that a command that drives need not load YAML and the schema.

An outline is what a client needs of an effective profile: keys, session, and which node is where.
It is written after a profile was loaded and validated, and used only while loading would give the
same result: the same code, options and ``extends``, and every file with the same content.
"""

from __future__ import annotations

import json
import os
import sys
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import vla_zenoh
from vla_zenoh.errors import VlaZenohError
from vla_zenoh.keys import Keys
from vla_zenoh.resources import extended_profile, profile_file

if TYPE_CHECKING:
    from vla_zenoh.profile import Profile

MAX_OUTLINES = 64


class _Section(dict[str, Any]):
    """A section of an outline: a map whose entries are attributes as well."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(name) from None

    def model_copy(self, *, update: dict[str, Any]) -> _Section:
        return _Section({**self, **update})


class _Outline:
    """What a client reads of a profile. Anything else is taken from the profile, then loaded."""

    def __init__(self, sections: dict[str, Any], load: Callable[[], Profile]) -> None:
        self._sections, self._load = sections, load
        self.keys = Keys(sections["robot"]["name"], sections["root"])

    def __getattr__(self, name: str) -> Any:
        return self._sections[name] if name in self._sections else getattr(self._load(), name)

    def model_copy(self, *, update: dict[str, Any]) -> _Outline:
        return _Outline({**self._sections, **update}, self._load)

    # Results of the profile's own methods are in the sections, see `_outline_of`.
    def workers_of(self, host: _Section) -> list[str]:
        return host["workers"]

    def cameras_of(self, host: _Section) -> list[str]:
        return host["cameras"]

    def node_name(self, host: str, kind: str) -> str:
        return self._sections["hosts"][host]["names"][kind]


def _outline_of(profile: Profile) -> dict[str, Any]:
    hosts = {
        name: {
            "nodes": list(part.nodes),
            "workers": list(profile.workers_of(part)),
            "cameras": list(profile.cameras_of(part)),
            "names": {kind: profile.node_name(name, kind) for kind in part.nodes},
        }
        for name, part in profile.hosts.items()
    }
    ros2 = profile.ros2
    return {
        "name": profile.name,
        "root": profile.root,
        "robot": profile.robot.model_dump(include={"name", "driver", "base_frame"}),
        "session": profile.session.model_dump(mode="json"),
        "hosts": hosts,
        "cameras": {name: {"from_ros2": one.from_ros2} for name, one in profile.cameras.items()},
        "ros2": None if ros2 is None else {"services": True if ros2.services else None},
    }


def cached_profile(name: str, options: Sequence[Any], load: Callable[[], Profile]) -> Profile:
    """An outline of the profile that `load` would return, or that profile.

    `options` are all that `load` depends on beside the files. Its `ProfileError` passes through.
    """
    try:
        file = profile_file(name)
        key = [str(file), list(options), _code()]
        root = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
        cache = root / "vla-zenoh" / "outlines" / f"{zlib.crc32(json.dumps(key).encode()):08x}.json"
        known = _read(cache)
        if known is not None and known["key"] == key and _unchanged(file, known["files"]):
            return cast("Profile", _Outline(known["outline"], load))
        before = _files(name)
    except (VlaZenohError, OSError, ValueError, KeyError, TypeError):
        return load()  # reports what is wrong
    profile = load()
    with suppress(OSError, ValueError):
        if before == _files(name):  # none was saved meanwhile
            _write(cache, {"key": key, "files": before, "outline": _outline_of(profile)})
    return profile


def _files(name: str) -> list[tuple[str, str]]:
    """Name and content of the profile and of those that it extends."""
    from vla_zenoh.profile.load import followed

    return [(parent, path.read_text("utf-8")) for path, parent in followed(name)]


def _unchanged(file: Path, files: Sequence[Sequence[str]]) -> bool:
    """Whether the profile and those it extends have the same content as before."""
    for number, (parent, text) in enumerate(files):
        file = extended_profile(file, parent) if number else file
        if file.read_text("utf-8") != text:
            return False
    return True


def _code() -> list[Any]:
    """Values that change when the schema or its defaults may have changed."""
    package = Path(vla_zenoh.__file__).parent
    modules = [*os.scandir(package / "profile"), *os.scandir(package / "cli")]
    dates = sorted(one.stat().st_mtime_ns for one in modules if one.name.endswith(".py"))
    return [vla_zenoh.__version__, sys.version, str(package), dates[-1], len(dates)]


def _read(path: Path) -> Any:
    """An outline that only this user can have written; None: there is none."""
    for place in (path.parent, path):
        try:
            found = place.stat()
        except FileNotFoundError:
            return None
        if found.st_uid != os.getuid() or found.st_mode & 0o022:
            return None
    return json.loads(path.read_text("utf-8"), object_hook=_Section)


def _write(path: Path, value: Any) -> None:
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    others = sorted(path.parent.glob("*.json"), key=lambda one: one.stat().st_mtime_ns)
    for old in others[: max(0, len(others) - MAX_OUTLINES + 1)]:
        old.unlink(missing_ok=True)
    beside = path.with_suffix(f".{os.getpid()}.new")
    number = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(number, "w", encoding="utf-8") as new:
        json.dump(value, new)
    beside.replace(path)
