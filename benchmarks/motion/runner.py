"""Runs fixed motions on a robot: prompt, wait for rest, compare the poses before and after."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np

from benchmarks.motion.segments import DemoSegment, RestPose, SegmentOutcome, judge_segment
from vla_zenoh.client.client import Client
from vla_zenoh.errors import NodeError
from vla_zenoh.kinematics.so3 import Pose, exp3, log3, rotation_from_quat
from vla_zenoh.lab.episode import EpisodeRunner
from vla_zenoh.lab.newest_records import NewestRecords
from vla_zenoh.types import GripperState, PoseState

SETTLE_S = 0.8
"""From the end of the commanded motion until arm and integral action are at rest."""
REST_WINDOW_S, REST_SAMPLE_S = 0.15, 0.01
STILL = 1e-3
"""Speed of a measured TCP at rest, m/s and rad/s."""
SLACK_S = 15.0


class MotionRunner(EpisodeRunner):
    """Runs motion segments one after the other. `watch`: see `EpisodeRunner`."""

    def __init__(
        self, client: Client, stop: threading.Event, watch: Callable[[], None] = lambda: None
    ) -> None:
        super().__init__(client, stop, watch)
        keys = client.keys
        self._streams = NewestRecords(
            client.session, {PoseState: keys.state_pose, GripperState: keys.state_gripper}
        )

    def begin(self, rate_hz: float) -> None:
        """Wait for the nodes and activate the arm; it stays where it is.

        Raises:
            NodeError: the nodes do not come up.
            SessionError: activation is rejected to the end, with every reason.
        """
        self.wait_until_ready(self.client.profile.task.worker, self._streams)
        self.start("hold", rate_hz)

    def run_segment(
        self,
        segment: DemoSegment,
        rate_hz: float,
        progress: Callable[[int], None] = lambda done: None,
    ) -> SegmentOutcome:
        """Publish a prompt, wait for its end and for rest, and judge.

        Args:
            progress: called with the accepted steps.

        Raises:
            NodeError: it does not end, or the arm does not stay active.
        """
        before, began_s = self._rest_pose(), time.monotonic()
        prompt, patience_s = segment.prompt_with_count, segment.steps / rate_hz * 2 + SLACK_S
        self.prompt(prompt)
        steps_done = 0

        def ended() -> bool:
            nonlocal steps_done
            view = self.view()
            if not view.active:
                raise NodeError(f"the arm is {view.state}: {view.why}")
            steps_done = view.steps
            progress(min(steps_done, segment.steps))
            return view.done and not self._streams.read(GripperState)[1].moving

        self.wait(ended, patience_s, f"{prompt!r} did not end in {patience_s:.0f} s")
        duration_s = time.monotonic() - began_s
        self.pause(SETTLE_S)
        return judge_segment(
            segment,
            before,
            self._rest_pose(),
            max_width_m=self.client.profile.robot.gripper.max_width_m,
            steps_done=steps_done,
            duration_s=duration_s,
        )

    def _at_rest(self) -> bool:
        _, pose = self._streams.read(PoseState)
        return float(np.abs(pose.twist).max()) < STILL

    def _rest_pose(self) -> RestPose:
        """Mean measured pose over `REST_WINDOW_S` from now."""
        self.wait(self._at_rest, SLACK_S, "the arm does not come to rest")
        since_s = time.monotonic()
        poses: dict[int, PoseState] = {}
        while time.monotonic() < since_s + REST_WINDOW_S or self._streams.missing(since_s):
            if time.monotonic() > since_s + SLACK_S:
                raise NodeError("the robot's states are silent")
            self.pause(REST_SAMPLE_S)
            header, pose = self._streams.read(PoseState)
            poses[header.seq] = pose
        positions = [pose.position_m for pose in poses.values()]
        rotations = [rotation_from_quat(pose.quat_xyzw) for pose in poses.values()]
        turns = [log3(rotation @ rotations[0].T) for rotation in rotations]
        mean = Pose(np.mean(positions, axis=0), exp3(np.mean(turns, axis=0)) @ rotations[0])
        return RestPose(mean, self._streams.read(GripperState)[1].width_m)
