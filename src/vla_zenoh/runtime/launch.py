"""Starts and stops the nodes that a profile assigns to a host."""

from __future__ import annotations

import fcntl
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO, Any

import zenoh

from vla_zenoh.bus.host import HOST_VARIABLE, HostId, own_boot_id, own_host_id
from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.errors import NodeError, ProfileError, SessionError, VlaZenohError
from vla_zenoh.keys import (
    CRASHED,
    NODE_KINDS,
    OPENING,
    ROLLING,
    STARTING,
    worker_node,
)
from vla_zenoh.profile import HostProfile, Profile, override, to_yaml
from vla_zenoh.runtime.certificate_expiry import CertificateExpiry
from vla_zenoh.runtime.process import ROUTER_PATIENCE_S, RUN_FOLDER_VARIABLE
from vla_zenoh.runtime.router import reject_taken
from vla_zenoh.runtime.starting import Voice
from vla_zenoh.runtime.supervisor import (
    Child,
    NodeCommand,
    SilenceMeter,
    Supervisor,
    hung_nodes,
    is_hearing,
    repeated,
    signal_group,
)
from vla_zenoh.security.roles import Role, operator_role
from vla_zenoh.types import Event, NodeStatus

EXPENDABLE = ("worker", "primitives", ROLLING)
BRAKE_PATIENCE_S = 1.0
STOP_BUDGET_S = 2.9
DOWN_PERIOD_S = 0.5
MAX_WHY = 1000


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


def lock_host(profile: Profile, host: str) -> IO[str]:
    """Lock of the only `vla-zenoh up` of a host and robot, until it is closed or its process ends.

    Raises:
        NodeError: another process holds it; names it, and since when.
    """
    # A folder that only this user can access and that is emptied at boot.
    run = os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()
    folder = Path(run) / f"vla-zenoh-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        raise NodeError(f"{folder} belongs to another user; set XDG_RUNTIME_DIR")
    router = (profile.hosts[host].connect or profile.session.connect)[0]
    name = "-".join((profile.root, profile.robot.name, host, router))
    readable = "".join(c if c.isalnum() or c in "-._" else "_" for c in name)
    # It is never removed: then two could hold it.
    path = folder / f"{readable[:200]}.lock"
    path.touch(mode=0o600)  # another user who could open it could hold it
    file = path.open("a+", encoding="utf-8", errors="replace")
    file.seek(0)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = file.read(4096)
        file.close()
        raise NodeError(
            f"host {host} of robot {profile.robot.name} is already running{holder}"
        ) from None
    file.truncate()
    pid, since = os.getpid(), time.strftime("%Y-%m-%d %H:%M:%S")
    file.write(f": pid {pid}, since {since}. End it there with Ctrl-C, or `kill {pid}`")
    file.flush()
    return file


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
        "router": ("--host", host, *repeated("--also", map(str, also_files))),
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
            options = repeated("--set", (worker_options or {}).get(worker, ()))
            words = ("worker", worker, *common, "--host", host, *worker_arguments, *options)
            commands.append(NodeCommand(worker_node(worker), kind, words))
    return commands


class Host:
    """All nodes of one host, up while the context lasts.

    Args:
        profile, host: the effective profile, and the host's name; None if there is only one.
        log, tell: called with (node, line) that it writes, and (node, sentence) about it.
        own_router: fail if a router already answers.
        worker_options: worker -> ``name=value`` options.
        worker_arguments: further arguments for the command line of every worker.
        also: other robots' profiles that the router of this host serves.
        dry_run: the command node computes and checks everything but commands nothing.
        rolling: folder of the rolling record, which runs beside a command node; None: no record.
        state: folder in which stops outlive this; None: they end with it.

    Raises:
        NodeError: this host already runs, or a router already answers although `own_router` is set
            or `also` names robots that it does not know.
        ProfileError: no such host, no router there for `also`, or no command node for `dry_run`.
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
        state: Path | None = None,
    ) -> None:
        self.host, part = choose_host(profile, host)
        changes: dict[str, Any] = {"connect": list(part.connect)} if part.connect else {}
        if profile.session.security is not None:
            changes["security"] = {"host": self.host}
        if changes:
            profile = override(profile, {"session": changes})
        self.profile, self._part, self._tell = profile, part, tell
        self._held = ExitStack()
        self._folder = self._held.enter_context(tempfile.TemporaryDirectory(prefix="vla-zenoh-"))
        # A lab is up for weeks, and systemd-tmpfiles removes files older than 10 days, except below
        # a folder that is locked (tmpfiles.d(5)).
        number = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY)
        self._held.callback(os.close, number)
        fcntl.flock(number, fcntl.LOCK_EX)
        # Children read the profile that is in force here, with all options applied.
        self.profile_file = self._write(profile)
        self._also = [self._write(other) for other in also]
        files = (self.profile_file, worker_options, worker_arguments, self._also)
        commands = node_commands(profile, self.host, *files, dry_run=dry_run)
        if rolling is not None and "command" in part.nodes:
            words = ("node", ROLLING, "--folder", str(rolling), "--profile", str(self.profile_file))
            commands.append(NodeCommand(ROLLING, ROLLING, words))
        self.supervisor = Supervisor(
            commands,
            log=log,
            tell=tell,
            variables={HOST_VARIABLE: self.host, RUN_FOLDER_VARIABLE: str(state or self._folder)},
        )
        self._own_router = own_router
        self._down: DownNodes | None = None
        self._ready, self._dry_run = False, dry_run
        self._deaf_s = time.monotonic()  # when no node was heard
        self._silence = SilenceMeter()
        self._starting: list[str] = []
        self._expiry = CertificateExpiry(profile.session.security)
        self.session: zenoh.Session | None = None
        self.client: Client | None = None

    def _write(self, profile: Profile) -> Path:
        folder = Path(tempfile.mkdtemp(dir=self._folder))
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

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _start(self) -> None:
        self._held.enter_context(lock_host(self.profile, self.host))
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
                self._tell(
                    "router",
                    f"one answers already at {self.profile.session.connect[0]}; using it, until "
                    "its program ends. For one of its own: --connect and --listen, another port",
                )
                self.supervisor.children = [
                    child for child in self.supervisor.children if child.command.kind != "router"
                ]
            else:
                reject_taken(self._part.listen or self.profile.session.listen)
                own, *substitutes = self.profile.session.connect
                # All others wait for it while they import. With substitutes it starts first: nodes
                # would connect to one of those, and stay there.
                self.supervisor.start("router" if substitutes else "")
                if substitutes:
                    first = open_session(
                        self.profile.session, connect=(own,), wait_s=ROUTER_PATIENCE_S
                    )
                    first.close()
        self.session = open_session(self.profile.session, wait_s=ROUTER_PATIENCE_S)
        self.client = Client(self.profile, self.session).subscribe()
        self.supervisor.start()
        self._down = DownNodes(self.profile, self.session, self.host, self._nodes_down)

    def _nodes_down(self) -> list[Child]:
        client = self.client
        if client is None:
            return []
        # A client that receives this has reached the only router, so no second one is expected.
        down = self.supervisor.down(client.alive)
        return [child for child in down if child.command.name in client.expected]

    def _router_answers(self) -> bool:
        # If this host runs a router, its endpoint comes first; the others are substitutes.
        own = self.profile.session.connect[:1] if "router" in self._part.nodes else None
        try:
            open_session(self.profile.session, connect=own).close()
        except SessionError:
            return False
        return True

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
            try:
                if not client.deactivate(BRAKE_PATIENCE_S):
                    self._tell("command", "does not confirm that the arm stands")
            except zenoh.ZError as error:
                why = f"cannot be asked to brake ({error}); stopping it brakes too"
                self._tell("command", why)
        if self._down is not None:
            self._down.close()
        if self.session is not None:
            self.session.close()
        self.session = self.client = None
        self.supervisor.stop(deadline_s)
        self._held.close()

    def _takes_part(self, client: Client) -> bool:
        """Whether a live node is one of ours, and not another one of the same name."""
        for name, (kind, pid) in self.supervisor.running().items():
            if kind == "router":  # which starts only if no other one answers
                return True
            status = client.status(name) if name in client.alive else None
            if status is None or status.boot != own_boot_id():
                continue
            # The environment of a model (uv) may be a process between us and the node.
            with suppress(ProcessLookupError, OverflowError):
                if os.getpgid(status.pid) == pid:
                    return True
        return False

    def serve(self, stop: threading.Event) -> None:
        """Run the nodes until `stop` is set; nodes that crash or hang are restarted.

        Reports once a day certificates of this host that are invalid or expire soon. A worker that
        keeps crashing is not restarted: a broken model must not end the robot's nodes beside it.

        Raises:
            NodeError: another node keeps crashing, or only such workers are left here.
        """
        while not stop.wait(0.1):
            for sentence in self._expiry.due():
                self._tell("up", sentence)
            if self.client is not None:
                self._look_at_nodes(self.client)
            self.poll(spare=EXPENDABLE)

    def poll(self, spare: Sequence[str] = ()) -> None:
        """Restart nodes that crashed; `NodeError`: one that is not of a kind to `spare` keeps
        crashing, or only such nodes are left here."""
        if not self.supervisor.poll(spare=spare) and (given_up := self.supervisor.given_up):
            why = f": {given_up.why}" if given_up.why else "; its last lines say why"
            raise NodeError(f"{given_up.command.name} keeps crashing{why}")

    def _look_at_nodes(self, client: Client) -> None:
        """Kill those that hang; report once that all are ready."""
        heard, running = client.snapshot(), self.supervisor.running()
        now_s = time.monotonic()
        said: dict[str, tuple[int, float]] = {}
        for name, (status, age_s, _) in heard.items():
            if name in running:
                starting = status.state == STARTING  # which `up` has published in its name
                silent_s = self._silence.silent_s(
                    name, running[name][1], age_s, now_s, starting=starting
                )
                said[name] = status.pid, silent_s
        if not is_hearing(heard):
            self._deaf_s = now_s
        for name in hung_nodes(running, said, now_s - self._deaf_s):
            self._tell(name, f"silent for {said[name][1]:.0f} s; it hangs; killing it")
            signal_group(running[name][1], signal.SIGKILL)
        names = client.expected.keys() & {each.command.name for each in self.supervisor.children}
        if self._ready or self._nodes_down() or not names <= heard.keys():
            return
        starting = sorted(why for name in names for why in still_starting(heard[name][0]))
        if not starting:
            self._ready = True
            self._tell("up", f"{self.mode} | ready: {', '.join(sorted(names))}")
            if self.mode == "LIVE" and self.profile.unconfirmed:
                guessed = ", ".join(self.profile.unconfirmed)
                self._tell("up", f"LIVE | rejects activation until these are confirmed: {guessed}")
        elif starting != self._starting:
            self._tell("up", f"{self.mode} | starting: {'; '.join(starting)}")
        self._starting = starting

    @property
    def mode(self) -> str:
        """SIM, DRY RUN or LIVE: prefix of messages about the arm's motion."""
        if self._dry_run:
            return "DRY RUN"
        return "SIM" if self.profile.robot.driver == "sim" else "LIVE"


def still_starting(status: NodeStatus) -> list[str]:
    """What of a node is still starting, as sentences; a camera that cannot be opened is not."""
    if status.state == STARTING:
        return [f"{status.node}: {status.detail.get('complaint') or 'it has not reported yet'}"]
    cameras = status.detail.get("cameras")
    if not isinstance(cameras, Mapping):
        return []
    return [
        f"camera {name!r}: {why}"
        for name, camera in cameras.items()
        if isinstance(camera, Mapping) and (why := str(camera.get("why"))).startswith(OPENING)
    ]


class DownNodes:
    """Publishes that nodes of this host crashed or are starting, in a thread, until `close`.

    A node that cannot start cannot publish its reason; without this it would be in one terminal
    only. The status is published in the node's name and with its certificate, on its own keys,
    which no other role may put.

    Args:
        profile: the effective profile.
        session: of the operator at this computer; in a secured lab each node gets its own.
        host: of the profile.
        down: the nodes that are down now.
    """

    def __init__(
        self,
        profile: Profile,
        session: zenoh.Session,
        host: str,
        down: Callable[[], Sequence[Child]],
    ) -> None:
        self._profile, self._session, self._down = profile, session, down
        self._host_id = own_host_id(profile.session, host)
        self._voices: dict[str, _Voice] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="down nodes", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and its sessions."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(DOWN_PERIOD_S):
            # If the router is down, so is every subscriber.
            with suppress(VlaZenohError, zenoh.ZError):
                self._publish(self._down())
        self._publish(())

    def _publish(self, down: Sequence[Child]) -> None:
        for name in self._voices.keys() - {child.command.name for child in down}:
            self._voices.pop(name).close()
        for child in down:
            name = child.command.name
            if name not in self._voices:
                self._voices[name] = _Voice(self._profile, name, self._session, self._host_id)
            self._voices[name].publish(child)


class _Voice:
    """Voice of one node that is down."""

    def __init__(self, profile: Profile, name: str, session: zenoh.Session, place: HostId) -> None:
        self._own: zenoh.Session | None = None
        if profile.session.security is not None:
            session = self._own = open_session(profile.session, identity=name)
        self._voice, self._crashes = Voice(session, profile, name, place), 0

    def publish(self, child: Child) -> None:
        crashes, state, why = child.deaths_in_a_row, STARTING, ""
        if crashes:
            state = CRASHED
            times = "once" if crashes == 1 else f"{crashes} times"
            then = (
                "correct that and restart `up` there" if child.left_alone else "it is started again"
            )
            end = child.end.encode("utf-8", "replace").decode()[:MAX_WHY]
            why = f"crashed {times}: {end}; {then}"
        if crashes > self._crashes:
            self._voice.emit(Event("error", "fault", CRASHED, why))
        self._crashes = crashes
        given_up = child.left_alone
        self._voice.say(state, child.pid, complaint=why, crashes=crashes, given_up=given_up)

    def close(self) -> None:
        self._voice.close()
        if self._own is not None:
            self._own.close()
