"""The node primitives: answers queries for guarded motions by driving the arm as a worker does.

Nothing bypasses the command node: the node selects itself as the worker, activates the arm for as
long as the asking client holds it, publishes chunks, and deactivates. One primitive at a time.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import zenoh

from vla_zenoh.bus.buffers import Wake, bytes_of
from vla_zenoh.client.answer import Answer
from vla_zenoh.client.remote_robot import TIMEOUT_S, RemoteRobot
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.states import DEACTIVATED
from vla_zenoh.errors import CodecError, NodeError, SessionError, VlaZenohError
from vla_zenoh.keys import PRIMITIVES, last_chunk, worker_node
from vla_zenoh.kinematics.so3 import Pose, pose_of, rotation_from_quat
from vla_zenoh.nodes.worker.node import InferenceDebugPublisher
from vla_zenoh.nodes.worker.robot_session import RobotSession
from vla_zenoh.policy.meaning import joints_as, wrapped
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, HeldBox
from vla_zenoh_primitives.endings import NEAR_JOINT, Arrival, Ending, Gripped, RunEnding, Sight
from vla_zenoh_primitives.policy import CHUNK_HZ, Target, TargetPolicy
from vla_zenoh_primitives.requests import (
    MAX_REQUEST_BYTES,
    Grip,
    Home,
    MoveTo,
    PrimitiveRequest,
    RunModel,
    decode_request,
)
from vla_zenoh_primitives.target_check import TargetCheck

POLL_S = 0.01
SPEC_LEAD_S = 0.1
"""A changed spec is published this long before the first chunk by it."""
READY_S = 4.0
"""Spec, first chunk and deadman have to reach the command node before it activates."""
AGAIN_S = 0.25
ARRIVES_S = 0.05
BLIND_S = 1.0
"""A command node that misses the states, too, has ended the motion by then, and says why."""
BRAKE_S = 5.0
POSE_JOINTS = 6


class Rejected(Exception):
    """Reason why a primitive is rejected; nothing moves."""


class _Asked(NamedTuple):
    name: str
    request: PrimitiveRequest
    query: zenoh.Query
    since_s: float


class PrimitivesNode:
    """Answers on `Keys.primitive`, see `vla_zenoh_primitives.requests`.

    Args:
        session: with the rights of a worker and of an operator.

    Raises:
        NodeError: it is already running.
        ProfileError: the robot has several arms.
        ResourceError: the robot's description is missing.
    """

    def __init__(self, profile: Profile, session: zenoh.Session) -> None:
        profile.require_one_arm("primitives")
        self._profile = profile
        self._policy = TargetPolicy(profile.robot.arm_joints)
        self._check = TargetCheck(profile, ReachabilityFilter(profile))
        self._worker = RobotSession(
            *(profile, session, self._policy, PRIMITIVES), images="jpeg", host=None, changed=Wake()
        )
        self._worker.complaint = ""
        self._debug = InferenceDebugPublisher(self._worker.node, PRIMITIVES, self._worker.spec)
        self._node, self._robot = self._worker.node, RemoteRobot(profile, session)
        self._robot.subscribe()
        self._stop, self._published = threading.Event(), threading.Event()
        self._asked: queue.SimpleQueue[_Asked] = queue.SimpleQueue()
        self._current: _Asked | None = None
        self._lock = threading.Lock()
        handler = zenoh.handlers.Callback(self._on_query, indirect=False)
        self._queryable = session.declare_queryable(
            profile.keys.all_primitives, handler, complete=True
        )

    def run(self, stop: threading.Event) -> None:
        """Serve until `stop` is set; an arm that moves is braked first.

        Raises:
            NodeError: an unexpected exception ended it before.
        """
        self._stop = stop
        thread = threading.Thread(target=self._serve, name="primitive")
        self._worker.report(now=True)
        thread.start()
        try:
            while thread.is_alive():
                self._publish_chunk()
                time.sleep(POLL_S)
        except BaseException:
            stop.set()  # the thread brakes the arm, and answers
            thread.join()
            raise
        self._queryable.undeclare()
        self._worker.close()
        if not stop.is_set():
            raise NodeError("the thread that carries out primitives failed; its traceback says why")

    # -- chunks -------------------------------------------------------------------------------
    def _publish_chunk(self) -> None:
        worker, now_s = self._worker, time.monotonic()
        worker.poll()
        observation = worker.observe() if worker.due_s <= now_s else None
        if observation is not None:
            clock = self._node.clock
            observed_ns = clock.wall_ns()
            target, steps = self._policy.target, self._policy.infer(observation)
            if self._policy.spec is not worker.spec:
                worker.adopt_spec()
                worker.due_s = now_s + SPEC_LEAD_S
                return
            worker.due_s = max(worker.due_s + 1 / CHUNK_HZ, now_s)
            times_ns = observed_ns, observed_ns, clock.wall_ns()
            chunk = worker.publish(observation, steps, times_ns, 1)
            with self._lock:
                # An arm activated by a chunk to the previous target would keep the spec of that
                # chunk.
                if target is self._policy.target:
                    self._published.set()
            if chunk is not None:
                self._debug.publish(observation, steps, *chunk)
        worker.report()

    def _aim(self, target: Target) -> None:
        """Publish chunks to `target` from now on."""
        with self._lock:
            self._policy.target = target
            self._published.clear()
        self._worker.due_s = 0.0

    # -- queries ------------------------------------------------------------------------------
    def _on_query(self, query: zenoh.Query) -> None:
        """On Zenoh's thread: rejects at once what cannot be executed."""
        name = last_chunk(str(query.key_expr))
        payload = query.payload
        try:
            asked = bytes_of(payload, MAX_REQUEST_BYTES) if payload is not None else b""
            request = decode_request(name, asked)
        except CodecError as error:
            self._node.reject(error.reason, f"primitive/{name[:40]}: {error}", "primitive")
            self._reply(query, Answer(False, "invalid", str(error)))
            return
        with self._lock:
            running = self._current
            if running is None:
                self._current = _Asked(name, request, query, time.monotonic())
                self._asked.put(self._current)
                return
        since_s = time.monotonic() - running.since_s
        why = f"{running.name} of {running.request.holder!r} has been running for {since_s:.1f} s"
        self._node.reject("busy", f"primitive/{name}: {why}", "primitive")
        self._reply(query, Answer(False, "busy", why))

    def _reply(self, query: zenoh.Query, answer: Answer) -> None:
        with query:
            if "*" in str(query.key_expr):
                query.reply_err(answer.encode())
            else:
                query.reply(query.key_expr, answer.encode(), encoding="application/json")

    def _serve(self) -> None:
        while not self._stop.is_set():
            try:
                asked = self._asked.get(timeout=AGAIN_S)
            except queue.Empty:
                continue
            answer = Answer(False, "ended", "the node primitives failed: its output says why")
            try:
                answer = self._carry_out(asked)
            finally:
                with self._lock:
                    self._current = None
                self._reply(asked.query, answer)

    # -- one primitive ------------------------------------------------------------------------
    def _carry_out(self, asked: _Asked) -> Answer:
        request = asked.request
        off: tuple[float, float] | None = None
        failed = "rejected"
        try:
            ending, target = self._prepare(request)
            run = request if isinstance(request, RunModel) else None
            worker, prompt = run.worker if run else PRIMITIVES, run and run.prompt
            with self._settings_kept(worker, prompt), self._stands_after():
                self._aim(target)
                self._activate(worker, prompt, request)
                failed = "ended"
                reason, why = self._watch(ending, asked.since_s + request.timeout_s)
            if isinstance(request, Grip) and reason == "reached":
                box = None if request.holds_m is None else HeldBox(request.holds_m)
                self._check.hold(box)
                self._robot.publish(self._robot.keys.held, "" if box is None else str(box))
            if isinstance(ending, Arrival):
                with suppress(VlaZenohError):  # a robot that is gone: the reason is known
                    off = ending.off(self._sight())
                    why = why or self._elbow(target)
        except (Rejected, VlaZenohError, zenoh.ZError) as error:
            reason, why = failed, str(error)
        ends_well = ["reached"]
        if isinstance(request, RunModel):
            ends_well += request.until.names or ["timeout"]
        return replace(
            self._standing(),
            ok=reason in ends_well,
            reason=reason,
            why=why,
            took_s=round(time.monotonic() - asked.since_s, 3),
            off_m=None if off is None else round(off[0], 6),
            off_rad=None if off is None else round(off[1], 6),
        )

    def _prepare(self, request: PrimitiveRequest) -> tuple[Ending, Target]:
        """Ending and target of a request.

        Raises:
            Rejected: the arm cannot go there, or is not free; says why.
        """
        robot, profile = self._robot, self._profile
        task = robot.task
        if task is None:
            raise Rejected("no command node is running")
        if latched := robot.latch_reason():
            raise Rejected(f"the arm is {latched}; `vla-zenoh reset` clears it")
        if task.active:
            raise Rejected(f"worker {task.worker!r} moves the arm: deactivate it first")
        sight, most_m = self._sight(), profile.robot.max_width_m
        grips = isinstance(request, Grip) or (
            isinstance(request, RunModel) and bool(request.until.gripper)
        )
        if grips and profile.robot.no_gripper:
            raise Rejected(profile.robot.no_gripper)
        if isinstance(request, RunModel):
            return self._prepare_run(request, sight, most_m)
        if isinstance(request, Grip):
            width_m = request.width_m
            closing = width_m == "closed"
            wanted_m = {"closed": 0.0, "open": most_m}.get(str(width_m), width_m)
            assert isinstance(wanted_m, float)
            if wanted_m > most_m:
                raise Rejected(f"width_m is {wanted_m:g}, the gripper opens to {most_m:g} m")
            return Gripped(wanted_m, closing=closing), Target(width_m=wanted_m)
        if isinstance(request, Home):
            return self._to_joints(np.array(profile.robot.home_rad, float), sight)
        assert isinstance(request, MoveTo)
        if request.joints_rad is not None:
            return self._to_joints(self._named(request.joints_rad, sight), sight)
        return self._to_pose(request, sight)

    def _prepare_run(self, request: RunModel, sight: Sight, most_m: float) -> tuple[Ending, Target]:
        if worker_node(request.worker) not in self._robot.alive:
            raise Rejected(f"worker {request.worker!r} is not alive")
        if request.worker == PRIMITIVES:
            raise Rejected(f"worker {PRIMITIVES!r} is this node: name a model")
        if request.until.force_n and sight.pose.wrench is None:
            raise Rejected("until.force_n: this robot does not report forces")
        return RunEnding(request.until, most_m), Target()

    def _to_pose(self, request: MoveTo, sight: Sight) -> tuple[Ending, Target]:
        if len(self._profile.robot.arm_joints) < POSE_JOINTS:
            raise Rejected(
                "a pose needs an arm of six joints: give joints_rad (`do move-to --joints`)"
            )
        here = pose_of(sight.pose)
        position_m = here.position_m if request.position_m is None else request.position_m
        quat = request.quat_xyzw
        rotation = here.rotation if quat is None else rotation_from_quat(np.array(quat))
        pose = Pose(np.array(position_m, float), rotation)
        if why := self._check.pose_fault(sight.joints_rad, pose):
            raise Rejected(why)
        return Arrival(pose), Target(pose=pose)

    def _named(self, joints_rad: dict[str, float] | tuple[float, ...], sight: Sight) -> FloatArray:
        """(n,) in the order of the profile."""
        names = self._profile.robot.arm_joints
        if isinstance(joints_rad, dict):
            if unknown := [name for name in joints_rad if name not in names]:
                raise Rejected(f"joints_rad: no joint {unknown[0]!r}; there are {', '.join(names)}")
            arm = self._check.kinematics
            here_rad = np.where(arm.endless, wrapped(sight.joints_rad), sight.joints_rad)
            now = dict(zip(arm.arm_joints, here_rad.tolist(), strict=True))
            return np.array([{**now, **joints_rad}[name] for name in names])
        if len(joints_rad) != len(names):
            raise Rejected(
                f"joints_rad has {len(joints_rad)} entries, the arm has {len(names)} joints: "
                f"{', '.join(names)}"
            )
        return np.array(joints_rad, float)

    def _to_joints(self, joints_rad: FloatArray, sight: Sight) -> tuple[Ending, Target]:
        kinematics = self._check.kinematics
        chain_rad = kinematics.ordered(self._profile.robot.arm_joints, joints_rad)
        if why := self._check.joints_fault(sight.joints_rad, chain_rad):
            raise Rejected(why)
        # An arm commanded by poses leaves the elbow to its own controller.
        judged = chain_rad if self._profile.robot.command == "joint" else None
        arrival = Arrival(kinematics.forward(chain_rad), judged, kinematics)
        return arrival, Target(joints_rad=joints_rad)

    def _elbow(self, target: Target) -> str:
        """How far an arm commanded by poses is from the requested joints."""
        if target.joints_rad is None or self._profile.robot.command == "joint":
            return ""
        names = self._profile.robot.arm_joints
        here_rad, arm = self._sight().joints_rad, self._check.kinematics
        asked_rad = arm.nearest(arm.ordered(names, target.joints_rad), here_rad)
        off, near = np.abs(here_rad - asked_rad), NEAR_JOINT.of(arm.slides)
        worst = int(np.argmax(off / near))
        return (
            f"this robot takes poses: the TCP is where these joints place it, the joints are up to "
            f"{off[worst]:.2g} {arm.unit(worst)} away, because its controller keeps the elbow"
            if off[worst] > near[worst]
            else ""
        )

    @contextmanager
    def _settings_kept(self, worker: str, prompt: str | None) -> Iterator[None]:
        """Restores both afterwards, unless somebody has chosen another one meanwhile."""
        robot, before = self._robot, self._robot.task
        try:
            yield
        finally:
            with suppress(SessionError):  # if the command node is gone, so are they
                now = robot.task
                if before is not None and now is not None:
                    if now.worker in (worker, before.worker):
                        robot.set_worker(before.worker)
                    if now.prompt in (prompt, before.prompt):
                        robot.set_prompt(before.prompt)

    @contextmanager
    def _stands_after(self) -> Iterator[None]:
        try:
            yield
        finally:
            self._robot.deactivate(BRAKE_S)
            self._aim(Target())

    def _activate(self, worker: str, prompt: str | None, request: PrimitiveRequest) -> None:
        """Select `worker`, and activate the arm for as long as the client holds it."""
        robot, give_up_s = self._robot, time.monotonic() + min(READY_S, request.timeout_s)
        robot.set_worker(worker)
        if prompt is not None:
            robot.set_prompt(prompt)
        if worker == PRIMITIVES:
            until_s = time.monotonic() + READY_S
            while not (self._published.wait(POLL_S) or self._stop.is_set()):
                if time.monotonic() > until_s:
                    break
            time.sleep(ARRIVES_S)
        while True:
            if self._stop.is_set():
                raise Rejected("the node primitives ends")
            try:
                robot.activate(holder=request.holder)
                return
            except SessionError:
                if time.monotonic() > give_up_s:
                    raise
            time.sleep(AGAIN_S)

    def _watch(self, ending: Ending, until_s: float) -> tuple[str, str]:
        """Wait until the primitive ends; returns its reason and details."""
        robot, looked_s, blind_for_s = self._robot, time.monotonic(), 0.0
        blind_s = self._profile.timing.state_timeout_s + BLIND_S
        while True:
            task = robot.task
            if task is None or not task.active:
                return self._why_inactive()
            if self._stop.is_set():
                return "ended", "the node primitives ends"
            try:
                reason = ending.check(self._sight(POLL_S))
                blind_for_s = 0.0
            except SessionError:
                reason = ""
                # A look lasts a few times POLL_S: more is a stall of this computer.
                blind_for_s += min(time.monotonic() - looked_s, 10 * POLL_S)
                if blind_for_s > blind_s:
                    return "ended", "no state of the robot reaches the node primitives"
            looked_s = time.monotonic()
            if reason == "bound":
                status = robot.status("command")
                limits = status.detail.get("limits") if status is not None else None
                acting = ", ".join(map(str, limits)) if isinstance(limits, (list, tuple)) else ""
                return reason, f"no more progress; active limits: {acting or 'none'}"
            if reason:
                return reason, ""
            if time.monotonic() > until_s:
                return "timeout", ""
            time.sleep(POLL_S)

    def _why_inactive(self) -> tuple[str, str]:
        robot = self._robot
        robot.wait_for(lambda: self._state() not in ("active", "holding"), 1.0)
        status = robot.status("command")
        if status is None or robot.task is None:
            return "ended", "the command node is gone"
        why = str(status.detail.get("why", ""))
        if status.state in ("stopped", "fault"):
            return status.state, why
        return ("deactivated", "") if why == DEACTIVATED else ("ended", why)

    def _state(self) -> str:
        status = self._robot.status("command")
        return status.state if status is not None else ""

    def _sight(self, timeout_s: float = TIMEOUT_S) -> Sight:
        robot = self._robot
        task, status = robot.task, robot.status("command")
        done = status is not None and status.detail.get("policy_done") is True
        # A status from before the activation describes an older episode.
        if task is not None and status is not None:
            done = done and status.detail.get("episode") == task.episode
        return Sight(
            time.monotonic(),
            robot.pose_state(timeout_s).record,
            self._check.kinematics.joints_of(robot.joint_state(timeout_s).record),
            robot.gripper_state(timeout_s).record,
            done,
            task.speed if task is not None else 1.0,
        )

    def _standing(self) -> Answer:
        """An answer with the state of the arm."""
        try:
            pose = self._robot.pose_state().record
            joint = joints_as(self._robot.joint_state().record, "wrapped")
            gripper = self._robot.gripper_state().record
        except VlaZenohError:
            return Answer(False, "")
        return Answer(
            False,
            "",
            position_m=pose.position_m.tolist(),
            quat_xyzw=pose.quat_xyzw.tolist(),
            joints_rad=dict(zip(joint.names, joint.position_rad.tolist(), strict=True)),
            width_m=gripper.width_m,
            holding=gripper.holding,
        )
