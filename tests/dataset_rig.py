"""A recorded run whose steps are known: written sample by sample, no robot needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec import records
from vla_zenoh.codec.image import depth_schema, encode_depth, encode_jpeg
from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording.sample import JPEG, MSGPACK, Sample
from vla_zenoh.lab.recording.writer import RecordingWriter
from vla_zenoh.policy import ActionSpec, ModelSpec, ObservationSpec
from vla_zenoh.profile import load_profile
from vla_zenoh.profile.load import to_yaml
from vla_zenoh.types import (
    ActionChunk,
    Cause,
    Depth,
    GripperCommand,
    GripperState,
    Header,
    Image,
    PoseCommand,
    PoseState,
    Task,
)

KEYS = Keys("panda")
PROFILE = to_yaml(load_profile("panda_sim"))
ZERO_NS = 1_700_000_000_000_000_000
MS = 1_000_000
LATENCY_MS = 31
"""From an observation to the publication of its chunk."""
HEIGHT, WIDTH = 48, 64
DOWN = np.array([1.0, 0.0, 0.0, 0.0])
HORIZON, DT_S = 4, 0.1
CHUNK_MS, CHUNKS = 200, 10
STATE_MS = 25
"""Between states of the arm: most of a recording is of them."""
PROMPTS = ("put the red brick in the box", "HARD: go up")


def spec(**action: Any) -> ModelSpec:
    fields = {"horizon": HORIZON, "dt_s": DT_S, "rotation": "rpy", "gripper": "open_fraction"}
    return ModelSpec(
        name="teacher", observation=ObservationSpec(), action=ActionSpec(**{**fields, **action})
    )


def steps_of(activation: int, chunk: int, dimension: int = 7) -> NDArray[np.float32]:
    """(H, D) that no other chunk has, with every bit of float32 in use."""
    random = np.random.default_rng(1000 * activation + chunk)
    steps = random.normal(0, 0.01, (HORIZON, dimension)).astype(np.float32)
    steps[:, -1] = random.uniform(0, 1, HORIZON)
    return steps


def picture(number: int) -> bytes:
    """Evenly coloured, a little brighter each time."""
    return encode_jpeg(Image(np.full((HEIGHT, WIDTH, 3), 2 * number, np.uint8)), 95)


def put(key: str, record: Any, at_ms: float, seq: int) -> Sample:
    at_ns = ZERO_NS + round(at_ms * MS)
    return Sample(key, records.encode(record), MSGPACK, Header(at_ns, seq, "node#1"), at_ns + MS)


def depth_counts(number: int) -> NDArray[np.uint16]:
    """A slope; farther each time."""
    return (np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) + 10 * number).astype(np.uint16)


_WRITTEN: dict[str, bytes] = {}
"""Recordings by what they were asked for: many tests begin with the same one."""


def write_run(path: Path, **how: Any) -> Path:
    """One activation of 2 s for each prompt, half a second of rest after each; see `_write_run`."""
    asked = repr(sorted(how.items()))
    if asked not in _WRITTEN:
        _WRITTEN[asked] = _write_run(path, **how).read_bytes()
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(_WRITTEN[asked])
    return path


def _write_run(
    path: Path,
    *,
    depth_unit_m: float | None = None,
    of: ModelSpec | None = None,
    prompts: Sequence[str] = PROMPTS,
    silent: Sequence[int] = (),
    with_spec: bool = True,
    percent: float = 100.0,
    cameras: Sequence[str] = ("front",),
    profile_yaml: str = PROFILE,
    ended: Mapping[str, Any] | None = None,
    set_back: tuple[str, float, float] | None = None,
    commander: str = "command#1",
    until_ms: float = 1e6,
) -> Path:
    """The recording of `write_run`.

    Args:
        path: of the file.
        depth_unit_m: of the depth that the camera measures; None: none.
        of: what the steps mean.
        prompts: of the activations.
        silent: chunks that were never published, in each activation.
        with_spec: the worker says what its steps mean.
        percent: speed override.
        cameras: those that were recorded.
        profile_yaml: the profile in force.
        ended: what stands at its end beside what was dropped.
        commander: process that commands the arm.
        until_ms: when the recorder ends.
        set_back: key (empty: all) whose writer's clock is set back, after how many ms, by how many.
    """
    said = of or spec()
    samples: list[Sample] = []
    if with_spec:
        samples.append(put(KEYS.spec("teacher"), said, 0, 0))
    lasts_ms = CHUNK_MS * CHUNKS
    end_ms = 500 + len(prompts) * (lasts_ms + 500)
    seq = 0
    for number, prompt in enumerate(prompts):
        begin_ms = 500 + number * (lasts_ms + 500)
        for at_ms in range(begin_ms, begin_ms + lasts_ms, 100):
            active = Task(number + 1, True, prompt, "teacher", 5.0, percent)
            samples.append(put(KEYS.task, active, at_ms, at_ms))
        idle = Task(number + 1, False, prompt, "teacher", 5.0, percent)
        samples.append(put(KEYS.task, idle, begin_ms + lasts_ms, begin_ms + lasts_ms))
        for chunk in range(CHUNKS):
            if chunk in silent:
                continue
            seen_ms = begin_ms + CHUNK_MS * chunk + 5
            seen_ns, seq = ZERO_NS + seen_ms * MS, seq + 1
            times = (seen_ns + MS, seen_ns + 2 * MS, seen_ns + 30 * MS)
            steps = steps_of(number, chunk, said.action.dimension)[: said.action.horizon]
            made = ActionChunk(
                "teacher", said.hash, number + 1, seen_ns, seq, seen_ns + 10**9, steps, *times
            )
            samples.append(put(KEYS.delta("teacher"), made, seen_ms + LATENCY_MS, seq))
            cause = Cause(
                "teacher", seq, seen_ns, *times, seen_ns + LATENCY_MS * MS, seen_ns + 32 * MS
            )
            place = np.array([0.4, 0.0, 0.3])
            still = np.zeros(6)
            command = PoseCommand(place, DOWN, still, still, place, DOWN, "active", cause)
            samples.append(put(KEYS.command_pose, command, seen_ms + 33, seq))
    for at_ms in range(0, end_ms, STATE_MS):
        pose = PoseState(np.array([0.4, 0.0, at_ms / 1e4]), DOWN, np.zeros(6))
        samples.append(put(KEYS.state_pose, pose, at_ms, at_ms))
        samples.append(put(KEYS.state_gripper, GripperState(0.05, False, False), at_ms, at_ms))
    for number in range(end_ms // 50):
        at_ns = ZERO_NS + 50 * number * MS
        header = Header(at_ns, number, "camera#1")
        for camera in cameras:
            key = KEYS.camera_jpeg(camera)
            samples.append(Sample(key, picture(number), JPEG, header, at_ns + MS))
        if depth_unit_m is not None:
            depth = Depth(depth_counts(number), depth_unit_m)
            encoding = f"image/png;{depth_schema(depth)}"
            key = KEYS.camera_depth("front")
            samples.append(Sample(key, encode_depth(depth), encoding, header, at_ns + MS))
    out = RecordingWriter(
        path, KEYS, profile_yaml=profile_yaml, base_frame="base", began_ns=ZERO_NS
    )
    samples = [each for each in samples if each.received_ns < ZERO_NS + until_ms * MS]
    for sample in sorted(samples, key=lambda each: each.received_ns):
        sample = _by(commander, sample)
        out.write(sample if set_back is None else stamped_back(sample, *set_back))
    out.finish({"dropped": {}, **(ended or {})})
    return path


def stamped_back(sample: Sample, key: str, after_ms: float, by_ms: float) -> Sample:
    """A sample as stamped by a clock that was set back."""
    header = sample.header
    if header is None or key not in ("", KEYS.short(sample.key)):
        return sample
    if header.stamp_wall_ns < ZERO_NS + after_ms * MS:
        return sample
    stamp_ns = header.stamp_wall_ns - round(by_ms * MS)
    return replace(sample, header=Header(stamp_ns, header.seq, header.source))


TELEOP_STEP_M, TELEOP_DT_S = 0.002, 0.05
MIXED = ((500, 1500, "teacher"), (1500, 2500, "teleop"), (2500, 3500, "teacher"))
"""Since and until when, ms, who leads an activation that a person takes over."""
PERSON_WIDTH_M = 0.03


def write_mixed_run(
    path: Path,
    *,
    of: ModelSpec | None = None,
    ended: Mapping[str, Any] | None = None,
    commander: str = "command#1",
) -> Path:
    """One activation in which a person takes the arm from the model and gives it back.

    The person asks for `TELEOP_STEP_M` along y each `TELEOP_DT_S`; the model goes on in shadow. The
    goal of a command is where all steps until then lead.
    """
    model = of or spec()
    person = ModelSpec(
        name="teleop",
        observation=ObservationSpec(cameras=(), prompt=False),
        action=ActionSpec(horizon=20, dt_s=TELEOP_DT_S, rotation="rotvec"),
    )
    samples = [
        put(KEYS.spec("teacher"), model, 0, 0),
        put(KEYS.spec("teleop"), person, 0, 0),
    ]
    begin_ms, end_ms = MIXED[0][0], MIXED[-1][1]
    for number, (since_ms, until_ms, worker) in enumerate(MIXED):
        for at_ms in range(since_ms, until_ms, 100):
            task = Task(number + 1, True, PROMPTS[0], worker, 5.0)
            samples.append(put(KEYS.task, task, at_ms, at_ms))
        for at_ms in range(since_ms, until_ms, CHUNK_MS):
            for whose, said in (("teacher", model), ("teleop", person)):
                seen_ms, seq = at_ms + 5, at_ms // CHUNK_MS
                seen_ns = ZERO_NS + seen_ms * MS
                times = (seen_ns + MS, seen_ns + 2 * MS, seen_ns + 30 * MS)
                steps = steps_of(number, seq, said.action.dimension)
                made = ActionChunk(
                    *(whose, said.hash, number + 1, seen_ns, seq, seen_ns + 10**9, steps),
                    *times,
                )
                samples.append(put(KEYS.delta(whose), made, seen_ms + LATENCY_MS, seq))
                if whose == worker:
                    cause = Cause(
                        *(whose, seq, seen_ns, *times, seen_ns + LATENCY_MS * MS, seen_ns + 32 * MS)
                    )
                    samples.append(_command(cause, seen_ms + 33))
    person_ms = (MIXED[1][0], MIXED[1][1])
    for at_ms in range(begin_ms, end_ms, 10):
        samples.append(_command(None, at_ms))
    idle = Task(4, False, PROMPTS[0], "teacher", 5.0)
    samples.append(put(KEYS.task, idle, end_ms, end_ms))
    shut = GripperCommand(PERSON_WIDTH_M, 0.1, 10.0)
    samples.append(put(KEYS.command_gripper, shut, sum(person_ms) / 2, 1))
    for at_ms in range(0, end_ms + 500, STATE_MS):
        pose = PoseState(np.array([0.4, 0.0, at_ms / 1e4]), DOWN, np.zeros(6))
        samples.append(put(KEYS.state_pose, pose, at_ms, at_ms))
        samples.append(put(KEYS.state_gripper, GripperState(0.05, False, False), at_ms, at_ms))
    for number in range((end_ms + 500) // 50):
        at_ns = ZERO_NS + 50 * number * MS
        header = Header(at_ns, number, "camera#1")
        key = KEYS.camera_jpeg("front")
        samples.append(Sample(key, picture(number), JPEG, header, at_ns + MS))
    out = RecordingWriter(path, KEYS, profile_yaml=PROFILE, base_frame="base", began_ns=ZERO_NS)
    for sample in sorted(samples, key=lambda each: each.received_ns):
        out.write(_by(commander, sample))
    out.finish({"dropped": {}, **(ended or {})})
    return path


def _by(commander: str, sample: Sample) -> Sample:
    """A task is of this process."""
    if sample.key != KEYS.task or sample.header is None:
        return sample
    return replace(sample, header=replace(sample.header, source=commander))


def _command(cause: Cause | None, at_ms: float) -> Sample:
    """With the goal as far along y as the person has asked for until then."""
    since_ms, until_ms = MIXED[1][0], MIXED[1][1]
    led_s = (min(max(at_ms, since_ms), until_ms) - since_ms) / 1e3
    goal = np.array([0.4, TELEOP_STEP_M * led_s / TELEOP_DT_S, 0.3])
    still = np.zeros(6)
    command = PoseCommand(goal, DOWN, still, still, goal, DOWN, "active", cause)
    return put(KEYS.command_pose, command, at_ms, round(at_ms))
