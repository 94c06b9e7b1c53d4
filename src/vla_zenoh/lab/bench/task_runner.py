"""Runs the task benchmark through the real chain in real time."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any, TypeVar

import zenoh

from vla_zenoh.bus.buffers import LatestSample, header_of
from vla_zenoh.codec import records
from vla_zenoh.control.states import DEACTIVATED
from vla_zenoh.errors import CodecError, NodeError, SessionError
from vla_zenoh.keys import worker_node
from vla_zenoh.lab.bench.task import ARM_LOST, NO_STATE, TaskOutcome, TaskPlan
from vla_zenoh.lab.bench.task_episode import SceneSnapshot, run_task
from vla_zenoh.lab.episode import COMMAND, EpisodeRunner
from vla_zenoh.runtime.launch import Host
from vla_zenoh.types import GripperState, Header, ObjectPoses, PoseState

READY_PATIENCE_S = 60.0
LOAD_PATIENCE_S = 600.0
"""While the worker reports that it loads; it may be building its environment."""
SETTLE_PATIENCE_S = 5.0
"""For cameras and worker to have data; then activation names what is missing."""
UNSETTLED = {"waiting", "degraded"}
STATE_PATIENCE_S = 3.0
STEP_S = 0.02
FRESH_PICTURES_S = 0.2
"""From a reset until cameras and worker have seen the new layout."""

Record = TypeVar("Record")


class TaskRunner:
    """Runs the episodes of a plan; a `TaskStage` of running nodes.

    Args:
        host: up, with a simulator whose scene has the bricks.
        plan: what to run.
        stop: set by Ctrl-C.
        camera: for the pictures of an outcome, None: none.
    """

    def __init__(
        self, host: Host, plan: TaskPlan, stop: threading.Event, camera: str | None
    ) -> None:
        assert host.session is not None and host.client is not None
        self._plan, self._client, session = plan, host.client, host.session
        self._runner = EpisodeRunner(host.client, stop, host.poll)
        keys = host.profile.keys
        self._slots: dict[type[Any], TaskSlot] = {
            kind: TaskSlot() for kind in (ObjectPoses, GripperState, PoseState)
        }
        self._picture = TaskSlot()
        slots = {
            keys.sim_objects: self._slots[ObjectPoses],
            keys.state_gripper: self._slots[GripperState],
            keys.state_pose: self._slots[PoseState],
        }
        if camera is not None:
            slots[keys.camera_jpeg(camera)] = self._picture
        self._subscribers = [
            session.declare_subscriber(key, zenoh.handlers.Callback(slot, indirect=False))
            for key, slot in slots.items()
        ]

    def run(self) -> Iterator[TaskOutcome]:
        """One outcome after the other.

        Raises:
            NodeError: the chain does not come up, or another client ended an episode.
            Interrupted: Ctrl-C.
        """
        self._wait_until_ready()
        if self._plan.rate_hz is not None:
            self._client.set_rate(self._plan.rate_hz)
        for request in self._plan.requests():
            yield run_task(self, self._plan, request)
            self._client.deactivate()

    def latency_ms(self) -> dict[str, tuple[float, float]]:
        """Latencies that worker and command node report now: ``node.stage`` -> (p50, p95)."""
        out: dict[str, tuple[float, float]] = {}
        for node in (worker_node(self._plan.worker), COMMAND):
            status = self._client.status(node)
            if status is not None:
                out |= {f"{node}.{stage}": pair for stage, pair in status.latency_ms.items()}
        return out

    # -- stage of an episode ------------------------------------------------------------------
    def reset(self, seed: int) -> ObjectPoses:
        """Reset the simulator; the objects' true poses, published after it."""
        self._runner.reset_simulator(seed)
        since_s = time.monotonic()
        self._runner.pause(FRESH_PICTURES_S)
        for kind, slot in self._slots.items():
            self._runner.wait(
                lambda slot=slot: slot.mono_s > since_s,
                STATE_PATIENCE_S,
                f"no {kind.__name__} received",
            )
        return self._newest(ObjectPoses)[1]

    def start(self, prompt: str) -> str:
        """Activate; the last rejection, where it is rejected to the end."""
        try:
            self._runner.start(prompt)
        except SessionError as error:
            self._check_not_ended_by_others()
            return str(error)
        return ""

    def step(self) -> None:
        """Wait for the next state."""
        self._runner.pause(STEP_S)

    def time_s(self) -> float:
        """Monotonic clock."""
        return time.monotonic()

    def scene(self) -> SceneSnapshot:
        """The newest states."""
        header, objects = self._newest(ObjectPoses)
        width_m = self._newest(GripperState)[1].width_m
        return SceneSnapshot(
            header.stamp_wall_ns, objects, width_m, self._newest(PoseState)[1].position_m
        )

    def failure(self) -> tuple[str, str] | None:
        """The arm is inactive, or the simulator's objects are silent."""
        why = self._why_inactive()
        if why:
            self._check_not_ended_by_others()
            return ARM_LOST, why
        silent_s = time.monotonic() - self._slots[ObjectPoses].mono_s
        if silent_s > STATE_PATIENCE_S:
            return NO_STATE, f"sim/objects is silent for {silent_s:.1f} s"
        return None

    def done(self) -> bool:
        """As the command node reports."""
        return self._runner.view().done

    def picture(self) -> bytes | None:
        """The newest picture, empty before the first."""
        return self._picture.payload()

    # -- the chain ----------------------------------------------------------------------------
    def _check_not_ended_by_others(self) -> None:
        """Do not activate again after a person's emergency stop or deactivation.

        Raises:
            NodeError: there was one.
        """
        latched, why = self._client.latch_reason(), self._why_inactive()
        if latched or why == DEACTIVATED:
            raise NodeError(f"another client ended the episode: {latched or why}")

    def _why_inactive(self) -> str:
        task, status = self._client.task, self._client.status(COMMAND)
        if task is not None and task.active:
            return ""
        why = status.detail.get("why", "") if status else "no status of the command node received"
        return str(why) or "inactive"

    def _wait_until_ready(self) -> None:
        worker = worker_node(self._plan.worker)
        began_s = time.monotonic()
        while True:
            status = self._client.status(worker)
            loading = status is None or status.detail.get("complaint") == "loading"
            ready = all(slot.mono_s for slot in self._slots.values())
            waited_s = time.monotonic() - began_s
            settled = waited_s > SETTLE_PATIENCE_S or self._settled()
            if ready and not loading and settled and self._client.status(COMMAND) is not None:
                return
            if waited_s > (LOAD_PATIENCE_S if loading and ready else READY_PATIENCE_S):
                nodes = {name: found[0].state for name, found in self._client.snapshot().items()}
                raise NodeError(f"the chain did not come up in {waited_s:.0f} s: {nodes}")
            self._runner.pause(0.1)

    def _settled(self) -> bool:
        states = {found[0].state for found in self._client.snapshot().values()}
        return states.isdisjoint(UNSETTLED)

    def _newest(self, kind: type[Record]) -> tuple[Header, Record]:
        return self._slots[kind].read(kind)


class TaskSlot(LatestSample):
    """The newest sample of a stream; reading does not consume it."""

    @property
    def mono_s(self) -> float:
        """When it was received, 0 before the first."""
        return self._arrival.mono_ns / 1e9 if self._arrival else 0.0

    def payload(self) -> bytes:
        """Its bytes, empty before the first."""
        return self._arrival.sample.payload.to_bytes() if self._arrival else b""

    def read(self, kind: type[Record]) -> tuple[Header, Record]:
        """Its header and record.

        Raises:
            NodeError: nothing was received, or no such record.
        """
        if self._arrival is None:
            raise NodeError(f"no {kind.__name__} received")
        try:
            return header_of(self._arrival.sample), records.decode(kind, self.payload())
        except CodecError as error:
            raise NodeError(f"{kind.__name__}: {error}") from error
