"""An arm of ours on the mesh: presence, state, stops in both directions, orders of named peers.

Stops have a thread of their own, so has the order in force: whatever those wait for, a stop does
not. Nothing here resets.
"""

from __future__ import annotations

import logging
import secrets
import socket
import threading
import time
from collections import Counter

from vla_zenoh.bus.buffers import CallbackRing, LatestSample, Wake, bytes_of
from vla_zenoh.client.client import StopClient, StopOutcome
from vla_zenoh.client.remote_robot import RemoteRobot
from vla_zenoh.errors import CountedError, SessionError, VlaZenohError
from vla_zenoh.policy.meaning import joints_as
from vla_zenoh_strands import wire
from vla_zenoh_strands.link import Link
from vla_zenoh_strands.mandate import Mandate
from vla_zenoh_strands.wire import Command, Message, Order, RefusalError

LOOK_S, STATE_S, PRESENCE_S = 0.02, 0.1, 0.5
STOP_TRIES, STOP_TRY_S = 10, 0.3
"""A stop is put again until a node says that it has latched it."""
STANDS_S = 2.5
"""Whoever stops it is answered within this: theirs waits for 3 s."""
ACCEPT_S = 5.0
"""The command node takes an order within this time, or the order is refused."""
TOLD_S = 5.0
"""A reason is told again after this time."""
MOVING = ("active", "holding")
LOG = logging.getLogger("vla_zenoh.strands")


class Peer:
    """An arm on the mesh.

    Args:
        robot: the arm, subscribed.
        link: with the mesh.
        mandate: who may give orders.
    """

    def __init__(self, robot: RemoteRobot, link: Link, mandate: Mandate) -> None:
        self._robot, self._link, self._mandate, self._keys = robot, link, mandate, link.keys
        self.counts: Counter[str] = Counter()
        """Commands by action, refusals by reason, stops."""
        self._told_s: dict[str, float] = {}
        self._ended = threading.Event()
        self._cancelled = threading.Event()
        self._latched: bool | None = None
        self._theirs = False
        self._estop = LatestSample(wire.MAX_ESTOP_BYTES)
        self._came = Wake()
        self._commands = CallbackRing(16, wire.MAX_COMMAND_BYTES, self._came)
        self._presences = CallbackRing(64, wire.MAX_PRESENCE_BYTES)
        link.listen(self._keys.estop, self._estop)
        link.listen(self._keys.commands, self._commands)
        link.listen(self._keys.broadcast, self._commands)
        for name in mandate.obeyed:
            link.listen(self._keys.presence(name), self._presences)

    def run(self, stop: threading.Event) -> None:
        """Be a peer until `stop`; an order in force then ends."""
        threads = [
            threading.Thread(target=self._obey_stops, daemon=True),
            threading.Thread(target=self._answer_all, daemon=True),
        ]
        for thread in threads:
            thread.start()
        state_s = presence_s = 0.0
        while not stop.wait(LOOK_S):
            now_s = time.monotonic()
            self._hear()
            self._tell_own_stop()
            if now_s - state_s >= STATE_S:
                state_s = now_s
                self._link.put(self._keys.state, self.state())
            if now_s - presence_s >= PRESENCE_S:
                presence_s = now_s
                self._link.put(self._keys.presence(self._keys.us), self._presence(), signed=True)
        self._cancelled.set()
        self._ended.set()
        for thread in threads:
            thread.join(ACCEPT_S)
        self._robot.release_deadman()

    # -- what is told -------------------------------------------------------------------------
    def _mode(self) -> tuple[str, str]:
        """State of the command node, and why."""
        status = self._robot.status("command") if "command" in self._robot.alive else None
        if status is None:
            return "absent", "no command node is running"
        return status.state, str(status.detail.get("why", ""))

    def _task(self) -> Message:
        mode, why = self._mode()
        words = {"stopped": "stopped", "fault": "error", "absent": "error"}
        status = "running" if mode in MOVING else words.get(mode, "idle")
        task = self._robot.task
        found = {"status": status, "instruction": task.prompt if task is not None else ""}
        return {**found, "mode": mode, "why": why, "commander": self._mandate.commander}

    def _presence(self) -> Message:
        task, profile = self._task(), self._robot.profile
        return {
            "robot_id": self._keys.us,
            "robot_type": "robot",
            "hostname": socket.gethostname(),
            "timestamp": time.time(),
            "task_status": task["status"],
            "instruction": task["instruction"],
            "connected": task["mode"] != "absent",
            "hw": profile.robot.name,
            "cameras": list(profile.cameras),
            "topics": ["state"],
        }

    def state(self) -> Message:
        """Joints in rad and rad/s, and what the arm does."""
        found: Message = {"peer_id": self._keys.us, "t": time.time(), "task": self._task()}
        try:
            joints = joints_as(self._robot.joint_state(0.0).record, "wrapped")
        except (SessionError, CountedError):
            return found
        numbers = zip(joints.names, joints.position_rad, joints.velocity_rad_s, strict=True)
        found["joints"] = {
            name: {"position": float(at), "velocity": float(speed)} for name, at, speed in numbers
        }
        return found

    def _tell_own_stop(self) -> None:
        """An emergency stop of our arm stops the mesh, unless it came from there."""
        latched = self._mode()[0] == "stopped" or bool(self._robot.stop_latched())
        before, self._latched = self._latched, latched
        if latched and before is False and not self._theirs:
            self._count("estop_told")
            LOG.warning("our arm is stopped: the mesh is told")
            self._link.put(self._keys.estop, self._stop_message())
            self._link.put(self._keys.broadcast, self._stop_command(), signed=True)
        if before and not latched:
            self._theirs = False

    def _stop_message(self) -> Message:
        return {
            "peer_id": self._keys.us,
            "t": time.time(),
            "responses_received": 0,
            "peers_not_stopped": [],
            "peers_silent": [],
            "lockout_engaged": True,
            "estop_id": secrets.token_hex(16),
            "source_zid": self._link.zid,
        }

    def _stop_command(self) -> Message:
        """Theirs lets a peer that only hears of a stop finish its task."""
        return {
            "sender_id": self._keys.us,
            "target_id": wire.EVERYBODY,
            "turn_id": secrets.token_hex(16),
            "command": {"action": "stop"},
            "timestamp": time.time(),
        }

    # -- stops --------------------------------------------------------------------------------
    def _obey_stops(self) -> None:
        while not self._ended.is_set():
            too_large = self._estop.wait(STATE_S) is False and bool(self._estop.pop_rejected())
            arrival = self._estop.pop()
            if arrival is None and not too_large:
                continue
            self._theirs = True  # before it is put: what it latches is not told back
            self._cancelled.set()
            StopClient.stop(self._robot)  # the subclass's waits
            self._count("estop")
            issuer = self._issuer(arrival.sample.payload.to_bytes() if arrival else b"")
            LOG.warning("emergency stop of %s on the mesh", issuer)
            self._follow_stop(issuer)

    def _issuer(self, payload: bytes) -> str:
        try:
            return str(wire.decode(payload).get("peer_id"))[:128]
        except CountedError:
            return "a message that cannot be read"

    def _follow_stop(self, issuer: str) -> None:
        robot = self._robot

        def heard() -> bool:
            return robot.stop_progress().outcome is not StopOutcome.NOT_CONFIRMED

        for _ in range(STOP_TRIES):
            if robot.wait_for(heard, STOP_TRY_S):
                break
            StopClient.stop(robot)
        robot.wait_for(robot.stopped, 2.0)
        found = robot.stop_progress()
        sentence = found.sentence(f"robot {robot.profile.robot.name}")
        LOG.warning("%s", sentence)
        told = {"trigger": "remote", "issuer": issuer, "outcome": found.outcome, "why": sentence}
        event = {"event_type": "remote_estop_engaged", "severity": "info", "payload": told}
        head = {"peer_id": self._keys.us, "t": time.time()}
        self._link.put(self._keys.event, {**head, **event})

    # -- commands -----------------------------------------------------------------------------
    def _hear(self) -> None:
        for sample in self._presences.drain():
            try:
                said = wire.decode(bytes_of(sample.sample.payload, wire.MAX_PRESENCE_BYTES))
                self._mandate.hear(said, time.time(), sample.mono_ns * 1e-9)
            except CountedError as error:
                self._refuse(error)

    def _answer_all(self) -> None:
        while not self._ended.is_set():
            self._came.wait(STATE_S)
            for each in self._commands.pop_rejected():
                self._refuse(RefusalError(each.reason, f"{each.key}: {each.why}"))
            for sample in self._commands.drain():
                try:
                    payload = bytes_of(sample.sample.payload, wire.MAX_COMMAND_BYTES)
                    command = wire.decode_command(payload)
                except CountedError as error:
                    self._refuse(error)
                    continue
                if command.sender != self._keys.us:
                    self._answer(command)

    def _answer(self, command: Command) -> None:
        self._count(command.action if command.action in _ACTIONS else "unknown")
        try:
            if command.action == "stop":
                self._reply(command, self._stop())
            elif command.action in ("execute", "start"):
                self._accept(command)
            elif command.action == "ping":
                pong = {"pong": True, "peer_id": self._keys.us, "t": time.time()}
                self._reply(command, pong)
            elif command.action == "status":
                self._reply(command, self._task())
            elif command.action == "state":
                self._reply(command, self.state())
            elif command.action == "features":
                self._reply(command, self._features())
            elif command.action in ("resume", "reset"):
                raise RefusalError("never_reset", "only a person at this robot resets it")
            else:
                raise RefusalError("unsupported", f"{command.action!r:.40} is not done here")
        except CountedError as error:
            self._refuse(error)
            self._reply_error(command, error.reason, str(error))
        except VlaZenohError as error:
            self._refuse(RefusalError("refused", str(error)))
            self._reply_error(command, "refused", str(error))

    def _features(self) -> Message:
        profile = self._robot.profile
        workers = list(profile.workers)
        joints = list(profile.robot.arm_joints)
        return {"joints": joints, "cameras": list(profile.cameras), "policy_providers": workers}

    def _stop(self) -> Message:
        """Brake, whoever asks and whoever drives: the arm is inactive then."""
        self._cancelled.set()
        if self._mode()[0] not in (*MOVING, "absent"):
            return {"ok": True, "status": "success", "note": "the arm was not active"}
        if self._robot.deactivate(STANDS_S):
            return {"ok": True, "status": "success", "note": "the arm stands"}
        why = "the arm has not confirmed that it stands; use its own emergency stop"
        return {"ok": False, "status": "error", "error": why}

    def _accept(self, command: Command) -> None:
        task = self._robot.task
        if task is not None and task.active and not self._mandate.commander:
            raise RefusalError("busy", "the arm is active by somebody at this robot")
        order = self._mandate.judge(command, time.time(), time.monotonic())
        self._cancelled.clear()
        if self._latched or self._mode()[0] == "stopped":
            self._mandate.end()
            raise RefusalError("stopped", "its emergency stop is latched; a person resets it here")
        what = f"strands-{command.sender}"
        threading.Thread(target=self._carry_out, args=(command, order, what), daemon=True).start()

    def _carry_out(self, command: Command, order: Order, what: str) -> None:
        robot, began_s = self._robot, time.monotonic()
        try:
            if order.worker:
                robot.set_worker(order.worker, ACCEPT_S)
            robot.set_prompt(order.prompt, ACCEPT_S)
            if self._cancelled.is_set():
                raise RefusalError("stopped", "it was stopped before it began")
            robot.activate_with_deadman(what, ACCEPT_S)
            self._mandate.begin(order, time.monotonic())
            LOG.warning("%s: %s, for %g s", command.sender, order.prompt, order.duration_s)
            if command.action == "start":
                self._reply(command, _told("started", f"it follows {order.prompt!r}", began_s))
            reason, why = self._until_over()
            stands = robot.deactivate()
            LOG.warning("%s: %s%s", command.sender, reason, f": {why}" if why else "")
            if not stands and reason == "completed":
                reason, why = "not_confirmed", "the arm has not said that it stands"
            if command.action == "execute":
                self._reply(command, _told(reason, why, began_s))
        except CountedError as error:
            self._refuse(error)
            self._reply_error(command, error.reason, str(error))
        except VlaZenohError as error:
            self._refuse(RefusalError("refused", str(error)))
            self._reply_error(command, "refused", str(error))
        finally:
            robot.release_deadman()
            self._mandate.end()

    def _until_over(self) -> tuple[str, str]:
        """Wait for the end of the order in force; its reason, and more words."""
        while True:
            if self._cancelled.is_set() or self._ended.is_set():
                return "stopped", "somebody stopped it"
            reason = self._mandate.over(time.monotonic())
            if reason == "silent":
                return reason, f"{self._mandate.commander} is not heard any more"
            if reason:
                return reason, ""
            task = self._robot.task
            if task is None or not task.active:
                return "ended", self._robot.why_inactive()
            time.sleep(LOOK_S)

    # -- answers ------------------------------------------------------------------------------
    def _reply(self, command: Command, result: Message) -> None:
        self._send(command, {"type": "response", "result": result})

    def _reply_error(self, command: Command, reason: str, why: str) -> None:
        self._send(command, {"type": "error", "error": f"{reason}: {why}", "reason": reason})

    def _send(self, command: Command, body: Message) -> None:
        if not command.sender:
            return
        who = {"responder_id": self._keys.us, "turn_id": command.turn, "timestamp": time.time()}
        key = self._keys.response(command.sender, command.turn)
        self._link.put(key, {**body, **who}, signed=True)

    def _count(self, what: str) -> None:
        self.counts[what] += 1

    def _refuse(self, error: CountedError) -> None:
        self._count(error.reason)
        now_s = time.monotonic()
        if now_s - self._told_s.get(error.reason, float("-inf")) >= TOLD_S:
            self._told_s[error.reason] = now_s
            LOG.warning("refused, %s (%d): %s", error.reason, self.counts[error.reason], error)


_ACTIONS = frozenset(
    ("stop", "execute", "start", "ping", "status", "state", "features", "resume", "reset")
)


def _told(reason: str, why: str, began_s: float) -> Message:
    """How an order went, as their tools read it."""
    well = reason in ("completed", "started")
    sentence = f"{reason}: {why}" if why else reason
    return {
        "status": "success" if well else "error",
        "content": [{"text": sentence}],
        "reason": reason,
        "why": why,
        "took_s": round(time.monotonic() - began_s, 3),
    }
