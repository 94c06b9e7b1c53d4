"""A history of observations: at its declared times, of its own episode, or a reason why not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from vla_zenoh_policy_servers.state_vector import StateNumbers, read_parts

from vla_zenoh.policy import ActionSpec, CameraSpec, ModelSpec, Observation, ObservationSpec
from vla_zenoh.policy.observation import MAX_PICTURES, NotReady, Streams, assemble
from vla_zenoh.types import Header, Image, JointState, PoseState, Stamped, Task

MS = 1_000_000
NOW_NS = 10**15
TASK = Task(episode=1, active=True, prompt="hold", worker="w", rate_hz=5.0)
LONG_AGO_MS = 10_000


def spec(**fields: Any) -> ModelSpec:
    looks = ObservationSpec(
        **{
            "cameras": (CameraSpec(camera="front"),),
            "state": ("pose",),
            "history": 3,
            "history_spacing_s": 0.1,
            "max_skew_s": 0.04,
            **fields,
        }
    )
    return ModelSpec(name="w", observation=looks, action=ActionSpec(horizon=1, dt_s=0.1))


def received(wanted: ModelSpec, pictures_ms: Any, states_ms: Any) -> Streams:
    """Pictures whose grey level, and poses whose x, say how many ms ago they were taken."""
    streams = Streams.of(wanted.observation)
    for ago in sorted(pictures_ms, reverse=True):
        header = Header(NOW_NS - ago * MS, LONG_AGO_MS - ago, "camera")
        image = Image(np.full((2, 2, 3), ago // 4 % 256, np.uint8))
        streams.images["front"].add(Stamped(header, image, NOW_NS))
    for ago in sorted(states_ms, reverse=True):
        header = Header(NOW_NS - ago * MS, LONG_AGO_MS - ago, "sim")
        pose = PoseState(
            np.array([ago / 1e3, 0.0, 0.0]),
            np.array([1.0, 0, 0, 0]),
            np.zeros(6),
            wrench=np.arange(6.0),
        )
        streams.states["pose"].add(Stamped(header, pose, NOW_NS))
    return streams


def look(
    wanted: ModelSpec, streams: Streams, began_ms: int = LONG_AGO_MS
) -> Observation | NotReady:
    began_ns = NOW_NS - began_ms * MS
    return assemble(
        wanted, TASK, streams, not_before_ns=began_ns, now_ns=NOW_NS, episode_ns=began_ns
    )


def ages_ms(seen: Observation | NotReady) -> list[int]:
    assert isinstance(seen, Observation), seen
    return [(NOW_NS - each.stamp_wall_ns) // MS for each in (*seen.history, seen)]


AT_30_HZ = range(7, 400, 33)
AT_200_HZ = range(0, 400, 5)


def test_each_observation_is_the_nearest_to_its_time_with_the_state_of_that_time() -> None:
    seen = look(spec(), received(spec(), AT_30_HZ, AT_200_HZ))
    assert ages_ms(seen) == [205, 106, 7]
    assert isinstance(seen, Observation)
    for each, ago in zip(seen.history, (205, 106), strict=True):
        assert each.images["front"][0, 0, 0] == ago // 4
        assert each.pose is not None
        assert each.pose.position_m[0] * 1e3 == pytest.approx(ago, abs=3)
        assert each.history == ()
        assert each.seq == LONG_AGO_MS - ago


def test_a_model_without_a_history_gets_none_and_keeps_one_picture() -> None:
    alone = spec(history=1, history_spacing_s=None)
    streams = received(alone, AT_30_HZ, AT_200_HZ)
    assert len(streams.images["front"].entries) == 1
    seen = look(alone, streams)
    assert isinstance(seen, Observation)
    assert seen.history == ()


def test_at_the_start_of_an_episode_its_first_observation_is_repeated() -> None:
    streams = received(spec(), AT_30_HZ, AT_200_HZ)
    # Pictures were taken 7, 40, 73, 106 ms ago and so on, the episode began 50 ms ago.
    assert ages_ms(look(spec(), streams, began_ms=50)) == [40, 40, 7]
    assert ages_ms(look(spec(), streams, began_ms=39)) == [7, 7, 7]
    assert ages_ms(look(spec(), streams, began_ms=150)) == [139, 106, 7]


def test_a_model_that_waits_is_asked_when_the_episode_is_old_enough() -> None:
    patient = spec(history_start="wait")
    streams = received(patient, AT_30_HZ, AT_200_HZ)
    early = look(patient, streams, began_ms=150)
    assert isinstance(early, NotReady)
    assert early.waiting
    assert early.why == "the episode is younger than 0.2 s"
    assert ages_ms(look(patient, streams, began_ms=300)) == [205, 106, 7]


def test_a_gap_in_a_stream_is_named_with_its_age() -> None:
    frozen = [ago for ago in AT_30_HZ if not 60 < ago < 150]
    seen = look(spec(), received(spec(), frozen, AT_200_HZ))
    assert isinstance(seen, NotReady)
    assert not seen.waiting
    assert "camera 'front' has nothing within 0.04 s of the time 0.1 s ago" in seen.why
    lost = [ago for ago in AT_200_HZ if not 50 < ago < 300]
    seen = look(spec(), received(spec(), AT_30_HZ, lost))
    assert isinstance(seen, NotReady)
    assert "history: state/pose has nothing" in seen.why


def test_half_a_spacing_is_the_most_whatever_skew_is_allowed() -> None:
    loose = spec(max_skew_s=1.0)
    slow = range(7, 400, 66)
    assert "within 0.05 s" in (
        found.why
        if isinstance(found := look(loose, received(loose, (7, 170, 230), AT_200_HZ)), NotReady)
        else ""
    )
    assert len(ages_ms(look(loose, received(loose, slow, AT_200_HZ)))) == 3


def test_without_pictures_states_have_a_history() -> None:
    blind = spec(cameras=(), state=("pose",))
    streams = Streams.of(blind.observation)
    streams.states["pose"].entries.extend(received(spec(), (), AT_200_HZ).states["pose"].entries)
    assert ages_ms(look(blind, streams)) == [200, 100, 0]


def test_what_is_kept_is_bounded_in_time_and_number() -> None:
    long = spec(history=11, history_spacing_s=0.2)
    streams = received(long, range(0, 9_000, 33), range(0, 9_000, 1))
    assert len(streams.images["front"].entries) <= 2.5 * 30
    assert streams.states["pose"].entries[0].header.stamp_wall_ns <= NOW_NS - 2000 * MS
    assert len(streams.states["pose"].entries) <= 4096
    fast = received(long, range(0, 2_000, 1), range(0, 100, 1))
    assert len(fast.images["front"].entries) <= MAX_PICTURES


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"history": 2, "history_spacing_s": None}, "go together"),
        ({"history": 1, "history_spacing_s": 0.1}, "go together"),
        ({"history": 16, "history_spacing_s": 0.2}, "span 3 s, at most 2 s are kept"),
        ({"cameras": (), "state": ()}, "a history needs cameras or state"),
        ({"history": 17}, "less than or equal to 16"),
    ],
)
def test_a_history_that_cannot_be_is_an_error(fields: dict[str, Any], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        spec(**fields)


# -- wrench and effort ----------------------------------------------------------------------------
def test_a_wrench_is_an_input_of_its_own_and_needs_no_pose() -> None:
    felt = spec(state=("wrench",))
    seen = look(felt, received(felt, AT_30_HZ, AT_200_HZ))
    assert isinstance(seen, Observation)
    assert seen.pose is None
    assert seen.wrench is not None
    np.testing.assert_array_equal(seen.wrench, np.arange(6.0))
    assert all(each.wrench is not None for each in seen.history)
    vector = StateNumbers(read_parts("wrench+zero"), (), 0.08).encode(seen)
    np.testing.assert_array_equal(vector, [0, 1, 2, 3, 4, 5, 0])


def test_what_the_robot_does_not_measure_is_named() -> None:
    felt = spec(cameras=(), state=("effort",), history=1, history_spacing_s=None)
    streams = Streams.of(felt.observation)
    header = Header(NOW_NS - 5 * MS, 1, "arm")
    for effort in (None, np.array([1.5, -2.0])):
        joints = JointState(("a", "b"), np.zeros(2), np.zeros(2), effort)
        streams.states["joint"].entries[:] = [Stamped(header, joints, NOW_NS)]
        seen = look(felt, streams)
        if effort is None:
            assert isinstance(seen, NotReady)
            assert seen.why == ("state/joint holds no effort_nm: this robot does not measure it")
        else:
            assert isinstance(seen, Observation)
            assert seen.joint is None
            np.testing.assert_array_equal(
                StateNumbers(read_parts("effort"), (), 0.08).encode(seen),
                np.array([1.5, -2.0], np.float32),
            )
