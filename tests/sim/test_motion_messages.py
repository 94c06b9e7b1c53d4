"""Messages that come late, early, twice, in disorder, in a heap, dated wrongly or broken.

Rows of the fault table in docs/design.md; each looks at the arm itself in MuJoCo.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from arm_rig import (
    HOLD,
    SPEED_M_S,
    STARTED_S,
    STARVED,
    STEP_M,
    STILL_M_S,
    UP,
    Asked,
    after,
    begin,
    check_motion,
    check_stop,
    chunks_only,
    delayed,
    later,
    mark,
    moving,
    path_m,
    speed_m_s,
    undisturbed,
    way_m,
    with_fields,
)
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Message

from vla_zenoh.codec import message
from vla_zenoh.types import (
    ActionChunk,
    GripperState,
    Image,
    PoseCommand,
    PoseState,
)

EXACT_M = 1e-3
AFTER_S = 0.5
WORKER = "worker-scripted"


def settled_height_m(loop: Lockstep) -> float:
    """Where it stands when nothing more is asked."""
    loop.put("prompt", HOLD)
    loop.run(0.8)
    assert speed_m_s(loop)[-1] < STILL_M_S
    return float(path_m(loop)[-1, 2])


@pytest.mark.long
def test_late_chunks_cost_time_and_no_way() -> None:
    loop = moving(0.6)
    start_m, steps = path_m(loop)[0, 2], loop.commander.progress.steps
    assert steps >= 5
    loop.tamper = delayed(0.2, ActionChunk)
    loop.run(0.6)
    steps = loop.commander.progress.steps  # a new prompt counts anew
    loop.tamper = None
    assert settled_height_m(loop) - start_m == pytest.approx(STEP_M * steps, abs=EXACT_M)
    check_motion(loop)


@pytest.mark.long
def test_a_camera_that_repeats_one_image_with_new_stamps_stops_the_arm() -> None:
    first: dict[str, Message] = {}

    def repeated(sent: Message) -> Iterable[Message]:
        if sent.kind is not Image:
            return [sent]
        shown = first.setdefault(sent.camera, sent)
        return [replace(sent, payload=shown.payload)]

    loop = moving()
    loop.tamper = repeated
    loop.run(1.7)
    (event,) = [event for event in loop.events if event.what == "same_image"]
    assert "while the arm moves" in event.why
    assert speed_m_s(loop)[-1] < STILL_M_S
    check_motion(loop)


def test_duplicates_at_once_and_much_later_move_nothing() -> None:
    def again(sent: Message) -> Iterable[Message]:
        if sent.kind in (ActionChunk, PoseCommand):
            return [sent, sent, later(sent, 0.15)]
        return [sent, sent] if sent.kind in (PoseState, GripperState) else [sent]

    np.testing.assert_array_equal(after(AFTER_S, again), undisturbed(AFTER_S))


@pytest.mark.long
def test_a_chunk_that_is_overtaken_is_left_out_and_nothing_jumps() -> None:
    loop = moving(0.6)
    start_m = path_m(loop)[0, 2]
    loop.tamper = chunks_only(
        lambda sent: [later(sent, 0.25) if sent.header.seq % 4 == 0 else sent]
    )
    loop.run(1.0)
    steps = loop.commander.progress.steps
    loop.tamper = None
    assert loop.refused["replayed"] >= 2
    # One that was left out had been seen by no later one: its way is missing, and no more.
    assert settled_height_m(loop) - start_m == pytest.approx(STEP_M * steps, abs=EXACT_M)
    check_motion(loop)


@pytest.mark.long
def test_commands_in_disorder_do_not_shake_the_arm() -> None:
    mixed = after(
        AFTER_S,
        lambda sent: [
            later(sent, 0.006) if sent.kind is PoseCommand and sent.header.seq % 3 == 0 else sent
        ],
    )
    assert np.abs(mixed - undisturbed(AFTER_S)).max() < EXACT_M


@pytest.mark.long
def test_a_heap_of_chunks_after_a_pause_is_not_made_up_for() -> None:
    loop = moving(steps=1)
    since = mark(loop)
    free_ns = loop.now_ns + 1_000_000_000
    loop.tamper = chunks_only(
        lambda sent: [replace(sent, arrival_ns=max(sent.arrival_ns, free_ns))]
    )
    loop.run(0.95)
    check_stop(loop, since, STARVED)
    waiting = mark(loop)
    loop.run(0.35)
    # Chunks lay there, fresh enough, made by a model that saw an arm that stood.
    assert way_m(loop, waiting) < 0.35 * SPEED_M_S + STEP_M
    assert speed_m_s(loop)[waiting:].max() < 1.5 * SPEED_M_S
    loop.run(0.2)
    assert speed_m_s(loop)[-1] > 0.5 * SPEED_M_S
    check_motion(loop)


def test_a_second_worker_moves_nothing_while_the_first_has_the_arm() -> None:
    loop = begin(UP, others={"other": Asked("other", horizon=8)})
    for duration_s in (STARTED_S, AFTER_S):
        loop.run(duration_s)
    check_motion(loop)
    np.testing.assert_array_equal(path_m(loop), undisturbed(AFTER_S))


@pytest.mark.long
def test_a_second_process_under_the_name_of_the_worker_moves_nothing() -> None:
    def forge(sent: Message) -> Iterable[Message]:
        header = replace(sent.header, source="worker-scripted-2", seq=sent.header.seq + 100)
        steps = -np.array(message.unpack(sent.payload)["steps"])
        return [sent, replace(with_fields(sent, steps=steps), header=header)]

    np.testing.assert_array_equal(after(AFTER_S, chunks_only(forge)), undisturbed(AFTER_S))


# -- NaN, infinity, quaternions -------------------------------------------------------------------
NO_ROTATION = {"quat_xyzw": np.array([0.9, 0.0, 0.0, 0.0])}


def test_the_undisturbed_arm_keeps_the_speed_that_is_asked_for() -> None:
    speed_m_s = np.diff(undisturbed(AFTER_S)[-25:, 2]) * 250
    assert np.abs(speed_m_s - SPEED_M_S).max() < 0.1 * SPEED_M_S
