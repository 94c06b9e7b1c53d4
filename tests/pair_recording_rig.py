"""A recorded run of two arms whose steps and states are known, written sample by sample."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from dataset_rig import (
    CHUNK_MS,
    CHUNKS,
    DT_S,
    HORIZON,
    LATENCY_MS,
    MS,
    ZERO_NS,
    picture,
    put,
    steps_of,
)

from vla_zenoh.keys import Keys
from vla_zenoh.lab.recording.sample import JPEG, Sample
from vla_zenoh.lab.recording.writer import RecordingWriter
from vla_zenoh.policy import ActionSpec, ModelSpec, ObservationSpec
from vla_zenoh.profile import load_profile, override
from vla_zenoh.profile.load import to_yaml
from vla_zenoh.types import (
    ActionChunk,
    Cause,
    GripperState,
    Header,
    JointCommand,
    JointState,
    PoseState,
    Task,
)

KEYS = Keys("pair")
JOINTS = ("joint1", "joint2")
BEGIN_MS, END_MS = 500, 500 + CHUNK_MS * CHUNKS
SPEED_M_S = {"left": 0.1, "right": 0.2}
"""Of each TCP along z, from the beginning of the recording."""
WIDTH_M = {"left": 0.05, "right": 0.02}
PROMPT = "lift the bar"
DOWN = np.array([1.0, 0.0, 0.0, 0.0])


def pair_spec(bare: str = "", **action: object) -> ModelSpec:
    """Two joints and a gripper of each part, but for the one that is `bare`."""
    fields = {"space": "joint", "joints": JOINTS, "kind": "absolute", "gripper": "absolute_m"}
    own = ActionSpec(horizon=HORIZON, dt_s=DT_S, **{**fields, **action})  # pyright: ignore
    return ModelSpec(
        name="pair_model",
        observation=ObservationSpec(state=("joint", "gripper"), prompt=True),
        action=ActionSpec.of_parts(
            {
                part: own.model_copy(update={"gripper": "none"}) if part == bare else own
                for part in ("left", "right")
            }
        ),
    )


def joints_rad(part: str, at_ms: float) -> np.ndarray:
    """Measured at a time."""
    return np.array([SPEED_M_S[part], -SPEED_M_S[part]]) * at_ms / 1e3


def write_pair_run(
    path: Path, *, of: ModelSpec | None = None, silent: Sequence[int] = (), bare: str = ""
) -> Path:
    """One activation; chunks in `silent` were never published, part `bare` has no gripper."""
    spec = of or pair_spec(bare)
    without = {"parts": {bare: {"robot": {"gripper": None, "finger_joints": []}}}} if bare else {}
    profile_yaml = to_yaml(override(load_profile("two_pandas_sim"), without))
    samples = [put(KEYS.spec("pair_model"), spec, 0, 0)]
    for at_ms in range(BEGIN_MS, END_MS, 100):
        task = Task(1, True, PROMPT, "pair_model", 5.0)
        samples.append(put(KEYS.task, task, at_ms, at_ms))
    samples.append(put(KEYS.task, Task(1, False, PROMPT, "pair_model", 5.0), END_MS, END_MS))
    still = np.zeros(2)
    for chunk in range(CHUNKS):
        if chunk in silent:
            continue
        seen_ms = BEGIN_MS + CHUNK_MS * chunk + 5
        seen_ns = ZERO_NS + seen_ms * MS
        times = (seen_ns + MS, seen_ns + 2 * MS, seen_ns + 30 * MS)
        steps = steps_of(0, chunk, spec.action.dimension)
        worker = ("pair_model", spec.hash, 1, seen_ns, chunk + 1, seen_ns + 10**9, steps)
        samples.append(
            put(
                KEYS.delta("pair_model"),
                ActionChunk(*worker, *times),
                seen_ms + LATENCY_MS,
                1 + chunk,
            )
        )
        cause = Cause(
            "pair_model", chunk + 1, seen_ns, *times, seen_ns + LATENCY_MS * MS, seen_ns + 32 * MS
        )
        for part in SPEED_M_S:
            command = JointCommand(JOINTS, joints_rad(part, seen_ms), still, still, "active", cause)
            samples.append(put(KEYS.of_part(part).command_joint, command, seen_ms + 33, chunk))
    for at_ms in range(0, END_MS + 500, 10):
        for part, speed_m_s in SPEED_M_S.items():
            keys, place = KEYS.of_part(part), np.array([0.4, 0.0, speed_m_s * at_ms / 1e3])
            twist = np.array([0.0, 0.0, speed_m_s, 0.0, 0.0, 0.0])
            states = {
                keys.state_pose: PoseState(place, DOWN, twist),
                keys.state_joint: JointState(JOINTS, joints_rad(part, at_ms), still, still),
                keys.state_gripper: GripperState(
                    None if part == bare else WIDTH_M[part], False, False
                ),
            }
            samples += [put(key, state, at_ms, at_ms) for key, state in states.items()]
    for number in range((END_MS + 500) // 50):
        at_ns = ZERO_NS + 50 * number * MS
        header = Header(at_ns, number, "camera#1")
        samples.append(Sample(KEYS.camera_jpeg("front"), picture(number), JPEG, header, at_ns + MS))
    out = RecordingWriter(
        path, KEYS, profile_yaml=profile_yaml, base_frame="base", began_ns=ZERO_NS
    )
    for sample in sorted(samples, key=lambda each: each.received_ns):
        out.write(sample)
    out.finish({"dropped": {}})
    return path
