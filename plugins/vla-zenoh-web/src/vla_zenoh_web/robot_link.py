"""The page's side of the bus: one client for all pages, its streams, its deadman, its worker."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import zenoh
from vla_zenoh_teleop.policy import OperatorInput

from vla_zenoh.bus.buffers import ReceivedSample, ZenohRing, bytes_of
from vla_zenoh.cli.node_rows import NodeRow, acting_limits, mode_of, node_rows
from vla_zenoh.client.client import Client, StopOutcome
from vla_zenoh.client.primitives import ask
from vla_zenoh.codec import records
from vla_zenoh.codec.settings import decode_held, encode_text
from vla_zenoh.errors import (
    CodecError,
    RecordError,
    RecordingError,
    SessionError,
    VlaZenohError,
)
from vla_zenoh.keys import ENDED, PRIMITIVES, ROLLING, last_chunk, worker_node
from vla_zenoh.policy import ModelSpec
from vla_zenoh.profile import Profile
from vla_zenoh.types import ActionChunk, Event, NodeStatus, Task
from vla_zenoh.types.records import LATENCY_STAGES
from vla_zenoh_web import requests
from vla_zenoh_web.episodes import Episodes
from vla_zenoh_web.hand import HandWorker
from vla_zenoh_web.hold import Hold
from vla_zenoh_web.part_streams import PartStreams
from vla_zenoh_web.plain_words import banner, holder_of
from vla_zenoh_web.recordings import Recordings

STAND_S, STAND_POLL_S = 3.0, 0.01
WATCH_S = 0.05
MAX_HOLDER = 48
MOVING = ("begin", "scene")
"""Steps of the guide that change the prompt, or the simulated scene."""
NOT_YOURS = (
    "another page holds the arm: only that page changes how it moves. STOP and Deactivate are for "
    "everyone"
)
FORCE = "external_force_n"
SPECS = 64


class RobotLink:
    """What all pages share of one robot. Safe to use from several threads.

    `poll` and `arm` belong to one thread; what waits for the robot (`stop`, `activate_held`) is
    called from others.
    """

    def __init__(self, profile: Profile, session: zenoh.Session) -> None:
        self.profile, self.session, self.keys = profile, session, profile.keys
        self.client = Client(profile, session).subscribe()
        self.counters: Counter[str] = Counter()
        self._parts = {
            name: PartStreams(profile.of_part(name), session, self.counters)
            for name in profile.part_names
        }
        self.no_arm = next((part.no_arm for part in self._parts.values()), "")
        self._rings = {ActionChunk: ZenohRing(16), ModelSpec: ZenohRing(16)}
        self._subscribers = [
            self._rings[ActionChunk].subscribe(session, self.keys.all_deltas),
            self._rings[ModelSpec].subscribe(session, self.keys.all_specs),
        ]
        self._specs: dict[str, ModelSpec] = {}
        self._short: dict[str, str] = {}
        self._seen: dict[str, list[str]] = {}
        self._hold, self._let_go, self._confirmed = Hold(), False, False
        self._run: tuple[int, int] | None = None
        """Page and press for which the arm was activated last, until it is inactive."""
        self._hold_lock, self._activating = threading.Lock(), threading.Lock()
        self._ending = threading.Lock()
        self._wake, self._closed = threading.Event(), threading.Event()
        self._hand = OperatorInput()
        self.hand = HandWorker(profile, self.client, self._read_hand)
        self.recordings = Recordings(profile, session)
        self.episodes = Episodes(profile, self.client, self.recordings, self.deactivate)
        self._watcher = threading.Thread(target=self._watch_hold, name="hold", daemon=True)
        self._watcher.start()

    # -- streams ------------------------------------------------------------------------------
    def poll(self) -> None:
        """Decode the newest sample of each stream."""
        now_s = time.monotonic()
        for part in self._parts.values():
            part.poll(now_s)
        for kind, ring in self._rings.items():
            for sample in ring.drain():
                self._take(kind, sample, now_s)
            for rejected in ring.pop_rejected():
                self.counters["bad_sample"] += rejected.times
        before, self._short = self._short, self.client.reception.short()
        for name, why in self._short.items():
            if name not in before:
                self.counters["short_streams"] += 1
                self.client.note("web", Event("warning", "fault", "short_stream", why))

    def _take(self, kind: type[Any], sample: ReceivedSample, now_s: float) -> None:
        try:
            record = records.decode(kind, bytes_of(sample.sample.payload))
            if kind is ActionChunk:
                self._take_chunk(record, now_s)
                return
        except (CodecError, RecordError):
            self.counters["bad_sample"] += 1
            return
        if len(self._specs) >= SPECS:
            del self._specs[next(iter(self._specs))]
        self._specs[record.hash] = record
        worker = last_chunk(str(sample.sample.key_expr))
        if worker in self._seen or len(self._seen) < SPECS:  # pictures of what its model sees
            seen = [f"seen/{worker}/{camera.camera}" for camera in record.observation.cameras]
            self._seen[worker] = seen

    def _take_chunk(self, chunk: ActionChunk, now_s: float) -> None:
        """Draw a chunk of the chosen worker."""
        spec, task = self._specs.get(chunk.spec_hash), self.client.task
        if spec is not None and task is not None and chunk.worker == task.worker:
            for part in self._parts.values():
                part.take_chunk(chunk, spec, now_s)

    def arms(self) -> dict[str, dict[str, Any]]:
        """What is drawn of each part; of a robot that is one arm, of one without a name."""
        now_s = time.monotonic()
        status = self.client.status("command")
        return {
            name: part.described(now_s, self._box_of(name, status))
            for name, part in self._parts.items()
        }

    @staticmethod
    def _box_of(part: str, status: NodeStatus | None) -> str:
        """The box that a gripper holds, as the command node reports it."""
        detail: Mapping[str, Any] = {} if status is None else status.detail
        return str(detail.get("parts", {"": detail}).get(part, {}).get("gripper_holds", ""))

    def hold_box(self, part: str, text: str) -> str:
        """Say what a gripper holds, see the key ``held``, and wait until it counts.

        Raises:
            CodecError: it is not a box.
            SessionError: there is no such part, or it was not accepted.
        """
        if part not in self._parts:
            raise SessionError(f"the robot has no part {part!r}")
        box = decode_held(encode_text(text))
        began_s = time.monotonic()
        self.client.publish(self.keys.of_part(part).held if part else self.keys.held, str(box))

        def counts() -> bool:
            status = self.client.status_since("command", began_s)
            return status is not None and self._box_of(part, status) == str(box)

        if not self.client.wait_for(counts, STAND_S):
            raise SessionError("not accepted: the log says why")
        return f"counted as held: {box} m" if box else "nothing is held"

    # -- nodes --------------------------------------------------------------------------------
    def rows(self) -> list[NodeRow]:
        client = self.client
        return node_rows(client.snapshot(), client.expected, client.alive, client.unreadable)

    def state(self) -> dict[str, Any]:
        """State of the robot, from statuses and task."""
        said, task = self.client.snapshot(), self.client.task
        status, age_s, alive = said.get("command", (None, 0.0, False))
        detail: Mapping[str, Any] = status.detail if status is not None and alive else {}
        state = "" if status is None else status.state
        if not alive and state not in ("", ENDED):
            state = "dead"
        found: dict[str, Any] = {
            "mode": mode_of(said),
            "state": state or "no command node",
            "silent_s": round(age_s, 2),
            "why": detail.get("why", ""),
            "at_rest": detail.get("at_rest"),
            "held_by": detail.get("held_by", ""),
            "holder": holder_of(str(detail.get("held_by", ""))),
            "force_n": _largest_force(detail),
            "latency_ms": _latency(status) if alive else None,
            "limits": acting_limits(said),
            "done": detail.get("policy_done", False),
            "task": None if task is None else asdict(task),
            "jog": self.hand.has_arm,
            "hand": self.hand.chosen,
            "primitives": worker_node(PRIMITIVES) in self.client.alive,
            "rolling": ROLLING in self.client.alive,
            "seen": [] if task is None else self._seen.get(task.worker, []),
            "workers": sorted(
                name.removeprefix(worker_node(""))
                for name in self.client.alive
                if name.startswith(worker_node(""))
            ),
        }
        found["banner"] = banner(found)._asdict()
        found["guide"] = self.episodes.observe(by_hand=found["jog"])
        return found

    # -- stopping -----------------------------------------------------------------------------
    def stop(self) -> dict[str, Any]:
        """Trigger the emergency stop and wait until the arm stands.

        Returns:
            ``robot``, ``outcome`` and its ``message``, and seconds from the call until a node had
            latched it and until the arm stood; None: it did not within `STAND_S`.
        """
        began_s = time.monotonic()
        self.client.stop()
        heard_s: float | None = None
        while True:
            found, took_s = self.client.stop_progress(), time.monotonic() - began_s
            if found.heard_by and heard_s is None:
                heard_s = round(took_s, 3)
            stands = found.outcome is StopOutcome.CONFIRMED
            if stands or took_s > STAND_S:
                break
            time.sleep(STAND_POLL_S)
        return {
            "robot": self.keys.robot,
            "outcome": found.outcome.value,
            "message": found.sentence(f"robot {self.keys.robot}"),
            "stopped_s": heard_s,
            "stands_s": round(took_s, 3) if stands else None,
            "at_ms": time.time_ns() // 1_000_000,
        }

    def set(self, page: int, asked: requests.Changes) -> Any:
        """Change a setting, and wait for the robot's confirmation.

        Raises:
            SessionError: another page holds the arm, which would move in another way.
        """
        moves = isinstance(asked, requests.MotionRequest)
        if not (moves or (isinstance(asked, requests.GuideRequest) and asked.step in MOVING)):
            return self._set(asked)
        self._require_free(page)  # before it waits: a primitive of the other may take long
        with self._activating:
            self._require_free(page)
            return self._set(asked)

    def _require_free(self, page: int) -> None:
        with self._hold_lock:
            self._hold.expire(time.monotonic())
            held = self._hold.held
        if held is not None and held.page != page:
            raise SessionError(NOT_YOURS)

    def _set(self, asked: requests.Changes) -> Any:
        match asked:
            case requests.PromptRequest():
                return self.client.set_prompt(asked.text)
            case requests.WorkerRequest():
                return self.client.set_worker(asked.name)
            case requests.RateRequest():
                return self.client.set_rate(asked.hz)
            case requests.SpeedRequest():
                return self.client.set_speed(asked.percent)
            case requests.HeldRequest():
                return self.hold_box(asked.part, asked.text)
            case requests.ActivateRequest():
                return self.client.activate()
            case requests.DeactivateRequest():
                return self.deactivate()
            case requests.ResetRequest():
                return self.reset()
            case requests.JogRequest():
                if asked.on:
                    return self.hand.take(asked.frame, asked.level, asked.part)
                return self.hand.give_back()
            case requests.SaveRequest():
                return self.save(asked.note)
            case requests.GuideRequest():
                return self.episodes.do(asked)
            case requests.RecordRequest():
                return self.record(asked.on, asked.verdict, asked.note)

    # -- hold-to-run --------------------------------------------------------------------------
    def press(self, page: int, press: int, tick_ms: int) -> None:
        """Begin a hold; `activate_held` activates the arm with it.

        Raises:
            SessionError: this page may not hold now; says why.
        """
        with self._hold_lock:
            why = self._hold.press(page, press, tick_ms, time.monotonic())
            if not why:
                self._hand = OperatorInput()
        if why:
            raise SessionError(why)

    def activate_held(self, page: int, asked: requests.HoldRequest, name: str) -> Task:
        """Activate the arm for as long as this press lasts; waits until it is active.

        Raises:
            SessionError: rejected, with every reason, or let go meanwhile.
        """
        press = asked.press
        with self._activating:
            self._await_turn(page, press)
            with self._ending:
                self._run, self._confirmed = (page, press), False
            try:
                if asked.hand and not self.hand.has_arm:
                    raise SessionError("the arm is not moved by hand any more: take it again")
                task = self.client.activate_with_deadman(f"web-{name}"[:MAX_HOLDER])
            except VlaZenohError:
                self.release(page, press)
                raise
            with self._ending:
                self._confirmed = True
            return task

    def _await_turn(self, page: int, press: int) -> None:
        """Wait until the arm no longer runs for an older press.

        Raises:
            SessionError: this one was let go meanwhile.
        """
        self._end_what_is_over()
        if self._run is not None:
            self.client.wait_for(lambda: not self._active, STAND_S)
        if not self.holds(page, press):
            raise SessionError("let go before the arm was active")

    def primitive(self, page: int, asked: requests.PrimitivePress, name: str) -> str:
        """Go home, open or close the gripper, for as long as this press lasts; waits for the end.

        Raises:
            SessionError: let go, or it was not done; says why.
        """
        what, press = asked.name, asked.press
        with self._activating:
            try:
                self._await_turn(page, press)
                answer = ask(
                    self.client,
                    "home" if what == "home" else "grip",
                    {} if what == "home" else {"width_m": what},
                    who=f"web-{name}"[:MAX_HOLDER],
                    cancelled=lambda: not self.holds(page, press),
                )
            finally:
                with self._hold_lock:  # it has ended by itself: nothing is to be deactivated
                    self._hold.release(page, press)
        if not answer.ok:
            raise SessionError(f"{what}: {answer.reason}{answer.why and f': {answer.why}'}")
        return f"{what}: {answer.reason} after {answer.took_s:.1f} s"

    def save(self, note: str) -> str:
        """Have the rolling record keep its last minutes. Raises SessionError: none runs."""
        if ROLLING not in self.client.alive:
            raise SessionError("no rolling record runs; `vla-zenoh up` keeps one")
        self.client.publish(self.keys.save, note or "asked on the page")
        return "the rolling record saves its last minutes; the log says where"

    def holds(self, page: int, press: int | None = None) -> bool:
        """Whether the hold in force is of this page, and of this press of it."""
        with self._hold_lock:
            return self._hold.holds(page, press)

    def beat(self, page: int, press: int, tick_ms: int, hand: OperatorInput) -> bool:
        """Extend a hold by the echo of a tick; False if it is not in force.

        Args:
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

    def release(self, page: int, press: int | None = None, *, gone: bool = False) -> None:
        """End the hold of a page, if it has it: the arm brakes. Of a press: no newer one."""
        with self._hold_lock:
            self._let_go = self._let_go or (self._hold.holds(page, press) and not gone)
            if gone:
                self._hold.forget(page)
            else:
                self._hold.release(page, press)
        self._wake.set()

    def _watch_hold(self) -> None:
        """Keep the liveliness token only while its press holds, whatever the server is doing."""
        while not self._closed.is_set():
            self._wake.wait(WATCH_S)
            self._wake.clear()
            self._end_what_is_over()

    @property
    def _active(self) -> bool:
        task = self.client.task
        return task is not None and task.active

    def _end_what_is_over(self) -> None:
        with self._ending:
            with self._hold_lock:
                before, run, active = self._hold.held, self._run, self._active
                self._hold.expire(time.monotonic())
                if run and self._confirmed and not active:  # stopped, or ended by itself
                    self._hold.release(*run)  # a new press starts again
                held = run is not None and self._hold.holds(*run)
                let_go, self._let_go = self._let_go, False
                self.counters["hold_lost"] += before is not None and self._hold.held is None
            self._confirmed = self._confirmed and held
            if let_go:  # a person ended it: that is no fault to be reported later
                self.client.publish(self.keys.active, "false")
            if not held:  # also one that was declared after the hold had ended
                self.client.release_deadman()
                if not active and not self._activating.locked():
                    self._run = None

    def deactivate(self) -> str:
        """Brake the arm, and wait until it stands. Raises SessionError: it does not in time."""
        began_s = time.monotonic()
        with self._hold_lock:
            self._hold.held, self._let_go = None, True
        self._end_what_is_over()
        if not self.client.wait_for(lambda: self.client.stands(began_s), STAND_S):
            raise SessionError(f"the command node does not say within {STAND_S:g} s that it stands")
        return "inactive, the arm stands"

    def record(self, on: bool, verdict: str, note: str) -> str:
        """Start a recording, or finish it with a person's verdict and note."""
        if self.episodes.records:
            raise RecordingError("an episode of the guide is being recorded: judge it there")
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
        self._closed.set()
        self._wake.set()
        self._watcher.join()
        self.hand.close()
        self.recordings.close()
        self.client.release_deadman()
        for subscriber in self._subscribers:
            subscriber.undeclare()
        for part in self._parts.values():
            part.close()


def _largest_force(detail: Mapping[str, Any]) -> float | None:
    """External force on the arm, of several the largest, in N; None: it is not measured."""
    parts = detail.get("parts", {"": detail}).values()
    return max((force for one in parts if (force := one.get(FORCE)) is not None), default=None)


def _latency(status: NodeStatus | None) -> float | None:
    """From an image to the first command of its chunk, median in ms."""
    pair = None if status is None else status.latency_ms.get(LATENCY_STAGES[-1])
    return None if pair is None else round(pair[0], 1)
