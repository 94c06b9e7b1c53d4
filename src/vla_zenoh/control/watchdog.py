"""Reasons to brake: overdue chunks, nodes that are gone, joints near a bound, a deadman let go."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet

import numpy as np

from vla_zenoh.control.limits import LimitHit, Slowdown, in_steps, joint_margins, slowest
from vla_zenoh.control.monitor import Brake, Monitor, PartSnapshot, too_near
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.keys import NO_DEADMAN_TOKEN, worker_node
from vla_zenoh.policy.plan_clock import FOREVER_NS
from vla_zenoh.profile import Profile, Timing
from vla_zenoh.types import FloatArray, JointBound, Task

FIRST_CHUNK_PATIENCE_S = 1.0
"""Extra time for the first chunk after activation: it needs an observation and an inference."""
PERIOD_NS = 30_000_000
"""Between two checks of the same measured values: noise has to be seen apart from motion."""
PAST = 0.005
"""The measured arm brakes this far past a stop, in m or of the singular value: goals end at the
stop, and the arm lags."""
PAST_MARGIN = 0.5
"""Part of ``joint_margin_rad``."""
BAND_RAD, BAND = 2e-3, 5e-4
"""Width of the band that follows a value: wider than noise, narrower than `PAST`."""


class Deadline:
    """A time that is some plan time away, which passes at the speed override, and some seconds."""

    def __init__(self) -> None:
        self.at_ns = 0
        self._left_ns, self._patience_ns = 0.0, 0

    def set(self, left_ns: float, patience_s: float, now_ns: int, speed: float) -> None:
        """`left_ns` of plan time from now at override `speed`, then `patience_s`; never at 0."""
        self._left_ns, self._patience_ns = left_ns, int(patience_s * 1e9)
        self.at_ns = FOREVER_NS
        if speed:
            left_ns = left_ns / speed if left_ns > 0 else left_ns
            self.at_ns = now_ns + round(left_ns) + self._patience_ns

    def left_ns(self, now_ns: int, speed: float) -> float:
        """Plan time that is left at override `speed`; below 0: time since it passed."""
        if not speed:
            return self._left_ns
        left_ns = self.at_ns - self._patience_ns - now_ns
        return left_ns * speed if left_ns > 0 else left_ns

    def move(self, left_ns: float, now_ns: int, speed: float) -> None:
        """Set it to `left_ns` of plan time from now, with the same patience."""
        self.set(left_ns, self._patience_ns / 1e9, now_ns, speed)


class Watchdog:
    """Deadline of the next chunk, and of the motion without one."""

    def __init__(self, timing: Timing) -> None:
        self._timing = timing
        self._chunk, self._motion = Deadline(), Deadline()

    def expect(
        self, left_ns: int | None, now_ns: int, task: Task, *, carries_on: bool = False
    ) -> None:
        """Set the deadline of the next chunk, and that of the motion without one.

        The next chunk is due one period at the requested rate, and the watchdog, after `left_ns` of
        plan time, of which ``max_open_loop_s`` count at most; None: the first chunk of an episode.
        Whatever the rate, the arm moves for ``max_open_loop_s`` of plan time and the watchdog at
        most; a motion that `carries_on` keeps its deadline. At override 0 plan time stands still.
        """
        patience_s = self._timing.watchdog_s
        first_s = patience_s + FIRST_CHUNK_PATIENCE_S
        open_loop_ns = self._timing.max_open_loop_s * 1e9
        plan_ns = min(left_ns or 0, open_loop_ns)
        chunk_s = first_s if left_ns is None else patience_s
        self._chunk.set(plan_ns + 1e9 / task.rate_hz, chunk_s, now_ns, task.speed)
        if not carries_on:
            self._motion.set(open_loop_ns, patience_s, now_ns, task.speed)

    def override_changed(self, now_ns: int, before: float, speed: float) -> None:
        """Keep the plan time that is left until the deadlines, of an override that was `before`."""
        for deadline in (self._chunk, self._motion):
            deadline.move(deadline.left_ns(now_ns, before), now_ns, speed)

    def rate_changed(self, now_ns: int, before_hz: float, task: Task) -> None:
        """The next chunk is due by the rate of `task`, which was `before_hz`.

        At a lower rate later by what the period is longer, at a higher one within a period.
        """
        period_ns, left_ns = 1e9 / task.rate_hz, self._chunk.left_ns(now_ns, task.speed)
        later_ns = period_ns - 1e9 / before_hz
        left_ns = left_ns + later_ns if later_ns > 0 else min(left_ns, period_ns)
        self._chunk.move(left_ns, now_ns, task.speed)

    @property
    def deadline_ns(self) -> int:
        """When the arm should have reached its last goal, if no chunk comes."""
        return min(self._chunk.at_ns, self._motion.at_ns)

    def overdue(self, now_ns: int, *, moves: bool) -> str:
        """Why the arm holds: no chunk came; empty while one may come, or the arm is on its way.

        An arm that `moves` is on its way to the last step of a chunk, which it may reach late.
        """
        if moves and now_ns > self._motion.at_ns:
            return "no fresh chunk within max_open_loop_s, and the arm still moved"
        if not moves and now_ns > self._chunk.at_ns:
            return "no fresh chunk within the watchdog"
        return ""

    def given_up(self, now_ns: int) -> bool:
        """It is overdue by ``max_hold_s``: the arm must not resume by itself any more."""
        return now_ns > self._chunk.at_ns + int(self._timing.max_hold_s * 1e9)


class NodeMonitor(Monitor):
    """The nodes and cameras that an activation depends on.

    Args:
        camera_servers: camera -> the node that serves it by the profile. What a node said of its
            cameras is forgotten when it is gone.
    """

    def __init__(self, camera_servers: Mapping[str, str]) -> None:
        self._camera_servers = camera_servers

    def check(self, part: PartSnapshot) -> Brake | None:
        assert part.lease is not None
        peers, cameras = part.peers, part.lease.spec.observation.camera_names
        needed = [peers.robot_node, worker_node(part.worker)]
        servers = {**self._camera_servers, **peers.camera_nodes}
        needed += [servers[camera] for camera in cameras if camera in servers]
        for node in needed:
            if node not in peers.alive:
                return Brake(f"node {node!r} is gone", late=False)
        for camera in cameras:
            if camera in peers.camera_faults:
                return Brake(f"camera {camera!r} {peers.camera_faults[camera]}")
        if peers.spec_sources.get(part.worker) != part.lease.source:
            return Brake(f"worker {part.worker!r} was restarted")
        return None


class JointMonitor(Monitor):
    """Monitors the measured joints: how near the moving arm is to its bounds, and its elbow.

    Goals are bounded on a model of the arm; this monitors the arm itself. For every bound (end of a
    joint's range, singular value, distances of the arm to itself and to the table)::

        inside its zone (slow to stop) and approaching    speed sqrt(distance left / zone)
        past the stop by `PAST` and approaching           the arm has to brake

    `PAST` allows for the tracking error of an arm that works at a stop. A value approaches when it
    leaves a band that follows it: noise within the band does not count, a slow drift does. In
    addition, no joint may be far from its command or, if poses are commanded, from its place in a
    model whose TCP follows the measured one: beyond ``limits.elbow_rad`` the arm slows down, at
    twice that it brakes.

    Args:
        profile: its limits.
        reach: the model of the arm.
    """

    def __init__(self, profile: Profile, reach: ReachabilityFilter) -> None:
        self._reach = reach
        barriers, slides = reach.barriers, reach.kinematics.slides
        limits = profile.limits
        self._elbow_limits = JointBound(limits.elbow_rad, limits.tracking_m).of(slides)
        margins = joint_margins(limits.reach, reach.kinematics)
        self._stop = np.concatenate([margins, barriers.stop])
        self._slow = np.concatenate([2 * margins, barriers.slow])
        others = np.ones(len(barriers.stop))
        self._past = np.concatenate([PAST_MARGIN * margins, PAST * others])
        self._band = np.concatenate([JointBound(BAND_RAD, BAND).of(slides), BAND * others])
        self.reset()

    def reset(self) -> None:
        """Forget the last values: the arm is not being moved."""
        self._edge: FloatArray | None = None
        self._expected_rad: FloatArray | None = None
        self._next_ns = 0
        self._elbow_next = False
        self.elbow_rad = 0.0
        """Greatest distance of a joint from where it is expected."""
        self._bound_slowdown: Slowdown | None = None
        self._elbow_slowdown: Slowdown | None = None

    @property
    def slowdown(self) -> Slowdown | None:
        """The slowdown of the arm, None for full speed."""
        return slowest(self._bound_slowdown, self._elbow_slowdown)

    def begin(self) -> None:
        self.reset()

    def check(self, part: PartSnapshot) -> Brake | None:
        if part.measured_rad is None or part.commanded is None:
            return None
        hit = self.update(
            part.measured_rad, part.commanded_rad, part.now_ns, joints_asked=part.joints_asked
        )
        return None if hit is None else too_near(hit)

    def update(
        self,
        measured_rad: FloatArray,
        commanded_rad: FloatArray | None,
        now_ns: int,
        *,
        joints_asked: bool = False,
    ) -> LimitHit | None:
        """Check the bounds and the elbow in turn, one of them every half `PERIOD_NS`.

        Args:
            measured_rad: (n,) in chain order.
            commanded_rad: (n,) joint commands; None: poses are commanded.
            now_ns: time of this tick.
            joints_asked: the goals are joints; then singularities do not matter.

        Returns:
            the bound for which the arm has to brake, None without one.
        """
        if now_ns < self._next_ns:
            return None
        self._next_ns = now_ns + PERIOD_NS // 2
        self._elbow_next = not self._elbow_next
        if self._elbow_next:
            return self._bounds(measured_rad, joints_asked=joints_asked)
        return self._elbow(measured_rad, commanded_rad)

    def _bounds(self, measured_rad: FloatArray, *, joints_asked: bool) -> LimitHit | None:
        kinematics, barriers = self._reach.kinematics, self._reach.barriers
        ends = np.minimum(measured_rad - kinematics.lower_rad, kinematics.upper_rad - measured_rad)
        left = barriers.at(measured_rad, kinematics.jacobian(measured_rad))
        left = np.concatenate([ends - self._stop[: len(ends)], left])
        before = left if self._edge is None else self._edge
        self._edge = np.minimum(np.maximum(before, left), left + self._band)
        nearer = self._edge < before
        nearer[
            len(ends)
        ] &= not joints_asked  # the singular value comes first after the joints' ends
        past = np.where(nearer, left + self._past, 1.0)
        worst = int(np.argmin(past))
        if past[worst] < 0:
            stop = float(self._stop[worst])
            name, where = self._bound_name(worst)
            return LimitHit(name, float(left[worst]) + stop, stop, where=where)
        zone = np.maximum(self._slow - self._stop, 1e-12)
        shares = np.where(nearer, np.sqrt(np.clip(left / zone, 0.0, 1.0)), 1.0)
        worst = int(np.argmin(shares))
        name, where = self._bound_name(worst)
        value, limit = float(left[worst] + self._stop[worst]), float(self._slow[worst])
        self._bound_slowdown = _slowdown(name, float(shares[worst]), value, limit, where)
        return None

    def _elbow(self, measured_rad: FloatArray, commanded_rad: FloatArray | None) -> LimitHit | None:
        expected_rad = commanded_rad
        if expected_rad is None:
            start_rad = measured_rad if self._expected_rad is None else self._expected_rad
            pose = self._reach.kinematics.forward(measured_rad)
            expected_rad = self._reach.solve(pose, start_rad)
            if expected_rad is None:
                return None  # the next solution starts where the last one was
            self._expected_rad = expected_rad
        apart_rad = np.abs(measured_rad - expected_rad)
        worst = int(np.argmax(apart_rad / self._elbow_limits))
        self.elbow_rad, limit_rad = float(apart_rad[worst]), float(self._elbow_limits[worst])
        where = self._reach.kinematics.arm_joints[worst]
        if self.elbow_rad > 2 * limit_rad:
            return LimitHit("elbow_rad", self.elbow_rad, 2 * limit_rad, where=where)
        share = min(2.0 - self.elbow_rad / limit_rad, 1.0)
        self._elbow_slowdown = _slowdown("elbow_rad", share, self.elbow_rad, limit_rad, where)
        return None

    def _bound_name(self, index: int) -> tuple[str, str]:
        joints = self._reach.kinematics.arm_joints
        if index < len(joints):
            return "joint_limit", joints[index]
        index -= len(joints)
        return self._reach.barriers.names[index], self._reach.barriers.where(index)


def _slowdown(name: str, share: float, value: float, limit: float, where: str) -> Slowdown | None:
    share = in_steps(share)
    return None if share >= 1.0 else Slowdown(name, share, value, limit, where)


class Deadman:
    """A deadman's handle on the bus: the client whose presence keeps the arm active.

    Its liveliness token disappears with its process, host or network; the arm then brakes.
    """

    def __init__(self) -> None:
        self.name = ""
        """Of the client that this activation depends on; empty: none is needed."""

    def reasons_against(
        self, holder: str, present: AbstractSet[str], *, obeying: bool = False
    ) -> list[str]:
        """Why the client `holder` cannot hold the arm active, empty if it can, or is no name.

        `present`: clients whose tokens exist; `obeying`: the arm is active already.
        """
        reasons = []
        if holder and holder not in present:
            reasons.append(f"the deadman of this activation, {holder!r}, {NO_DEADMAN_TOKEN}")
        if obeying and holder and self.name and holder != self.name:
            reasons.append(f"the arm is active already, held by {self.name!r}; deactivate it first")
        return reasons

    def lost(self, present: AbstractSet[str]) -> str:
        """Why the arm must brake, empty while the client is present."""
        if not self.name or self.name in present:
            return ""
        return f"deadman {self.name!r} is gone"
