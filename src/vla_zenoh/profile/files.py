"""Every file that a profile needs beside what the package ships: what another computer has to have.

What is named relative to the profile keeps its place beside it, what was found on the search path
keeps its place below a folder of that path, and what is named whole has to be where it is here.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from vla_zenoh import resources
from vla_zenoh.errors import ResourceError
from vla_zenoh.profile.load import SUFFIXES, below, followed, load_profile, paths_in
from vla_zenoh.profile.profile import Profile
from vla_zenoh.profile.yaml_text import read

MESH = re.compile(rb"""<mesh\b[^>]*?\bfilename\s*=\s*["']([^"']+)["']""")
PACKAGE, FILE = "package://", "file://"
BESIDE, HOME, WHOLE = "beside the profile", "~", "/"


@dataclass(frozen=True, slots=True)
class FileUse:
    """Files and folders that belong together.

    Args:
        base: the folder that they are named from.
        names: below it.
    """

    base: Path
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class NeededFiles:
    """What another computer has to have.

    Args:
        profile: its own file, below `beside.base`.
        beside: that file, and what is named relative to it.
        searched: what is found by its name; for each folder of ``VLA_ZENOH_PATH``.
        home: what is named from ``~``.
        whole: what is named by its whole path.
        missing: what is not on this computer, in words.
    """

    profile: str
    beside: FileUse
    searched: tuple[FileUse, ...]
    home: FileUse
    whole: FileUse
    missing: tuple[str, ...]


def needed_files(name: str) -> NeededFiles:
    """What has to be copied with the profile called `name`, or at that path.

    Raises:
        ProfileError: it is wrong.
    """
    profile, found = load_profile(name), _Found()
    own = found.profiles(name)
    for section, key, prefix in paths_in(profile.model_dump()):
        found.path(section[key].removeprefix(prefix))
    for kind, thing in _by_name(profile):
        found.search(kind, thing)
    return found.needed(own)


def _by_name(profile: Profile) -> Iterator[tuple[str, str]]:
    """(kind, name) of what hosts of the profile look for by its name."""
    for host in profile.hosts.values():
        if {"sim", "camera"} & set(host.nodes):
            yield "sim", profile.sim.scene
        for worker in profile.workers_of(host):
            model = profile.models.get(worker, worker)
            if not resources.is_path(model):
                yield "models", model


@dataclass
class _Found:
    """Files by where they have to be: `BESIDE`, `HOME`, `WHOLE`, or a folder of the search path."""

    files: dict[str, dict[Path, None]] = field(default_factory=dict)
    relative: dict[str, str] = field(default_factory=dict)
    """What profiles name relative to themselves -> where it has to be."""
    missing: dict[str, None] = field(default_factory=dict)

    def add(self, where: str, file: Path) -> None:
        if file.exists():
            self.files.setdefault(where, {})[file] = None
        else:
            self.missing[str(file)] = None

    def profiles(self, name: str) -> Path:
        """The files of the profile and of those it extends; returns its own."""
        before, where = None, BESIDE
        for path, named in followed(name):
            if before is not None:
                if path.parent == resources.shipped("profiles"):
                    break  # the package is there as well, with all that this one extends
                where = _place(before, path, named, where)
            file = Path(os.path.normpath(path.absolute()))
            self.add(where, file)
            data, _ = read(path.read_bytes(), str(path))
            for section, key, prefix in paths_in(data):
                text = section[key].removeprefix(prefix)
                if not text.startswith(("/", "~")):
                    self.relative[below(path.parent, text)] = where
            before = path
        return next(iter(self.files[BESIDE]))

    def path(self, text: str) -> None:
        """A file that the profile in force names."""
        where = self.relative.get(text, HOME if text.startswith("~") else WHOLE)
        file = Path(text).expanduser()
        self.add(where, file)
        if file.suffix == ".urdf" and file.is_file():
            self._meshes(where, file)

    def _meshes(self, where: str, urdf: Path) -> None:
        named = {found.decode("utf-8", "replace") for found in MESH.findall(urdf.read_bytes())}
        absent = 0
        for text in sorted(named):
            mesh = _mesh(urdf, text)
            absent += mesh is None
            if mesh is not None:
                whole = text.startswith((FILE, "/"))
                # A folder of meshes has what they name in turn. That of the URDF has anything.
                folder = mesh.parent not in urdf.parents
                self.add(WHOLE if whole else where, mesh.parent if folder else mesh)
        if absent:
            self.missing[f"{absent} of {len(named)} meshes that {urdf} names"] = None

    def search(self, kind: str, name: str) -> None:
        """Something that is found by its name, in a folder that people have told us of."""
        try:
            path = resources.find(kind, name)
        except ResourceError:
            self.missing[f"{resources.ONE[kind]} {name}"] = None
            return
        if path.parent != resources.shipped(kind):
            self.add(str(path.parent.parent.absolute()), path.absolute())

    def needed(self, own: Path) -> NeededFiles:
        """All of it. What lies outside of the folder that it is looked for in counts as missing."""
        beside = list(self.files.pop(BESIDE))
        base = Path(os.path.commonpath([file.parent for file in beside]))
        home, whole = (list(self.files.pop(where, ())) for where in (HOME, WHOLE))
        searched = [
            self._part(Path(folder), list(files)) for folder, files in sorted(self.files.items())
        ]
        return NeededFiles(
            str(own.relative_to(base)),
            self._part(base, beside),
            tuple(searched),
            self._part(Path.home(), home),
            self._part(Path("/"), whole),
            tuple(self.missing),
        )

    def _part(self, base: Path, files: list[Path]) -> FileUse:
        outside = [file for file in files if not file.is_relative_to(base)]
        self.missing.update({f"{file}, which is not below {base}": None for file in outside})
        names = [str(file.relative_to(base)) for file in files if file not in outside]
        return FileUse(base, tuple(names))


def _place(before: Path, path: Path, named: str, where: str) -> str:
    """Where a profile has to be that the one `before`, which has to be at `where`, extends."""
    if named.startswith("/"):
        return WHOLE
    if path in [before.parent / f"{named}{suffix}" for suffix in ("", *SUFFIXES)]:
        return where
    return str(path.parent.parent.absolute())


def _mesh(urdf: Path, text: str) -> Path | None:
    """The file that a URDF names; ``package://`` is looked for in every folder above it."""
    if text.startswith(PACKAGE):
        rest = text.removeprefix(PACKAGE)
        found = [folder / rest for folder in urdf.parents if (folder / rest).is_file()]
        return found[0] if found else None
    path = urdf.parent / text.removeprefix(FILE)
    return Path(os.path.normpath(path)) if path.is_file() else None
