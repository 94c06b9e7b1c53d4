"""Hypothesis strategies: a valid record of every kind that travels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vla_zenoh.errors import CodecError
from vla_zenoh.policy import (
    ROTATION_SIZE,
    ActionSpec,
    CameraSpec,
    ModelSpec,
    ObservationSpec,
    StatePart,
)
from vla_zenoh.types import (
    ActionChunk,
    Cause,
    ClockReply,
    Event,
    GripperCommand,
    GripperState,
    Header,
    Image,
    InferenceDebug,
    JointCommand,
    JointState,
    NodeStatus,
    ObjectPoses,
    PoseCommand,
    PoseState,
    PrivilegedState,
    SceneState,
    Task,
)
from vla_zenoh.types.stream import EVENT_KINDS, EVENT_LEVELS

MAX_COMPONENT = 1e6

finite = st.floats(-MAX_COMPONENT, MAX_COMPONENT)
texts = st.text(st.characters(exclude_categories=("Cs",)), max_size=40)
counts = st.integers(0, 2**63 - 1)


def vectors(size: int) -> st.SearchStrategy[np.ndarray[Any, Any]]:
    return hnp.arrays(np.float64, size, elements=finite)


@st.composite
def quaternions(draw: st.DrawFn) -> np.ndarray[Any, Any]:
    raw = draw(hnp.arrays(np.float64, 4, elements=st.floats(-1, 1)))
    norm = float(np.linalg.norm(raw))
    return raw / norm if norm > 1e-3 else np.array([0.0, 0.0, 0.0, 1.0])


headers = st.builds(Header, counts, counts, texts)
images = st.tuples(st.integers(1, 24), st.integers(1, 24)).flatmap(
    lambda size: hnp.arrays(np.uint8, (*size, 3)).map(Image)
)


@st.composite
def joint_states(draw: st.DrawFn) -> JointState:
    names = draw(st.lists(texts, min_size=1, max_size=9, unique=True))
    size = len(names)
    return JointState(
        tuple(names),
        draw(vectors(size)),
        draw(vectors(size)),
        draw(vectors(size)),
        draw(st.none() | vectors(size)),
        tuple(draw(st.lists(st.sampled_from(names), unique=True))),
        tuple(draw(st.lists(st.sampled_from(names), unique=True))),
    )


@st.composite
def pose_states(draw: st.DrawFn) -> PoseState:
    reference = draw(st.booleans())
    return PoseState(
        draw(vectors(3)),
        draw(quaternions()),
        draw(vectors(6)),
        draw(st.none() | vectors(6)),
        draw(vectors(3)) if reference else None,
        draw(quaternions()) if reference else None,
    )


causes = st.builds(Cause, texts, *[counts] * 7)


@st.composite
def pose_commands(draw: st.DrawFn) -> PoseCommand:
    return PoseCommand(
        draw(vectors(3)),
        draw(quaternions()),
        draw(vectors(6)),
        draw(vectors(6)),
        draw(vectors(3)),
        draw(quaternions()),
        draw(st.sampled_from(["active", "holding"])),
        draw(st.none() | causes),
    )


@st.composite
def joint_commands(draw: st.DrawFn) -> JointCommand:
    names = draw(st.lists(texts, min_size=1, max_size=9, unique=True))
    size = len(names)
    return JointCommand(
        tuple(names),
        draw(vectors(size)),
        draw(vectors(size)),
        draw(vectors(size)),
        draw(st.sampled_from(["active", "holding"])),
        draw(st.none() | causes),
    )


@st.composite
def action_chunks(draw: st.DrawFn) -> ActionChunk:
    shape = (draw(st.integers(1, 20)), draw(st.integers(1, 9)))
    steps = draw(hnp.arrays(np.float32, shape, elements=st.floats(-10, 10, width=32)))
    times = [draw(counts) for _ in range(7)]
    return ActionChunk(
        draw(texts), draw(texts), *times[:4], steps, *times[4:], done=draw(st.booleans())
    )


@st.composite
def object_poses(draw: st.DrawFn) -> ObjectPoses:
    names = draw(st.lists(texts, max_size=4))
    return ObjectPoses(
        tuple(names),
        np.array([draw(vectors(3)) for _ in names]).reshape(-1, 3),
        np.array([draw(quaternions()) for _ in names]).reshape(-1, 4),
    )


leaves = st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | finite | texts
details = st.dictionaries(
    texts,
    leaves
    | st.lists(leaves, max_size=4)
    | st.dictionaries(texts, leaves | st.dictionaries(texts, leaves, max_size=3), max_size=3),
    max_size=6,
)


def maps(values: st.SearchStrategy[Any]) -> st.SearchStrategy[dict[str, Any]]:
    return st.dictionaries(texts, values, max_size=4)


statuses = st.builds(
    NodeStatus,
    texts,
    texts,
    texts,
    counts,
    counts,
    maps(finite),
    maps(finite),
    maps(st.tuples(finite, finite)),
    maps(counts),
    details,
    texts,
)
cameras = st.builds(
    CameraSpec,
    camera=texts.filter(bool),
    width=st.just(64),
    height=st.integers(8, 64),
    resize=st.sampled_from(["none", "stretch", "pad", "crop"]),
    colour=st.sampled_from(["rgb", "bgr"]),
)
observation_specs = st.builds(
    ObservationSpec,
    cameras=st.lists(cameras, max_size=3, unique_by=lambda camera: camera.camera).map(tuple),
    state=st.lists(st.sampled_from(get_args(StatePart)), unique=True).map(tuple),
    prompt=st.booleans(),
    max_skew_s=st.floats(0.001, 10),
    max_age_s=st.floats(0.001, 10),
)
kinds_and_frames = st.sampled_from([("delta", "base"), ("delta", "tcp"), ("absolute", "base")])


@st.composite
def action_specs(draw: st.DrawFn) -> ActionSpec:
    kind, frame = draw(kinds_and_frames)
    return ActionSpec(
        horizon=draw(st.integers(1, 50)),
        dt_s=draw(st.floats(0.001, 60)),
        kind=kind,
        frame=frame,
        rotation=draw(st.sampled_from(sorted(ROTATION_SIZE))),
        position_scale_m=draw(st.floats(0.001, 10)),
        gripper=draw(st.sampled_from(["none", "delta_m", "absolute_m", "open_fraction", "binary"])),
        gripper_open_is_high=draw(st.booleans()),
        gripper_threshold=draw(finite),
        normalisation=draw(st.none() | texts.filter(bool)),
    )


model_specs = st.builds(
    ModelSpec,
    name=texts.filter(bool),
    observation=observation_specs,
    action=action_specs(),
    every_step=st.booleans(),
)

RECORDS: dict[type, st.SearchStrategy[Any]] = {
    JointState: joint_states(),
    PoseState: pose_states(),
    GripperState: st.builds(
        GripperState,
        st.floats(-0.01, 1),
        st.booleans(),
        st.booleans(),
        texts,
        st.lists(texts, max_size=3).map(tuple),
    ),
    ActionChunk: action_chunks(),
    PoseCommand: pose_commands(),
    JointCommand: joint_commands(),
    GripperCommand: st.builds(
        GripperCommand, st.floats(0, 1), st.floats(1e-4, 10), st.floats(0, 1000)
    ),
    Task: st.builds(
        *(Task, counts, st.booleans(), texts, texts, st.floats(0.01, 1000)),
        speed_percent=st.floats(0, 100),
    ),
    NodeStatus: statuses,
    Event: st.builds(
        Event,
        st.sampled_from(EVENT_LEVELS),
        st.sampled_from(EVENT_KINDS),
        texts,
        texts,
        st.none() | finite,
        st.none() | finite,
        st.integers(1, 2**63 - 1),
    ),
    PrivilegedState: st.builds(PrivilegedState, maps(st.integers(0, 40).flatmap(vectors))),
    SceneState: st.builds(
        SceneState, texts, st.integers(0, 40).flatmap(vectors), st.none() | counts
    ),
    ObjectPoses: object_poses(),
    ModelSpec: model_specs,
    InferenceDebug: st.builds(
        InferenceDebug,
        texts,
        counts,
        texts,
        counts,
        counts,
        texts,
        st.tuples(st.integers(1, 6), st.integers(1, 10)).map(
            lambda shape: np.linspace(-1, 1, shape[0] * shape[1]).reshape(shape).astype(np.float32)
        ),
        st.floats(0, 1e6),
        st.dictionaries(texts, finite | texts | st.booleans(), max_size=4),
        st.booleans(),
    ),
}
"""Records that have a key."""
ALL_RECORDS = RECORDS | {
    Cause: causes,
    ClockReply: st.builds(ClockReply, counts, counts),
    Header: headers,
}


def refusal(decode: Callable[..., Any], *arguments: Any) -> CodecError | None:
    """The CodecError that `decode` raises, None when it decodes; any other error goes on."""
    try:
        decode(*arguments)
    except CodecError as error:
        return error
    return None


def same(one: Any, other: Any) -> bool:
    """Whether two records hold the same, arrays compared bit by bit."""
    if isinstance(one, np.ndarray):
        return (
            isinstance(other, np.ndarray)
            and one.dtype == other.dtype
            and one.shape == other.shape
            and one.tobytes() == other.tobytes()
        )
    if hasattr(type(one), "__dataclass_fields__"):
        return type(one) is type(other) and all(
            same(getattr(one, name), getattr(other, name)) for name in one.__dataclass_fields__
        )
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(one[name], other[name]) for name in one)
    return type(one) is type(other) and one == other
