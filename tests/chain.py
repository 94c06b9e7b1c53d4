"""A whole robot at work: real processes under a real `Host`, a client, and a record of its motion.

`running_chain` starts what ``vla-zenoh up`` starts, on a free port, with small pictures, and hands
over a `Chain`: put settings through `Chain.client`, end processes by `Chain.pid`, and ask
`Chain.track` how the arm moved.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zenoh
from camera_rig import PATIENCE_S, free_endpoint, until
from numpy.typing import NDArray

from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.codec import records
from vla_zenoh.errors import SessionError
from vla_zenoh.keys import Keys
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.runtime import launch
from vla_zenoh.runtime.launch import Host
from vla_zenoh.types import Event, PoseCommand, PoseState, Task

READY_PATIENCE_S = 90.0
"""From nothing to an arm that obeys, on a busy machine: five interpreters load numpy and more."""
launch.ROUTER_PATIENCE_S = READY_PATIENCE_S
END_PATIENCE_S = 10.0
MOVING_M_S = 0.05
STILL_M_S = 0.005
"""A measured arm that is slower than this stands: the impedance controller still settles."""
WIDTH, HEIGHT, CAMERA_HZ = 160, 120, 10
"""As many pictures as the worker asks for: each is drawn by the processor."""
LOW_M, HIGH_M = 0.30, 0.55
UNKNOWN = np.full(3, np.nan)

FloatArray = NDArray[np.float64]

PROFILE = """\
extends: {extends}
cameras:
  front: {{source: "sim:front", width: {width}, height: {height}, rate_hz: {camera_hz}}}
  wrist: null
task: {{prompt: hold, rate_hz: {rate_hz}, worker: scripted}}
session:
  listen: [{endpoint}]
  connect: [{endpoint}]
  lease_ms: {lease_ms}
timing:
  command_timeout_s: {patience_s[command]}
  state_timeout_s: {patience_s[state]}
  command_hz: {command_hz}
  state_hz: {state_hz}
{more}"""
COMMAND_HZ, STATE_HZ = (250, 200) if (os.cpu_count() or 1) >= 4 else (100, 100)
"""Two slow cores are not enough for robot, camera and model at 250 Hz, and a test beside them."""
# A computer that is busy with other things stands still for a tenth of a second now and then, which
# is where the shipped profiles rightly brake. tests/sim/test_motion_robot.py holds them to it, in
# the arm's own time.
CHAIN_PATIENCE_S = {"command": 0.25, "state": 0.35}
LONG_PATIENCE_S = {"command": 1.0, "state": 2.0}
"""The longest that a profile may ask for: for tests that look at no brake by silence. Their file
says ``ROBOT_PATIENCE_S = LONG_PATIENCE_S``."""
LEASE_MS = 4000
"""A process that a busy computer does not run for a second is not to be given up by the router."""
SETTLE_AGAIN_S = 2.0
THERE_MM = 0.01


def write_profile(
    folder: Path,
    *,
    extends: str = "panda_sim",
    rate_hz: float = 10.0,
    endpoint: str | None = None,
    more: str = "",
    name: str = "small",
    patience_s: Mapping[str, float] = CHAIN_PATIENCE_S,
    lease_ms: int = LEASE_MS,
) -> Path:
    """A profile with small pictures and an address of its own; `more` is YAML at its end."""
    path = folder / f"{name}.yaml"
    path.write_text(
        PROFILE.format(
            extends=extends,
            width=WIDTH,
            height=HEIGHT,
            camera_hz=CAMERA_HZ,
            rate_hz=rate_hz,
            endpoint=endpoint or free_endpoint(),
            patience_s=patience_s,
            command_hz=COMMAND_HZ,
            state_hz=STATE_HZ,
            lease_ms=lease_ms,
            more=more,
        )
    )
    return path


class Track(NamedTuple):
    """How the arm moved: one row per ``state/pose``, in the order of their stamps.

    Args:
        stamp_ns: (n,) the simulator's time of each state.
        position_m: (n, 3) measured.
        twist: (n, 6) measured, m/s and rad/s.
        reference_m: (n, 3) what the robot's own controller was following.
        sources: (n,) who wrote it: changes when the simulator is started anew.
    """

    stamp_ns: NDArray[np.int64]
    position_m: FloatArray
    twist: FloatArray
    reference_m: FloatArray
    sources: NDArray[Any]

    @property
    def speed_m_s(self) -> FloatArray:
        return np.linalg.norm(self.twist[:, :3], axis=1)

    def between(self, since_ns: int, until_ns: int = 1 << 62) -> Track:
        chosen = (self.stamp_ns >= since_ns) & (self.stamp_ns < until_ns)
        return Track(*(column[chosen] for column in self))

    def of(self, source: str) -> Track:
        chosen = self.sources == source
        return Track(*(column[chosen] for column in self))

    def time_to_stand_s(self, since_ns: int) -> float:
        """From `since_ns` until the measured speed stays below `STILL_M_S`; inf: it never does."""
        after = self.between(since_ns)
        moving = np.flatnonzero(after.speed_m_s > STILL_M_S)
        if len(moving) == 0:
            return 0.0
        if moving[-1] == len(after.stamp_ns) - 1:
            return float("inf")
        return (int(after.stamp_ns[moving[-1] + 1]) - since_ns) / 1e9

    def hardest_change(self, window_s: float = 0.02) -> float:
        """Largest change of the measured velocity within `window_s`, as m/s^2."""
        return _steepest(self.stamp_ns, self.twist[:, :3], window_s)

    def hardest_reference_change(self, window_s: float = 0.02) -> float:
        """The same of the reference the robot's controller followed."""
        t_s = (self.stamp_ns - self.stamp_ns[0]) / 1e9
        velocity = np.diff(self.reference_m, axis=0) / np.diff(t_s)[:, None]
        return _steepest(self.stamp_ns[1:], velocity, window_s)

    def largest_step_m(self) -> float:
        """Largest distance between two references that follow each other."""
        return float(np.linalg.norm(np.diff(self.reference_m, axis=0), axis=1).max(initial=0.0))


def _steepest(stamp_ns: NDArray[np.int64], velocity: FloatArray, window_s: float) -> float:
    later = np.searchsorted(stamp_ns, stamp_ns + int(window_s * 1e9))
    keep = later < len(stamp_ns)
    first = np.flatnonzero(keep)
    apart_s = (stamp_ns[later[keep]] - stamp_ns[first]) / 1e9
    change = np.abs(velocity[later[keep]] - velocity[first]).max(axis=1)
    return float((change / apart_s).max(initial=0.0))


class Recorder:
    """Keeps every ``state/pose`` and ``command/pose`` as it came; decodes when asked.

    The records of strangers are left out: what `source` does not say ``sim#`` or ``command#``, and
    bytes that are no record. A test that forges those names says so by `only`.
    """

    def __init__(self, session: zenoh.Session, keys: Keys) -> None:
        self.only: Mapping[str, str] = {"state": "sim#", "command": "command#"}
        self._states: list[tuple[bytes, bytes | None, int]] = []
        self._commands: list[tuple[bytes, bytes | None, int]] = []
        self._subscribers = [
            session.declare_subscriber(key, zenoh.handlers.Callback(keep, indirect=False))
            for key, keep in (
                (keys.state_pose, self._keep_in(self._states)),
                (keys.command_pose, self._keep_in(self._commands)),
            )
        ]

    @staticmethod
    def _keep_in(
        samples: list[tuple[bytes, bytes | None, int]],
    ) -> Callable[[zenoh.Sample], None]:
        def keep(sample: zenoh.Sample) -> None:
            attachment = sample.attachment
            samples.append(
                (
                    sample.payload.to_bytes(),
                    attachment.to_bytes() if attachment is not None else None,
                    time.time_ns(),
                )
            )

        return keep

    def _read(self, samples: Sequence[Any], kind: type, since_ns: int, ours: str) -> list[Any]:
        out = []
        for payload, attachment, arrived_ns in list(samples):
            if arrived_ns < since_ns:
                continue
            try:
                header = records.decode_header(attachment)
                if header.source.startswith(ours):
                    out.append((header, records.decode(kind, payload)))
            except ValueError:
                continue
        return out

    def track(self, since_ns: int = 0) -> Track:
        """The measured motion of what arrived since `since_ns`."""
        found: list[tuple[Any, PoseState]] = self._read(
            self._states, PoseState, since_ns, self.only["state"]
        )
        found.sort(key=lambda pair: pair[0].stamp_wall_ns)
        return Track(
            np.array([header.stamp_wall_ns for header, _ in found], np.int64),
            np.array([state.position_m for _, state in found]).reshape(-1, 3),
            np.array([state.twist for _, state in found]).reshape(-1, 6),
            np.array(
                [
                    UNKNOWN if state.reference_position_m is None else state.reference_position_m
                    for _, state in found
                ]
            ).reshape(-1, 3),
            np.array([header.source for header, _ in found]),
        )

    def commands(self, since_ns: int = 0) -> list[tuple[Any, PoseCommand]]:
        """(header, command) of what arrived since `since_ns`."""
        return self._read(self._commands, PoseCommand, since_ns, self.only["command"])

    def hardest_command(self, since_ns: int = 0) -> float:
        """Largest change of the commanded velocity within 20 ms, as m/s^2."""
        found = sorted(self.commands(since_ns), key=lambda pair: pair[0].stamp_wall_ns)
        hardest = 0.0
        for source in {header.source for header, _ in found}:
            own = [(h.stamp_wall_ns, c.twist[:3]) for h, c in found if h.source == source]
            stamps = np.array([stamp for stamp, _ in own], np.int64)
            hardest = max(hardest, _steepest(stamps, np.array([v for _, v in own]), 0.02))
        return hardest

    def newest_state(self) -> PoseState | None:
        """The newest measured pose by the simulator."""
        for payload, attachment, _ in reversed(self._states):
            try:
                if records.decode_header(attachment).source.startswith(self.only["state"]):
                    return records.decode(PoseState, payload)
            except ValueError:
                continue
        return None

    def forget(self) -> None:
        """Drop what was recorded so far."""
        self._states.clear()
        self._commands.clear()


class PatientClient(Client):
    """A client that waits as long as a busy computer may need, unless a test says how long."""

    def set_prompt(self, prompt: str, timeout_s: float = PATIENCE_S) -> Task:
        return super().set_prompt(prompt, timeout_s)

    def set_rate(self, rate_hz: float, timeout_s: float = PATIENCE_S) -> Task:
        return super().set_rate(rate_hz, timeout_s)

    def set_speed(self, percent: float, timeout_s: float = PATIENCE_S) -> Task:
        return super().set_speed(percent, timeout_s)

    def slow_down(self, percent: float, timeout_s: float = PATIENCE_S) -> Task:
        return super().slow_down(percent, timeout_s)

    def set_worker(self, worker: str, timeout_s: float = PATIENCE_S) -> Task:
        return super().set_worker(worker, timeout_s)

    def activate(self, timeout_s: float = PATIENCE_S, holder: str = "") -> Task:
        return super().activate(timeout_s, holder)

    def activate_with_deadman(self, what: str, timeout_s: float = PATIENCE_S) -> Task:
        return super().activate_with_deadman(what, timeout_s)

    def deactivate(self, timeout_s: float = PATIENCE_S) -> bool:
        return super().deactivate(timeout_s)


@dataclass
class Chain:
    """What a test holds. See the module."""

    profile: Profile
    profile_file: Path
    host: Host
    session: zenoh.Session
    client: Client
    recorder: Recorder
    lines: list[tuple[str, str]] = field(default_factory=list)
    told: list[tuple[str, str]] = field(default_factory=list)
    failure: list[BaseException] = field(default_factory=list)

    # -- driving ------------------------------------------------------------------------------
    def activate_when_ready(self, timeout_s: float = READY_PATIENCE_S) -> None:
        """Activate as soon as preflight finds nothing more; until then it names what is missing."""
        give_up = time.monotonic() + timeout_s
        # What is put before the command node listens is lost.
        self.until("the task is said", lambda: self.client.task is not None, timeout_s)
        while True:
            try:
                self.client.activate()
                return
            except SessionError as error:
                if time.monotonic() > give_up:
                    raise AssertionError(f"never ready: {error}\n{self.story()}") from error
            time.sleep(0.2)

    def settle(self) -> None:
        """Whatever was before: inactive, standing, the profile's task at full speed.

        All of it is put again until it is so: what is put while a node starts is lost, and a robot
        that has a fault still rejects a reset.
        """
        client, rate_hz = self.client, self.profile.task.rate_hz

        def settled() -> bool:
            # A task may have been under way when all this was put.
            task = client.task
            said = (task.worker, task.prompt, task.active, task.speed_percent) if task else ()
            still = self.state() == "inactive" and self.detail("at_rest")
            return said == ("scripted", "hold", False, 100.0) and bool(still)

        give_up_s = time.monotonic() + READY_PATIENCE_S
        while time.monotonic() < give_up_s:
            if self.state() in ("stopped", "fault"):
                client.publish(client.keys.reset, "")
            client.publish(client.keys.active, "false")
            client.publish(client.keys.worker, "scripted")
            client.publish(client.keys.prompt, "hold")
            client.publish(client.keys.speed, "100")
            with suppress(SessionError):
                client.set_rate(rate_hz, SETTLE_AGAIN_S)  # returns when all of them were read
                if client.wait_for(settled, SETTLE_AGAIN_S):
                    return
        raise AssertionError(f"the arm does not come to rest\n{self.story()}")

    def move(self) -> None:
        """Activate with an endless motion, away from the nearer end, and wait until it is fast."""
        self.client.set_prompt("HARD: go up" if self.height_m() < self._middle_m else self.down)
        self.activate_when_ready()
        self.until(f"speed {MOVING_M_S} m/s", self.moves)

    down = "HARD: go down"
    _middle_m = (LOW_M + HIGH_M) / 2

    def go(self, direction: str, count: int, timeout_s: float = 20.0) -> float:
        """Carry out `count` steps from an active standing arm; returns the way in z (m)."""
        self.client.set_prompt("hold")
        self.wait_still()
        start_m = self.reference_m()[2]
        prompt = f"HARD: go {direction} x{count}"
        self.client.set_prompt(prompt)
        self.wait_done(prompt, count, timeout_s)
        self.wait_still()
        return float(self.reference_m()[2] - start_m)

    def until(self, what: str, ask: Callable[[], Any], timeout_s: float = PATIENCE_S) -> Any:
        """Like `camera_rig.until`; a failure tells what happened meanwhile."""
        try:
            return until(what, ask, timeout_s)
        except AssertionError as error:
            raise AssertionError(f"{error}\n{self.story()}") from None

    # -- looking ------------------------------------------------------------------------------
    def state(self, node: str = "command") -> str:
        status = self.client.status(node)
        return status.state if status else ""

    def detail(self, name: str, node: str = "command") -> Any:
        status = self.client.status(node)
        return status.detail.get(name) if status else None

    def counter(self, name: str, node: str = "command") -> int:
        status = self.client.status(node)
        return status.counters.get(name, 0) if status else 0

    def refused(self) -> dict[str, int]:
        """Refusals by ``node.reason``, of every node."""
        return {
            f"{node}.{name.removeprefix('refused.')}": count
            for node, (status, _, _) in self.client.snapshot().items()
            for name, count in status.counters.items()
            if name.startswith("refused.")
        }

    def events(self, what: str) -> list[Event]:
        """Events called `what` (a transition: ``active->inactive``) since the last `take`."""
        return [event for _, _, event in list(self.client.events) if event.what == what]

    def pid(self, node: str) -> int:
        return self.until(f"node {node} runs", lambda: self.host.supervisor.pids().get(node))

    def living(self) -> dict[str, int]:
        """Node -> its process; of the router, and of nodes that live: no longer starting."""
        pids, alive = self.host.supervisor.pids(), {"router", *self.client.alive}
        return {node: pid for node, pid in pids.items() if node in alive}

    def measured(self) -> PoseState:
        return self.until("a measured pose", self.recorder.newest_state)

    def height_m(self) -> float:
        return float(self.measured().position_m[2])

    def reference_m(self) -> FloatArray:
        reference = self.measured().reference_position_m
        assert reference is not None
        return reference

    def moves(self) -> bool:
        return bool(np.linalg.norm(self.measured().twist[:3]) > MOVING_M_S)

    def wait_still(self, timeout_s: float = 10.0) -> None:
        """Until command node and arm both stand, for a quarter of a second."""
        since: list[float] = []

        def still() -> bool:
            slow = np.linalg.norm(self.measured().twist[:3]) < STILL_M_S
            if not (slow and self.detail("at_rest")):
                since.clear()
                return False
            since.append(time.monotonic())
            return since[-1] - since[0] > 0.25

        self.until("the arm stands", still, timeout_s)

    def wait_done(self, prompt: str, steps: int = 0, timeout_s: float = PATIENCE_S) -> None:
        """Until the policy says that it is done with a prompt, and its steps were accepted."""

        def done() -> bool:
            status = self.client.status("command")  # one, as a newer one may come in between
            said = status.detail if status else {}
            ours = said.get("prompt") == prompt  # and not what was done before
            return ours and said["policy_done"] and said["accepted_steps"] >= steps

        self.until(f"{prompt} carried out", done, timeout_s)

    def wait_arrived(self) -> None:
        """Until a perfect arm is where it is commanded to be, and that stands.

        One that has not heard of its motion yet stands, too.
        """

        def arrived() -> bool:
            status = self.client.status("command")
            said = status.detail if status else {}
            return bool(said["at_rest"]) and said["tracking_mm"] < THERE_MM

        self.until("the arm arrives", arrived)

    def story(self) -> str:
        """What happened, for the message of a test that fails."""
        news = [f"  {node} {e.what}: {e.why}" for node, _, e in list(self.client.events)[-12:]]
        lines = [f"  {node} | {line}" for node, line in self.lines[-25:]]
        states = {
            name: (found.state, dict(found.rates_hz), dict(found.latency_ms))
            for name, (found, _, _) in self.client.snapshot().items()
        }
        newest = self.recorder.newest_state()  # not `measured`, which waits, and tells this
        z_m = f"{newest.position_m[2] if newest else np.nan:.3f} m, at {self.client.task}"
        refused = {name: count for name, count in self.refused().items() if count}
        states = {"nodes": states, "height": z_m, "refused": refused}
        return "\n".join([f"states: {states}", "events:", *news, "log:", *lines])


@contextmanager
def running_chain(
    folder: Path,
    *,
    profile_file: Path | None = None,
    host: str | None = None,
    rate_hz: float = 10.0,
    more: str = "",
    worker_options: Mapping[str, Sequence[str]] | None = None,
    also: Sequence[Path] = (),
    rolling: Path | None = None,
    patience_s: Mapping[str, float] = CHAIN_PATIENCE_S,
    lease_ms: int = LEASE_MS,
) -> Iterator[Chain]:
    """Every node of a small profile, up while the block lasts.

    Args:
        folder: for the profile file.
        profile_file: another profile than `write_profile` makes.
        host: which part of it.
        rate_hz: chunks per second at first.
        more: YAML at the end of the profile.
        worker_options: worker -> ``name=value`` options of its model.
        also: profiles of other robots that the router serves.
        rolling: folder of a rolling record.
        patience_s: with commands and states that are late, of the profile that is made.
        lease_ms: of that profile.
    """
    path = profile_file or write_profile(
        folder, rate_hz=rate_hz, more=more, patience_s=patience_s, lease_ms=lease_ms
    )
    profile = load_profile(str(path))
    others = [load_profile(str(other)) for other in also]
    lines: list[tuple[str, str]] = []
    told: list[tuple[str, str]] = []

    def log(node: str, line: str) -> None:
        lines.append((node, line))

    def tell(node: str, line: str) -> None:
        told.append((node, line))
        lines.append((node, f"** {line}"))

    hosts: list[Host] = []
    failure: list[BaseException] = []
    stop = threading.Event()

    def serve() -> None:
        # Children die with the thread that started them: it has to be the one that serves.
        try:
            with Host(
                profile,
                host,
                log=log,
                tell=tell,
                worker_options=worker_options,
                also=others,
                rolling=rolling,
            ) as running:
                hosts.append(running)
                running.serve(stop)
        except BaseException as error:
            failure.append(error)

    thread = threading.Thread(target=serve, name="host")
    thread.start()
    try:
        until(
            "the host is up",
            lambda: hosts or failure,
            READY_PATIENCE_S,
        )
        if failure:
            raise failure[0]
        with open_session(profile.session) as session:
            client = PatientClient(profile, session)
            client.subscribe()
            recorder = Recorder(session, profile.keys)
            yield Chain(profile, path, hosts[0], session, client, recorder, lines, told, failure)
    finally:
        stop.set()
        thread.join(END_PATIENCE_S)
        assert not thread.is_alive(), "the host does not end"


def command_line(
    *arguments: str, profile: Path | None = None, timeout_s: float = 90.0
) -> subprocess.CompletedProcess[str]:
    """Run ``vla-zenoh`` as a person would; its output in plain text, 200 columns wide."""
    words = [sys.executable, "-m", "vla_zenoh", *arguments]
    environment = {**os.environ, "COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"}
    if profile is not None:
        environment["VLA_ZENOH_PROFILE"] = str(profile)
    return subprocess.run(
        words, capture_output=True, text=True, timeout=timeout_s, env=environment, check=False
    )
