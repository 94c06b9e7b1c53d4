"""The robot that a client command is for, and how to type a command for it."""

from __future__ import annotations

import json
import os
import shlex
import sys
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import zenoh

import vla_zenoh
from vla_zenoh.bus.session import open_session, put_text
from vla_zenoh.cli.plain import warn
from vla_zenoh.cli.words import DEFAULT_PROFILE, PROFILE_VARIABLE
from vla_zenoh.errors import SecurityError, SessionError, VlaZenohError
from vla_zenoh.keys import Keys
from vla_zenoh.resources import extended_profile, profile_file
from vla_zenoh.security.roles import Role, operator_role
from vla_zenoh.security.store import local_role, operator_hosts

if TYPE_CHECKING:  # Typer and the schema: the commands that drive do without them
    import typer

    from vla_zenoh.bus.client import Client
    from vla_zenoh.cli.options import ConnectOption, HostOption, ProfileOption
    from vla_zenoh.profile import Profile

MAX_OUTLINES = 64


@dataclass(frozen=True)
class RobotTarget:
    """Options that select a robot, and its client."""

    profile: ProfileOption = DEFAULT_PROFILE
    connect: ConnectOption = None
    host: HostOption = None
    robot: Annotated[
        str | None, typer.Option("--robot", help="Another robot on this router than the profile's.")
    ] = None

    def typed(self, *command: str, host: str | None = None, robot: str | None = None) -> str:
        """The command line of another command for this robot, or for the host or robot given."""
        words = ["vla-zenoh", *command]
        if self.profile != DEFAULT_PROFILE or PROFILE_VARIABLE in os.environ:
            words += ["--profile", self.profile]
        for endpoint in self.connect or ():
            words += ["--connect", endpoint]
        for option, value in (("--host", host or self.host), ("--robot", robot or self.robot)):
            words += [option, value] if value is not None else []
        return shlex.join(words)

    def load(self) -> Profile:
        """Load the profile, with the best certificate that this computer has for an operator."""
        return _choices(self._load(), stop=False)[0]

    def _load(self) -> Profile:
        from vla_zenoh.cli.options import effective_profile
        from vla_zenoh.profile import as_robot

        profile = effective_profile(self.profile, self.connect, host=self.host)
        return profile if self.robot is None else as_robot(profile, self.robot)

    def outline(self) -> Profile:
        """What a client needs of the profile: keys, session, and which node is where.

        It is cached when a profile has been loaded and validated, and used while loading would give
        the same: the same code, options and ``extends``, and every file with the same content. Its
        sections are read; it is no `Profile` of pydantic.
        """
        try:
            file = profile_file(self.profile)
            key = [str(file), list(self.connect or ()), self.host, self.robot, _code()]
            root = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
            name = f"{zlib.crc32(json.dumps(key).encode()):08x}.json"
            cache = root / "vla-zenoh" / "outlines" / name
            known = _read(cache)
            if known is not None and known["key"] == key and _unchanged(file, known["files"]):
                return cast("Profile", _Outline(known["outline"], self._load))
            before = _files(self.profile)
        except (VlaZenohError, OSError, ValueError, KeyError, TypeError):
            return self._load()  # reports what is wrong
        profile = self._load()
        with suppress(OSError, ValueError):
            if before == _files(self.profile):  # none was saved meanwhile
                _write(cache, {"key": key, "files": before, "outline": _outline_of(profile)})
        return profile

    @contextmanager
    def client(self, *, stop: bool = False, stop_now: bool = False) -> Iterator[Client]:
        """A connected client that will know the nodes in a moment.

        Args:
            stop: prefer a certificate that may stop the robot, and try every one.
            stop_now: put the emergency stop before anything else; includes `stop`.

        Raises:
            ProfileError: the profile is invalid.
            SecurityError: there is no certificate for an operator or viewer.
            SessionError: no router answers.
        """
        stop = stop or stop_now
        profile, session = _first(_choices(self.outline(), stop=stop)[: None if stop else 1])
        with session:
            if stop_now:
                put_text(session, profile.keys.stop, "stop")
            from vla_zenoh.bus.client import Client  # after the stop: it takes 20 ms to load

            yield Client(profile, session).subscribe()

    @contextmanager
    def operator(self, *command: str) -> Iterator[Client]:
        """A connected client that may change settings; errors name the robot and the others.

        Raises:
            SecurityError: the certificate here is not an operator's.
            SessionError: the session or the block failed.
        """
        with self.client() as client:
            if why := self.not_operator(client.profile, *command):
                raise SecurityError(why)
            try:
                yield client
            except SessionError as error:
                if "command" in client.alive:
                    raise
                raise SessionError(self.no_node(client, *command, kind="command node")) from error

    def named(self, client: Client) -> str:
        """Robot and profile."""
        return f"robot {client.keys.robot} (profile {self.profile})"

    def no_node(self, client: Client, *command: str, kind: str = "node") -> str:
        """Message that this robot has no such node, with `command` for the other robots."""
        others = [f"{name} (`{self.typed(*command, robot=name)}`)" for name in self.others(client)]
        there = f"Alive on this router: {', '.join(others)}"
        none = "No other robot is visible on this router; `vla-zenoh up` starts one"
        return f"no {kind} of {self.named(client)} is alive. {there if others else none}"

    def others(self, client: Client) -> list[str]:
        """Other robots whose command node is alive."""
        from vla_zenoh.bus.session import alive_robots

        return [
            name for name in alive_robots(client.session, client.keys) if name != client.keys.robot
        ]

    def not_operator(self, profile: Profile, *command: str) -> str:
        """Why the certificate here may not drive, with what to type; empty if it may."""
        role = local_role(profile)
        if role is None or role is Role.OPERATOR:
            return ""
        assert profile.session.security is not None
        who = f"{role.value}@{profile.session.security.host}"
        able = [
            host
            for host in operator_hosts(_with_host(profile, None), stop=True)
            if operator_role(profile, host) is Role.OPERATOR
        ]
        what = (
            "this computer also has an operator certificate: "
            f"`{self.typed(*command, host=able[0])}`"
            if able
            else "`vla-zenoh secure add HOST --role operator` makes an operator certificate"
        )
        return (
            f"the certificate of this computer is {who}, and the router drops what a {role.value} "
            f"publishes; {what}"
        )


def _choices(profile: Profile, *, stop: bool) -> list[Profile]:
    """The profile with each certificate of an operator or viewer on this computer, best first."""
    hosts = operator_hosts(profile, stop=stop)
    return [_with_host(profile, host) for host in hosts] or [profile]


def _with_host(profile: Profile, host: str | None) -> Profile:
    security = profile.session.security
    assert security is not None
    session = profile.session.model_copy(
        update={"security": security.model_copy(update={"host": host})}
    )
    return profile.model_copy(update={"session": session})


def _first(choices: Sequence[Profile]) -> tuple[Profile, zenoh.Session]:
    """A session with the first certificate that the router accepts, or the first one's error."""
    failed: list[SecurityError | SessionError] = []
    for profile in choices:
        try:
            return profile, open_session(profile.session)
        except (SecurityError, SessionError) as error:
            failed.append(error)
            security = profile.session.security
            if profile is not choices[-1] and security is not None:
                why = error if isinstance(error, SecurityError) else "no router accepts it"
                warn(f"not with the certificate of {security.host} ({why}); trying the next one")
    raise failed[0]


# -- outlines of profiles: a command that drives need not load YAML and the schema ---------------
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
        "ros2": None if ros2 is None else {"prefix": ros2.prefix},
    }


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
