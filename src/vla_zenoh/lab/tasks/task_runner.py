"""Runs the task benchmark through the real chain in real time."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

from vla_zenoh.control.states import DEACTIVATED
from vla_zenoh.errors import NodeError, SessionError
from vla_zenoh.keys import worker_node
from vla_zenoh.lab.episode import COMMAND, EpisodeRunner
from vla_zenoh.lab.newest_records import NewestRecords, StreamSlot
from vla_zenoh.lab.tasks.task import (
    ARM_LOST,
    NO_STATE,
    SceneSnapshot,
    TaskOutcome,
    TaskPlan,
    run_task,
)
from vla_zenoh.runtime.launch import Host
from vla_zenoh.types import GripperState, ObjectPoses, PoseState

STATE_PATIENCE_S = 3.0
STEP_S = 0.02
FRESH_PICTURES_S = 0.2
"""From a reset until cameras and worker have seen the new layout."""


class TaskRunner:
    """Runs the episodes of a plan; a `TaskStage` of running nodes.

    Args:
        host: up, with a simulator whose scene has the bricks.
        camera: for the pictures of an outcome, None: none.
    """

    def __init__(
        self, host: Host, plan: TaskPlan, stop: threading.Event, camera: str | None
    ) -> None:
        assert host.session is not None and host.client is not None
        self._plan, self._client, session = plan, host.client, host.session
        self._runner = EpisodeRunner(host.client, stop, host.poll)
        keys = host.profile.of_part(host.profile.part_names[0]).keys
        self._states = NewestRecords(
            session,
            {
                ObjectPoses: keys.sim_objects,
                GripperState: keys.state_gripper,
                PoseState: keys.state_pose,
            },
        )
        self._picture = StreamSlot()
        if camera is not None:
            self._camera = self._picture.subscribe(session, keys.camera_jpeg(camera))

    def run(self) -> Iterator[TaskOutcome]:
        """One outcome after the other.

        Raises:
            NodeError: the chain does not come up, or another client ended an episode.
        """
        self._runner.wait_until_ready(self._plan.worker, self._states)
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
        self._runner.wait(
            lambda: not self._states.missing(since_s),
            STATE_PATIENCE_S,
            "no state received after the reset",
        )
        return self._states.read(ObjectPoses)[1]

    def start(self, prompt: str) -> str:
        try:
            self._runner.start(prompt)
        except SessionError as error:
            self._check_not_ended_by_others()
            return str(error)
        return ""

    def step(self) -> None:
        self._runner.pause(STEP_S)

    def time_s(self) -> float:
        return time.monotonic()

    def scene(self) -> SceneSnapshot:
        header, objects = self._states.read(ObjectPoses)
        width_m = self._states.read(GripperState)[1].opening_m
        tcp_m = self._states.read(PoseState)[1].position_m
        return SceneSnapshot(header.stamp_wall_ns, objects, width_m, tcp_m)

    def failure(self) -> tuple[str, str] | None:
        """The arm is inactive, or the simulator's objects are silent."""
        why = self._client.why_inactive()
        if why:
            self._check_not_ended_by_others()
            return ARM_LOST, why
        silent_s = time.monotonic() - self._states.received_s(ObjectPoses)
        if silent_s > STATE_PATIENCE_S:
            return NO_STATE, f"sim/objects is silent for {silent_s:.1f} s"
        return None

    def done(self) -> bool:
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
        latched, why = self._client.latch_reason(), self._client.why_inactive()
        if latched or why == DEACTIVATED:
            raise NodeError(f"another client ended the episode: {latched or why}")
