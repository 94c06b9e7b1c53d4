"""How far two workers are apart: the same motion is no difference, however it is said."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from vla_zenoh_benchmarks.disagreement import (
    ArmState,
    Disagreement,
    disagreement,
)

from vla_zenoh.kinematics.so3 import Pose, exp3, quat_from_rotation
from vla_zenoh.policy import ActionSpec
from vla_zenoh.types import ActionChunk

ATOL_M, ATOL_RAD = 1e-6, 1e-6
"""Steps travel as float32."""
MS = 1_000_000
START_NS = 10**18
MAX_WIDTH_M = 0.08
START = ArmState(Pose(np.array([0.45, 0.1, 0.3]), exp3(np.array([3.1, 0.2, 0.1]))), 0.05)

DELTA = ActionSpec(horizon=8, dt_s=0.1, gripper="absolute_m")
ABSOLUTE = ActionSpec(
    horizon=8, dt_s=0.1, kind="absolute", rotation="quaternion", gripper="absolute_m"
)
IN_TCP = ActionSpec(horizon=8, dt_s=0.1, frame="tcp", gripper="absolute_m")


def chunk(steps: Sequence[Sequence[float]] | np.ndarray, at_ms: float = 0.0) -> ActionChunk:
    stamp_ns = START_NS + round(at_ms * MS)
    return ActionChunk("m", "h", 1, stamp_ns, 0, stamp_ns, np.array(steps), 0, 0, 0)


def apart(
    a: ActionChunk | list[ActionChunk],
    b: ActionChunk | list[ActionChunk],
    spec_a: ActionSpec = DELTA,
    spec_b: ActionSpec = DELTA,
) -> Disagreement:
    return disagreement(
        a if isinstance(a, list) else [a],
        b if isinstance(b, list) else [b],
        spec_a,
        spec_b,
        lambda _: START,
        max_width_m=MAX_WIDTH_M,
    )


UP = [[0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.08]] * 4
SIDE = [[0.0, 0.01, 0.0, 0.0, 0.0, 0.0, 0.08]] * 4
DOWN = [[0.0, 0.0, -0.01, 0.0, 0.0, 0.0, 0.0]] * 4


def test_a_worker_agrees_with_itself() -> None:
    found = apart(chunk(UP), chunk(UP))
    assert found.pairs == 1
    assert (found.distance_m, found.angle_rad) == pytest.approx((0.0, 0.0))
    assert found.cosine == pytest.approx(1.0)
    assert found.gripper == 0.0
    assert found.after_s == pytest.approx(0.4)


def test_opposite_ways_are_told_by_bias_and_cosine() -> None:
    found = apart(chunk(UP), chunk(DOWN))
    assert found.bias is not None
    assert found.bias[:3] == pytest.approx([0.0, 0.0, -0.08], abs=ATOL_M)
    assert found.cosine == pytest.approx(-1.0)
    assert found.gripper == 1.0
    assert apart(chunk(UP), chunk(SIDE)).cosine == pytest.approx(0.0, abs=1e-6)


def test_deltas_and_absolute_poses_of_one_motion_are_the_same() -> None:
    said = []
    position, rotation = START.pose
    for _ in range(4):
        position = position + (0.0, 0.0, 0.01)
        rotation = exp3(np.array([0.0, 0.0, 0.05])) @ rotation
        said.append([*position, *quat_from_rotation(rotation), 0.08])
    turning = [[0.0, 0.0, 0.01, 0.0, 0.0, 0.05, 0.08]] * 4
    found = apart(chunk(turning), chunk(said), DELTA, ABSOLUTE)
    assert found.distance_m == pytest.approx(0.0, abs=ATOL_M)
    assert found.angle_rad == pytest.approx(0.0, abs=ATOL_RAD)


def test_a_way_in_the_tcp_frame_is_turned_into_the_base_frame() -> None:
    along = START.pose.rotation.T @ np.array([0.0, 0.0, 0.01])
    found = apart(chunk(UP), chunk([[*along, 0.0, 0.0, 0.0, 0.08]] * 4), DELTA, IN_TCP)
    assert found.distance_m == pytest.approx(0.0, abs=ATOL_M)


def test_one_step_is_compared_with_the_first_of_many_and_other_durations_by_time() -> None:
    one = ActionSpec(horizon=1, dt_s=0.1, gripper="absolute_m")
    assert apart(chunk(UP[:1]), chunk(UP), one, DELTA).distance_m == pytest.approx(0, abs=ATOL_M)
    slow = ActionSpec(horizon=1, dt_s=0.4, gripper="none")
    found = apart(chunk([[0.0, 0.0, 0.04, 0.0, 0.0, 0.0]]), chunk(UP), slow, DELTA)
    assert found.distance_m == pytest.approx(0.0, abs=ATOL_M)
    assert found.gripper is None


def test_who_stands_still_has_no_direction() -> None:
    found = apart(chunk([[0.0] * 6 + [0.08]]), chunk(UP))
    assert found.cosine is None
    assert found.moving == 0


def test_what_has_no_meaning_is_counted() -> None:
    found = apart(chunk(UP), chunk([[0.0] * 6 + [9.0]]))
    assert (found.pairs, found.unreadable, found.mean) == (1, 1, None)


def test_nearest_observations_are_paired_once_and_far_ones_not() -> None:
    a = [chunk(UP, at_ms) for at_ms in (0, 200, 400, 1000)]
    b = [chunk(UP, at_ms) for at_ms in (30, 210, 225, 600)]
    found = apart(a, b)
    assert (found.pairs, found.only_a, found.only_b) == (2, 2, 2)
    assert found.apart_s == pytest.approx(0.02)


@given(
    st.lists(st.integers(0, 3000), max_size=30),
    st.lists(st.integers(0, 3000), max_size=30),
)
def test_every_chunk_is_counted_once(times_a: list[int], times_b: list[int]) -> None:
    found = apart([chunk(UP, t) for t in times_a], [chunk(UP, t) for t in times_b])
    assert found.pairs + found.only_a == len(times_a)
    assert found.pairs + found.only_b == len(times_b)
    assert found.apart_s <= 0.06
