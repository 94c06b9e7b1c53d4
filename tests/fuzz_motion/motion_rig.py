"""The command node's mind, its guard and a perfect arm on one clock, with trouble by chance.

Whatever happens here may happen to a robot; nothing that happens here may break a property of
`motion_judge`.
"""

from __future__ import annotations

import heapq
import math
import random
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from motion_case import WORKER, Actions, Case

from vla_zenoh.control.commander import Commander, Inputs, Outputs, Setting
from vla_zenoh.control.plan_timeline import JointGoal
from vla_zenoh.control.preflight import PeerSnapshot
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.guard.arm_guard import ArmGuard, Measured
from vla_zenoh.kinematics.so3 import Pose, exp3, log3, pose_distance, quat_from_rotation
from vla_zenoh.types import (
    ActionChunk,
    GripperState,
    Header,
    JointState,
    PoseState,
    Stamped,
    Task,
)

START_NS = 1_700_000_000_000_000_000
SOURCE, ROBOT, NODE = "worker-scripted-1", "sim-1", "command-1"
OBEYING = ("active", "holding")
LEFT = 1e-4
"""m and rad: less that is left of a chunk is rounding."""
FROZEN_M = 0.02
"""Joints that stand still while the TCP moves this far are frozen."""
NOTICED_NS, LATE_NS = 400_000_000, 2_000_000_000
"""Time in which a lie is noticed; how late a late state is."""
WIRE_NS = 200_000
"""What a command needs where nothing is wrong."""
HAPPENINGS = {
    "style": 0.7,
    "pause": 0.06,
    "heap": 0.1,
    "prompt": 0.06,
    "prompts": 0.02,
    "rates": 0.03,
    "deactivate": 0.08,
    "toggle": 0.08,
    "stop": 0.04,
    "all at once": 0.03,
    "late": 0.25,
    "dropout": 0.05,
    "stuck": 0.03,
    "blocked": 0.03,
    "fault": 0.02,
    "speed": 0.15,
}
"""How often each of them happens, per second."""
LIES_1_S = 0.03
LIES = ("pose late", "joints late", "gripper late", "joints frozen", "pose false")
"""What a robot may tell that is not so, each while its other streams go on; see `Lie`."""
HAS_SPEED = "speed_percent" in Task.__dataclass_fields__


class Tick(NamedTuple):
    """One call of the commander.

    Args:
        time_ns: nominal time.
        state: afterwards.
        followed: the guard followed a stream before it.
        anchored: the arm was activated in it.
        misled: the robot tells joints, and its set-point of them, of some time ago.
        record: the command, None: nothing was streamed.
        goal: the goal in force, None: none is.
        goal_rad: joints that it asks for, None: it is a pose.
        percent: of the speed, in force.
        retreats: the arm is led back from what blocked it.
    """

    time_ns: int
    state: str
    followed: bool
    anchored: bool
    misled: bool
    record: Any
    goal: Pose | None
    goal_rad: Any
    percent: float
    retreats: bool


@dataclass
class Lie:
    """A false measured state.

    Args:
        name: of `LIES`.
        since, until: ticks.
        shift_m: of the pose, or how far the arm has moved since its joints froze.
        seen_ns: time for which it could have been noticed.
    """

    name: str
    since: int
    until: int
    shift_m: np.ndarray
    state: Any = None
    seen_ns: int = 0


@dataclass
class Trace:
    """All that is judged: every call of the commander, and every reference of the guard."""

    ticks: list[Tick] = field(default_factory=list)
    references: list[Any] = field(default_factory=list)
    guard_tick: list[int] = field(default_factory=list)
    """Index of the call of the commander that came before."""
    faults: list[tuple[int, str]] = field(default_factory=list)
    """(tick, why) of every fault that was not the robot's."""
    broken: list[tuple[int, str, float, str]] = field(default_factory=list)
    """(tick, property, size, unit) of what the rig itself sees."""
    failed: tuple[int, str] | None = None
    """(tick, exception)."""


class Rig:
    """See the module.

    Args:
        case: the run.
    """

    def __init__(self, case: Case) -> None:
        profile = case.profile
        self.case, self._rng = case, case.random
        self.trace = Trace()
        reach = ReachabilityFilter(profile, case.arm) if case.reach else None
        self._kinematics = case.arm if case.reach else None
        self._joints = np.array(profile.robot.home_rad)
        self._measured = self._held = case.start
        if self._kinematics is not None:
            away = [self._rng.uniform(-0.2, 0.2) for _ in self._joints]
            self._joints = self._joints + np.array(away)
            self._measured = self._held = self._kinematics.forward(self._joints)
        self._held_joints, self._rates = self._joints, np.zeros(len(self._joints))
        self.commander = Commander(profile, reach=reach)
        known = case.arm
        self.guard = ArmGuard(
            profile,
            self._measure,
            (known.lower_rad, known.upper_rad),
            known.velocity_rad_s,
            known.slides,
            1.0 / case.guard_hz,
        )
        self._actions = Actions(case)
        self._period_ns = round(1e9 / profile.timing.command_hz)
        self._guard_period_ns = round(1e9 / case.guard_hz)
        self._now_ns = START_NS
        self._guard_ns = START_NS
        self._seq = 0
        self._wire: list[tuple[int, int, Stamped[Any]]] = []
        self._sent = self._held_until_ns = 0
        same_host = frozenset({"sim", "camera", f"worker-{WORKER}"})
        self._peers: PeerSnapshot | None = PeerSnapshot(
            alive=same_host,
            robot_node="sim",
            specs={WORKER: case.spec},
            spec_sources={WORKER: SOURCE},
            camera_ages_s={"front": 0.0},
            camera_nodes={"front": "camera"},
            same_host=same_host,
        )
        self._grippers = {
            mode: GripperState(0.08, moving=False, holding=False, mode=mode)
            for mode in ("ready", "braking", "unheeded")
        }
        self._sore = GripperState(0.08, moving=False, holding=False, faults=("sore",))
        self._pose_state: PoseState | None = None
        self._told_of: Pose | None = None
        self._last_pose: Stamped[PoseState] | None = None
        # What is going on, by the tick at which it ends.
        self._silent_until = self._stuck_until = self._blocked_until = self._sore_until = 0
        self._next_chunk = 0
        self._heap: list[Stamped[ActionChunk]] = []
        self._heap_until = 0
        self._person_at = 2
        self._liar = random.Random(case.seed)
        self._lie: Lie | None = None
        self._chunk_ns = 0
        self._offered = False
        self._share = -math.expm1(-1.0 / (case.guard_hz * case.lag_s)) if case.lag_s else 1.0
        self._rate_hz = 5.0
        self._age_s = self._rng.uniform(0.02, 0.3)
        self._names = [n for n in HAPPENINGS if n != "speed" or HAS_SPEED]
        self._weights = [HAPPENINGS[name] for name in self._names]
        self._chance = sum(self._weights) / profile.timing.command_hz

    # -- time ---------------------------------------------------------------------------------
    def run(self, ticks: int) -> Trace:
        """So many calls of the commander."""
        trace = self.trace
        while len(trace.ticks) < ticks and trace.failed is None:
            try:
                self._tick()
            except Exception as error:
                trace.failed = (len(trace.ticks), f"{type(error).__name__}: {error}")
        return trace

    def _tick(self) -> None:
        at = len(self.trace.ticks)
        settings: list[Setting] = []
        chunks: list[Stamped[ActionChunk]] = []
        periods = self._happen(at, settings) if self._rng.random() < self._chance else 1
        self._now_ns += periods * self._period_ns
        self._robot()
        self._person(at, settings, chunks)
        if at >= self._next_chunk:
            self._think(at, chunks)
        if self._heap and at >= self._heap_until:
            chunks += self._heap
            self._heap = []
        inputs = Inputs(settings, chunks, peers=self._peers)
        self._peers = None
        if at >= self._silent_until:
            self._tell(at, inputs)
            self._tamper(at, inputs)
        followed, before = self.guard.following, self.commander.state.value
        if inputs.chunks and at % 2:  # as the command node does with one that comes between ticks
            early, inputs = inputs, Inputs(inputs.settings, peers=inputs.peers)
            self.commander.prepare(replace(early, settings=(), peers=None), self._now_ns)
        plan_before, arrived = self._plan(), self.commander.parts[0].motion.arrived
        out = self.commander.step(inputs, self._now_ns, periods)
        self._check(at, plan_before, before, out, arrived=arrived)
        state = self.commander.state.value
        # Deactivated and activated in one tick, it is, too.
        anew = before not in OBEYING or any(e.what.startswith("inactive->") for e in out.events)
        for event in out.events:
            if event.what.endswith("->fault") and not event.why.startswith("the robot reports"):
                self.trace.faults.append((at, event.why))
        record = out.joint if self.case.joint else out.pose
        goal = self.commander.parts[0].motion.goal
        self.trace.ticks.append(
            Tick(
                self._now_ns,
                state,
                followed,
                anew and state in OBEYING,
                self._lie is not None and self._lie.name == "joints frozen",
                record,
                goal.pose if goal is not None else None,
                goal.joints_rad if isinstance(goal, JointGoal) else None,
                float(getattr(self.commander.task, "speed_percent", 100.0)),
                self.commander.retreating,
            )
        )
        if record is not None:
            self._send(record)

    def _plan(self) -> Any:
        timeline = self.commander.parts[0].motion.timeline
        return None if timeline is None else timeline.plan

    def _check(self, at: int, before: Any, state: str, out: Outputs, *, arrived: bool) -> None:
        """Nothing of a chunk is lost in silence, and no lie is believed for long.

        A hold is judged by whether the arm had `arrived` before the tick: the brake of the hold is
        a motion of its own, which ends the creep of an elbow to its posture.
        """
        now = self.commander.state.value
        if out.accepted is not None:
            self._chunk_ns = self._now_ns
        plan = self._plan()
        held = plan is not None and plan.cause is None
        if held and before is not None and before.cause is not None:
            left = pose_distance(before.goals[before.bounded - 1].pose, plan.goals[0].pose)
            if max(left) > LEFT and all(event.what != "dropped" for event in out.events):
                self.trace.broken.append((at, "part of a chunk lost in silence", max(left), "m"))
        early_s = self.case.profile.timing.max_open_loop_s - (self._now_ns - self._chunk_ns) / 1e9
        if (state, now) == ("active", "holding") and early_s > 0 and not arrived:
            self.trace.broken.append((at, "holds on its way to the last step", early_s, "s"))
        lie = self._lie
        if lie is None or now not in OBEYING:
            return
        lie.seen_ns += self._period_ns if self._noticeable(lie) else 0
        if lie.seen_ns > NOTICED_NS:
            self.trace.broken.append((at, f"{lie.name}: not noticed", lie.seen_ns / 1e9, "s"))

    def _noticeable(self, lie: Lie) -> bool:
        """The difference is large enough for it to be a lie."""
        if self._kinematics is None:  # its joints are not told
            return lie.name in ("pose late", "gripper late")
        if lie.name.endswith("late"):
            return True
        if lie.name == "pose false":
            return True
        if lie.state is None:
            return False
        told = self._kinematics.forward(lie.state.record.position_rad)
        return max(pose_distance(told, self._measured)[:1]) > FROZEN_M

    def _tamper(self, at: int, inputs: Inputs) -> None:
        """What the robot tells is false now and then."""
        lie = self._lie
        if lie is not None and at >= lie.until:
            lie = self._lie = None
        if lie is None and self._liar.random() < LIES_1_S * self._period_ns / 1e9:
            name = self._liar.choice(LIES)
            length = round(self._liar.uniform(0.3, 1.5) * 1e9 / self._period_ns)
            shift_m = np.array([self._liar.gauss(0.0, 1.0) for _ in range(3)])
            shift_m *= self._liar.uniform(0.05, 0.065) / np.linalg.norm(shift_m)
            lie = self._lie = Lie(name, at, at + length, shift_m)
        if lie is None or inputs.pose is None:
            return
        if lie.name == "pose late":
            inputs.pose = _late(inputs.pose)
        elif lie.name == "gripper late" and inputs.gripper is not None:
            inputs.gripper = _late(inputs.gripper)
        elif lie.name == "joints late" and inputs.joint is not None:
            inputs.joint = _late(inputs.joint)
        elif lie.name == "joints frozen" and inputs.joint is not None:
            lie.state = lie.state or inputs.joint
            inputs.joint = replace(inputs.joint, record=lie.state.record)
        elif lie.name == "pose false":
            record = inputs.pose.record
            moved = replace(record, position_m=record.position_m + lie.shift_m)
            inputs.pose = replace(inputs.pose, record=moved)

    # -- the robot ----------------------------------------------------------------------------
    def _robot(self) -> None:
        """All of the guard's ticks until now."""
        at = len(self.trace.ticks) - 1
        guard, wire, trace = self.guard, self._wire, self.trace
        offer = guard.offer
        blocked = at < self._blocked_until
        while self._guard_ns <= self._now_ns:
            while wire and wire[0][0] <= self._guard_ns:
                arrival_ns, _, command = heapq.heappop(wire)
                offer(command, arrival_ns)
            reference = guard.tick(self._guard_ns)
            trace.references.append(reference)
            trace.guard_tick.append(at)
            self._guard_ns += self._guard_period_ns
            self._follow(reference, 0.0 if blocked else self._share)

    def _follow(self, reference: Any, share: float) -> None:
        """The arm goes where the reference is, or part of the way."""
        if self.case.joint:
            self._held_joints = reference.position_rad
            self._rates = reference.velocity_rad_s if share else np.zeros(len(self._joints))
            self._joints = self._joints + share * (reference.position_rad - self._joints)
            return
        here = self._held = Pose(reference.position_m, reference.rotation)
        if not share:
            return
        if share < 1.0:
            was = self._measured
            turn = log3(here.rotation @ was.rotation.T)
            here = Pose(
                was.position_m + share * (here.position_m - was.position_m),
                exp3(share * turn) @ was.rotation,
            )
        self._measured = here

    def _measure(self) -> Measured:
        return Measured(self._measured, self._joints, self._rates)

    def _tell(self, at: int, inputs: Inputs) -> None:
        """State of the robot; the same record where it is stuck."""
        if at < self._stuck_until and self._last_pose is not None:
            inputs.pose = self._last_pose
            return
        self._seq += 1
        header = Header(self._now_ns, self._seq, ROBOT)
        if self._kinematics is not None:
            self._tell_joints(header, inputs)
        elif self._pose_state is None or self._held is not self._told_of:
            self._pose_state = self._pose_record()
        self._told_of = self._held
        assert self._pose_state is not None
        inputs.pose = self._last_pose = Stamped(header, self._pose_state, self._now_ns)
        mode = "ready"
        if self.guard.braking:
            mode = "braking"
        elif self.guard.unheeded:
            mode = "unheeded"
        gripper = self._sore if at < self._sore_until else self._grippers[mode]
        inputs.gripper = Stamped(header, gripper, self._now_ns)

    def _tell_joints(self, header: Header, inputs: Inputs) -> None:
        assert self._kinematics is not None
        if self.case.joint:
            self._measured = self._kinematics.forward(self._joints)
            self._held = self._kinematics.forward(self._held_joints)
        else:
            # The joints of an arm whose own controller leaves its elbow where it was.
            pose, jacobian = self._kinematics.pose_and_jacobian(self._joints)
            apart = np.concatenate(
                [
                    self._measured.position_m - pose.position_m,
                    log3(self._measured.rotation @ pose.rotation.T),
                ]
            )
            square = jacobian @ jacobian.T + 1e-6 * np.eye(6)
            self._joints = self._joints + jacobian.T @ np.linalg.solve(square, apart)
            self._held_joints = self._joints
        self._pose_state = self._pose_record()
        record = JointState(
            self._kinematics.arm_joints,
            self._joints,
            self._rates,
            np.zeros(len(self._joints)),
            self._held_joints,
        )
        inputs.joint = Stamped(header, record, self._now_ns)

    def _pose_record(self) -> PoseState:
        noise_m, measured, held = self.case.noise_m, self._measured, self._held
        shaken = [self._rng.uniform(-noise_m, noise_m) for _ in range(3)] if noise_m else 0.0
        quat = quat_from_rotation(measured.rotation)
        held_quat = quat if held is measured else quat_from_rotation(held.rotation)
        return PoseState(
            measured.position_m + shaken,
            quat,
            np.zeros(6),
            None,
            held.position_m + shaken,
            held_quat,
        )

    # -- the network --------------------------------------------------------------------------
    def _send(self, record: Any) -> None:
        rng, network = self._rng, self.case.network
        self._seq += 1
        arrival_ns = self._now_ns + WIRE_NS
        times = 1
        if network.loss and rng.random() < network.loss:
            times = 0
        elif network.again and rng.random() < network.again:
            times = 2
        if network.held_1_s and rng.random() * 1e9 < network.held_1_s * self._period_ns:
            self._held_until_ns = self._now_ns + round(rng.uniform(0.01, 0.25) * 1e9)
        header = Header(self._now_ns, self._seq, NODE)
        for _ in range(times):
            later_ns = round(rng.uniform(0, network.delay_s) * 1e9) if network.delay_s else 0
            at_ns = max(arrival_ns + later_ns, self._held_until_ns)
            self._sent += 1
            heapq.heappush(self._wire, (at_ns, self._sent, Stamped(header, record, at_ns)))

    # -- the worker ---------------------------------------------------------------------------
    def _think(self, at: int, chunks: list[Stamped[ActionChunk]]) -> None:
        rng = self._rng
        gap_s = rng.uniform(0.7, 1.3) / self._rate_hz
        self._next_chunk = at + max(1, round(gap_s * 1e9 / self._period_ns))
        if self.commander.state.value not in OBEYING:
            return
        goal = self.commander.parts[0].motion.goal
        if self.case.in_joints:
            asked_rad = goal.joints_rad if goal is not None else None
            here_rad = self._held_joints if asked_rad is None else asked_rad
            chunk = self._chunk(self._actions.joint_steps(here_rad))
        else:
            chunk = self._chunk(self._actions.steps(goal.pose if goal else self._held))
        (self._heap if at < self._heap_until else chunks).append(chunk)

    def _chunk(self, steps: np.ndarray, *, sound: bool = False) -> Stamped[ActionChunk]:
        rng, now_ns = self._rng, self._now_ns
        age_s, episode, spec = self._age_s, self.commander.task.episode, self.case.spec.hash
        if sound:
            age_s = 0.0
        elif rng.random() < 0.05:
            age_s = rng.uniform(-0.2, 1.3)
            episode += rng.choice([0, 0, 0, 1, -1])
            spec = spec if rng.random() < 0.9 else "another"
        observed_ns = now_ns - round(age_s * 1e9)
        self._seq += 1
        with np.errstate(over="ignore"):
            steps = np.asarray(steps, np.float32)
        record = ActionChunk(
            worker=WORKER,
            spec_hash=spec,
            episode=max(episode, 0),
            observation_stamp_ns=observed_ns,
            observation_seq=self._seq,
            valid_until_ns=now_ns + 2_000_000_000,
            steps=steps,
            observed_ns=observed_ns,
            inference_start_ns=observed_ns,
            inference_end_ns=now_ns,
        )
        return Stamped(Header(now_ns - 1_000_000, self._seq, SOURCE), record, now_ns)

    # -- people and trouble -------------------------------------------------------------------
    def _person(self, at: int, settings: list[Setting], chunks: list[Stamped[ActionChunk]]) -> None:
        """Activates an arm that does not obey, some time later."""
        state = self.commander.state.value
        if state in OBEYING:
            self._person_at, self._offered = 0, False
        elif not self._person_at:
            wait_s = self._rng.choice([0.004, 0.05, 0.2, 0.6, 1.0])
            self._person_at = at + max(1, round(wait_s * 1e9 / self._period_ns))
        elif at >= self._person_at:
            if state in ("stopped", "fault"):
                settings.append(Setting("reset"))
            elif not self._offered:
                absolute = self.case.spec.action.kind == "absolute"
                still = self._joints[None] * absolute
                if not self.case.in_joints:
                    still = self._actions.standing(self._held)
                chunks.append(self._chunk(still, sound=True))
                self._offered = True
            else:
                settings.append(Setting("active", True))
                self._person_at, self._offered = 0, False

    def _happen(self, at: int, settings: list[Setting]) -> int:
        """Something does; how many periods later this tick is."""
        rng = self._rng
        second = round(1e9 / self._period_ns)
        what = rng.choices(self._names, self._weights)[0]
        if what == "style":
            self._actions.change()
            self._rate_hz = rng.choice([1.0, 2.0, 5.0, 10.0, 20.0])
            self._age_s = rng.choice([0.02, 0.1, 0.25, 0.5])
        elif what == "pause":
            self._next_chunk = at + round(rng.uniform(0.2, 1.5) * second)
        elif what == "heap":
            self._heap_until = at + round(rng.uniform(0.1, 0.8) * second)
        elif what == "prompt":
            settings.append(Setting("prompt", f"prompt {at}"))
        elif what == "prompts":
            settings += [Setting("prompt", f"prompt {at} {n}") for n in range(20)]
        elif what == "rates":
            settings += [Setting("rate", rng.choice([0.0, 1.0, 5.0, 50.0, 1e9])) for _ in range(9)]
        elif what == "deactivate":
            settings.append(Setting("active", False))
        elif what == "toggle":
            settings += [Setting("active", False), Setting("active", True)]
        elif what == "stop":
            settings.append(Setting("stop"))
        elif what == "all at once":
            settings += [Setting("stop"), Setting("reset"), Setting("active", True)]
        elif what == "late":
            return rng.randint(2, 24)
        elif what == "dropout":
            self._silent_until = at + rng.randint(5, 90)
        elif what == "stuck":
            self._stuck_until = at + rng.randint(5, 90)
        elif what == "blocked":
            self._blocked_until = at + round(rng.uniform(0.05, 1.0) * second)
        elif what == "fault":
            self._sore_until = at + round(rng.uniform(0.01, 0.5) * second)
        elif what == "speed":
            settings.append(Setting("speed", rng.choice([0.0, 1.0, 10.0, 50.0, 100.0, 100.0])))
        return 1


def _late(state: Stamped[Any]) -> Stamped[Any]:
    header = state.header
    return replace(state, header=replace(header, stamp_wall_ns=header.stamp_wall_ns - LATE_NS))
