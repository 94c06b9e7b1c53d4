"""Plug-ins: robots, cameras, models, benchmarks and commands that installed packages bring.

A package declares an entry point in one of the groups below, whose value is one small declaration
from this module. Ours are declared in the same way, in ``pyproject.toml``. Whoever reads a profile
imports its declarations, so they import the library of a device only where it is used.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import EntryPoint, PackageNotFoundError, distribution, entry_points
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

from vla_zenoh.errors import PluginError, how_to_install, in_words, nearest

if TYPE_CHECKING:  # a command that only lists names loads neither
    from pydantic import BaseModel

    from vla_zenoh.robot import Robot

OWN_ENVIRONMENT_VARIABLE = "VLA_ZENOH_WORKER_ENVIRONMENT"
"""Set in an environment made for one model: ``NAME=PATH``. It may lack all other plug-ins."""
Fault = tuple[Any, ...]
"""Keys from the top of the profile down to what is wrong, and a sentence that continues them; see
`vla_zenoh.profile.section.Fault`."""


def _nothing(profile: Any, options: Any) -> Iterable[Any]:
    return ()


def _right(text: str) -> str:
    return ""


def _no_script(options: Any) -> Path | None:
    return None


@dataclass(frozen=True, kw_only=True)
class RobotPlugin:
    """A kind of robot: a value of ``robot.driver``. Group ``vla_zenoh.robots``.

    Every function takes the `Profile` and the checked `options`, an instance of that class or None.

    Args:
        make: returns the robot, see `vla_zenoh.robot.Robot`, without connecting to it. None: the
            driver is a node of its own, as ``sim`` and ``ros2`` are.
        options: of the profile's section that has the name of the plug-in. A subclass of
            `vla_zenoh.profile.section.Section` rejects unknown keys and NaN. None: no section.
        commands: values of ``robot.command`` that it takes.
        paths: names of options that are files, relative to the profile.
        script: of the options: a file whose PEP 723 header asks for an environment of its own, in
            which `make` is then called.
        contradictions: faults of a profile, found whenever it is loaded.
        check: further faults, found by `vla-zenoh profile check`; may read files.
        check_host: yields `vla_zenoh.lab.doctor.HostFinding` about the computer that runs the node.
        check_robot: yields them about the robot, for `vla-zenoh robot check`; it moves nothing.
    """

    make: Callable[[Any, Any], Robot] | None = None
    options: type[BaseModel] | None = None
    commands: tuple[str, ...] = ("pose", "joint")
    paths: tuple[str, ...] = ()
    script: Callable[[Any], Path | None] = _no_script
    contradictions: Callable[[Any, Any], Iterable[Fault]] = _nothing
    check: Callable[[Any, Any], Iterable[Fault]] = _nothing
    check_host: Callable[[Any, Any], Iterable[Any]] = _nothing
    check_robot: Callable[[Any, Any], Iterable[Any]] | None = None


class FoundCamera(NamedTuple):
    """A camera of this computer.

    Args:
        source: how to write it in a profile, so that it is the same camera after a restart.
        name: as its maker or driver calls it.
        device: where it is plugged in; empty: not known.
    """

    source: str
    name: str
    device: str


def _no_cameras() -> Iterable[FoundCamera]:
    return ()


@dataclass(frozen=True, kw_only=True)
class CameraPlugin:
    """What the ``source`` of a camera may begin with. Group ``vla_zenoh.cameras``.

    Args:
        written: how a profile names one, as ``v4l2:DEVICE``; the word before the colon is the name
            of the plug-in.
        make: of the text behind the colon and the `CameraProfile`: returns a
            `vla_zenoh.nodes.camera.source.Source`, not open yet. None: no camera node reads it.
        check: of the text behind the colon: what is wrong with it; empty: nothing.
        is_path: that text is a file or folder, relative to the profile.
        has_lens: its images may be cropped, flipped and undistorted.
        has_intrinsics: it reports those of its lens.
        has_depth: it measures depth.
        has_locks: its exposure and white balance can be fixed.
        same_moving_s: how long an image may repeat while the arm moves, s; 0: indefinitely.
        connected: cameras of this computer, for `vla-zenoh camera list`; a `MissingExtraError`
            where the library that knows them is not installed.
        maker: a word in the names of its cameras. Where it can list them, other sources do not.
    """

    written: str
    make: Callable[[str, Any], Any] | None = None
    check: Callable[[str], str] = _right
    is_path: bool = False
    has_lens: bool = False
    has_intrinsics: bool = False
    has_depth: bool = False
    has_locks: bool = False
    same_moving_s: float = 1.0
    connected: Callable[[], Iterable[FoundCamera]] = _no_cameras
    maker: str = ""


@dataclass(frozen=True, kw_only=True)
class FilePlugin:
    """A model or benchmark in a Python file. Groups ``vla_zenoh.models``, ``vla_zenoh.benchmarks``.

    Args:
        file: the file, or a folder with a ``model.py``. A PEP 723 header asks for an environment of
            its own, which has the package that brings the file only if the header names it.
    """

    file: Path


Declaration = TypeVar("Declaration")


class Group(NamedTuple, Generic[Declaration]):
    """Plug-ins of one kind.

    Args:
        name: of the entry point group.
        noun: what one of them is called in messages.
        kind: class of their declarations.
    """

    name: str
    noun: str
    kind: type[Declaration]


ROBOTS = Group("vla_zenoh.robots", "robot driver", RobotPlugin)
CAMERAS = Group("vla_zenoh.cameras", "camera source", CameraPlugin)
MODELS = Group("vla_zenoh.models", "model", FilePlugin)
BENCHMARKS = Group("vla_zenoh.benchmarks", "benchmark", FilePlugin)
COMMANDS = Group("vla_zenoh.commands", "command", FunctionType)
"""Words of a command, joined by dots as ``bench.sim``, -> the function that runs it. A command of
this package cannot be replaced."""
GROUPS: tuple[Group[Any], ...] = (ROBOTS, CAMERAS, MODELS, BENCHMARKS, COMMANDS)
_COMMANDS_OF: Mapping[str, str] = {
    "vla-zenoh-benchmarks": "bench.command bench.task bench.sim compare",
    "vla-zenoh-calibrate": "camera.board camera.calibrate",
    "vla-zenoh-canary": "canary.watch canary.promote canary.back",
    "vla-zenoh-conform": "conform.robot conform.worker conform.camera",
    "vla-zenoh-dataset": "dataset.export dataset.stats",
    "vla-zenoh-diagnose": "inspect net keys echo",
    "vla-zenoh-figures": "figure.motion figure.latency figure.success",
    "vla-zenoh-mcp": "serve.mcp",
    "vla-zenoh-newarm": "profile.new",
    "vla-zenoh-nights": "nights",
    "vla-zenoh-otel": "otel",
    "vla-zenoh-primitives": "do.move-to do.home do.grip do.run node.primitives",
    "vla-zenoh-r2c": "serve.r2c",
    "vla-zenoh-replay": "replay",
    "vla-zenoh-rolling": "node.rolling save",
    "vla-zenoh-ros2": "node.ros2 profile.bridge-config",
    "vla-zenoh-secure": "secure.init secure.add secure.here secure.show secure.revoke "
    "secure.retire secure.rename",
    "vla-zenoh-serve": "serve.policy",
    "vla-zenoh-strands": "serve.strands",
    "vla-zenoh-teleop": "teleop",
    "vla-zenoh-trial": "trial",
    "vla-zenoh-view": "view",
    "vla-zenoh-web": "web",
}
PACKAGES: Mapping[str, str] = {
    command: package for package, own in _COMMANDS_OF.items() for command in own.split()
}
"""Command of a package in ``plugins/`` -> that package, for a computer that lacks it; help has this
order."""
NEEDED: Mapping[str, tuple[str, ...]] = {
    "lerobot_robot_vla_zenoh": ("vla-zenoh-policy-servers",),
    "vla-zenoh-canary": ("vla-zenoh-benchmarks",),
    "vla-zenoh-dataset": ("vla-zenoh-policy-servers",),
    "vla-zenoh-figures": ("vla-zenoh-benchmarks",),
    "vla-zenoh-inspect": ("vla-zenoh-policy-servers", "vla-zenoh-primitives"),
    "vla-zenoh-mcp": ("vla-zenoh-primitives",),
    "vla-zenoh-nights": ("vla-zenoh-trial",),
    "vla-zenoh-serve": ("vla-zenoh-policy-servers",),
    "vla-zenoh-trial": ("vla-zenoh-benchmarks",),
    "vla-zenoh-web": ("vla-zenoh-diagnose", "vla-zenoh-teleop"),
}
"""Package in ``plugins/`` -> others that it needs."""
OURS = "vla-zenoh-"
"""A requirement in the header of a model that begins with it is a package in ``plugins/``: they are
on no index."""


def installed(group: Group[Any]) -> Mapping[str, EntryPoint]:
    """Name -> entry point of every plug-in of a group, sorted; nothing is imported."""
    return {name: entries[0] for name, entries in _found(group.name, tuple(sys.path)).items()}


@lru_cache(maxsize=16)
def _found(group: str, path: tuple[str, ...]) -> Mapping[str, list[EntryPoint]]:
    out: dict[str, list[EntryPoint]] = {}
    for entry in sorted(entry_points(group=group), key=lambda entry: entry.name):
        out.setdefault(entry.name, []).append(entry)
    return out


def package_of(entry: EntryPoint) -> str:
    """Name of the package that declares a plug-in."""
    return entry.dist.name if entry.dist is not None else "a package"


def lacking(command: str) -> str:
    """What must be installed for a command that a package brings; empty: nothing.

    Args:
        command: its words, joined by dots.
    """
    if command in installed(COMMANDS):
        return ""
    words = command.replace(".", " ")
    return f"`vla-zenoh {words}` {lacking_package([PACKAGES[command]])}"


def installing(package: str) -> str:
    """Command that installs a package of ``plugins/``, and those that it needs."""
    return how_to_install(package=package, needed=needed_by(package))


def needed_by(package: str) -> tuple[str, ...]:
    """Packages of ``plugins/`` that one of them needs, each after those that it needs itself."""
    found: dict[str, None] = {}
    for other in NEEDED.get(package, ()):
        found |= dict.fromkeys((*needed_by(other), other))
    return tuple(found)


def lacking_package(requirements: Iterable[str]) -> str:
    """What must be installed for the first of `requirements` that is a package of ``plugins/``, as
    text; empty: none is."""
    ours = [each for each in requirements if each.startswith(OURS)]
    return f"needs the package {ours[0]}; install it with: {installing(ours[0])}" if ours else ""


def load(group: Group[Declaration], name: str) -> Declaration:
    """The declaration of one plug-in; the others are not imported.

    Raises:
        PluginError: it is not installed, cannot be imported, is something else, or two packages
            bring this name.
    """
    known = installed(group)
    if name not in known:
        raise PluginError(
            f"no {group.noun} {name!r} is installed{nearest(name, known)} Installed: "
            f"{', '.join(known) or 'none'}. Install its package into {sys.prefix}, "
            "the environment of this program: docs/how-to/install.md"
        )
    entry, *others = _found(group.name, tuple(sys.path))[name]
    if others:
        packages = " and ".join(map(package_of, (entry, *others)))
        raise PluginError(f"{packages} both bring the {group.noun} {name!r}: uninstall one of them")
    try:
        found = entry.load()
    except (Exception, SystemExit) as error:
        where = f"the {group.noun} {name!r} of {package_of(entry)}"
        raise PluginError(f"{where} cannot be imported: {in_words(error)}") from error
    if not isinstance(found, group.kind):
        raise PluginError(
            f"the {group.noun} {name!r} of {package_of(entry)}: {entry.value} is of type "
            f"{type(found).__name__}, wanted a {group.kind.__name__}; see vla_zenoh.plugins"
        )
    return found


def load_all(group: Group[Declaration]) -> dict[str, Declaration]:
    """Every plug-in of a group that can be imported, by name; `broken` has the others."""
    out: dict[str, Declaration] = {}
    for name in installed(group):
        try:
            out[name] = load(group, name)
        except PluginError:
            continue
    return out


def broken(group: Group[Any]) -> dict[str, str]:
    """Name -> reason of every plug-in of a group that cannot be imported."""
    out: dict[str, str] = {}
    for name in installed(group):
        try:
            load(group, name)
        except PluginError as error:
            out[name] = str(error)
    return out


def faults_of(
    driver: str, check: Callable[[Any, Any], Iterable[Fault]], profile: Any, options: Any
) -> list[Fault]:
    """What a `check` of a robot driver finds; that it fails is a fault as well."""
    try:
        return list(check(profile, options))
    except Exception as error:
        return [(("robot", "driver"), f"the check of {driver} itself failed: {in_words(error)}")]


def faults_of_text(kind: str, check: Callable[[str], str], text: str) -> str:
    """What a `check` of a camera source says of `text`; that it fails is a fault as well."""
    try:
        return check(text)
    except Exception as error:
        return f"cannot be checked: the check of {kind} itself failed: {in_words(error)}"


def in_own_environment() -> bool:
    """Whether this process runs in an environment made for one model."""
    return OWN_ENVIRONMENT_VARIABLE in os.environ


def file_here(name: str) -> Path | None:
    """The file of the model `name` for which the environment of this process was made."""
    own, _, path = os.environ.get(OWN_ENVIRONMENT_VARIABLE, "").partition("=")
    return Path(path) if path and own == name else None


def how_to_repeat(package: str) -> list[str]:
    """Options of ``uv run`` that put an installed package, and those of ``plugins/`` that it needs,
    into another environment.

    Raises:
        PluginError: one of them is not installed.
    """
    return [word for each in (*needed_by(package), package) for word in _repeated(each)]


def _repeated(package: str) -> list[str]:
    try:
        found = distribution(package)
    except PackageNotFoundError as error:
        raise PluginError(
            f"the package {package} is not installed; install it with: {installing(package)}"
        ) from error
    origin = json.loads(found.read_text("direct_url.json") or "{}")
    url = str(origin.get("url", ""))
    if origin.get("dir_info", {}).get("editable"):
        return ["--with-editable", url.removeprefix("file://")]
    pinned = f"{found.name} @ {url}" if url else f"{found.name}=={found.version}"
    return ["--with", pinned]
