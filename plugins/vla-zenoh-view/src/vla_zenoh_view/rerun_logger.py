"""Logs the samples of a robot, live or recorded, into a Rerun stream."""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr

from vla_zenoh.codec import records, settings
from vla_zenoh.errors import CodecError, RecordError, SpecError
from vla_zenoh.keys import Keys, last_chunk
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import Pose, pose_of, rotation_from_quat
from vla_zenoh.lab.recording.record_types import group_of, part_of, record_of
from vla_zenoh.lab.recording.sample import DEPTH, JPEG, Sample
from vla_zenoh.policy import ModelSpec
from vla_zenoh.profile import Profile, to_yaml
from vla_zenoh.types import (
    ActionChunk,
    Event,
    GripperCommand,
    GripperState,
    InferenceDebug,
    JointCommand,
    JointState,
    NodeStatus,
    ObjectPoses,
    PoseCommand,
    PoseState,
    SceneState,
    Task,
)
from vla_zenoh_view import paths
from vla_zenoh_view.charts import Charts
from vla_zenoh_view.layout import blueprint
from vla_zenoh_view.robot_model import load_robot_model
from vla_zenoh_view.scene import Scene
from vla_zenoh_view.texts import TextPanels

DRAW_NS = 33_000_000
"""Shortest interval between two drawings of a state or command; every cause is logged."""
OFTEN = (PoseState, JointState, GripperState, ObjectPoses)
APART_NS = 10_000_000_000
"""A stamp that far from the reception is of another clock: the reception counts."""
NO_SPEC, UNFIT = "no_spec", "does not fit its spec"
MAX_WAITING = 100
"""Chunks kept until their spec is received: workers publish it once a second."""
JPEG_BEGINS = b"\xff\xd8\xff"
COMMAND_NODE = "command"
APPLICATION = "vla-zenoh"


@dataclass(slots=True)
class _Arm:
    """What is drawn of an arm: one part of the robot, or all of it."""

    part: str
    scene: Scene
    charts: Charts
    kinematics: Kinematics | None
    commanded: PoseCommand | None = None


class RerunLogger:
    """Logs samples, in the order of reception, into a Rerun stream.

    Samples that cannot be shown are counted in `rejected`, which the view displays.

    Args:
        keys: of the samples; None: those of the profile.
    """

    def __init__(
        self,
        profile: Profile,
        stream: rr.RecordingStream,
        *,
        keys: Keys | None = None,
        live: bool = False,
    ) -> None:
        self._stream, self._live = stream, live
        self.keys = keys or profile.keys
        self._command_status = self.keys.status(COMMAND_NODE)
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        self._arms: dict[str, _Arm] = {}
        missing = ""
        for part in profile.parts or ("",):
            own = profile.of_part(part) if part else profile
            robot, why = load_robot_model(own, stream, f"{paths.arm(part)}/{paths.ROBOT}")
            charts = Charts(stream, own.robot.arm_joints, part)
            kinematics = robot.kinematics if robot is not None else None
            self._arms[part] = _Arm(part, Scene(stream, own, robot), charts, kinematics)
            missing = missing or why
            if part:
                base = profile.parts[part].base
                turn = rr.RotationAxisAngle(axis=(0.0, 0.0, 1.0), radians=base.yaw_rad)
                placed = rr.Transform3D(translation=base.position_m, rotation=turn)
                stream.log(paths.arm(part), placed, static=True)
        self._first = next(iter(self._arms.values()))
        self._texts = TextPanels(stream, to_yaml(profile), missing)
        self._drawn_ns: dict[str, int] = {}
        self._specs: dict[str, ModelSpec] = {}
        self._waiting: deque[tuple[str, int, ActionChunk]] = deque()
        self._obeyed = profile.task.worker
        self._widest_mm = profile.robot.max_width_m * 1e3
        self._cameras: set[str] = set()
        self._seen: defaultdict[str, set[str]] = defaultdict(set)
        self._layout()
        self.shown: Counter[str] = Counter()
        """Samples that were logged, by key."""
        self.rejected: Counter[str] = Counter()
        """Samples that cannot be shown, by key and reason."""
        self.dropped = 0
        """Samples that the source of the samples had to drop."""

    def _layout(self) -> None:
        self._stream.send_blueprint(
            blueprint(self._cameras, self._seen, widest_mm=self._widest_mm, live=self._live)
        )

    # -- in -----------------------------------------------------------------------------------
    def log(self, sample: Sample) -> None:
        """Log what a sample shows; whatever it holds, nothing is raised."""
        group, kind = group_of(self.keys, sample.key), record_of(self.keys.short(sample.key))
        if not group or kind is SceneState:
            return
        stamp_ns = self._stamp_ns(sample)
        if not self.shown:
            for arm in self._arms.values():
                arm.scene.robot_moved()  # at home, until its joints are known
        try:
            if kind is not None:
                self._record(kind, sample, stamp_ns)
            elif group in (paths.CAMERA, paths.SEEN):
                self._picture(sample, group)
            else:
                self._setting(sample)
            self.shown[sample.key] += 1
        except CodecError as error:
            self._reject(sample.key, error.reason)
        except RecordError:
            self._reject(sample.key, UNFIT)

    def _arm(self, sample: Sample) -> _Arm:
        arm = self._arms.get(part_of(self.keys, sample.key))
        if arm is None:
            raise CodecError("invalid", f"{sample.key} is of no part of the profile's robot")
        return arm

    def _reject(self, key: str, reason: str) -> None:
        self.rejected[f"{self.keys.short(key)}: {reason}"] += 1

    def _at(self, stamp_ns: int) -> None:
        self._stream.set_time(paths.TIMELINE, timestamp=np.datetime64(stamp_ns, "ns"))

    def _stamp_ns(self, sample: Sample) -> int:
        stamp_ns = sample.received_ns
        if sample.header is not None and abs(sample.header.stamp_wall_ns - stamp_ns) < APART_NS:
            stamp_ns = sample.header.stamp_wall_ns
        self._at(stamp_ns)
        return stamp_ns

    def _due(self, key: str, stamp_ns: int) -> bool:
        if 0 <= stamp_ns - self._drawn_ns.get(key, 0) < DRAW_NS:
            return False
        self._drawn_ns[key] = stamp_ns
        return True

    def _record(self, kind: type, sample: Sample, stamp_ns: int) -> None:
        if sample.header is None and kind is not ModelSpec:  # the reply to a query has none
            raise CodecError("no_header", f"{sample.key} has no header")
        if kind in OFTEN and not self._due(sample.key, stamp_ns):
            return
        match records.decode(kind, sample.payload):
            case PoseState() as state:
                self._pose_state(self._arm(sample), stamp_ns, state)
            case JointState() as state:
                arm = self._arm(sample)
                arm.scene.joints(state.names, state.position_rad)
                arm.charts.joints(state.names, state.position_rad)
            case GripperState() as state:
                arm = self._arm(sample)
                if state.width_m is not None:
                    arm.scene.gripper(max(state.width_m, 0.0))
                    arm.charts.gripper(paths.MEASURED, state.width_m)
            case ObjectPoses() as objects:
                self._first.scene.objects(objects)
            case PoseCommand() as command:
                self._pose_command(sample, stamp_ns, command)
            case JointCommand() as command:
                self._joint_command(sample, stamp_ns, command)
            case GripperCommand() as command:
                self._arm(sample).charts.gripper(paths.COMMANDED, command.width_m)
            case ModelSpec() as spec:
                self._spec(stamp_ns, spec)
            case ActionChunk() as chunk:
                self._chunk(sample.key, stamp_ns, chunk)
            case InferenceDebug() as seen:
                if seen.worker not in self._seen:
                    self._seen[seen.worker] = set()
                    self._layout()
                self._texts.answer(seen, self._specs.get(seen.spec_hash))
            case Task() as task:
                self._obeyed = task.worker
                self._texts.task(task)
                self._texts.now(stamp_ns, self.rejected, self.dropped)
            case NodeStatus() as status:
                if sample.key == self._command_status:
                    self._first.charts.status(status)
                    self._texts.status(status)
                self._texts.now(stamp_ns, self.rejected, self.dropped)
            case Event() as event:
                self._texts.event(last_chunk(sample.key), stamp_ns, event)
            case _:
                raise CodecError("invalid", f"{kind.__name__} is not shown")

    # -- pictures and settings ----------------------------------------------------------------
    def _picture(self, sample: Sample, group: str) -> None:
        _, first, *rest = self.keys.short(sample.key).split("/", 2)
        second = rest[0] if rest else ""
        depth = sample.encoding.startswith(DEPTH)
        if group == paths.CAMERA and second != "jpeg" and not depth:
            return
        if depth:
            metre, suffix = 1.0 / sample.depth().unit_m, " depth"
            shown: Any = rr.EncodedDepthImage(sample.payload, media_type="image/png", meter=metre)
        elif second and sample.encoding == JPEG and sample.payload.startswith(JPEG_BEGINS):
            shown, suffix = rr.EncodedImage(contents=sample.payload, media_type=JPEG), ""
        else:
            raise CodecError("malformed", "not a JPEG")
        if group == paths.CAMERA:
            name = first + suffix
            path, known = paths.picture(name), self._cameras
        else:
            name = second.partition("/")[0] + suffix
            path, known = paths.seen(first, name), self._seen[first]
        if name not in known:
            known.add(name)
            self._layout()
        self._stream.log(path, shown)

    def _setting(self, sample: Sample) -> None:
        nested = "/" in self.keys.short(sample.key) and sample.key != self.keys.sim_reset
        if sample.header is not None or nested:
            raise CodecError("malformed", "neither a record nor a setting")
        self._texts.setting(self.keys.short(sample.key), settings.decode_text(sample.payload))

    # -- the robot ----------------------------------------------------------------------------
    def _pose_state(self, arm: _Arm, stamp_ns: int, state: PoseState) -> None:
        arm.scene.pose(paths.MEASURED, stamp_ns, pose_of(state))
        arm.charts.speed(paths.MEASURED, state.twist)
        commanded_m = state.reference_position_m
        if commanded_m is None and arm.commanded is not None:
            commanded_m = arm.commanded.position_m
        if commanded_m is not None:
            arm.charts.tracking(float(np.linalg.norm(commanded_m - state.position_m)))

    # -- commands -----------------------------------------------------------------------------
    def _pose_command(self, sample: Sample, stamp_ns: int, command: PoseCommand) -> None:
        arm = self._arm(sample)
        goal = Pose(command.goal_position_m, rotation_from_quat(command.goal_quat_xyzw))
        arm.scene.goal(stamp_ns, goal)
        self._first.charts.command(stamp_ns, command.cause)
        arm.commanded = command
        if self._due(sample.key, stamp_ns):
            pose = Pose(command.position_m, rotation_from_quat(command.quat_xyzw))
            arm.scene.pose(paths.COMMANDED, stamp_ns, pose)
            arm.scene.pose(paths.GOAL, stamp_ns, goal)
            arm.charts.speed(paths.COMMANDED, command.twist)

    def _joint_command(self, sample: Sample, stamp_ns: int, command: JointCommand) -> None:
        arm = self._arm(sample)
        self._first.charts.command(stamp_ns, command.cause)
        chain = arm.kinematics
        if chain is None or not self._due(sample.key, stamp_ns):
            return
        joints_rad = chain.ordered(command.names, command.position_rad)
        velocity = chain.ordered(command.names, command.velocity_rad_s)
        pose, jacobian = chain.pose_and_jacobian(joints_rad)
        arm.scene.pose(paths.COMMANDED, stamp_ns, pose)
        arm.charts.speed(paths.COMMANDED, jacobian @ velocity)

    # -- models -------------------------------------------------------------------------------
    def _spec(self, stamp_ns: int, spec: ModelSpec) -> None:
        self._specs[spec.hash] = spec
        waiting, self._waiting = self._waiting, deque()
        for key, chunk_ns, chunk in waiting:
            if chunk.spec_hash != spec.hash:
                self._waiting.append((key, chunk_ns, chunk))
                continue
            self._at(chunk_ns)
            try:
                self._draw_chunk(chunk_ns, chunk, spec)
            except RecordError:
                self._reject(key, UNFIT)
        self._at(stamp_ns)

    def _chunk(self, key: str, stamp_ns: int, chunk: ActionChunk) -> None:
        spec = self._specs.get(chunk.spec_hash)
        if spec is not None:
            self._draw_chunk(stamp_ns, chunk, spec)
            return
        self._waiting.append((key, stamp_ns, chunk))
        if len(self._waiting) > MAX_WAITING:
            self._reject(self._waiting.popleft()[0], NO_SPEC)

    def _draw_chunk(self, stamp_ns: int, chunk: ActionChunk, spec: ModelSpec) -> None:
        obeyed, action, steps = chunk.worker == self._obeyed, spec.action, chunk.steps
        if steps.shape[1] != action.dimension:
            raise RecordError(f"steps have {steps.shape[1]} numbers, their spec {action.dimension}")
        for part, arm in self._arms.items():
            try:
                own = action.of(part)
            except SpecError as error:
                raise RecordError(str(error)) from error
            arm.scene.chunk(stamp_ns, chunk, own, steps[:, action.columns(part)], obeyed)
        if not obeyed:
            self._first.charts.shadow(chunk)

    def close(self) -> None:
        """Count the chunks whose spec was never received."""
        while self._waiting:
            self._reject(self._waiting.popleft()[0], NO_SPEC)
