"""Files that a profile needs on another computer, beside those of the package.

Files named relative to the profile stay beside it, files on the search path stay below a folder of
that path, and files with an absolute path need the same path there.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from vla_zenoh import resources
from vla_zenoh.errors import ResourceError
from vla_zenoh.profile.load import below, followed, load_profile, paths_in
from vla_zenoh.profile.profile import Profile
from vla_zenoh.profile.yaml_text import read

MESH = re.compile(rb"""<mesh\b[^>]*?\bfilename\s*=\s*["']([^"']+)["']""")
PACKAGE, FILE = "package://", "file://"
BESIDE, HOME, WHOLE = "beside the profile", "~", "/"


@dataclass(frozen=True, slots=True)
class FileUse:
    """Files and folders below a common folder.

    Args:
        base: the folder.
        names: paths relative to it.
    """

    base: Path
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class NeededFiles:
    """Files that another computer needs.

    Args:
        profile: file of the profile, below `beside.base`.
        beside: that file, and files named relative to it.
        searched: files found by name, for each folder of ``VLA_ZENOH_PATH``.
        home: files named from ``~``.
        whole: files with an absolute path.
        missing: what this computer lacks, as text.
    """

    profile: str
    beside: FileUse
    searched: tuple[FileUse, ...]
    home: FileUse
    whole: FileUse
    missing: tuple[str, ...]


def needed_files(name: str) -> NeededFiles:
    """Files to copy for the profile `name`, which may be a path.

    Raises:
        ProfileError: the profile is invalid.
    """
    profile, found = load_profile(name), _Found()
    own = found.profiles(name)
    for section, key, prefix in paths_in(profile.model_dump()):
        found.path(section[key].removeprefix(prefix))
    for kind, thing in _by_name(profile):
        found.search(kind, thing)
    return found.needed(own)


def _by_name(profile: Profile) -> Iterator[tuple[str, str]]:
    """(kind, name) of scenes and models that the profile's hosts find by name."""
    for host in profile.hosts.values():
        if {"sim", "camera"} & set(host.nodes):
            yield "sim", profile.sim.scene
        for worker in profile.workers_of(host):
            model = profile.models.get(worker, worker)
            if not resources.is_path(model):
                yield "models", model


@dataclass
class _Found:
    """Files by their location: `BESIDE`, `HOME`, `WHOLE`, or a folder of the search path."""

    files: dict[str, dict[Path, None]] = field(default_factory=dict)
    relative: dict[str, str] = field(default_factory=dict)
    """Path relative to a profile -> its location."""
    missing: dict[str, None] = field(default_factory=dict)

    def add(self, where: str, file: Path) -> None:
        if file.exists():
            self.files.setdefault(where, {})[file] = None
        else:
            self.missing[str(file)] = None

    def profiles(self, name: str) -> Path:
        """Add the files of the profile and of those it extends; returns its own."""
        before, where = None, BESIDE
        for path, named in followed(name):
            if before is not None:
                if path.parent == resources.shipped("profiles"):
                    break  # the package on the other computer has the rest
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
        """Add a file that the effective profile names."""
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
                # A folder of meshes also has the files that they name; that of the URDF has more.
                folder = mesh.parent not in urdf.parents
                self.add(WHOLE if whole else where, mesh.parent if folder else mesh)
        if absent:
            self.missing[f"{absent} of {len(named)} meshes that {urdf} names"] = None

    def search(self, kind: str, name: str) -> None:
        """Add a scene or model that is found by name."""
        try:
            path = resources.find(kind, name)
        except ResourceError:
            self.missing[f"{resources.ONE[kind]} {name}"] = None
            return
        if path.parent != resources.shipped(kind):
            self.add(str(path.parent.parent.absolute()), path.absolute())

    def needed(self, own: Path) -> NeededFiles:
        """The result; files outside the folder in which they are looked for count as missing."""
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
    """Location of a profile that the one `before`, located at `where`, extends."""
    if named.startswith("/"):
        return WHOLE
    if path in [before.parent / f"{named}{suffix}" for suffix in ("", *resources.PROFILE_SUFFIXES)]:
        return where
    return str(path.parent.parent.absolute())


def _mesh(urdf: Path, text: str) -> Path | None:
    """The file that a URDF names; ``package://`` is resolved in every folder above it."""
    if text.startswith(PACKAGE):
        rest = text.removeprefix(PACKAGE)
        found = [folder / rest for folder in urdf.parents if (folder / rest).is_file()]
        return found[0] if found else None
    path = urdf.parent / text.removeprefix(FILE)
    return Path(os.path.normpath(path)) if path.is_file() else None
