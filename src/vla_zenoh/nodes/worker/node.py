"""A model worker: newest coherent observation in, action chunk out, at the task's rate.

Inference never runs in a Zenoh callback and nothing is queued: each inference takes the newest
observation that was captured after the worker's last chunk was published. The worker infers whether
or not it is obeyed, so that it can be looked at, compared and checked before it gets the arm.

It may serve several robots, each each by a `RobotSession`. A model that has
``infer_batch`` is asked for all of them that are ready at once; the others are not waited for.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal

import zenoh

from vla_zenoh.errors import SpecError, WorkerError
from vla_zenoh.nodes.worker.robot_session import RobotSession
from vla_zenoh.policy import ActionSteps, Observation, Policy, reset_of, takes_robot
from vla_zenoh.profile import Profile, as_robot
from vla_zenoh.types import Event

LOOK_PERIOD_S = 0.25
NAP_S, NAPS = 0.004, 5
BLIND_NAP_S, IDLE_NAP_S = 0.002, 0.02

Ready = tuple[RobotSession, Observation, int]
"""A robot, what it shows, and when that was at hand (wall ns)."""


class WorkerNode:
    """See the module.

    Args:
        profile: cameras, timing, session.
        session: open session.
        policy: the model, not loaded yet.
        name: of the worker.
        images: which form of pictures to listen to. Between processes of one host raw ones travel
            through shared memory and cost least; between hosts JPEG is a tenth of the bytes.
        host: of the profile, on which this runs.
        delay_s: let every inference take so much longer: what a slower computer would do.
        robots: names of the robots to serve, all as the profile describes; none: the profile's.
        another: makes the model once more, for every further robot, where it cannot batch.

    Raises:
        NodeError: a worker of this name serves one of the robots already.
        WorkerError: the model cannot serve several robots, says why.
    """

    def __init__(
        self,
        profile: Profile,
        session: zenoh.Session,
        policy: Policy,
        name: str,
        *,
        images: Literal["raw", "jpeg"] = "raw",
        host: str | None = None,
        delay_s: float = 0.0,
        robots: Sequence[str] = (),
        another: Callable[[], Policy] | None = None,
    ) -> None:
        self._delay_s, self._changed = delay_s, threading.Condition()
        self._infer_batch: Callable[..., Any] | None = getattr(policy, "infer_batch", None)
        self._most = getattr(policy, "max_batch", None) or max(len(robots), 1)
        policies = [policy]
        if len(robots) > 1:
            policies = self._one_for_each(policy, len(robots), another)
        profiles = [as_robot(profile, robot) for robot in robots] or [profile]
        self.policy, self.name, self.spec = policy, name, policy.spec
        self._policies = policies
        self.sessions: list[RobotSession] = []
        try:
            for number, part in enumerate(profiles):
                mind = policies[number % len(policies)]
                seat = RobotSession(
                    part, session, mind, name, images=images, host=host, changed=self._changed
                )
                self.sessions.append(seat)
        except BaseException:
            for seat in self.sessions:
                seat.close()
            raise
        self.node = self.sessions[0].node

    def _one_for_each(
        self, policy: Policy, count: int, another: Callable[[], Policy] | None
    ) -> list[Policy]:
        if self._infer_batch is not None:
            if reset_of(policy) is not None and not takes_robot(policy):
                raise WorkerError(
                    f"model {policy.spec.name!r} serves several robots together, but its reset() "
                    "does not say whose episode begins: give it the robot's name, reset(robot)"
                )
            return [policy]
        if another is None:
            raise WorkerError(f"model {policy.spec.name!r} serves one robot: it has no infer_batch")
        return [policy, *(another() for _ in range(count - 1))]

    # -- running ------------------------------------------------------------------------------
    def run(self, stop: threading.Event) -> None:
        """Load the model, then infer until `stop` is set."""
        for seat in self.sessions:
            seat.report(now=True)
        began = time.monotonic()
        for policy in self._policies:
            load = getattr(policy, "load", None)
            if callable(load):
                load()
        took_s = time.monotonic() - began
        for seat in self.sessions:
            if callable(getattr(self.policy, "load", None)):
                seat.node.emit(Event("info", "notice", "loaded", f"in {took_s:.1f} s"))
            seat.complaint, seat.due_s = "", time.monotonic()
        while not stop.is_set():
            self._turn(stop)
        for seat in self.sessions:
            seat.close()
        for policy in self._policies:
            close = getattr(policy, "close", None)
            if callable(close):
                close()

    def _turn(self, stop: threading.Event) -> None:
        now_s = time.monotonic()
        due = sorted(
            (seat for seat in self.sessions if seat.due_s <= now_s), key=lambda seat: seat.due_s
        )
        for seat in self.sessions:
            if seat not in due:
                seat.listen()
        ready = self._look(due)
        if ready:
            self._infer(ready)
        for seat in self.sessions:
            seat.report()
        if not ready:
            self._rest(due, stop)

    def _look(self, due: Sequence[RobotSession]) -> list[Ready]:
        """Who is due and has something to show: all of them for a batch, else the first."""
        most = self._most if self._infer_batch is not None else 1
        ready: list[Ready] = []
        for seat in due:
            if len(ready) == most:
                seat.listen()
                continue
            observation = seat.observe()
            if observation is not None:
                ready.append((seat, observation, seat.node.clock.wall_ns()))
        return ready

    def _rest(self, due: Sequence[RobotSession], stop: threading.Event) -> None:
        """Sleep until somebody is due, or brings news, or a little while."""
        now_s = time.monotonic()
        others_s = [seat.due_s - now_s for seat in self.sessions if seat not in due]
        if not due:
            stop.wait(max(0.0, min(*others_s, LOOK_PERIOD_S)))
        elif all(seat.sees for seat in due):
            for _ in range(NAPS):
                with self._changed:
                    if self._changed.wait_for(lambda: any(seat.news for seat in due), NAP_S):
                        return
                # States that are decoded while nothing else is to do need no time afterwards.
                for seat in self.sessions:
                    seat.listen_to_states()
                if others_s and min(others_s) <= time.monotonic() - now_s:
                    return
        else:
            idle = all(seat.task is None for seat in due)
            stop.wait(IDLE_NAP_S if idle else BLIND_NAP_S)

    # -- inference ----------------------------------------------------------------------------
    def _infer(self, ready: Sequence[Ready]) -> None:
        began_s = time.monotonic()
        start_ns = {seat.robot: seat.node.clock.wall_ns() for seat, _, _ in ready}
        answers = self._answers(ready)
        if self._delay_s:
            time.sleep(self._delay_s)
        for (seat, observation, observed_ns), answer in zip(ready, answers, strict=True):
            seat.due_s = max(seat.due_s + 1.0 / observation.task.requested_hz, began_s)
            if isinstance(answer, Exception):
                seat.failed(answer)
                continue
            end_ns = seat.node.clock.wall_ns()
            seat.publish(observation, answer, observed_ns, start_ns[seat.robot], end_ns, len(ready))

    def _answers(self, ready: Sequence[Ready]) -> list[ActionSteps | Exception]:
        try:
            if self._infer_batch is None or len(ready) == 1:
                seat, observation, _ = ready[0]
                return [seat.continuation.infer(observation)]
            return self._together(ready)
        except Exception as error:
            if len(ready) == 1:
                return [error]
            # Whose observation it was is not known: the others shall not suffer for it.
            return [answer for one in ready for answer in self._answers([one])]

    def _together(self, ready: Sequence[Ready]) -> list[ActionSteps | Exception]:
        assert self._infer_batch is not None
        extra: dict[str, Any] = {}
        if getattr(self.policy, "takes_committed", False):
            extra["committed"] = [seat.continuation.committed(seen) for seat, seen, _ in ready]
        found = list(self._infer_batch([observation for _, observation, _ in ready], **extra))
        if len(found) != len(ready):
            raise SpecError(f"infer_batch gave {len(found)} answers to {len(ready)} observations")
        return [one if isinstance(one, ActionSteps) else ActionSteps(one) for one in found]
