"""What a model says of itself is shown whatever it is, and never breaks the worker."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
import zenoh
from camera_rig import await_match, routed_session, until
from vla_zenoh_diagnose.inference_views import MAX_WAITING, PendingImages

from vla_zenoh.bus.node import Node
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError, RecordError
from vla_zenoh.nodes.worker.node import InferenceDebugPublisher
from vla_zenoh.policy import (
    MAX_CAMERAS,
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.policy.inference import make_chunk
from vla_zenoh.profile import load_profile
from vla_zenoh.types import Header, InferenceDebug, Task
from vla_zenoh.types.records import plain_values

PICTURE = np.zeros((24, 32, 3), np.uint8)
LOOK = ModelSpec(
    name="look",
    observation=ObservationSpec(cameras=(CameraSpec(camera="front"),)),
    action=ActionSpec(horizon=1, dt_s=0.1, rotation="rpy", gripper="none"),
)


class Tensor:
    """Like one of another device: numpy cannot read it."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    def __repr__(self) -> str:
        return "tensor(cuda)"


def seen(**fields: Any) -> InferenceDebug:
    given: dict[str, Any] = {
        "worker": "openvla",
        "chunk_seq": 7,
        "spec_hash": "68bc1fea58b3f857",
        "episode": 2,
        "observation_stamp_ns": 10**18,
        "prompt": "put the red brick in the box",
        "steps": np.arange(14, dtype=np.float32).reshape(2, 7),
        "inference_ms": 83.5,
        **fields,
    }
    return InferenceDebug(**given)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (np.array([31744, 31999]), [31744, 31999]),
        (np.array([[0.5, -1.0]], np.float32), [[0.5, -1.0]]),
        ([1, 2], [1, 2]),
        ("text", "text"),
        (None, None),
        (True, True),
        (np.bool_(True), True),
        (float("nan"), "nan"),
        (np.array([1.0, np.inf]), "[1.0, inf]"),
        (np.zeros((3, 3, 3)), None),
        (np.zeros(5000), "float64 of shape (5000,)"),
        ({"normalised": np.float32(0.25)}, {"normalised": 0.25}),
        (Tensor(), "tensor(cuda)"),
        (10**30, str(10**30)),
    ],
)
def test_whatever_a_model_tells_is_text_numbers_and_lists(given: Any, said: Any) -> None:
    raw = plain_values({"it": given})
    assert said is None or raw["it"] == said
    again = records.decode(InferenceDebug, records.encode(seen(raw=raw)))
    assert again.raw == raw


@pytest.mark.parametrize(
    "told",
    [
        {"raw": [1, 2]},
        {"raw": "a thought"},
        {"raw": np.zeros(3)},
        {"pictures": {"front": Tensor()}},
        {"pictures": {"front": [[1], [2, 3]]}},
        {"pictures": [np.zeros((4, 4, 3), np.uint8)]},
    ],
)
def test_what_a_model_shows_of_itself_is_shown_or_rejected_and_the_worker_lives(
    told: dict[str, Any],
) -> None:
    profile = load_profile("panda_sim")
    observation = Observation(1, 1, Task(1, True, "", "look", 5.0), images={"front": PICTURE})
    steps = np.zeros((1, 6), np.float32)
    chunk = make_chunk("look", LOOK, observation, steps, False, patience_s=1.0, times_ns=(1, 1, 1))
    with routed_session() as session:
        node = Node("worker-look", profile, session)
        shown = InferenceDebugPublisher(node, "look", LOOK)
        heard = session.declare_subscriber(
            profile.keys.all_seen_records, zenoh.handlers.RingChannel(9)
        )
        pictures = session.declare_subscriber(profile.keys.all_seen, zenoh.handlers.RingChannel(9))
        await_match(session, profile.keys.seen_record("look"))
        await_match(session, profile.keys.seen("look", "front"))
        shown.publish(observation, ActionSteps(steps, **told), Header(1, 1, "look#1"), chunk)
        assert node.counters["refused.seen"] == ("pictures" in told)
        if "raw" in told:
            until("the record", heard.try_recv)
        pictures.undeclare()
        node.close()


def test_it_travels_and_comes_back() -> None:
    sent = seen(raw={"tokens": [1, 2]}, done=True)
    came = records.decode(InferenceDebug, records.encode(sent))
    np.testing.assert_array_equal(came.steps, sent.steps)
    for name in ("worker", "chunk_seq", "prompt", "raw", "done", "inference_ms"):
        assert getattr(came, name) == getattr(sent, name)


@pytest.mark.parametrize(
    "fields", [{"steps": [1.0]}, {"steps": [["a"]]}, {"inference_ms": -1.0}, {"prompt": 3}]
)
def test_what_is_no_such_record_is_refused(fields: dict[str, Any]) -> None:
    with pytest.raises(RecordError):
        seen(**fields)


def test_foreign_bytes_are_refused() -> None:
    with pytest.raises(CodecError):
        records.decode(InferenceDebug, b"\x81\xa1a\x01")


def test_a_worker_that_names_more_cameras_than_a_model_can_have_is_refused() -> None:
    kept = PendingImages(Counter())
    for number in range(MAX_CAMERAS):
        kept.add("liar", 1, f"cam{number}", b"jpeg")
    with pytest.raises(CodecError, match="more than 16"):
        kept.add("liar", 1, "one_more", b"jpeg")
    kept.add("liar", 1, "cam0", b"newer")
    kept.add("liar", 2, "one_more", b"jpeg")
    found = kept.pop("liar", 1)
    assert len(found) == MAX_CAMERAS
    assert found["cam0"] == b"newer"


def test_pictures_without_a_record_are_counted_and_fill_nothing() -> None:
    left_out: Counter[str] = Counter()
    kept = PendingImages(left_out, limit=1000)
    for seq in range(MAX_WAITING + 2):
        kept.add("worker", seq, "front", b"x")
    assert left_out == {"no_record": 2}
    kept.add("worker", 100, "front", b"x" * 999)
    assert left_out == {"no_record": 2 + MAX_WAITING - 1}
    kept.add("worker", 100, "front", b"x" * 10)  # in place of the large one
    kept.add("worker", 101, "front", b"x" * 989)
    assert left_out == {"no_record": 2 + MAX_WAITING - 1}
    assert {camera: len(jpeg) for camera, jpeg in kept.pop("worker", 101).items()} == {"front": 989}
    assert kept.pop("worker", 101) == {}
    kept.add("worker", 102, "front", b"x" * 989)
    assert left_out == {"no_record": 2 + MAX_WAITING - 1}
