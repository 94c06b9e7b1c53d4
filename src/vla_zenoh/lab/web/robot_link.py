"""The page's side of the bus: one client for all pages, its streams, its deadman, its worker."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import zenoh

from vla_zenoh.bus.buffers import LatestSample, ReceivedSample, ZenohRing, bytes_of, header_of
from vla_zenoh.bus.client import Client
from vla_zenoh.bus.primitives import ask
from vla_zenoh.cli.node_rows import NodeRow, acting_limits, mode_of, node_rows
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError, RecordError, SessionError, VlaZenohError
from vla_zenoh.keys import PRIMITIVES, ROLLING, last_chunk, worker_node
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import Pose, rotation_from_quat
from vla_zenoh.lab.teleop.policy import OperatorInput
from vla_zenoh.lab.web.arm import ArmLines, Line, rounded
from vla_zenoh.lab.web.hand import HandWorker
from vla_zenoh.lab.web.hold import Hold
from vla_zenoh.lab.web.recordings import Recordings
from vla_zenoh.lab.web.trial import PageTrial
from vla_zenoh.policy import ModelSpec
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
    ActionChunk,
    GripperState,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
    Task,
)

STILL_M_S = 0.005
"""A measured arm that is slower stands: an impedance controller still settles."""
STAND_S, STAND_POLL_S = 3.0, 0.01
WATCH_S = 0.05
MAX_HOLDER = 48
GOALS = 100
SPECS = 64
CHUNK_S = 2.0
"""A chunk that none followed for this long is drawn no more."""


class RobotLink:
    """What all pages share of one robot. Safe to use from several threads.

    `poll` and `arm` belong to one thread; what waits for the robot (`stop`, `activate_held`) is
    called from others.

    Args:
        profile: of the robot.
        session: open, with the rights of a person.
    """

    def __init__(self, profile: Profile, session: zenoh.Session) -> None:
        self.profile, self.session, self.keys = profile, session, profile.keys
        self.client = Client(profile, session).subscribe()
        self.counters: Counter[str] = Counter()
        self.speed_m_s = 0.0
        self._rings: dict[type[Any], ZenohRing] = {}
        self._subscribers: list[Any] = []
        keys = self.keys
        for kind, key, size in (
            (PoseState, keys.state_pose, 1),
            (JointState, keys.state_joint, 1),
            (GripperState, keys.state_gripper, 1),
            (PoseCommand, keys.command_pose, 1),
            (JointCommand, keys.command_joint, 1),
            (ActionChunk, keys.all_deltas, 16),
            (ModelSpec, keys.all_specs, 16),
        ):
            ring = self._rings[kind] = ZenohRing(size)
            self._subscribers.append(ring.subscribe(session, key))
        self._newest: dict[type[Any], tuple[Any, float]] = {}
        self._goals: deque[tuple[int, Pose]] = deque(maxlen=GOALS)
        self._specs: dict[str, ModelSpec] = {}
        self._seen: dict[str, list[str]] = {}
        self._chunk: tuple[Line, float] = ([], 0.0)
        self._lines, self.no_arm = _lines_of(profile)
        self._hold, self._let_go, self._confirmed = Hold(), False, False
        self._hold_lock, self._activating = threading.Lock(), threading.Lock()
        self._wake, self._closed = threading.Event(), threading.Event()
        self._hand = OperatorInput()
        self.hand = HandWorker(profile, self.client, self._read_hand)
        self.recordings = Recordings(profile, session)
        self.trial = PageTrial(profile)
        self._watcher = threading.Thread(target=self._watch_hold, name="hold", daemon=True)
        self._watcher.start()

    # -- streams ------------------------------------------------------------------------------
    def poll(self) -> None:
        """Decode the newest sample of each stream."""
        now_s = time.monotonic()
        for kind, ring in self._rings.items():
            for sample in ring.drain():
                self._take(kind, sample, now_s)
            for rejected in ring.pop_rejected():
                self.counters["bad_sample"] += rejected.times

    def _take(self, kind: type[Any], sample: ReceivedSample, now_s: float) -> None:
        try:
            header = header_of(sample.sample)
            record = records.decode(kind, bytes_of(sample.sample.payload))
            if kind is ActionChunk:
                self._take_chunk(record, now_s)
                return
        except (CodecError, RecordError):
            self.counters["bad_sample"] += 1
            return
        if kind is ModelSpec:
            if len(self._specs) >= SPECS:
                del self._specs[next(iter(self._specs))]
            self._specs[record.hash] = record
            self._take_seen(last_chunk(str(sample.sample.key_expr)), record)
            return
        self._newest[kind] = (record, now_s)
        if kind is PoseState:
            self.speed_m_s = float(np.linalg.norm(record.twist[:3]))
        elif kind is PoseCommand:
            goal = Pose(record.goal_position_m, rotation_from_quat(record.goal_quat_xyzw))
            self._goals.append((header.stamp_wall_ns, goal))

    def _take_seen(self, worker: str, spec: ModelSpec) -> None:
        """Note which pictures show what a worker's model sees."""
        if worker in self._seen or len(self._seen) < SPECS:
            seen = [f"seen/{worker}/{camera.camera}" for camera in spec.observation.cameras]
            self._seen[worker] = seen

    def _take_chunk(self, chunk: ActionChunk, now_s: float) -> None:
        """Draw a chunk of the chosen worker, from the goal in force at its observation."""
        spec, task = self._specs.get(chunk.spec_hash), self.client.task
        measured, lines = self._recent(PoseState, now_s), self._lines
        if spec is None or measured is None or lines is None or task is None:
            return
        if chunk.worker != task.worker:
            return
        start = Pose(measured.position_m, rotation_from_quat(measured.quat_xyzw))
        if spec.action.anchor == "goal":
            seen_ns = chunk.observation_stamp_ns
            before = (pose for stamp_ns, pose in reversed(self._goals) if stamp_ns <= seen_ns)
            start = next(before, start)
        joints = self._recent(JointState, now_s)
        self._chunk = (lines.chunk(chunk, spec, start, joints), now_s)

    def _recent(self, kind: type[Any], now_s: float) -> Any:
        """The newest record of a stream, None if it is silent."""
        record, at_s = self._newest.get(kind, (None, 0.0))
        return record if now_s - at_s < 1.0 else None

    def arm(self) -> dict[str, Any]:
        """Positions for the picture of the arm, m in the base frame; what is unknown is absent."""
        now_s = time.monotonic()
        pose, joints = self._recent(PoseState, now_s), self._recent(JointState, now_s)
        found: dict[str, Any] = {"speed_m_s": round(self.speed_m_s, 4)}
        if pose is not None:
            found["measured_m"] = rounded([pose.position_m])[0]
        command = self._recent(PoseCommand, now_s)
        if command is not None:
            found["command_m"] = rounded([command.position_m])[0]
            found["goal_m"] = rounded([command.goal_position_m])[0]
        gripper = self._recent(GripperState, now_s)
        if gripper is not None:
            found |= {"width_m": round(gripper.width_m, 4), "holding": gripper.holding}
        if now_s - self._chunk[1] < CHUNK_S:
            found["chunk_m"] = self._chunk[0]
        try:
            if self._lines is not None and joints is not None:
                found["links_m"] = self._lines.links_of(joints)
            by_joints = self._recent(JointCommand, now_s)
            if self._lines is not None and by_joints is not None:
                found["command_m"] = self._lines.tcp(by_joints.names, by_joints.position_rad)
        except RecordError:
            self.counters["bad_sample"] += 1
        return found

    # -- nodes --------------------------------------------------------------------------------
    def rows(self) -> list[NodeRow]:
        """Every node heard or expected."""
        client = self.client
        return node_rows(client.snapshot(), client.expected, client.alive)

    def state(self) -> dict[str, Any]:
        """State of the robot, from statuses and task."""
        said, task = self.client.snapshot(), self.client.task
        status, age_s, alive = said.get("command", (None, 0.0, False))
        detail: Mapping[str, Any] = status.detail if status is not None and alive else {}
        state = "" if status is None else status.state if alive else "dead"
        return {
            "mode": mode_of(said),
            "state": state or "no command node",
            "silent_s": round(age_s, 2),
            "why": detail.get("why", ""),
            "at_rest": detail.get("at_rest"),
            "held_by": detail.get("held_by", ""),
            "limits": acting_limits(said),
            "done": detail.get("policy_done", False),
            "task": None if task is None else task_fields(task),
            "jog": self.hand.has_arm,
            "trial": self.trial.state(),
            "primitives": worker_node(PRIMITIVES) in self.client.alive,
            "rolling": ROLLING in self.client.alive,
            "seen": [] if task is None else self._seen.get(task.worker, []),
            "workers": sorted(
                name.removeprefix(worker_node(""))
                for name in self.client.alive
                if name.startswith(worker_node(""))
            ),
        }

    # -- stopping -----------------------------------------------------------------------------
    def stop(self) -> dict[str, Any]:
        """Trigger the emergency stop and wait until the arm stands.

        Returns:
            ``robot``, whether it is ``stopped`` (latched) and ``stands`` (measured), and seconds
            from the call to both.
        """
        began_s = time.monotonic()
        self.client.stop()
        measured = LatestSample()
        subscriber = measured.subscribe(self.session, self.keys.state_pose)
        try:
            return self._stopping(measured, began_s)
        finally:
            subscriber.undeclare()

    def _stopping(self, measured: LatestSample, began_s: float) -> dict[str, Any]:
        stopped_s: float | None = None
        while (now_s := time.monotonic()) < began_s + STAND_S:
            status = self.client.status("command")
            if status is not None and status.state == "stopped":
                stopped_s = stopped_s or now_s - began_s
                if status.detail.get("at_rest") is True and self._stands(measured):
                    return self._stop_report(stopped_s, now_s - began_s)
            time.sleep(STAND_POLL_S)
        return self._stop_report(stopped_s, None)

    @staticmethod
    def _stands(measured: LatestSample) -> bool:
        sample = measured.pop()
        if sample is None:
            return False
        try:
            state = records.decode(PoseState, bytes_of(sample.sample.payload))
        except CodecError:
            return False
        return float(np.linalg.norm(state.twist[:3])) < STILL_M_S

    def _stop_report(self, stopped_s: float | None, stands_s: float | None) -> dict[str, Any]:
        return {
            "robot": self.keys.robot,
            "stopped": stopped_s is not None,
            "stopped_s": None if stopped_s is None else round(stopped_s, 3),
            "stands_s": None if stands_s is None else round(stands_s, 3),
            "at_ms": time.time_ns() // 1_000_000,
        }

    # -- hold-to-run --------------------------------------------------------------------------
    def press(self, page: int, press: int, tick_ms: int) -> None:
        """Begin a hold; `activate_held` activates the arm with it.

        Raises:
            SessionError: this page may not hold now; says why.
        """
        with self._hold_lock:
            why = self._hold.press(page, press, tick_ms, time.monotonic())
            self._hand = OperatorInput()
        if why:
            raise SessionError(why)

    def activate_held(self, page: int, name: str) -> Task:
        """Activate the arm for as long as this page holds; waits until it is active.

        Raises:
            SessionError: rejected, with every reason, or let go meanwhile.
        """
        with self._activating:
            if not self.holds(page):
                raise SessionError("let go before the arm was active")
            self._confirmed = False
            try:
                task = self.client.activate_with_deadman(f"web-{name}"[:MAX_HOLDER])
            except VlaZenohError:
                self.release(page)
                raise
            self._confirmed = True
            return task

    def primitive(self, page: int, name: str, what: str) -> str:
        """Go home, open or close the gripper, for as long as this page holds; waits for the end.

        Args:
            page: that holds.
            name: of the person.
            what: ``home``, ``open`` or ``closed``.

        Raises:
            SessionError: let go, or it was not done; says why.
        """
        with self._activating:
            try:
                answer = ask(
                    self.client,
                    "home" if what == "home" else "grip",
                    {} if what == "home" else {"width_m": what},
                    who=f"web-{name}"[:MAX_HOLDER],
                    cancelled=lambda: not self.holds(page),
                )
            finally:
                with self._hold_lock:  # it has ended by itself: nothing is to be deactivated
                    self._hold.release(page)
        if not answer.ok:
            raise SessionError(f"{what}: {answer.reason}{answer.why and f': {answer.why}'}")
        return f"{what}: {answer.reason} after {answer.took_s:.1f} s"

    def save(self, note: str) -> str:
        """Have the rolling record keep its last minutes.

        Raises:
            SessionError: none runs.
        """
        if ROLLING not in self.client.alive:
            raise SessionError("no rolling record runs; `vla-zenoh up` keeps one")
        self.client.publish(self.keys.save, note or "asked on the page")
        return "the rolling record saves its last minutes; the log says where"

    def holds(self, page: int) -> bool:
        """Whether the hold in force is of this page."""
        with self._hold_lock:
            return self._hold.held is not None and self._hold.held.page == page

    def beat(self, page: int, press: int, tick_ms: int, hand: OperatorInput) -> bool:
        """Extend a hold by the echo of a tick; False if it is not in force.

        Args:
            page: that holds.
            press: of its button.
            tick_ms: echoed.
            hand: motion by hand, for as long as the hold is in force.
        """
        with self._hold_lock:
            in_force = self._hold.beat(page, press, tick_ms, time.monotonic())
            if in_force:
                self._hand = hand
            return in_force

    def _read_hand(self) -> OperatorInput:
        with self._hold_lock:
            self._hold.expire(time.monotonic())
            return self._hand if self._hold.held is not None else OperatorInput()

    def release(self, page: int, *, gone: bool = False) -> None:
        """End the hold of a page, if it has it: the arm brakes."""
        with self._hold_lock:
            self._let_go = self._let_go or (self._held_by(page) and not gone)
            (self._hold.forget if gone else self._hold.release)(page)
        self._wake.set()

    def _held_by(self, page: int) -> bool:
        return self._hold.held is not None and self._hold.held.page == page

    def _watch_hold(self) -> None:
        """Keep the liveliness token only while a page holds, whatever the server is doing."""
        while not self._closed.is_set():
            self._wake.wait(WATCH_S)
            self._wake.clear()
            with self._hold_lock:
                before = self._hold.held
                self._hold.expire(time.monotonic())
                if self._over():  # stopped, or ended by itself: a new press begins anew
                    self._hold.held = None
                held = self._hold.held is not None
                let_go, self._let_go = self._let_go, False
                self.counters["hold_lost"] += before is not None and not held
            self._confirmed = self._confirmed and held
            if let_go and not held:  # a person ended it: that is no fault to be reported later
                self.client.publish(self.keys.active, "false")
            if not held:  # also one that was declared after the hold had ended
                self.client.release_deadman()

    def _over(self) -> bool:
        """The arm was active with the hold in force, and is not any more."""
        task = self.client.task
        return self._confirmed and (task is None or not task.active)

    def deactivate(self) -> str:
        """Brake the arm, and wait until it stands.

        Raises:
            SessionError: it does not in time.
        """
        with self._hold_lock:
            self._hold.held = None
        if not self.client.deactivate(STAND_S):
            raise SessionError(f"the command node does not say within {STAND_S:g} s that it stands")
        return "inactive, the arm stands"

    def record(self, on: bool, verdict: str, note: str) -> str:
        """Start a recording, or finish it with a person's verdict and note."""
        if on:
            return self.recordings.begin()
        task = self.client.task
        return self.recordings.end(task.worker if task is not None else "", verdict, note)

    def reset(self) -> str:
        """Clear a stop or a fault, and wait for it.

        Raises:
            SessionError: it was not cleared; says why.
        """
        self.client.reset()
        if not self.client.wait_for(self.client.cleared, STAND_S):
            why = self.client.latch_reason() or "the command node does not answer"
            raise SessionError(f"not cleared: {why}")
        return "cleared; inactive"

    def close(self) -> None:
        """End a hold, and unsubscribe."""
        self._closed.set()
        self._wake.set()
        self._watcher.join()
        self.trial.close()
        self.hand.close()
        self.recordings.close()
        self.client.release_deadman()
        for subscriber in self._subscribers:
            subscriber.undeclare()


def task_fields(task: Task) -> dict[str, Any]:
    """The settings that a page shows."""
    return {
        "prompt": task.prompt,
        "worker": task.worker,
        "rate_hz": task.rate_hz,
        "speed_percent": task.speed_percent,
        "active": task.active,
        "episode": task.episode,
    }


def _lines_of(profile: Profile) -> tuple[ArmLines | None, str]:
    """The arm of a profile, or why it cannot be drawn."""
    try:
        return ArmLines(make_kinematics(profile)), ""
    except VlaZenohError as error:
        return None, str(error)
