"""Whatever comes in: the commander never raises, its goal never leaves the workspace, and what it
streams never breaks a limit."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from command_rig import OTHER, SOURCE, WORKER, Rig
from hypothesis import given, settings
from hypothesis import strategies as st

from vla_zenoh.control.commander import Inputs, Setting
from vla_zenoh.control.limits import into_workspace
from vla_zenoh.types import ActionChunk, GripperState, Header, Stamped

BORDER_M = 1e-9
HUGE = 3.0e38  # nearly the largest float32

float32s = st.floats(width=32, allow_nan=False, allow_infinity=False)
sizes = st.one_of(st.floats(-0.05, 0.05), st.floats(-0.3, 0.3), float32s)
small_steps = st.lists(st.floats(-0.04, 0.04), min_size=7, max_size=7)
steps = st.one_of(
    st.lists(small_steps, min_size=1, max_size=16),
    st.lists(st.lists(sizes, min_size=7, max_size=7), min_size=1, max_size=20),
    st.lists(st.lists(sizes, min_size=1, max_size=9), min_size=1, max_size=1),
)
stamps_s = st.one_of(st.floats(-0.3, 0.06), st.floats(-20.0, 20.0))
chunks = st.fixed_dictionaries(
    {
        "steps": steps,
        "observed_s": stamps_s,
        "published_s": stamps_s,
        "valid_s": st.floats(-1.0, 100.0),
        "sequence": st.sampled_from([1, 1, 1, 1, 0, -3, 10**9, 2**62]),
        "source": st.sampled_from([SOURCE, SOURCE, SOURCE, "worker-other-1", "garbage", ""]),
        "worker": st.sampled_from([WORKER, WORKER, WORKER, OTHER, "ghost"]),
        "spec": st.sampled_from(["", "", "", "another"]),
        "episode": st.sampled_from([0, 0, 0, 0, -1, 1]),
    }
)
put = st.one_of(
    st.tuples(st.just("active"), st.booleans() | st.sampled_from([None, "true", 1.0])),
    st.tuples(st.sampled_from(["stop", "reset", "lose", "nonsense"]), st.none()),
    st.tuples(st.just("rate"), st.floats() | st.none()),
    st.tuples(st.sampled_from(["speed", "slower"]), st.floats(0, 100) | st.floats() | st.none()),
    st.tuples(st.just("prompt"), st.text(max_size=20)),
    st.tuples(st.just("worker"), st.sampled_from([WORKER, OTHER, "ghost", ""])),
)
events = st.lists(
    st.one_of(
        chunks,
        chunks,
        chunks,
        put,
        st.just("activate"),
        st.just("lose a node"),
        st.just("find it"),
        st.just("fault"),
        st.just("repair"),
        st.just("block"),
        st.just("free"),
        st.integers(1, 60),
    ),
    min_size=5,
    max_size=60,
)


def hostile(rig: Rig, wish: dict[str, Any]) -> Stamped[ActionChunk] | None:
    rows = wish["steps"]
    width = len(rows[0])
    numbers = np.array([(row + [0.0] * width)[:width] for row in rows], np.float32)
    now_ns = rig.now_ns + rig.period_ns
    rig.seq[wish["worker"]] = max(rig.seq[wish["worker"]] + wish["sequence"], 0)
    observed_ns = now_ns + round(wish["observed_s"] * 1e9)
    record = ActionChunk(
        worker=wish["worker"],
        spec_hash=wish["spec"] or rig.spec.hash,
        episode=max(rig.commander.task.episode + wish["episode"], 0),
        observation_stamp_ns=observed_ns,
        observation_seq=0,
        valid_until_ns=now_ns + round(wish["valid_s"] * 1e9),
        steps=numbers,
        observed_ns=observed_ns,
        inference_start_ns=observed_ns,
        inference_end_ns=observed_ns,
    )
    published_ns = now_ns + round(wish["published_s"] * 1e9)
    header = Header(published_ns, min(rig.seq[wish["worker"]], 2**63 - 1), wish["source"])
    return Stamped(header, record, now_ns)


def play(rig: Rig, script: list[Any]) -> None:
    whole = rig.peers
    for event in script:
        if isinstance(event, dict):
            chunk = hostile(rig, event)
            rig.tick(chunks=[chunk] if chunk else [])
            rig.run(0.02)
        elif isinstance(event, tuple):
            rig.put(*event)
        elif isinstance(event, int):
            rig.run(event * 0.004)
        elif event == "activate":
            rig.seq[WORKER] = rig.commander.lease.last_seq if rig.commander.lease else 0
            rig.tick("reset", chunks=[rig.chunk([[0.0] * rig.spec.action.dimension])])
            rig.put("active", True)
        elif event == "lose a node":
            rig.peers = replace(whole, alive=frozenset({"sim", "camera"}))
            rig.tick()
        elif event == "find it":
            rig.peers = whole
            rig.tick()
        elif event in ("fault", "repair"):
            faults = ("sore",) if event == "fault" else ()
            rig.gripper = GripperState(0.05, moving=False, holding=True, faults=faults)
            rig.tick()
        else:
            rig.blocked = event == "block"
        check_goal(rig)


def check_goal(rig: Rig) -> None:
    goal = rig.commander.parts[0].motion.goal
    if goal is not None:
        assert into_workspace(rig.profile.limits, goal.pose.position_m)[1] <= BORDER_M
        assert 0.0 <= goal.width_m <= rig.profile.robot.gripper.max_width_m
    for width_m in rig.widths_m:
        assert 0.0 <= width_m <= rig.profile.robot.gripper.max_width_m


def check(rig: Rig) -> None:
    rig.put("active", False)
    rig.run(1.0)
    assert rig.commander.parts[0].motion.failures == 0
    if rig.commands:
        rig.assert_smooth()


@settings(max_examples=15)
@given(events)
def test_rotation_vectors_and_base_deltas_of_any_kind_stay_within_every_limit(
    script: list[Any],
) -> None:
    rig = Rig()
    rig.activate()
    play(rig, script)
    check(rig)


@settings(max_examples=15)
@given(
    events,
    st.sampled_from(["rpy", "rotvec"]),
    st.sampled_from(["delta", "absolute"]),
    st.sampled_from(["none", "delta_m", "absolute_m", "open_fraction", "binary"]),
    st.sampled_from([0.01, 0.1, 1.0]),
)
def test_whatever_the_spec_says_the_stream_stays_within_every_limit(
    script: list[Any], rotation: str, kind: str, gripper: str, dt_s: float
) -> None:
    rig = Rig(rotation=rotation, kind=kind, gripper=gripper, dt_s=dt_s)
    play(rig, ["activate", *script])
    check(rig)


def test_values_at_the_end_of_float32_are_refused_in_every_frame_and_form() -> None:
    for rotation in ("rpy", "rotvec", "quaternion"):
        for frame in ("base", "tcp"):
            rig = Rig(rotation=rotation, frame=frame, gripper="none", position_scale_m=10.0)
            unit = [0.0, 0.0, 0.0, 1.0] if rotation == "quaternion" else [0.0] * 3
            rig.tick(chunks=[rig.chunk([[0.0] * 3 + unit])])
            rig.put("active", True)
            assert rig.state == "active"
            for size in (HUGE, -HUGE):
                rig.send([[size] * 3 + unit])
                rig.send([[0.0] * 3 + [size] * len(unit)])
                rig.send([[size] * (3 + len(unit))])
            rig.run(1.0)
            check(rig)


def test_a_thousand_steps_of_no_time_are_no_harm() -> None:
    rig = Rig(horizon=1000, dt_s=1e-12)
    rig.activate()
    rig.send([[0.0001, 0, 0, 0, 0, 0, 0]] * 1000)
    rig.run(1.0)
    check(rig)


def test_inputs_of_everything_at_once_in_one_tick() -> None:
    rig = Rig()
    rig.activate()
    names = [
        "active",
        "prompt",
        "worker",
        "rate",
        "speed",
        "slower",
        "lose",
        "reset",
        "stop",
        "other",
    ]
    values: list[Any] = [True, False, None, "", "x", 0.0, float("nan"), float("inf")]
    inputs = Inputs(
        [Setting(name, value) for name in names for value in values],
        [rig.chunk([[0.01] * 7]) for _ in range(64)],
        rig.pose_state(),
        rig.gripper_state(),
        rig.peers,
    )
    out = rig.commander.step(inputs, rig.now_ns)
    assert rig.state == "stopped"
    assert out.events
