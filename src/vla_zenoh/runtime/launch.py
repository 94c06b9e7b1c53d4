"""Starts and stops the nodes that a profile assigns to a host."""

from __future__ import annotations

import fcntl
import json
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import zenoh

from vla_zenoh.bus.client import Client
from vla_zenoh.bus.host import HOST_VARIABLE, own_boot_id
from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import NodeError, ProfileError, SessionError
from vla_zenoh.keys import NODE_KINDS, ROLLING, worker_node
from vla_zenoh.profile import HostProfile, Profile, override, to_yaml
from vla_zenoh.runtime.certificate_expiry import CertificateExpiry
from vla_zenoh.runtime.down_nodes import DownNodes
from vla_zenoh.runtime.process import ROUTER_PATIENCE_S
from vla_zenoh.runtime.router import reject_taken
from vla_zenoh.runtime.supervisor import DownNode, NodeCommand, Supervisor, hung_nodes
from vla_zenoh.security.identity import Role, operator_role

EXPENDABLE = ("worker", "primitives", ROLLING)
BRAKE_PATIENCE_S = 1.0
STOP_BUDGET_S = 2.9


def choose_host(profile: Profile, host: str | None) -> tuple[str, HostProfile]:
    """The section of the profile for this computer.

    Raises:
        ProfileError: no such host, or several of which none was named.
    """
    if host is None:
        if len(profile.hosts) == 1:
            return next(iter(profile.hosts.items()))
        raise ProfileError(
            f"profile {profile.name} has hosts {', '.join(profile.hosts)}: say which one this is "
            "with --host"
        )
    if host not in profile.hosts:
        raise ProfileError(
            f"profile {profile.name} has no host {host!r}; it has: {', '.join(profile.hosts)}"
        )
    return host, profile.hosts[host]


class HostLock:
    """Held by the only `vla-zenoh up` of a host and robot until `release`, or its process ends.

    Args:
        profile: of the robot.
        host: one of its hosts.
    """

    def __init__(self, profile: Profile, host: str) -> None:
        router = (profile.hosts[host].connect or profile.session.connect)[0]
        name = "-".join((profile.root, profile.robot.name, host, router))
        readable = "".join(c if c.isalnum() or c in "-._" else "_" for c in name)
        self._path = _own_folder() / f"{readable[:200]}.lock"
        self._what = f"host {host} of robot {profile.robot.name}"
        self._file: int | None = None

    def take(self) -> None:
        """Hold the lock.

        Raises:
            NodeError: another process holds it; names it, and since when.
        """
        number = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(number, 4096)
            os.close(number)
            raise NodeError(f"{self._what} is already running{_described(holder)}") from None
        os.ftruncate(number, 0)
        os.write(number, json.dumps({"pid": os.getpid(), "since_s": time.time()}).encode())
        self._file = number

    def release(self) -> None:
        """Release the lock, if it is held."""
        if self._file is not None:
            os.close(self._file)  # the file stays: removing it would let two hold it
            self._file = None


def _described(holder: bytes) -> str:
    with suppress(ValueError, KeyError, TypeError):
        found = json.loads(holder)
        pid, since_s = int(found["pid"]), float(found["since_s"])
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(since_s))
        return f": pid {pid}, since {since}. End it there with Ctrl-C, or `kill {pid}`"
    return ""


def _own_folder() -> Path:
    """A folder that only this user can access and that is emptied at boot."""
    run = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(run or tempfile.gettempdir()) / f"vla-zenoh-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        raise NodeError(f"{folder} belongs to another user; set XDG_RUNTIME_DIR")
    return folder


def node_commands(
    profile: Profile,
    host: str,
    profile_file: Path,
    worker_options: Mapping[str, Sequence[str]] | None = None,
    worker_arguments: Sequence[str] = (),
    also_files: Sequence[Path] = (),
    *,
    dry_run: bool = False,
) -> list[NodeCommand]:
    """Command lines of all nodes of `host`, in the order to start them; arguments as of `Host`.

    Raises:
        ProfileError: `also_files` without a router on this host, or `dry_run` without command node.
    """
    part = profile.hosts[host]
    if dry_run and "command" not in part.nodes:
        raise ProfileError(
            f"host {host!r} of profile {profile.name} runs no command node, which --dry-run is for"
        )
    if also_files and "router" not in part.nodes:
        routers = [name for name, other in profile.hosts.items() if "router" in other.nodes]
        raise ProfileError(
            f"host {host!r} of profile {profile.name} runs no router, which --also is for; "
            f"{' and '.join(routers) or 'no host'} does"
        )
    common = ("--profile", str(profile_file))
    more: dict[str, Sequence[str]] = {
        "router": ("--host", host, *_each("--also", map(str, also_files))),
        "camera": ("--name", profile.node_name(host, "camera"), *(part.cameras or ())),
        "command": ("--dry-run",) if dry_run else (),
    }
    commands: list[NodeCommand] = []
    for kind in sorted(part.nodes, key=list(NODE_KINDS).index):
        if kind != "worker":
            words = ("node", kind, *common, *more.get(kind, ()))
            commands.append(NodeCommand(profile.node_name(host, kind), kind, words))
            continue
        for worker in profile.workers_of(part):
            options = (worker_options or {}).get(worker, ())
            words = ("worker", worker, *common, "--host", host, *worker_arguments)
            words += _each("--set", options)
            commands.append(NodeCommand(worker_node(worker), kind, words))
    return commands


def _each(option: str, values: Iterable[str]) -> tuple[str, ...]:
    return tuple(word for value in values for word in (option, value))


class Host:
    """All nodes of one host, up while the context lasts.

    Args:
        profile: the effective profile.
        host: its name; None if there is only one.
        log: called with (node, line) for each line that a node writes.
        tell: called with (node, sentence) for each event of a node.
        own_router: fail if a router already answers.
        worker_options: worker -> ``name=value`` options.
        worker_arguments: further arguments for the command line of every worker.
        also: other robots' profiles that the router of this host serves.
        dry_run: the command node computes and checks everything but commands nothing.
        rolling: folder of the rolling record, which runs beside a command node; None: no record.

    Raises:
        NodeError: this host already runs, or a router already answers although `own_router` is set
            or `also` names robots that it does not know.
        ProfileError: there is no such host, it has no router for `also`, or it has no command node
            for `dry_run`.
    """

    def __init__(
        self,
        profile: Profile,
        host: str | None,
        *,
        log: Callable[[str, str], None],
        tell: Callable[[str, str], None],
        own_router: bool = False,
        worker_options: Mapping[str, Sequence[str]] | None = None,
        worker_arguments: Sequence[str] = (),
        also: Sequence[Profile] = (),
        dry_run: bool = False,
        rolling: Path | None = None,
    ) -> None:
        self.host, part = choose_host(profile, host)
        changes: dict[str, Any] = {"connect": list(part.connect)} if part.connect else {}
        if profile.session.security is not None:
            changes["security"] = {"host": self.host}
        if changes:
            profile = override(profile, {"session": changes})
        self.profile, self._part, self._tell = profile, part, tell
        self._folder = tempfile.TemporaryDirectory(prefix="vla-zenoh-")
        # A lab is up for weeks, and systemd-tmpfiles removes files older than 10 days, except below
        # a folder that is locked (tmpfiles.d(5)).
        self._folder_lock = os.open(self._folder.name, os.O_RDONLY | os.O_DIRECTORY)
        fcntl.flock(self._folder_lock, fcntl.LOCK_EX)
        # Children read the profile that is in force here, with all options applied.
        self.profile_file = self._write(profile)
        self._also = [self._write(other) for other in also]
        files = (self.profile_file, worker_options, worker_arguments, self._also)
        commands = node_commands(profile, self.host, *files, dry_run=dry_run)
        if rolling is not None and "command" in part.nodes:
            words = ("lab", ROLLING, "--folder", str(rolling), "--profile", str(self.profile_file))
            commands.append(NodeCommand(ROLLING, ROLLING, words))
        self.supervisor = Supervisor(
            commands,
            log=log,
            tell=tell,
            folder=Path(self._folder.name),
            variables={HOST_VARIABLE: self.host},
        )
        self._own_router = own_router
        self._once = HostLock(profile, self.host)
        self._down: DownNodes | None = None
        self._ready, self._dry_run = False, dry_run
        self._expiry = CertificateExpiry(profile.session.security)
        self.session: zenoh.Session | None = None
        self.client: Client | None = None

    def _write(self, profile: Profile) -> Path:
        folder = Path(tempfile.mkdtemp(dir=self._folder.name))
        path = folder / f"{profile.name}.yaml"
        path.write_text(to_yaml(profile), "utf-8")
        return path

    def __enter__(self) -> Host:
        try:
            self._start()
        except BaseException:
            self.stop()
            raise
        return self

    def _start(self) -> None:
        self._once.take()
        answers = self._router_answers()
        if answers and self._own_router:
            where = ", ".join(self.profile.session.connect)
            raise NodeError(f"a router already answers at {where}")
        if answers and self._also:
            raise NodeError(
                "a router already answers and cannot serve other robots; stop it, or start it "
                "with --also"
            )
        if "router" in self._part.nodes:
            if answers:
                self._tell("router", "one answers already; using it")
                self.supervisor.children = [
                    child for child in self.supervisor.children if child.command.kind != "router"
                ]
            else:
                reject_taken(self._part.listen or self.profile.session.listen)
                self._start_router()
        self.session = open_session(self.profile.session, wait_s=ROUTER_PATIENCE_S)
        self.client = Client(self.profile, self.session).subscribe()
        self.supervisor.start()
        self._down = DownNodes(self.profile, self.session, self.host, self._nodes_down)

    def _start_router(self) -> None:
        """Start the router, and all others, which wait for it while they import.

        With substitutes it starts first: nodes would connect to one of those, and stay there.
        """
        own, *substitutes = self.profile.session.connect
        self.supervisor.start("router" if substitutes else "")
        if substitutes:
            open_session(self.profile.session, connect=(own,), wait_s=ROUTER_PATIENCE_S).close()

    def _nodes_down(self) -> list[DownNode]:
        client = self.client
        if client is None:
            return []
        # A client that receives this has reached the only router, so no second one is expected.
        return [each for each in self.supervisor.down(client.alive) if each.name in client.expected]

    def _router_answers(self) -> bool:
        # If this host runs a router, its endpoint comes first; the others are substitutes.
        own = self.profile.session.connect[:1] if "router" in self._part.nodes else None
        try:
            open_session(self.profile.session, connect=own).close()
        except SessionError:
            return False
        return True

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Brake the arm, then stop every node; within `STOP_BUDGET_S` in all.

        An arm that needs none of our nodes continues: if a lab already runs and every node started
        here was rejected as a duplicate, that lab is left alone.
        """
        deadline_s = time.monotonic() + STOP_BUDGET_S
        # If this client may only observe, the arm brakes because the nodes of this host exit.
        may = (
            self.profile.session.security is None
            or operator_role(self.profile, self.host) is Role.OPERATOR
        )
        client = self.client
        if may and client is not None and "command" in client.alive and self._takes_part(client):
            self._brake(client)
        if self._down is not None:
            self._down.close()
            self._down = None
        if self.session is not None:
            self.session.close()
            self.session = self.client = None
        self.supervisor.stop(deadline_s)
        self._once.release()
        self._folder.cleanup()
        if self._folder_lock >= 0:
            os.close(self._folder_lock)
            self._folder_lock = -1

    def _takes_part(self, client: Client) -> bool:
        """Whether a live node is one of ours, and not another one of the same name."""
        alive = client.alive
        for name, (kind, _) in self.supervisor.running().items():
            if kind == "router":  # which starts only if no other one answers
                return True
            status = client.status(name) if name in alive else None
            if status is None or status.boot != own_boot_id():
                continue
            if self.supervisor.owns(name, status.pid):
                return True
        return False

    def _brake(self, client: Client) -> None:
        try:
            if not client.deactivate(BRAKE_PATIENCE_S):
                self._tell("command", "does not confirm that the arm stands")
        except zenoh.ZError as error:
            self._tell("command", f"cannot be asked to brake ({error}); stopping it brakes too")

    def serve(self, stop: threading.Event) -> None:
        """Run the nodes until `stop` is set; nodes that crash or hang are restarted.

        Reports once a day certificates of this host that are invalid or expire soon. A worker that
        keeps crashing is not restarted: a broken model must not end the robot's nodes beside it.

        Raises:
            NodeError: another node keeps crashing, or only such workers are left here.
        """
        while not stop.wait(0.1):
            self._kill_hung()
            for sentence in self._expiry.due():
                self._tell("up", sentence)
            self._tell_when_ready()
            self.poll(spare=EXPENDABLE)

    def poll(self, spare: Sequence[str] = ()) -> None:
        """Restart nodes that crashed.

        Args:
            spare: kinds of nodes that the others do not need.

        Raises:
            NodeError: another node keeps crashing.
        """
        if not self.supervisor.poll(spare=spare) and (given_up := self.supervisor.given_up):
            why = f": {given_up.why}" if given_up.why else "; its last lines say why"
            raise NodeError(f"{given_up.command.name} keeps crashing{why}")

    def _tell_when_ready(self) -> None:
        if self._ready or self.client is None:
            return
        names = {child.command.name for child in self.supervisor.children}
        names &= self.client.expected.keys()
        if not self._nodes_down() and names <= self.client.snapshot().keys():
            self._ready = True
            self._tell("up", f"{self.mode} | ready: {', '.join(sorted(names))}")

    @property
    def mode(self) -> str:
        """SIM, DRY RUN or LIVE: prefix of messages about the arm's motion."""
        if self._dry_run:
            return "DRY RUN"
        return "SIM" if self.profile.robot.driver == "sim" else "LIVE"

    def _kill_hung(self) -> None:
        if self.client is None:
            return
        heard = self.client.snapshot().items()
        said = {name: (status.pid, age_s) for name, (status, age_s, _) in heard}
        for name in hung_nodes(self.supervisor.running(), said):
            self.supervisor.terminate(
                name, f"silent for {said[name][1]:.0f} s; it hangs; killing it"
            )
