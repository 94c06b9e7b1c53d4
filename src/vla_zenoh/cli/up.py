"""vla-zenoh up: all nodes of this host."""

from __future__ import annotations

import json
import logging
import logging.handlers
import os
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vla_zenoh import plugins
from vla_zenoh.bus.shared_memory import obstacle
from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    PROFILE_VARIABLE,
    AlsoOption,
    ConnectOption,
    DryRunOption,
    HostOption,
    JsonOption,
    ListenOption,
    SimOption,
    effective_profile,
)
from vla_zenoh.cli.output import console, errors, fail, styled
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.errors import NodeError
from vla_zenoh.keys import ROLLING
from vla_zenoh.resources import is_path, profile_file
from vla_zenoh.runtime.process import DETAIL, FATAL, die_with_parent, stop_on_signals
from vla_zenoh.runtime.supervisor import repeated

if TYPE_CHECKING:
    from vla_zenoh.profile import Profile
    from vla_zenoh.runtime.launch import Host

LOG_BYTES = 10 * 1024 * 1024
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
    sim: SimOption = False,
    dry_run: DryRunOption = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Also show tracebacks and every restart.")
    ] = False,
    log_dir: Annotated[
        Path | None,
        typer.Option(
            "--log-dir", help="Folder of the log file. Default: ~/.local/state/vla-zenoh."
        ),
    ] = None,
    no_record: Annotated[
        bool, typer.Option("--no-record", help="Keep no rolling record of the last minutes.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Start and supervise all nodes of this host. Ctrl-C brakes the arm, then ends them.

    The profile is checked first, as `profile check` does; nothing starts if it cannot run.
    """
    hosts = repeated("--host", None if host is None else [host])
    endpoints = (*repeated("--connect", connect), *repeated("--listen", listen))
    simulated = ["--sim"] if sim else []
    with profile_check([profile, *hosts, *endpoints, *simulated]) as check:
        from vla_zenoh.runtime.launch import Host, choose_host, lock_host  # meanwhile

        loaded = effective_profile(profile, connect, listen, sim=sim)
        name, part = choose_host(loaded, host)
        for kind in part.nodes:
            if f"node.{kind}" in plugins.PACKAGES and (why := plugins.lacking(f"node.{kind}")):
                raise NodeError(f"hosts.{name}.nodes has {kind}: {why}")
        lock_host(loaded, name).close()  # says at once that it runs already; `Host` takes it again
        reject_wrong(profile, check)
    logs = log_dir or default_log_folder()
    file, logger = log_file(logs, f"{loaded.robot.name}-{name}")
    stop = stop_on_signals()
    die_with_parent()
    out = console()
    lock = threading.Lock()

    def show(node: str, line: str, style: str = "") -> None:
        if as_json:
            said = {"time_s": time.time(), "node": node, "from": "up" if style else "node"}
            with lock:
                print(json.dumps({**said, "text": line}), flush=True)
            return
        name = styled(f"{node:>16}", COLOURS[zlib.crc32(node.encode()) % len(COLOURS)])
        with lock:
            out.print(name, styled(line, style), sep=" | ", soft_wrap=True)

    def log(node: str, line: str) -> None:
        hidden = line.startswith((DETAIL, FATAL))
        logger.log(logging.DEBUG if hidden else logging.INFO, "%s: %s", node, line)
        if verbose or not hidden:
            show(node, line)

    def tell(node: str, sentence: str) -> None:
        logger.info("%s: %s", node, sentence)
        show(node, sentence, "bold")

    others = [effective_profile(name, host=host) for name in also or ()]
    missing = plugins.lacking(f"node.{ROLLING}")
    record = None if no_record or missing else rolling_folder(logs, loaded)
    given: dict[str, Any] = {
        "also": others,
        "dry_run": dry_run,
        "rolling": record,
        "state": logs.absolute(),
    }
    with Host(loaded, host, log=log, tell=tell, **given) as running:
        where = ", ".join(running.profile.session.connect)
        more = "; the robot gets no commands" if dry_run else ""
        place = f"profile {loaded.name}, host {running.host}, router at {where}"
        tell("up", f"{running.mode} | {place}{more}")
        tell("up", f"log: {file}")
        if loaded.session.shared_memory and (why := obstacle()):
            tell("up", f"no shared memory: {why}")
        kinds = {child.command.kind for child in running.supervisor.children}
        if ROLLING in kinds:
            tell("up", f"rolling record: {record}")
        elif "command" in kinds and not no_record:
            tell("up", f"no rolling record: {missing}")
        target = target_of(profile, running)
        status, activate, end = (target.typed(word) for word in ("status", "activate", "stop"))
        tell("up", f"watch: {status}; drive: {activate}, also prompt; stop: {end}; end: Ctrl-C")
        running.serve(stop)
        tell("up", "braking the arm, then stopping every node")
    tell("up", "all nodes have stopped")


def default_log_folder() -> Path:
    """Where `up` keeps its log: ``$XDG_STATE_HOME/vla-zenoh``."""
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "vla-zenoh"


def rolling_folder(logs: Path, profile: Profile) -> Path:
    """Where `up` keeps the rolling record of a robot, beside its log."""
    return logs.absolute() / f"rolling-{profile.robot.name}"


def log_file(folder: Path, name: str) -> tuple[Path, logging.Logger]:
    """A log of everything the nodes of a host write, with times; it grows to 4 x `LOG_BYTES`.

    Raises:
        NodeError: it cannot be written.
    """
    path = folder / f"{name}.log"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handler = logging.handlers.RotatingFileHandler(
            path, maxBytes=LOG_BYTES, backupCount=3, encoding="utf-8", errors="backslashreplace"
        )
    except OSError as error:
        raise NodeError(f"{path} cannot be written: {error.strerror}; choose --log-dir") from error
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logger = logging.Logger("up", logging.DEBUG)
    logger.addHandler(handler)
    return path, logger


@contextmanager
def profile_check(words: Sequence[str]) -> Iterator[subprocess.Popen[str]]:
    """``vla-zenoh profile check`` with these arguments; it ends with the block.

    A separate process checks: models are imported there, which may take much memory.
    """
    with subprocess.Popen(
        [sys.executable, "-m", "vla_zenoh", "profile", "check", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def reject_wrong(profile: str, check: subprocess.Popen[str]) -> None:
    """Exit with the errors of the check, if there are any."""
    try:
        _, said = check.communicate(timeout=CHECK_PATIENCE_S)
    except subprocess.TimeoutExpired:
        why = f"the check of the profile took over {CHECK_PATIENCE_S:g} s; starting without it"
        errors().print(styled(why, "yellow"), soft_wrap=True)
        return
    if check.returncode == 0:
        return
    lines = said.splitlines() or [f"`profile check` ended with code {check.returncode}"]
    for line in lines:
        errors().print(styled(line, "red"), soft_wrap=True)
    fail(f"nothing was started: {profile} has faults; `vla-zenoh profile check` lists them too")


def target_of(profile: str, running: Host) -> RobotTarget:
    """Options that reach this robot from any folder and terminal of this computer."""
    there = running.profile.session.connect
    name = str(profile_file(profile)) if is_path(profile) else profile
    own = effective_profile(profile).session.connect
    return RobotTarget(name, None if there == own else list(there))
