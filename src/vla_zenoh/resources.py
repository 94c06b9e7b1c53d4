"""Finds models, scenes, profiles and robot descriptions, in a checkout and in a wheel alike.

Looked through in this order, first hit wins: an explicit path, each folder in ``VLA_ZENOH_PATH``
(``<folder>/profiles/name.yaml``), what the package ships; of models and benchmarks instead what
installed packages bring, this one among them. Nothing is ever fetched from the net.
"""

from __future__ import annotations

import os
from pathlib import Path

from vla_zenoh import plugins
from vla_zenoh.errors import MissingExtraError, ProfileError, ResourceError, nearest

PROFILE_SUFFIXES = (".yaml", ".yml")
BENCHMARKS = "benchmarks"
KINDS = {"models": (".py", ""), "profiles": PROFILE_SUFFIXES, "sim": ("",), BENCHMARKS: (".py",)}
ONE = {"models": "model", "profiles": "profile", "sim": "scene", BENCHMARKS: "benchmark"}
PLUGINS = {"models": plugins.MODELS, BENCHMARKS: plugins.BENCHMARKS}
"""What packages bring, and no folder of this one is searched for."""
SEARCH_PATH_VARIABLE = "VLA_ZENOH_PATH"
ROBOT_DATA_PREFIX = "example-robot-data:"
SHIPPED_PREFIX = "shipped:"
PACKAGED = (ROBOT_DATA_PREFIX, SHIPPED_PREFIX)
"""How a robot description begins that is not a path."""


def shipped(kind: str) -> Path:
    """The folder that holds what the package ships of `kind`."""
    package = Path(__file__).resolve().parent
    inside_wheel, checkout = package / "_data" / kind, package.parents[1]
    if inside_wheel.is_dir():
        return inside_wheel
    if (checkout / kind).is_dir() and (checkout / "pyproject.toml").is_file():
        return checkout / kind
    raise ResourceError(
        f"the installation of vla-zenoh is damaged: {inside_wheel} is missing, and {checkout} is "
        f"no checkout with pyproject.toml and {kind}/"
    )


def folders(kind: str) -> list[Path]:
    """Folders that are searched for `kind`, first match wins."""
    parts = os.environ.get(SEARCH_PATH_VARIABLE, "").split(os.pathsep)
    named = [Path(part) / kind for part in parts if part]
    own = [] if kind in PLUGINS else [shipped(kind)]
    return [folder for folder in named if folder.is_dir()] + own


def names(kind: str) -> list[str]:
    """Names of everything of `kind` that is found, sorted."""
    found = set(plugins.installed(PLUGINS[kind])) if kind in PLUGINS else set()
    for folder in folders(kind):
        for entry in folder.iterdir():
            if entry.name.startswith((".", "_")):
                continue
            if entry.is_dir() and "" in KINDS[kind]:
                found.add(entry.name)
            elif entry.is_file() and entry.suffix and entry.suffix in KINDS[kind]:
                found.add(entry.stem)
    return sorted(found)


def is_path(name: str) -> bool:
    """Whether `find` takes `name` as a path and not as a name."""
    return os.sep in name or Path(name).suffix in (".py", *PROFILE_SUFFIXES)


def find(kind: str, name: str) -> Path:
    """The file or folder called `name`, which may also be a path; a `ResourceError` lists all."""
    if is_path(name):
        path = Path(name).expanduser()
        if path.exists():
            return path.resolve()
        raise ResourceError(f"there is no file or folder {name!r}")
    for folder in folders(kind):
        for suffix in KINDS[kind]:
            path = folder / f"{name}{suffix}"
            if path.exists() and (suffix or path.is_dir()):
                return path
    if kind in PLUGINS:
        if file := plugins.file_here(name):
            return file
        if name in plugins.installed(PLUGINS[kind]):
            return plugins.load(PLUGINS[kind], name).file
    known = names(kind)
    own = f"by a profile's models: {{{name[:80]}: PATH}}, " if kind == "models" else ""
    raise ResourceError(
        f"no {ONE[kind]} called {name!r}{nearest(name, known)} "
        f"Known: {', '.join(known) or 'none'}. One of your own is found by its path, "
        f"{own}or as {kind}/{name[:80]}{KINDS[kind][0]} below a folder that "
        f"{SEARCH_PATH_VARIABLE} names"
    )


def profile_file(name: str) -> Path:
    """File of the profile `name`, which may be a path, or a `ProfileError` with those there are."""
    try:
        return find("profiles", name)
    except ResourceError as error:
        raise ProfileError(str(error)) from error
    except (OSError, ValueError, RuntimeError) as error:  # too long, a NUL in it, an unknown ~user
        raise ProfileError(f"{name[:80]!r} cannot be the name of a profile") from error


def extended_profile(path: Path, parent: str) -> Path:
    """File that the profile at `path` extends: beside it, or first on the search path.

    A profile that extends its own name means the next one there. If there is none, `ProfileError`.
    """
    if parent == path.stem:
        files = [f / f"{parent}{end}" for f in folders("profiles") for end in PROFILE_SUFFIXES]
        files = [file for file in files if file.is_file()]
        own = [index for index, file in enumerate(files) if file.samefile(path)]
        if after := files[own[0] + 1 :] if own else files:
            return after[0]
        raise ProfileError(
            f"{parent!r} is this file, and no other profile of that name comes after it"
        )
    try:
        whole = Path(parent).suffix in PROFILE_SUFFIXES
        for suffix in ("",) if whole else PROFILE_SUFFIXES:
            if (beside := path.parent / f"{parent}{suffix}").is_file():
                return beside
    except (OSError, ValueError) as error:
        raise ProfileError(f"{parent[:80]!r} cannot be the name of a profile") from error
    try:
        return profile_file(parent)
    except ProfileError as error:
        beside = "" if is_path(parent) else f", or as {parent[:80]}.yaml beside this file"
        raise ProfileError(f"{error}{beside}") from error


def robot_urdf(description: str) -> Path:
    """The URDF a profile names: a path, ``shipped:`` or ``example-robot-data:`` and one in there.

    A `ResourceError` without that file, a `MissingExtraError` without the package.
    """
    if description.startswith(SHIPPED_PREFIX):
        description = str(shipped("profiles") / description.removeprefix(SHIPPED_PREFIX))
    if not description.startswith(ROBOT_DATA_PREFIX):
        path = Path(description).expanduser()
        if not path.is_file():
            raise ResourceError(
                f"robot description {description!r} is not a file; a path in a profile is relative "
                "to the profile's folder"
            )
        return path.resolve()
    import importlib.metadata  # only here: it takes 45 ms

    try:
        package = importlib.metadata.distribution("example-robot-data")
    except importlib.metadata.PackageNotFoundError as error:
        raise MissingExtraError("example-robot-data", "meshes") from error
    root = Path(str(package.locate_file("cmeel.prefix/share/example-robot-data/robots")))
    if not root.is_dir():
        raise MissingExtraError("example-robot-data", "meshes")
    path = root / description.removeprefix(ROBOT_DATA_PREFIX)
    if not path.is_file():
        raise ResourceError(
            f"robot description {description!r} is not in example-robot-data; "
            f"robots there: {', '.join(sorted(entry.name for entry in root.glob('*')))}"
        )
    return path


def meshes_of(urdf: Path) -> Path:
    """Collision meshes of a URDF: ``../meshes/collision``, or ``../meshes/<its name>``."""
    folders = [urdf.parent.parent / "meshes" / name for name in ("collision", urdf.stem)]
    for folder in folders:
        if folder.is_dir():
            return folder
    wanted = " nor ".join(str(folder) for folder in folders)
    raise ResourceError(f"no collision meshes for {urdf.name}: neither {wanted} is a folder")
