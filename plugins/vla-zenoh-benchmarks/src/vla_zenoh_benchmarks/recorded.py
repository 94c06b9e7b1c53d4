"""An episode of a benchmark as a recording, as ``vla-zenoh record`` writes one of a robot.

Its time is the environment's: step n begins n steps after `START_NS`, however long it took to
compute. A command is the pose or the joints that the environment holds at the end of its step, and
the gripper's width that it goes to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vla_zenoh.codec import records
from vla_zenoh.codec.image import encode_jpeg
from vla_zenoh.control.actions import step_width
from vla_zenoh.lab.recording.sample import JPEG, MSGPACK, Sample
from vla_zenoh.lab.recording.verdict import FACT
from vla_zenoh.lab.recording.writer import RecordingWriter
from vla_zenoh.policy import ActionSpec, ModelSpec
from vla_zenoh.policy.spec import PERSON
from vla_zenoh.profile import Profile
from vla_zenoh.profile.load import to_yaml
from vla_zenoh.types import (
    ActionChunk,
    Cause,
    FloatArray,
    GripperCommand,
    Header,
    Image,
    JointCommand,
    PoseCommand,
    Task,
)
from vla_zenoh_benchmarks.contract import BenchmarkObservation

START_NS = 1_700_000_000_000_000_000
QUALITY = 95
PARTS = ("joint", "pose", "gripper")
ROBOT, COMMAND = "sim", "command"


def recording_file(folder: Path, key: str) -> Path:
    """Where the recording of an episode is kept."""
    return folder / f"{key.replace('/', '.')}.mcap"


class EpisodeRecorder:
    """Writes one episode; the file has its name once the episode has ended.

    Args:
        path: of the file; what an earlier attempt left there goes.
        worker: name of the demonstrator.
        spec: of the demonstrator.
        cameras: whose pictures are recorded at every step.
        action: what a step of the environment means.
    """

    def __init__(
        self,
        path: Path,
        profile: Profile,
        worker: str,
        spec: ModelSpec,
        cameras: Sequence[str],
        action: ActionSpec,
    ) -> None:
        self.cameras: Sequence[str] = tuple(cameras)
        self._path, self._part = path, path.with_suffix(".part")
        self._part.unlink(missing_ok=True)
        self._keys, self._worker = profile.keys, worker
        self._action = action
        self._gripper = profile.robot.require_gripper("a recording of a benchmark")
        self._width_m = self._gripper.max_width_m
        self._spec_hash = spec.hash
        self._task = Task(1, True, "", worker, min(1000.0, 1.0 / action.dt_s))
        self._seq, self._cause = 0, Cause(worker, 0, *(START_NS,) * 6)
        self._out = RecordingWriter(
            self._part,
            profile.keys,
            profile_yaml=to_yaml(profile),
            base_frame=profile.robot.base_frame,
            began_ns=START_NS,
        )
        self._put(profile.keys.spec(worker), spec, START_NS, f"worker-{worker}")

    def begin(self, prompt: str) -> None:
        """The episode begins."""
        self._task = Task(1, True, prompt, self._worker, self._task.rate_hz)
        self._put(self._keys.task, self._task, START_NS, COMMAND)

    def taken_over(self, worker: str, spec: ModelSpec, step: int) -> None:
        """Another worker leads from step number `step` on; it counts as a person."""
        at_ns = self._at_ns(step)
        person = spec.model_copy(update={"name": PERSON})
        self._worker, self._spec_hash = worker, person.hash
        self._task = replace(self._task, worker=worker)
        self._put(self._keys.spec(worker), person, at_ns, f"worker-{worker}")
        self._put(self._keys.task, self._task, at_ns, COMMAND, 1)

    def chunk(self, chunk: ActionChunk, step: int) -> None:
        """The leading worker's answer to what there was to see before step number `step`."""
        at_ns = self._at_ns(step)
        times_ns = (at_ns,) * 6
        seen = ActionChunk(
            *(self._worker, self._spec_hash, 1, at_ns, step, at_ns + 1_000_000_000, chunk.steps),
            *(at_ns, at_ns, at_ns, chunk.done),
        )
        self._seq += 1
        self._cause = Cause(self._worker, self._seq, *times_ns)
        key = self._keys.delta(self._worker)
        self._put(key, seen, at_ns, f"worker-{self._worker}", self._seq)

    def saw(self, seen: BenchmarkObservation, step: int) -> None:
        """What there was to see before step number `step`."""
        at_ns = self._at_ns(step)
        for part in PARTS:
            record = getattr(seen, part)
            if record is not None:
                self._put(getattr(self._keys, f"state_{part}"), record, at_ns, ROBOT, step + 1)
        for camera, picture in seen.images.items():
            jpeg = encode_jpeg(Image(np.ascontiguousarray(picture)), QUALITY)
            said = Header(at_ns, step + 1, f"camera-{camera}")
            self._out.write(Sample(self._keys.camera_jpeg(camera), jpeg, JPEG, said, at_ns))

    def moved(self, seen: BenchmarkObservation, action: FloatArray, step: int) -> None:
        """Where step number `step` led, whose numbers are `action`."""
        at_ns, zeros = self._at_ns(step + 1), np.zeros(6)
        own = self._gripper
        width_m = step_width(self._action, action, self._width_m, own.max_width_m)
        if width_m is not None:
            self._width_m = width_m
            asked = GripperCommand(width_m, own.speed_m_s, own.force_n)
            self._put(self._keys.command_gripper, asked, at_ns, COMMAND, step + 1)
        if seen.pose is not None:
            pose = seen.pose
            position_m, quat_xyzw = pose.reference_position_m, pose.reference_quat_xyzw
            if position_m is None or quat_xyzw is None:
                position_m, quat_xyzw = pose.position_m, pose.quat_xyzw
            goal = position_m, quat_xyzw
            command: Any = PoseCommand(*goal, zeros, zeros, *goal, "active", self._cause)
            self._put(self._keys.command_pose, command, at_ns, COMMAND, step + 1)
        elif seen.joint is not None:
            still = np.zeros(len(seen.joint.names))
            joint = seen.joint
            command = JointCommand(
                joint.names, joint.position_rad, still, still, "active", self._cause
            )
            self._put(self._keys.command_joint, command, at_ns, COMMAND, step + 1)

    def finish(self, *, success: bool, steps: int) -> None:
        """The episode has ended after so many steps."""
        at_ns = self._at_ns(steps)
        done = Task(1, False, self._task.prompt, self._worker, self._task.rate_hz)
        self._put(self._keys.task, done, at_ns, COMMAND, 2)
        verdict = "success" if success else "failure"
        self._out.finish({FACT: {"worker": self._worker, "verdict": verdict}})
        self._part.rename(self._path)

    def abandon(self) -> None:
        """Close the file of an episode that failed to end."""
        self._out.abandon()

    def _at_ns(self, step: int) -> int:
        return START_NS + round(step * self._action.dt_s * 1e9)

    def _put(self, key: str, record: Any, at_ns: int, source: str, seq: int = 0) -> None:
        said = Header(at_ns, seq, source)
        self._out.write(Sample(key, records.encode(record), MSGPACK, said, at_ns))
