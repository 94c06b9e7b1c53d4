"""The motion protocol in lockstep: a row of figures that hold."""

from __future__ import annotations

import multiprocessing
import threading
import time

import pytest

from benchmarks.motion import lockstep
from benchmarks.motion.lockstep import lockstep_row, run_in_lockstep
from benchmarks.motion.protocol import PROTOCOL, Conditions
from vla_zenoh.errors import NodeError
from vla_zenoh.profile import load_profile, override

NAMES = {trial.name: trial for trial in PROTOCOL}
SLOW_MODEL = {"delay_ms": 140.0, "jitter": 0.3}
PATIENCE_S = 60.0


@pytest.mark.parametrize(
    ("prompt", "conditions"),
    [
        ("close gripper", Conditions(25.0)),
        pytest.param("go up", Conditions(5.0, 8, **SLOW_MODEL), marks=pytest.mark.slow),
        pytest.param("yaw right", Conditions(1.0, 50, **SLOW_MODEL), marks=pytest.mark.slow),
        pytest.param("roll left", Conditions(2.0), marks=pytest.mark.slow),
    ],
)
def test_a_prompt_is_carried_out_exactly_within_limits(prompt: str, conditions: Conditions) -> None:
    row = lockstep_row(load_profile("panda_sim"), NAMES[prompt], conditions)
    assert row["ok"], row["faults"]
    assert row["steps_done"] >= 50
    assert row["seam_jerk_over_limit"] <= 1.001


def test_a_prompt_that_cannot_be_carried_out_is_a_row_that_says_why(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(lockstep, "SLACK_S", 0.5)
    late = override(load_profile("panda_sim"), {"timing": {"max_observation_age_s": 0.01}})
    row = lockstep_row(late, NAMES["go up"], Conditions(50.0))
    assert not row["ok"]
    assert "did not end" in row["faults"][0]


@pytest.mark.slow
def test_rows_come_in_the_order_they_were_asked_for() -> None:
    rows = run_in_lockstep(
        load_profile("panda_sim"),
        [NAMES["open gripper"], NAMES["close gripper"]],
        [Conditions(10.0), Conditions(5.0)],
        threading.Event(),
    )
    assert [(row["prompt"], row["rate_hz"]) for row in rows] == [
        ("open gripper", 10.0),
        ("close gripper", 10.0),
        ("open gripper", 5.0),
        ("close gripper", 5.0),
    ]


def begun() -> list[multiprocessing.process.BaseProcess]:
    """The processes of the bench, as soon as there are some."""
    give_up_s = time.monotonic() + PATIENCE_S
    while not (found := multiprocessing.active_children()):
        assert time.monotonic() < give_up_s
        time.sleep(0.05)
    return found


def test_a_process_that_is_killed_ends_the_bench_with_a_word() -> None:
    def kill() -> None:
        for process in begun():
            process.kill()

    killer = threading.Thread(target=kill)
    killer.start()
    rows = run_in_lockstep(
        load_profile("panda_sim"),
        [NAMES["go up"]],
        [Conditions(1.0)],
        threading.Event(),
        processes=1,
    )
    with pytest.raises(NodeError, match="was killed"):
        list(rows)
    killer.join()


def test_who_stops_it_does_not_wait_for_the_end_of_a_row() -> None:
    stop = threading.Event()

    def stop_soon() -> None:
        begun()
        stop.set()

    stopper = threading.Thread(target=stop_soon)
    stopper.start()
    rows = run_in_lockstep(load_profile("panda_sim"), [NAMES["go up"]], [Conditions(1.0)], stop)
    assert list(rows) == []
    assert multiprocessing.active_children() == []
    stopper.join()
