"""A recorded run whose steps are known: written sample by sample, no robot needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec import records
from vla_zenoh.codec.image import encode_jpeg
from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording.sample import JPEG, MSGPACK, Sample
from vla_zenoh.lab.recording.writer import RecordingWriter
from vla_zenoh.policy import ActionSpec, ModelSpec, ObservationSpec
from vla_zenoh.types import (
    ActionChunk,
    Cause,
    GripperState,
    Header,
    Image,
    PoseCommand,
    PoseState,
    Task,
)

KEYS = Keys("panda")
ZERO_NS = 1_700_000_000_000_000_000
MS = 1_000_000
HEIGHT, WIDTH = 48, 64
DOWN = np.array([1.0, 0.0, 0.0, 0.0])
HORIZON, DT_S = 4, 0.1
CHUNK_MS, CHUNKS = 200, 10
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


def write_run(
    path: Path,
    *,
    of: ModelSpec | None = None,
    prompts: Sequence[str] = PROMPTS,
    silent: Sequence[int] = (),
    with_spec: bool = True,
    ended: Mapping[str, Any] | None = None,
) -> Path:
    """One activation of 2 s for each prompt, half a second of rest after each.

    Args:
        path: of the file.
        of: what the steps mean.
        prompts: of the activations.
        silent: chunks that were never published, in each activation.
        with_spec: the worker says what its steps mean.
        ended: what stands at its end beside what was dropped.
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
            active = Task(number + 1, True, prompt, "teacher", 5.0)
            samples.append(put(KEYS.task, active, at_ms, at_ms))
        idle = Task(number + 1, False, prompt, "teacher", 5.0)
        samples.append(put(KEYS.task, idle, begin_ms + lasts_ms, begin_ms + lasts_ms))
        for chunk in range(CHUNKS):
            if chunk in silent:
                continue
            seen_ms = begin_ms + CHUNK_MS * chunk + 5
            seen_ns, seq = ZERO_NS + seen_ms * MS, seq + 1
            times = (seen_ns + MS, seen_ns + 2 * MS, seen_ns + 30 * MS)
            steps = steps_of(number, chunk, said.action.dimension)
            made = ActionChunk(
                "teacher", said.hash, number + 1, seen_ns, seq, seen_ns + 10**9, steps, *times
            )
            samples.append(put(KEYS.delta("teacher"), made, seen_ms + 31, seq))
            cause = Cause("teacher", seq, seen_ns, *times, seen_ns + 31 * MS, seen_ns + 32 * MS)
            place = np.array([0.4, 0.0, 0.3])
            still = np.zeros(6)
            command = PoseCommand(place, DOWN, still, still, place, DOWN, "active", cause)
            samples.append(put(KEYS.command_pose, command, seen_ms + 33, seq))
    for at_ms in range(0, end_ms, 10):
        pose = PoseState(np.array([0.4, 0.0, at_ms / 1e4]), DOWN, np.zeros(6))
        samples.append(put(KEYS.state_pose, pose, at_ms, at_ms))
        samples.append(put(KEYS.state_gripper, GripperState(0.05, False, False), at_ms, at_ms))
    for number in range(end_ms // 50):
        at_ns = ZERO_NS + 50 * number * MS
        header = Header(at_ns, number, "camera#1")
        key = KEYS.camera_jpeg("front")
        samples.append(Sample(key, picture(number), JPEG, header, at_ns + MS))
    out = RecordingWriter(path, KEYS, profile_yaml="", base_frame="base", began_ns=ZERO_NS)
    for sample in sorted(samples, key=lambda each: each.received_ns):
        out.write(sample)
    out.finish({"dropped": {}, **(ended or {})})
    return path
