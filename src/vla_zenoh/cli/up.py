"""vla-zenoh up: all nodes of this host."""

from __future__ import annotations

import subprocess
import sys
import threading
import zlib
from typing import Annotated

import typer

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    PROFILE_VARIABLE,
    AlsoOption,
    ConnectOption,
    HostOption,
    ListenOption,
    effective_profile,
)
from vla_zenoh.cli.output import console, errors, fail, styled
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.profile import load_profile, profile_file
from vla_zenoh.resources import is_path
from vla_zenoh.runtime.launch import Host, choose_host
from vla_zenoh.runtime.process import die_with_parent, stop_on_signals

COLOURS = ("cyan", "magenta", "green", "yellow", "blue", "bright_cyan", "bright_magenta")
CHECK_PATIENCE_S = 60.0


def up(
    profile: Annotated[
        str, typer.Argument(envvar=PROFILE_VARIABLE, help="Name or path of a profile.")
    ] = DEFAULT_PROFILE,
    host: HostOption = None,
    connect: ConnectOption = None,
    listen: ListenOption = None,
    also: AlsoOption = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Compute and check everything, command nothing.")
    ] = False,
) -> None:
    """Start and supervise all nodes of this host. Ctrl-C brakes the arm, then ends them.

    The profile is checked first, as `profile check` does; nothing starts if it cannot run.
    """
    loaded = effective_profile(profile, connect, listen)
    choose_host(loaded, host)
    reject_wrong(profile, host, connect, listen)
    stop = stop_on_signals()
    die_with_parent()
    out = console()
    lock = threading.Lock()

    def log(node: str, line: str, style: str = "") -> None:
        name = styled(f"{node:>16}", COLOURS[zlib.crc32(node.encode()) % len(COLOURS)])
        with lock:
            out.print(name, styled(line, style), sep=" | ", soft_wrap=True)

    def tell(node: str, sentence: str) -> None:
        log(node, sentence, "bold")

    others = [effective_profile(name, host=host) for name in also or ()]
    with Host(loaded, host, log=log, tell=tell, also=others, dry_run=dry_run) as running:
        where = ", ".join(running.profile.session.connect)
        tell("up", f"profile {loaded.name}, host {running.host}, router at {where}")
        if dry_run:
            tell("up", "dry run: the robot gets no commands")
        target = target_of(profile, running)
        status, activate, end = (target.typed(word) for word in ("status", "activate", "stop"))
        tell("up", f"watch: {status}; drive: {activate}, also prompt; stop: {end}; end: Ctrl-C")
        running.serve(stop)
        tell("up", "braking the arm, then ending every node")
    tell("up", "all nodes have ended")


def reject_wrong(
    profile: str, host: str | None, connect: list[str] | None, listen: list[str] | None
) -> None:
    """Exit with the errors of ``vla-zenoh profile check``, if there are any.

    A process of its own checks: models are imported there, which may take much memory.
    """
    words = ["profile", "check", profile]
    words += ["--host", host] if host is not None else []
    for option, endpoints in (("--connect", connect), ("--listen", listen)):
        words += [word for endpoint in endpoints or () for word in (option, endpoint)]
    command = [sys.executable, "-m", "vla_zenoh", *words]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=CHECK_PATIENCE_S
        )
    except subprocess.TimeoutExpired:
        why = f"the check of the profile took over {CHECK_PATIENCE_S:g} s; starting without it"
        errors().print(styled(why, "yellow"), soft_wrap=True)
        return
    if done.returncode == 0:
        return
    lines = done.stderr.splitlines() or [f"`profile check` ended with code {done.returncode}"]
    for line in lines:
        errors().print(styled(line, "red"), soft_wrap=True)
    fail(f"nothing was started: {profile} has faults, which `vla-zenoh profile check` names too")


def target_of(profile: str, running: Host) -> RobotTarget:
    """Options that reach this robot from any folder and terminal of this computer."""
    there = running.profile.session.connect
    name = str(profile_file(profile)) if is_path(profile) else profile
    own = load_profile(profile).session.connect
    return RobotTarget(name, None if there == own else list(there))
