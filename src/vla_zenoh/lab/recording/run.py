"""A recorded run as decoded records, for evaluation and export."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from vla_zenoh.errors import CodecError, ProfileError, RecordingError
from vla_zenoh.keys import Keys, last_chunk
from vla_zenoh.lab.recording.reader import Recording, open_recording
from vla_zenoh.lab.recording.record_types import group_of, part_of
from vla_zenoh.lab.recording.sample import DEPTH, JPEG, Sample
from vla_zenoh.policy import ModelSpec
from vla_zenoh.profile import Profile, read_profile
from vla_zenoh.types import (
    ActionChunk,
    Cause,
    Event,
    GripperCommand,
    GripperState,
    Header,
    InferenceDebug,
    JointCommand,
    JointState,
    NodeStatus,
    ObjectPoses,
    PoseCommand,
    PoseState,
    Task,
)

MAX_PROBLEMS, SHOWN_KEYS = 20, 3
_read_profile = lru_cache(maxsize=4)(partial(read_profile, where="the recorded profile"))
PART_STREAMS = ("poses", "joints", "grippers", "commands", "joint_commands", "gripper_commands")
"""Fields of a `Run` that each part of a robot has of its own."""


class RecordedSample(NamedTuple):
    """A record with its header, time of reception (wall clock of the recorder) and key."""

    header: Header
    record: Any
    received_ns: int
    key: str


class RecordedImage(NamedTuple):
    """A JPEG file with its time of capture and its sequence number."""

    stamp_ns: int
    seq: int
    jpeg: bytes


Span = tuple[int, int, str]
"""Since and until when, wall ns, the arm obeyed one worker."""


@dataclass(slots=True)
class Run:
    """All records of one robot in a file, oldest first; a minute takes some 60 MB of memory.

    Images stay in the file, see `pictures`. Of a robot of parts states and commands of all parts
    are in the same lists; see `of_part`.
    """

    file: Recording
    poses: list[RecordedSample] = field(default_factory=list)
    joints: list[RecordedSample] = field(default_factory=list)
    grippers: list[RecordedSample] = field(default_factory=list)
    commands: list[RecordedSample] = field(default_factory=list)
    joint_commands: list[RecordedSample] = field(default_factory=list)
    gripper_commands: list[RecordedSample] = field(default_factory=list)
    chunks: list[RecordedSample] = field(default_factory=list)
    tasks: list[RecordedSample] = field(default_factory=list)
    events: list[RecordedSample] = field(default_factory=list)
    objects: list[RecordedSample] = field(default_factory=list)
    seen: list[RecordedSample] = field(default_factory=list)
    specs: dict[str, ModelSpec] = field(default_factory=dict)
    """By hash."""
    statuses: dict[str, NodeStatus] = field(default_factory=dict)
    """The last of every node."""
    first_statuses: dict[str, NodeStatus] = field(default_factory=dict)
    """The first of every node."""
    picture_counts: Counter[str] = field(default_factory=Counter)
    """Pictures by camera."""
    depth_cameras: set[str] = field(default_factory=set)
    """Cameras with depth."""
    problems: list[str] = field(default_factory=list)
    """Messages about what could not be read."""
    began_ns: int = 0
    """Reception of the first sample."""
    ended_ns: int = 0
    """Reception of the last sample."""
    part: str = ""
    """Whose states and commands these are, of a robot of parts; empty: those of all."""

    @property
    def path(self) -> Path:
        return self.file.path

    @property
    def keys(self) -> Keys:
        return self.file.keys

    @property
    def seconds(self) -> float:
        """From the first sample to the last."""
        return (self.ended_ns - self.began_ns) / 1e9

    @property
    def profile(self) -> Profile:
        """The profile that was in force, of this part.

        Raises:
            RecordingError: the recording holds none that can be read.
        """
        try:
            return _read_profile(self.file.profile_yaml).of_part(self.part)
        except (ProfileError, KeyError) as error:
            raise RecordingError(
                f"{self.path} holds no profile of this robot that can be read, which says how far "
                f"its gripper opens and where its home is: {error}"
            ) from error

    @property
    def part_names(self) -> tuple[str, ...]:
        """Names of the parts that sent states, in alphabetical order; of one arm one empty name."""
        keys = {entry.key for entry in (*self.poses, *self.joints, *self.grippers)}
        found = {part_of(self.keys, key) for key in keys}
        return (self.part,) if self.part else tuple(sorted(found)) or ("",)

    def of_part(self, name: str) -> Run:
        """The same run with states and commands of one part alone; of no name: this one."""
        if not name:
            return self
        every = {entry.key for stream in PART_STREAMS for entry in getattr(self, stream)}
        keys = {key for key in every if part_of(self.keys, key) == name}
        own = {
            stream: [entry for entry in getattr(self, stream) if entry.key in keys]
            for stream in PART_STREAMS
        }
        return replace(self, part=name, **own)

    def first_commands(self) -> list[tuple[Cause, int]]:
        """The cause of each chunk, and the stamp of its first pose command, else joint command.

        The stamp, not the reception: a recorder may receive late what the robot received in time.
        """
        out: list[tuple[Cause, int]] = []
        newest: tuple[str, int] | None = None
        for entry in self.commands or self.joint_commands:
            cause = entry.record.cause
            if cause is not None and (cause.worker, cause.chunk_seq) != newest:
                newest = (cause.worker, cause.chunk_seq)
                out.append((cause, entry.header.stamp_wall_ns))
        return out

    # -- intervals, by the stamps of the writers: a replayed run is divided as the original is ----
    @property
    def commanders(self) -> set[str]:
        """Processes that commanded the robot, as they name themselves."""
        return {task.header.source for task in self.tasks}

    def activations(self) -> list[Span]:
        """Each interval in which the arm obeyed one worker."""
        return [
            (since_ns, until_ns, worker) for since_ns, until_ns, (worker,) in self._spans("worker")
        ]

    def prompt_intervals(self) -> list[tuple[int, int, str, str]]:
        """Each interval with one worker obeyed and one prompt in force, after its two ends."""
        found = self._spans("worker", "prompt")
        return [(since, until, worker, prompt) for since, until, (worker, prompt) in found]

    def reads_prompts(self, worker: str) -> bool:
        """Whether a worker is a model that is given prompts, by the specs of its chunks."""
        hashes = {chunk.record.spec_hash for chunk in self.chunks if chunk.record.worker == worker}
        specs = [self.specs[each] for each in hashes if each in self.specs]
        return not specs or any(spec.observation.prompt for spec in specs)

    def obeyed_chunks(self) -> list[RecordedSample]:
        """Chunks of the obeyed worker while the arm was active: the requests."""
        spans = self.activations()
        return [chunk for chunk in self.chunks if any(is_within(chunk, span) for span in spans)]

    def _spans(self, *names: str) -> list[tuple[int, int, tuple[str, ...]]]:
        out: list[tuple[int, int, tuple[str, ...]]] = []
        since_ns, now = 0, None
        for entry in self.tasks:
            task = entry.record
            value = tuple(getattr(task, name) for name in names) if task.active else None
            if value != now:
                stamp_ns = entry.header.stamp_wall_ns
                if now is not None:
                    out.append((since_ns, stamp_ns, now))
                since_ns, now = stamp_ns, value
        if now is not None:
            # Not the end of the file: a recorder may run on after robot and models.
            streams = (self.tasks, self.chunks, self.commands, self.joint_commands, self.poses)
            last_ns = max(stream[-1].header.stamp_wall_ns for stream in streams if stream)
            out.append((since_ns, last_ns + 1, now))
        return out


def is_within(chunk: RecordedSample, span: Span) -> bool:
    """Whether a chunk is of the worker and the time of a span."""
    since_ns, until_ns, worker = span
    return since_ns <= chunk.header.stamp_wall_ns < until_ns and chunk.record.worker == worker


def newest(stream: Sequence[RecordedSample], at_ns: int) -> RecordedSample | None:
    """The last sample stamped until a time; None: there is none."""
    index = bisect_right(stream, at_ns, key=lambda entry: entry.header.stamp_wall_ns) - 1
    return stream[index] if index >= 0 else None


def nearest(stream: Sequence[RecordedSample], at_ns: int) -> RecordedSample | None:
    """The sample stamped nearest to a time; None: the stream is empty."""
    index = bisect_left(stream, at_ns, key=lambda entry: entry.header.stamp_wall_ns)
    around = stream[max(index - 1, 0) : index + 1]
    return min(around, key=lambda each: abs(each.header.stamp_wall_ns - at_ns), default=None)


def load_run(path: Path) -> Run:
    """Read a file of ``vla-zenoh record``; `Run.problems` lists what cannot be read.

    Raises:
        RecordingError: the file cannot be opened, or is of another program.
    """
    file = open_recording(path)
    run, keys, rejected = Run(file), file.keys, Counter[str]()
    lists: dict[type, list[RecordedSample]] = {
        PoseState: run.poses,
        JointState: run.joints,
        GripperState: run.grippers,
        PoseCommand: run.commands,
        JointCommand: run.joint_commands,
        GripperCommand: run.gripper_commands,
        ActionChunk: run.chunks,
        Task: run.tasks,
        Event: run.events,
        ObjectPoses: run.objects,
        InferenceDebug: run.seen,
    }
    is_wanted, others = _of_interest(keys), set[str]()

    def wanted(key: str) -> bool:
        if not key.startswith(f"{keys.root}/{keys.robot}/"):
            others.add(key)
        return is_wanted(key)

    for entry in file.entries(wanted):
        run.began_ns = run.began_ns or entry.received_ns
        run.ended_ns = max(run.ended_ns, entry.received_ns)
        if entry.kind is None:
            if entry.header is None and entry.attachment is None:
                continue  # a setting; `tasks` has what the command node made of it
            if entry.encoding == JPEG:
                run.picture_counts[_camera(keys, entry.key)] += 1
            elif entry.encoding.startswith(DEPTH):
                run.depth_cameras.add(_camera(keys, entry.key))
            else:
                rejected[f"{keys.short(entry.key)}: bytes that are no record"] += 1
            continue
        try:
            record = entry.record()
        except CodecError as error:
            rejected[f"{keys.short(entry.key)}: {error.reason} records"] += 1
            continue
        if entry.header is None:
            continue
        if type(record) in lists:
            received = RecordedSample(entry.header, record, entry.received_ns, entry.key)
            lists[type(record)].append(received)
        elif isinstance(record, ModelSpec):
            run.specs[record.hash] = record
        elif isinstance(record, NodeStatus):
            node = last_chunk(entry.key)
            run.first_statuses.setdefault(node, record)
            run.statuses[node] = record
    if file.damage:
        run.problems.append(f"{path.name} is {file.damage}")
    if others and not run.began_ns:
        run.problems.append(
            f"it says that it is of {keys.root}/{keys.robot}, and holds nothing of that robot, but "
            f"{', '.join(sorted(others)[:SHOWN_KEYS])}: is it damaged?"
        )
    run.problems += [
        f"{told.header.source}: {told.record.why}"
        for told in run.events
        if told.record.what == "clock_step"
    ]
    for each in lists.values():
        each.sort(key=lambda received: received.header.stamp_wall_ns)
    run.problems += file.clock_steps[:MAX_PROBLEMS]
    run.problems += [f"{what} ({count})" for what, count in rejected.most_common(MAX_PROBLEMS)]
    return run


def _of_interest(keys: Keys) -> Callable[[str], bool]:
    """All keys of the robot but raw images and the input images of models."""

    def wanted(key: str) -> bool:
        group = group_of(keys, key)
        try:
            if group == "camera":
                camera = _camera(keys, key)
                return key in (keys.camera_jpeg(camera), keys.camera_depth(camera))
            if group == "seen":
                return key == keys.seen_record(last_chunk(key))
        except ProfileError:  # of another program: a name that none of ours has
            return False
        return bool(group)

    return wanted


def _camera(keys: Keys, key: str) -> str:
    return keys.short(key).partition("/")[2].partition("/")[0]


def pictures(file: Recording, camera: str) -> Iterator[RecordedImage]:
    """Every JPEG of a camera, oldest first, one in memory at a time."""
    return _jpegs(file, file.keys.camera_jpeg(camera))


def seen_pictures(file: Recording, worker: str, camera: str) -> Iterator[RecordedImage]:
    """Input images of a model; `seq` is that of the chunk, the stamp that of the observation."""
    return _jpegs(file, file.keys.seen(worker, camera))


def depths(file: Recording, camera: str) -> Iterator[Sample]:
    """Every depth image of a camera, oldest first, one in memory at a time."""
    return _images(file, file.keys.camera_depth(camera), DEPTH)


def _jpegs(file: Recording, key: str) -> Iterator[RecordedImage]:
    for entry in _images(file, key, JPEG):
        assert entry.header is not None
        yield RecordedImage(entry.stamp_ns, entry.header.seq, entry.payload)


def _images(file: Recording, key: str, encoding: str) -> Iterator[Sample]:
    for entry in file.entries(lambda each: each == key):
        if entry.header is not None and entry.encoding.startswith(encoding):
            yield entry
