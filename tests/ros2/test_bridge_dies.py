"""The real bridge is killed while the arm moves, and started again."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from vla_zenoh.errors import SessionError

if TYPE_CHECKING:
    from rig import Lab

pytest.importorskip("ros_messages", exc_type=ImportError)

pytestmark = [pytest.mark.ros2, pytest.mark.slow]

STAND_S = 0.4
"""The robot's own controller stops at the last pose it got: nobody can tell it anything else."""
WAY_M = 0.03
RECOVERY_S = 2.0
AWAY_S = 1.0
STANDS_M = 0.001
JUMP_M = 0.003
"""From where the arm stands to the first pose it is told again; and from one pose to the next."""
STEPS, STEP_M, WAY_TOLERANCE_M = 5, 0.01, 0.002
FASTEST_M_S = 0.3


@pytest.fixture(scope="module", params=["beside", "router", "apart"])
def shared_lab(
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
    bridge_program: Path,
) -> Iterator[Lab]:
    """Every way of putting bridge and routers: see `rig.running_lab`."""
    from rig import running_lab

    folder = tmp_path_factory.mktemp("lab")
    with running_lab(folder, bridge_program, topology=request.param) as lab:
        lab.chain.activate_when_ready()
        yield lab


def kill_in_motion(lab: Lab) -> int:
    """Returns when (ns), with the arm standing again."""
    lab.move()
    time.sleep(0.3)
    lab.witness.forget()
    killed_ns = time.time_ns()
    lab.bridge.kill()
    time.sleep(AWAY_S)
    track = lab.witness.track(killed_ns)
    assert track.time_to_stand_s(killed_ns) < STAND_S
    assert np.linalg.norm(track.position_m[-1] - track.position_m[0]) < WAY_M
    return killed_ns


def takes_prompt(lab: Lab, prompt: str) -> bool:
    """Whether it was taken; where the router has just come back nobody may hear it yet."""
    try:
        lab.chain.client.set_prompt(prompt, timeout_s=0.2)
    except SessionError:
        return False
    return True


def assert_no_jump(lab: Lab, since_ns: int) -> None:
    """Neither in what the robot was told nor in what it did."""
    at_ns, goals = lab.witness.goals(since_ns)
    track = lab.witness.track(since_ns)
    assert track.speed_m_s.max() < FASTEST_M_S
    if len(goals):
        before = track.position_m[np.searchsorted(track.stamp_ns, at_ns[0]) - 1]
        assert np.linalg.norm(goals[0] - before) < JUMP_M
        assert np.linalg.norm(np.diff(goals, axis=0), axis=1).max(initial=0.0) < JUMP_M


def test_after_the_bridges_death_the_arm_stands_until_it_is_activated(lab: Lab) -> None:
    kill_in_motion(lab)
    stood_m = lab.witness.position_m()
    lab.bridge.start()
    back_ns = time.time_ns()
    lab.chain.until(
        "the robot's state comes again",
        lambda: len(lab.chain.recorder.track(back_ns + 100_000_000).stamp_ns) > 10,
    )
    time.sleep(1.0)
    assert np.linalg.norm(lab.witness.position_m() - stood_m) < STANDS_M
    lab.chain.until("inactive", lambda: lab.chain.state() == "inactive")
    assert lab.chain.client.task is not None
    assert not lab.chain.client.task.active

    lab.chain.until("the prompt is taken", lambda: takes_prompt(lab, "hold"))
    began_m = lab.activate_at_rest()
    assert np.linalg.norm(began_m - stood_m) < STANDS_M
    sign = 1 if began_m[2] < 0.45 else -1
    lab.chain.go("up" if sign > 0 else "down", STEPS)
    ended_m = lab.witness.wait_still()
    assert ended_m[2] - began_m[2] == pytest.approx(sign * STEPS * STEP_M, abs=WAY_TOLERANCE_M)
    assert_no_jump(lab, back_ns)


def test_two_seconds_after_the_bridge_is_back_the_arm_obeys_again(lab: Lab) -> None:
    kill_in_motion(lab)
    began_s, back_ns = time.monotonic(), time.time_ns()
    lab.bridge.start()
    lab.chain.until("the prompt is taken", lambda: takes_prompt(lab, "hold"))
    lab.chain.activate_when_ready()
    took_s = time.monotonic() - began_s
    print(f"\nobeys {took_s:.2f} s after the bridge was started")
    lab.witness.wait_still()
    assert_no_jump(lab, back_ns)
    assert took_s < RECOVERY_S
