"""Carries the segments of a demo out through plain puts, and measures the arm before and after."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from vla_zenoh.bus.client import Client
from vla_zenoh.errors import NodeError, SessionError
from vla_zenoh.keys import worker_node
from vla_zenoh.kinematics.so3 import Pose, exp3, log3, rotation_from_quat
from vla_zenoh.lab.demo.segments import DemoSegment, RestPose, SegmentOutcome, judge
from vla_zenoh.lab.episode import Interrupted
from vla_zenoh.lab.recording.stream_listener import StreamListener
from vla_zenoh.types import NodeStatus

READY_PATIENCE_S = 40.0
ACTIVATE_PATIENCE_S = 15.0
WELL_FOR_S = 0.7
"""Status comes twice a second."""
SETTLE_S = 0.8
"""The commanded motion has ended; the arm itself and its integral action come to rest after it."""
STAND_WINDOW_NS = 150_000_000
SLACK_S = 15.0


@dataclass(slots=True)
class DemoResult:
    """What a demo found out.

    Args:
        outcomes: one per segment that ended.
        statuses: last status of every node.
        interrupted: it was cut short by a person.
    """

    outcomes: list[SegmentOutcome] = field(default_factory=list)
    statuses: dict[str, NodeStatus] = field(default_factory=dict)
    interrupted: bool = False


class DemoRunner:
    """See the module.

    Args:
        client: hears the nodes.
        listener: hears the streams.
        stop: set by Ctrl-C.
        watch: called often; raises when the nodes cannot be kept alive.
        progress: called with (segment index, steps carried out).
    """

    def __init__(
        self,
        client: Client,
        listener: StreamListener,
        stop: threading.Event,
        watch: Callable[[], None],
        progress: Callable[[int, int], None],
    ) -> None:
        self._client, self._listener, self._stop = client, listener, stop
        self._watch, self._progress = watch, progress
        self._well_since_s = 0.0

    def run(
        self, segments: Sequence[DemoSegment], rate_hz: float, seconds: float | None
    ) -> DemoResult:
        """Activate, carry out, brake.

        Raises:
            NodeError: the chain does not come up, or the arm is not obeyed to the end.
        """
        result = DemoResult()
        try:
            self.wait_until_ready()
            self.activate(rate_hz)
            for index, segment in enumerate(segments):
                result.outcomes.append(self.run_segment(index, segment, rate_hz, seconds))
        except Interrupted:
            result.interrupted = True
        result.statuses = {name: found[0] for name, found in self._client.snapshot().items()}
        self._client.deactivate()
        return result

    def wait_until_ready(self) -> None:
        """Until every node is well.

        Raises:
            NodeError: one is not in time; says what each says.
        """
        self._well_since_s = 0.0
        self._wait(self._ready, READY_PATIENCE_S, "the nodes did not come up")

    def _ready(self) -> bool:
        """Everybody has been well for long enough that the command node has heard it too."""
        worker = self._client.status(worker_node(self._client.profile.task.worker))
        heard = self._listener.streams
        well = bool(
            worker is not None
            and worker.state == "inferring"
            and self._client.status("command") is not None
            and heard.poses
            and heard.grippers
        )
        now = time.monotonic()
        self._well_since_s = self._well_since_s or now if well else 0.0
        return well and now - self._well_since_s > WELL_FOR_S

    def activate(self, rate_hz: float) -> None:
        """Activate, standing; what is missing for a moment (a first picture) is waited for."""
        self._client.set_prompt("hold")
        self._client.set_rate(rate_hz)
        give_up = time.monotonic() + ACTIVATE_PATIENCE_S
        while True:
            try:
                self._client.activate()
                return
            except SessionError:
                if time.monotonic() > give_up or self._client.latched():
                    raise
                self._pause(0.3)

    def run_segment(
        self, index: int, segment: DemoSegment, rate_hz: float, seconds: float | None = None
    ) -> SegmentOutcome:
        """Put a prompt, wait until it has been carried out and the arm stands, and judge.

        Args:
            index: of the segment, for `progress`.
            segment: what to ask.
            rate_hz: at which it is asked.
            seconds: let the prompt run this long instead of counting steps.

        Raises:
            NodeError: it does not end.
            Interrupted: Ctrl-C.
        """
        before = self._standing()
        self._listener.streams.mark(segment.prompt)
        began = time.monotonic()
        if seconds is None:
            task = self._client.set_prompt(segment.prompt_with_count)
            patience_s = segment.steps / rate_hz * 2 + SLACK_S
            self._wait(
                lambda: self._finished(task.episode, segment.steps, index),
                patience_s,
                f"{segment.prompt_with_count!r} did not end in {patience_s:.0f} s",
            )
        else:
            task = self._client.set_prompt(segment.prompt_without_end)
            self._pause(seconds)
        steps_done = self._steps_of(task.episode)
        if seconds is not None:
            self._client.set_prompt("hold")
            self._wait(self._at_rest, SLACK_S, "the arm does not come to rest")
            steps_done = self._listener.steps_carried_out(task.episode)
            segment = replace(segment, steps=steps_done)
        self._pause(SETTLE_S)
        duration_s = time.monotonic() - began - SETTLE_S
        return judge(
            segment,
            before,
            self._standing(),
            max_width_m=self._client.profile.robot.gripper.max_width_m,
            steps_done=steps_done,
            duration_s=duration_s,
        )

    # -- watching -----------------------------------------------------------------------------
    def _command(self) -> dict[str, Any]:
        status = self._client.status("command")
        if status is None:
            return {}
        if status.state not in ("active", "holding"):
            raise NodeError(f"the arm is {status.state}: {status.detail.get('why', '')}")
        return dict(status.detail)

    def _steps_of(self, episode: int) -> int:
        detail = self._command()
        return int(detail.get("accepted_steps", 0)) if detail.get("episode") == episode else 0

    def _finished(self, episode: int, steps: int, index: int) -> bool:
        detail = self._command()
        if detail.get("episode") != episode:
            return False
        self._progress(index, min(self._steps_of(episode), steps))
        return bool(detail.get("policy_done")) and self._at_rest()

    def _at_rest(self) -> bool:
        heard = self._listener.streams
        if not heard.grippers or heard.grippers[-1].record.moving:
            return False
        if heard.joint_commands:
            joints = heard.joint_commands[-1].record
            return self._at_rest_measured() and float(np.abs(joints.velocity_rad_s).max()) < 1e-5
        if not heard.commands:
            return False
        command = heard.commands[-1].record
        ahead_m = float(np.linalg.norm(command.goal_position_m - command.position_m))
        return float(np.abs(command.twist).max()) < 1e-5 and ahead_m < 1e-5

    def _standing(self) -> RestPose:
        """Mean measured pose of the next moments."""
        self._wait(self._at_rest_measured, SLACK_S, "the arm does not come to rest")
        heard = self._listener.streams
        # Decoding may lag behind on a busy computer: what was heard before now does not count.
        until_ns = time.time_ns() + STAND_WINDOW_NS
        self._wait(
            lambda: (
                heard.poses[-1].received_ns > until_ns and heard.grippers[-1].received_ns > until_ns
            ),
            SLACK_S,
            "no state is heard any more",
        )
        since_ns = heard.poses[-1].received_ns - STAND_WINDOW_NS
        poses = [entry.record for entry in heard.poses[-200:] if entry.received_ns >= since_ns]
        position = np.mean([pose.position_m for pose in poses], axis=0)
        first = rotation_from_quat(poses[0].quat_xyzw)
        turns = [log3(rotation_from_quat(pose.quat_xyzw) @ first.T) for pose in poses]
        rotation = exp3(np.mean(turns, axis=0)) @ first
        return RestPose(Pose(position, rotation), heard.grippers[-1].record.width_m)

    def _at_rest_measured(self) -> bool:
        pose = self._listener.streams.newest_pose()
        return pose is not None and float(np.abs(pose.twist).max()) < 1e-3

    def _wait(self, condition: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        give_up = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > give_up:
                raise NodeError(f"{otherwise}; {self._story()}")
            self._pause(0.03)

    def _pause(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while True:
            self._watch()
            left = end - time.monotonic()
            if left <= 0:
                return
            if self._stop.wait(min(left, 0.1)):
                raise Interrupted

    def _story(self) -> str:
        said: list[str] = []
        for name, (found, _, _) in self._client.snapshot().items():
            word = found.detail.get("complaint") or found.detail.get("why") or ""
            said.append(f"{name} is {found.state}" + (f" ({word})" if word else ""))
        return "; ".join(said) or "no node says anything"
