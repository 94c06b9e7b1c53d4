"""Which robot a person's command is for, and how that is typed."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import zenoh

from vla_zenoh.bus.client import Client
from vla_zenoh.bus.liveliness import alive_robots
from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.options import DEFAULT_PROFILE, PROFILE_VARIABLE, effective_profile
from vla_zenoh.cli.output import errors, styled
from vla_zenoh.errors import SecurityError, SessionError
from vla_zenoh.profile import Profile, as_robot
from vla_zenoh.security.identity import Role, operator_role
from vla_zenoh.security.operator_identity import local_role, operator_hosts


@dataclass(frozen=True, slots=True)
class RobotTarget:
    """What was given on the command line.

    Args:
        profile: name or path.
        connect: routers, in place of the profile's.
        host: which host of the profile this computer is, or whose certificate people show.
        robot: in place of the profile's.
    """

    profile: str = DEFAULT_PROFILE
    connect: Sequence[str] | None = None
    host: str | None = None
    robot: str | None = None

    def typed(self, *command: str, host: str | None = None, robot: str | None = None) -> str:
        """The whole of another command that means the same.

        Args:
            command: its words, such as ``status``.
            host: in place of its own.
            robot: likewise.
        """
        words = ["vla-zenoh", *command]
        if self.profile != DEFAULT_PROFILE or PROFILE_VARIABLE in os.environ:
            words += ["--profile", self.profile]
        for endpoint in self.connect or ():
            words += ["--connect", endpoint]
        for option, value in (("--host", host or self.host), ("--robot", robot or self.robot)):
            words += [option, value] if value is not None else []
        return shlex.join(words)

    # -- the profile --------------------------------------------------------------------------
    def load(self) -> Profile:
        """The profile, with the certificate of whoever people here are.

        Raises:
            ProfileError: it is wrong.
        """
        return self._choices(stop=False)[0]

    def _choices(self, *, stop: bool) -> list[Profile]:
        """The same for each of those who people here may be, best first."""
        profile = effective_profile(self.profile, list(self.connect or ()), host=self.host)
        if self.robot is not None:
            profile = as_robot(profile, self.robot)
        hosts = operator_hosts(profile, stop=stop)
        return [_with_host(profile, host) for host in hosts] or [profile]

    # -- sessions -----------------------------------------------------------------------------
    @contextmanager
    def client(self, *, stop: bool = False) -> Iterator[Client]:
        """A connected client that already hears the nodes.

        Args:
            stop: as somebody who may stop the robot, if any who lie here may; tries all of them.

        Raises:
            ProfileError: the profile is wrong.
            SecurityError: there is no certificate for people.
            SessionError: no router answers.
        """
        profile, session = _first(self._choices(stop=stop)[: None if stop else 1])
        with session:
            yield Client(profile, session).subscribe()

    @contextmanager
    def driver(self, *command: str) -> Iterator[Client]:
        """Likewise, to put a setting; an error names the robot and tells of others.

        Args:
            command: what is done, in words as they are typed.

        Raises:
            SecurityError: people here may not drive.
            SessionError: what goes wrong in the block, as well.
        """
        with self.client() as client:
            if why := self.powerless(client.profile, *command):
                raise SecurityError(why)
            try:
                yield client
            except SessionError as error:
                if "command" in client.alive:
                    raise
                raise SessionError(self.absent(client, *command)) from error

    # -- words --------------------------------------------------------------------------------
    def named(self, client: Client) -> str:
        """Robot and profile."""
        return f"robot {client.keys.robot} (profile {self.profile})"

    def absent(self, client: Client, *command: str) -> str:
        """That nobody obeys for this robot, and what to type for those that are there."""
        return f"no command node of {self.named(client)} is alive. {self.there(client, *command)}"

    def silent(self, client: Client, *command: str) -> str:
        """That nothing is heard of this robot, and what to type for those that are there."""
        return f"nothing is heard of {self.named(client)}. {self.there(client, *command)}"

    def there(self, client: Client, *command: str) -> str:
        """Which other robots are alive on this router, with what to type."""
        others = [f"{name} (`{self.typed(*command, robot=name)}`)" for name in self.others(client)]
        if not others:
            return (
                "Nor is another robot alive on this router, as far as one may know here; "
                "`vla-zenoh up` starts one"
            )
        return f"Alive on this router: {', '.join(others)}"

    def others(self, client: Client) -> list[str]:
        """Other robots whose command node is alive."""
        return [
            name for name in alive_robots(client.session, client.keys) if name != client.keys.robot
        ]

    def powerless(self, profile: Profile, *command: str) -> str:
        """Why people here drive no robot, empty where they may, with what to type if that helps."""
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
            f"here lies that of an operator: `{self.typed(*command, host=able[0])}`"
            if able
            else "`vla-zenoh secure add HOST --role operator` makes one of somebody who may"
        )
        return (
            f"the certificate of people here is {who}, and the router drops what a {role.value} "
            f"says; {what}"
        )


def _with_host(profile: Profile, host: str | None) -> Profile:
    security = profile.session.security
    assert security is not None
    session = profile.session.model_copy(
        update={"security": security.model_copy(update={"host": host})}
    )
    return profile.model_copy(update={"session": session})


def _first(choices: Sequence[Profile]) -> tuple[Profile, zenoh.Session]:
    """A session with the first certificate that the router takes.

    Raises:
        SecurityError: as the first of them, where none is taken.
        SessionError: likewise.
    """
    failed: list[SecurityError | SessionError] = []
    for profile in choices:
        try:
            return profile, open_session(profile.session)
        except (SecurityError, SessionError) as error:
            failed.append(error)
            if profile is not choices[-1]:
                _tell_next(profile, error)
    raise failed[0]


def _tell_next(profile: Profile, error: SecurityError | SessionError) -> None:
    security = profile.session.security
    assert security is not None
    why = error if isinstance(error, SecurityError) else "there is no router that takes it"
    told = f"not with the certificate of {security.host} ({why}); trying the next one here"
    errors().print(styled(told, "yellow"), soft_wrap=True)
