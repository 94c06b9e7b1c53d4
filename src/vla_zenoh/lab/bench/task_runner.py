"""Runs tasks through the real chain in real time: processes, pictures, keys.

An episode ends with the judge's verdict and the next one begins at once; nothing else is done to
make it shorter.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

import zenoh

from vla_zenoh.bus.buffers import LatestSample
from vla_zenoh.bus.payload_limits import header_of
from vla_zenoh.codec import records
from vla_zenoh.control.states import DEACTIVATED
from vla_zenoh.errors import CodecError, NodeError, SessionError
from vla_zenoh.keys import worker_node
from vla_zenoh.lab.bench.task import (
    ARM_LOST,
    NO_STATE,
    NOT_OBEYED,
    SAY_IT_IS_OVER_S,
    TaskOutcome,
    TaskPlan,
    TaskRequest,
)
from vla_zenoh.lab.episode import Interrupted
from vla_zenoh.lab.tasks import TaskEpisode, TaskJudge
from vla_zenoh.runtime.launch import Host
from vla_zenoh.types import GripperState, Header, ObjectPoses, PoseState

SIM, COMMAND = "sim", "command"
READY_PATIENCE_S = 60.0
LOAD_PATIENCE_S = 600.0
"""With a worker that says it is loading; it may be making its environment."""
RESET_PATIENCE_S, RESET_PERIOD_S = 8.0, 1.0
ACTIVATE_PATIENCE_S = 15.0
HEARD_PATIENCE_S = 3.0
LOOK_S = 0.02
FRESH_PICTURES_S = 0.2
"""From a reset until cameras and worker have seen the new layout."""

Record = TypeVar("Record")


class TaskRunner:
    """See the module.

    Args:
        host: up, with a simulator whose scene has what tasks are about.
        plan: what to run.
        stop: set by Ctrl-C.
        camera: whose pictures go into the sheet of failures, None: none.
    """

    def __init__(
        self, host: Host, plan: TaskPlan, stop: threading.Event, camera: str | None
    ) -> None:
        assert host.session is not None
        assert host.client is not None
        self._host, self._plan, self._stop = host, plan, stop
        self._client, session = host.client, host.session
        keys = host.profile.keys
        streams = {
            ObjectPoses: keys.sim_objects,
            GripperState: keys.state_gripper,
            PoseState: keys.state_pose,
        }
        self._heard = {kind: TaskSlot() for kind in streams}
        self._picture = TaskSlot()
        listening = [(key, self._heard[kind]) for kind, key in streams.items()]
        if camera is not None:
            listening.append((keys.camera_jpeg(camera), self._picture))
        self._subscribers = [
            session.declare_subscriber(key, zenoh.handlers.Callback(slot, indirect=False))
            for key, slot in listening
        ]

    def run(self) -> Iterator[TaskOutcome]:
        """One outcome after the other.

        Raises:
            NodeError: the chain does not come up.
            Interrupted: Ctrl-C.
        """
        self._wait_until_ready()
        client, plan = self._client, self._plan
        if plan.rate_hz is not None:
            client.set_rate(plan.rate_hz)
        for asked in plan.asked():
            yield self._episode(asked)
            client.deactivate()

    def latency_ms(self) -> dict[str, tuple[float, float]]:
        """What worker and command node say of their stages now."""
        out: dict[str, tuple[float, float]] = {}
        for node in (worker_node(self._plan.worker), COMMAND):
            status = self._client.status(node)
            if status is not None:
                out |= {f"{node}.{stage}": pair for stage, pair in status.latency_ms.items()}
        return out

    # -- one episode --------------------------------------------------------------------------
    def _episode(self, asked: TaskRequest) -> TaskOutcome:
        objects = self._lay_out(asked.seed)
        episode = asked.draw(objects, held_out=self._plan.held_out)
        prompt = self._plan.prompt_for(episode)
        refused = self._give_the_arm(prompt)
        if refused:
            self._end_if_somebody_did()
            return TaskOutcome(episode, prompt, False, NOT_OBEYED, 0.0, refused, self._pictures())
        return self._watch_it(episode, prompt)

    def _lay_out(self, seed: int) -> ObjectPoses:
        """Arm home, objects placed anew; what is true then."""
        client = self._client
        resets, give_up_s = self._resets(), time.monotonic() + RESET_PATIENCE_S
        while self._resets() == resets:
            # Refused while the last of the command stream is still followed.
            client.put(client.keys.sim_reset, str(seed))
            client.wait_for(lambda: self._resets() > resets, RESET_PERIOD_S)
            if time.monotonic() > give_up_s:
                raise NodeError(f"sim/reset is not obeyed in {RESET_PATIENCE_S:g} s")
            self._pause(0.0)
        # What is heard of the simulator from here on was written after the reset.
        since_s = time.monotonic()
        self._pause(FRESH_PICTURES_S)
        for kind in self._heard:
            self._until(
                lambda kind=kind: self._heard[kind].mono_s > since_s,
                HEARD_PATIENCE_S,
                f"no {kind.__name__} is heard",
            )
        return self._newest(ObjectPoses)[1]

    def _resets(self) -> int:
        status = self._client.status(SIM)
        return int(status.counters.get("sim.resets", 0)) if status else 0

    def _give_the_arm(self, prompt: str) -> str:
        """Put the prompt and activate; why not, where it is refused to the end."""
        give_up = time.monotonic() + ACTIVATE_PATIENCE_S
        while True:
            try:
                self._client.set_prompt(prompt)
                self._client.activate()
                return ""
            except SessionError as error:
                if time.monotonic() > give_up or self._client.latched():
                    return str(error)
                self._pause(0.2)

    def _end_if_somebody_did(self) -> None:
        """No episode is lost, and no arm moved, against the will of a person.

        Raises:
            NodeError: it was stopped, or somebody deactivated it.
        """
        why = self._client.latched() or self._why_lost()
        if self._client.latched() or why == DEACTIVATED:
            raise NodeError(f"ended by somebody else: {why}")

    def _watch_it(self, episode: TaskEpisode, prompt: str) -> TaskOutcome:
        first, objects = self._newest(ObjectPoses)
        judge = TaskJudge(episode.order, objects, self._newest(PoseState)[1].position_m)
        beginning = self._picture.payload()
        began_s = time.monotonic()
        seen_ns, over_since_s = first.stamp_wall_ns, 0.0
        while True:
            self._pause(LOOK_S)
            time_s = time.monotonic() - began_s
            header, objects = self._newest(ObjectPoses)
            width_m = self._newest(GripperState)[1].width_m
            tcp_m = self._newest(PoseState)[1].position_m
            verdict = None
            if header.stamp_wall_ns > seen_ns:
                seen_ns = header.stamp_wall_ns
                verdict = judge.see(objects, width_m, time_s, tcp_m)
            ended = (episode, prompt, (beginning, self._picture.payload()))
            lost = self._why_lost()
            over_since_s = (over_since_s or time_s) if self._says_it_is_over() else 0.0
            if verdict is None and lost:
                self._end_if_somebody_did()
                return TaskOutcome(episode, prompt, False, ARM_LOST, time_s, lost, ended[2])
            silent_s = time.monotonic() - self._heard[ObjectPoses].mono_s
            if verdict is None and silent_s > HEARD_PATIENCE_S:
                why = f"sim/objects is silent for {silent_s:.1f} s"
                return TaskOutcome(episode, prompt, False, NO_STATE, time_s, why, ended[2])
            over = over_since_s and time_s - over_since_s > SAY_IT_IS_OVER_S
            if verdict is None and (over or time_s > self._plan.limit_s):
                verdict = judge.end()
            if verdict is not None:
                return TaskOutcome.by(verdict, *ended)

    def _pictures(self) -> tuple[bytes, bytes]:
        return self._picture.payload(), self._picture.payload()

    def _why_lost(self) -> str:
        task = self._client.task
        if task is not None and task.active:
            return ""
        status = self._client.status(COMMAND)
        why = status.detail.get("why", "") if status else "no command node is heard"
        return str(why) or "inactive"

    def _says_it_is_over(self) -> bool:
        status = self._client.status(COMMAND)
        if status is None:
            return False
        return bool(status.detail.get("policy_done")) and bool(status.detail.get("at_rest"))

    # -- waiting ------------------------------------------------------------------------------
    def _wait_until_ready(self) -> None:
        worker = worker_node(self._plan.worker)
        began_s = time.monotonic()
        while True:
            said = self._client.status(worker)
            loading = said is None or said.detail.get("complaint") == "loading"
            ready = all(slot.mono_s for slot in self._heard.values())
            if ready and not loading and self._client.status(COMMAND) is not None:
                return
            waited_s = time.monotonic() - began_s
            if waited_s > (LOAD_PATIENCE_S if loading and ready else READY_PATIENCE_S):
                nodes = {name: found[0].state for name, found in self._client.snapshot().items()}
                raise NodeError(f"the chain did not come up in {waited_s:.0f} s: {nodes}")
            self._pause(0.1)

    def _until(self, condition: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        give_up = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > give_up:
                raise NodeError(otherwise)
            self._pause(LOOK_S)

    def _pause(self, seconds: float) -> None:
        self._host.watch()
        if self._stop.wait(seconds):
            raise Interrupted

    def _newest(self, kind: type[Record]) -> tuple[Header, Record]:
        return self._heard[kind].read(kind)


class TaskSlot(LatestSample):
    """The newest sample of a stream, to be read as often as one likes."""

    @property
    def mono_s(self) -> float:
        """When it arrived, 0 before the first."""
        return self._arrival.mono_ns / 1e9 if self._arrival else 0.0

    def payload(self) -> bytes:
        """Its bytes, none before the first."""
        return self._arrival.sample.payload.to_bytes() if self._arrival else b""

    def read(self, kind: type[Record]) -> tuple[Header, Record]:
        """What it says.

        Raises:
            NodeError: nothing was heard, or it is no such record.
        """
        if self._arrival is None:
            raise NodeError(f"no {kind.__name__} was heard")
        try:
            return header_of(self._arrival.sample), records.decode(kind, self.payload())
        except CodecError as error:
            raise NodeError(f"{kind.__name__}: {error}") from error
