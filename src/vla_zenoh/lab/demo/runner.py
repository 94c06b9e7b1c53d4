"""Runs motion segments on a robot: prompt, wait for rest, compare the poses before and after."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from vla_zenoh.bus.client import Client
from vla_zenoh.errors import NodeError
from vla_zenoh.keys import worker_node
from vla_zenoh.kinematics.so3 import Pose, exp3, log3, rotation_from_quat
from vla_zenoh.lab.demo.segments import DemoSegment, RestPose, SegmentOutcome, judge_segment
from vla_zenoh.lab.episode import COMMAND, EpisodeRunner, Interrupted
from vla_zenoh.lab.recording.stream_listener import StreamListener
from vla_zenoh.types import NodeStatus

READY_PATIENCE_S = 40.0
READY_FOR_S = 0.7
"""A status comes twice a second."""
SETTLE_S = 0.8
"""From the end of the commanded motion until arm and integral action are at rest."""
REST_WINDOW_NS = 150_000_000
SLACK_S = 15.0
NOT_AT_REST = "the arm does not come to rest"


@dataclass(slots=True)
class DemoResult:
    """Result of a demo.

    Args:
        outcomes: one per segment that ended.
        statuses: last status of every node.
        interrupted: by Ctrl-C.
    """

    outcomes: list[SegmentOutcome] = field(default_factory=list)
    statuses: dict[str, NodeStatus] = field(default_factory=dict)
    interrupted: bool = False


class DemoRunner(EpisodeRunner):
    """Runs segments one after the other.

    Args:
        client: follows the nodes.
        listener: receives the streams.
        stop: set by Ctrl-C.
        watch: see `EpisodeRunner`.
        progress: called with (segment index, accepted steps).
    """

    def __init__(
        self,
        client: Client,
        listener: StreamListener,
        stop: threading.Event,
        watch: Callable[[], None],
        progress: Callable[[int, int], None],
    ) -> None:
        super().__init__(client, stop, watch)
        self._listener, self._progress = listener, progress
        self._ready_since_s = 0.0

    def run(
        self, segments: Sequence[DemoSegment], rate_hz: float, seconds: float | None
    ) -> DemoResult:
        """Activate, run every segment, brake.

        Raises:
            NodeError: the chain does not come up, or the arm does not stay active to the end.
        """
        result = DemoResult()
        try:
            self.wait_until_ready()
            self.start("hold", rate_hz)
            for index, segment in enumerate(segments):
                result.outcomes.append(self.run_segment(index, segment, rate_hz, seconds))
        except Interrupted:
            result.interrupted = True
        result.statuses = {name: found[0] for name, found in self.client.snapshot().items()}
        self.client.deactivate()
        return result

    def wait_until_ready(self) -> None:
        """Wait until every node works.

        Raises:
            NodeError: one does not in time; with the state of each.
        """
        self._ready_since_s = 0.0
        self.wait(self._ready, READY_PATIENCE_S, "the nodes did not come up")

    def _ready(self) -> bool:
        """All nodes have worked for long enough that the command node knows."""
        worker = self.client.status(worker_node(self.client.profile.task.worker))
        streams = self._listener.streams
        ready = bool(
            worker is not None
            and worker.state == "inferring"
            and self.client.status(COMMAND) is not None
            and streams.poses
            and streams.grippers
        )
        now_s = time.monotonic()
        self._ready_since_s = self._ready_since_s or now_s if ready else 0.0
        return ready and now_s - self._ready_since_s > READY_FOR_S

    def run_segment(
        self, index: int, segment: DemoSegment, rate_hz: float, seconds: float | None = None
    ) -> SegmentOutcome:
        """Publish a prompt, wait for its end and for rest, and judge.

        Args:
            index: of the segment, for `progress`.
            segment: prompt and steps.
            rate_hz: at which chunks are requested.
            seconds: run the prompt for this long instead of counting steps.

        Raises:
            NodeError: it does not end.
            Interrupted: Ctrl-C.
        """
        before = self._rest_pose()
        self._listener.streams.mark(segment.prompt)
        began_s = time.monotonic()
        if seconds is None:
            prompt = segment.prompt_with_count
            episode = self.client.set_prompt(prompt).episode
            patience_s = segment.steps / rate_hz * 2 + SLACK_S
            self.wait(
                lambda: self._finished(episode, segment.steps, index),
                patience_s,
                f"{prompt!r} did not end in {patience_s:.0f} s",
            )
            steps_done = self._steps_of(episode)
        else:
            episode = self.client.set_prompt(segment.prompt_without_end).episode
            self.pause(seconds)
            self._steps_of(episode)
            self.client.set_prompt("hold")
            self.wait(self._at_rest, SLACK_S, NOT_AT_REST)
            steps_done = self._listener.steps_carried_out(episode)
            segment = replace(segment, steps=steps_done)
        self.pause(SETTLE_S)
        duration_s = time.monotonic() - began_s - SETTLE_S
        return judge_segment(
            segment,
            before,
            self._rest_pose(),
            max_width_m=self.client.profile.robot.gripper.max_width_m,
            steps_done=steps_done,
            duration_s=duration_s,
        )

    def _detail(self) -> dict[str, Any]:
        status = self.client.status(COMMAND)
        if status is None:
            return {}
        if status.state not in ("active", "holding"):
            raise NodeError(f"the arm is {status.state}: {status.detail.get('why', '')}")
        return dict(status.detail)

    def _steps_of(self, episode: int) -> int:
        detail = self._detail()
        return int(detail.get("accepted_steps", 0)) if detail.get("episode") == episode else 0

    def _finished(self, episode: int, steps: int, index: int) -> bool:
        detail = self._detail()
        if detail.get("episode") != episode:
            return False
        self._progress(index, min(self._steps_of(episode), steps))
        return bool(detail.get("policy_done")) and self._at_rest()

    def _at_rest(self) -> bool:
        """The commanded motion has ended."""
        streams = self._listener.streams
        if not streams.grippers or streams.grippers[-1].record.moving:
            return False
        if streams.joint_commands:
            joints = streams.joint_commands[-1].record
            return self._at_rest_measured() and float(np.abs(joints.velocity_rad_s).max()) < 1e-5
        if not streams.commands:
            return False
        command = streams.commands[-1].record
        ahead_m = float(np.linalg.norm(command.goal_position_m - command.position_m))
        return float(np.abs(command.twist).max()) < 1e-5 and ahead_m < 1e-5

    def _at_rest_measured(self) -> bool:
        pose = self._listener.streams.newest_pose()
        return pose is not None and float(np.abs(pose.twist).max()) < 1e-3

    def _rest_pose(self) -> RestPose:
        """Mean measured pose over `REST_WINDOW_NS` from now."""
        self.wait(self._at_rest_measured, SLACK_S, NOT_AT_REST)
        streams = self._listener.streams
        # Decoding may lag behind on a busy computer: samples received before now do not count.
        until_ns = time.time_ns() + REST_WINDOW_NS
        self.wait(
            lambda: min(streams.poses[-1].received_ns, streams.grippers[-1].received_ns) > until_ns,
            SLACK_S,
            "the robot's states are silent",
        )
        since_ns = streams.poses[-1].received_ns - REST_WINDOW_NS
        poses = [entry.record for entry in streams.poses[-200:] if entry.received_ns >= since_ns]
        position = np.mean([pose.position_m for pose in poses], axis=0)
        first = rotation_from_quat(poses[0].quat_xyzw)
        turns = [log3(rotation_from_quat(pose.quat_xyzw) @ first.T) for pose in poses]
        rotation = exp3(np.mean(turns, axis=0)) @ first
        return RestPose(Pose(position, rotation), streams.grippers[-1].record.width_m)
