"""The robot that a client command is for, and how to type a command for it."""

from __future__ import annotations

import os
import shlex
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import typer
import zenoh

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    PROFILE_VARIABLE,
    ConnectOption,
    HostOption,
    ProfileOption,
    effective_profile,
    require_host,
)
from vla_zenoh.cli.plain import warn
from vla_zenoh.client.client import ANSWER_S, START_PATIENCE_S, Client, StopClient, open_patiently
from vla_zenoh.errors import SecurityError, SessionError
from vla_zenoh.profile import Profile, as_robot
from vla_zenoh.profile.stop_profile import StopProfile, load_for_stop
from vla_zenoh.security.roles import Role, operator_role
from vla_zenoh.security.store import local_role, operator_hosts

AnyProfile = TypeVar("AnyProfile", bound=Profile | StopProfile)
SILENCE_S = 0.8
OWN_STOP = "The arm may still be moving: use the robot's own emergency stop"


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
        profile = effective_profile(self.profile, self.connect, host=self.host)
        return profile if self.robot is None else as_robot(profile, self.robot)

    def load_for_stop(self) -> StopProfile:
        """Load what a stop needs of the profile: no certificate is read, no router asked."""
        changes: dict[str, Any] = {"session": {"connect": self.connect}} if self.connect else {}
        if self.robot is not None:
            changes["robot"] = {"name": self.robot}
        profile = load_for_stop(self.profile, changes)
        if self.host is None:
            return profile
        require_host(profile, self.host)
        return profile if profile.session.security is None else _with_host(profile, self.host)

    def stop_session(self, profile: AnyProfile) -> tuple[AnyProfile, zenoh.Session]:
        """A session with the best certificate that may stop the robot and that works.

        Raises:
            SecurityError: there is no certificate.
            SessionError: no router answers.
        """
        return _first(_choices(profile, stop=True))[:2]

    @contextmanager
    def client(self, *, stop: bool = False, wait_s: float = 0.0) -> Iterator[Client]:
        """A connected client that will know the nodes in a moment.

        Args:
            stop: prefer a certificate that may stop the robot, and try every one.
            wait_s: for a router, and of settings for nodes, that are starting.

        Raises:
            ProfileError: the profile is invalid.
            SecurityError: there is no certificate for an operator or viewer.
            SessionError: no router answers.
        """
        choices = _choices(self._load(), stop=stop)[: None if stop else 1]
        # A router that hangs keeps this waiting for 10 s, and the arm may be moving.
        alarm = threading.Timer(SILENCE_S, warn, [f"no router answers yet. {OWN_STOP}"])
        alarm.daemon = True
        if stop:
            alarm.start()
        try:
            profile, session, cold = _first(choices, wait_s)
        except SessionError as error:
            raise SessionError(f"{error}. {OWN_STOP}") if stop else error from error
        finally:
            alarm.cancel()
        with session:
            patience_s = max(wait_s, ANSWER_S)
            yield Client(profile, session, patience_s=patience_s, tell=warn, cold=cold).subscribe()

    @contextmanager
    def operator(self, *command: str) -> Iterator[Client]:
        """A connected client that may change settings; errors name the robot and the others.

        It waits for a router and a command node that are starting, at most `START_PATIENCE_S`.

        Raises:
            SecurityError: the certificate here is not an operator's.
            SessionError: the session or the block failed.
        """
        with self.client(wait_s=START_PATIENCE_S) as client:
            if why := self.not_operator(client.profile, *command):
                raise SecurityError(why)
            client.await_start("command")
            try:
                yield client
            except SessionError as error:
                if "command" in client.alive or client.starting():
                    raise
                raise SessionError(self.no_node(client, *command, kind="command node")) from error

    def named(self, client: StopClient) -> str:
        """Robot and profile."""
        return f"robot {client.keys.robot} (profile {self.profile})"

    def no_node(self, client: Client, *command: str, kind: str = "node") -> str:
        """Message that this robot has no such node, with `command` for the other robots."""
        if client.other_version:
            return f"no {kind} of {self.named(client)} can be read: {client.other_version}"
        if not client.session.info.routers_zid():
            where = ", ".join(client.profile.session.connect)
            return f"no Zenoh router answers at {where} any more; `vla-zenoh up` starts one"
        none = "No other robot is visible on this router; `vla-zenoh up` starts one"
        if client.profile.session.security is not None:
            none += (
                ". Or they run, and the router grants this certificate nothing (revoked, or its "
                "rights are older): `vla-zenoh doctor` tells"
            )
        there = self.alive(client, *command) or none
        return f"no {kind} of {self.named(client)} is alive. {there}"

    def alive(self, client: StopClient, *command: str) -> str:
        """Other robots whose command node is alive, with `command` for each; empty: none."""
        others = [f"{name} (`{self.typed(*command, robot=name)}`)" for name in self.others(client)]
        return f"Alive on this router: {', '.join(others)}" if others else ""

    def others(self, client: StopClient) -> list[str]:
        """Other robots whose command node is alive."""
        from vla_zenoh.bus.session import alive_robots

        return [
            name for name in alive_robots(client.session, client.keys) if name != client.keys.robot
        ]

    def not_operator(self, profile: Profile | StopProfile, *command: str) -> str:
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


def _choices(profile: AnyProfile, *, stop: bool) -> list[AnyProfile]:
    """The profile with each certificate of an operator or viewer on this computer, best first."""
    hosts = operator_hosts(profile, stop=stop)
    return [_with_host(profile, host) for host in hosts] or [profile]


def _with_host(profile: AnyProfile, host: str | None) -> AnyProfile:
    security = profile.session.security
    assert security is not None
    session = profile.session.model_copy(
        update={"security": security.model_copy(update={"host": host})}
    )
    return profile.model_copy(update={"session": session})


def _first(
    choices: Sequence[AnyProfile], wait_s: float = 0.0
) -> tuple[AnyProfile, zenoh.Session, bool]:
    """A session with the first certificate that the router accepts, or the first one's error; and
    whether the router had to be waited for."""
    failed: list[SecurityError | SessionError] = []
    for profile in choices:
        try:
            session, cold = open_patiently(profile.session, wait_s, warn)
            return profile, session, cold
        except (SecurityError, SessionError) as error:
            failed.append(error)
            security = profile.session.security
            if profile is not choices[-1] and security is not None:
                why = error if isinstance(error, SecurityError) else "no router accepts it"
                warn(f"not with the certificate of {security.host} ({why}); trying the next one")
    raise failed[0]
