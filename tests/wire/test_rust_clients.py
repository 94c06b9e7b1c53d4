"""The robot and the worker of examples/wire/rust in the real chain."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from threading import Event as Flag

import numpy as np
import pytest
import zenoh
from chain import LONG_PATIENCE_S, Chain, running_chain
from vla_zenoh_conform import rules
from wire_rig import (
    CLIENTS,
    alone,
    arguments_of,
    conform,
    moves_exactly_stops_and_is_reset,
    profile_of,
    running,
)

from benchmarks.motion.protocol import PREPARATION_HZ, PROTOCOL, STEPS, MotionCase
from benchmarks.motion.runner import MotionRunner
from benchmarks.motion.segments import make_segment
from vla_zenoh.codec import records
from vla_zenoh.profile import Profile, load_profile

pytestmark = pytest.mark.clients

BUILT = Path(os.environ.get("CARGO_TARGET_DIR", CLIENTS / "rust" / "target")) / "release"
EXACT_M, EXACT_RAD = 1e-3, 2e-3
RATE_HZ, WATCHED_S = 1000.0, 5.0
MEAN_S, LATE_S = 2e-5, 1.5e-3
"""Of the period: how far its mean may be off, and its 99th percentile at most."""
REAL_TIME = ("chrt", "-f", "10")


def in_rust(profile: Profile, name: str, *arguments: str) -> list[str]:
    program = BUILT / name
    if not program.is_file():
        pytest.skip(f"no {program}: make test-clients builds it")
    return [str(program), *arguments_of(profile, *arguments)]


def real_time_permitted() -> bool:
    try:
        return subprocess.run([*REAL_TIME, "true"], capture_output=True).returncode == 0
    except FileNotFoundError:
        return False


def robot_of(profile: Profile, every: int = 4) -> list[str]:
    """With real-time priority where that is permitted; a state every `every` ms."""
    first = REAL_TIME if real_time_permitted() else ()
    return [*first, *in_rust(profile, "robot", str(LONG_PATIENCE_S["command"]), str(every))]


@pytest.fixture
def chain(tmp_path: Path) -> Iterator[Chain]:
    """All of a robot but the robot."""
    more = "task: {prompt: hold, rate_hz: 10}\n"
    path = profile_of(tmp_path, str(CLIENTS / "robot.yaml"), more)
    robot_of(load_profile(str(path)))  # skips before anything is started
    with running_chain(tmp_path, profile_file=path) as chain:
        chain.recorder.only = {"state": "arm#", "command": "command#"}
        yield chain


def periods_s(chain: Chain, seconds: float) -> np.ndarray:
    """Between the stamps of the robot's states."""
    stamps_ns: list[int] = []

    def keep(sample: zenoh.Sample) -> None:
        assert sample.attachment is not None
        stamps_ns.append(records.decode_header(sample.attachment.to_bytes()).stamp_wall_ns)

    with chain.session.declare_subscriber(chain.profile.keys.state_joint, keep):
        time.sleep(seconds)
    return np.diff(stamps_ns) / 1e9


def test_the_rust_robot_holds_1_khz_moves_exactly_and_obeys_a_stop(chain: Chain) -> None:
    with running(robot_of(chain.profile, every=1)):
        moves_exactly_stops_and_is_reset(chain)
        chain.client.set_prompt("HARD: go up")
        chain.until("it moves", chain.moves)
        if not real_time_permitted():
            pytest.skip("a busy computer holds no 1 kHz without real-time priority (chrt)")
        periods = periods_s(chain, WATCHED_S)
        mean_s, late_s = periods.mean(), np.percentile(periods, 99)
        print(f"period: mean {1e3 * mean_s:.4f} ms, 99 % below {1e3 * late_s:.3f} ms")
        assert abs(mean_s - 1 / RATE_HZ) < MEAN_S
        assert late_s < LATE_S


def test_the_rust_robot_killed_in_motion_is_back_and_is_driven_on(chain: Chain) -> None:
    with running(robot_of(chain.profile)) as first:
        chain.activate_when_ready()
        chain.client.set_prompt("HARD: go up")
        chain.until("it moves", chain.moves)
        first.send_signal(signal.SIGKILL)
        chain.until("it is inactive", lambda: chain.state() == "inactive")
    with running(robot_of(chain.profile)):
        moves_exactly_stops_and_is_reset(chain)


@pytest.mark.parametrize("case", PROTOCOL, ids=lambda case: case.name)
def test_the_rust_robot_does_a_motion_of_the_bench_exactly(chain: Chain, case: MotionCase) -> None:
    run = MotionRunner(chain.client, Flag())
    with running(robot_of(chain.profile)):
        run.begin(PREPARATION_HZ)
        if case.preparation:
            prepared = run.run_segment(make_segment(case.preparation, 1), PREPARATION_HZ)
            assert not prepared.faults(), chain.story()
        found = run.run_segment(case.segment, PREPARATION_HZ)
        chain.client.deactivate()
    off_m = max(abs(found.reached_m - found.asked_m), found.drift_mm / 1e3)
    off_rad = max(abs(found.reached_rad - found.asked_rad), found.drift_rad)
    print(f"{case.name}: {1e3 * off_m:.4f} mm, {1e3 * off_rad:.4f} mrad")
    assert not found.faults(), chain.story()
    assert off_m < EXACT_M
    assert off_rad < EXACT_RAD
    assert found.steps_done == STEPS


def test_conform_finds_nothing_wrong_with_the_rust_robot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = profile_of(tmp_path, str(CLIENTS / "robot.yaml"))
    profile = load_profile(str(path))
    with alone(path, *robot_of(profile)):
        status, found, told = conform(capsys, path, profile.robot.node, "robot", "--move")
    assert set(rules.TRIALS) <= set(found), told
    assert not {rule for rule, right in found.items() if right is False}, told
    assert status == 0


def test_the_rust_worker_draws_circles_with_the_rust_robot_and_conforms(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = "workers: [circles]\ntask: {prompt: hold, rate_hz: 10, worker: circles}\n"
    more += "options: {scripted: null}\nhosts: {here: {nodes: [router, command]}}\n"
    path = profile_of(tmp_path, str(CLIENTS / "robot.yaml"), more)
    profile = load_profile(str(path))
    words = robot_of(profile), in_rust(profile, "worker")
    with running_chain(tmp_path, profile_file=path) as chain, ExitStack() as stack:
        chain.recorder.only = {"state": "arm#", "command": "command#"}
        for each in words:
            stack.enter_context(running(each))
        chain.activate_when_ready()
        chain.client.set_prompt("circle")
        chain.until("it moves", chain.moves)
        status, found, told = conform(capsys, path, "worker-circles", "worker", "circles")
        assert not {rule for rule, right in found.items() if right is False}, told
        assert {"steps as its spec says", "spec_hash", "episode"} <= set(found), told
        assert status == 0
        assert chain.state() == "active", chain.story()
        way_m = np.ptp(chain.recorder.track().position_m, axis=0)
        assert way_m[1:] == pytest.approx([2 * RADIUS_M] * 2, abs=WAY_M)


RADIUS_M, WAY_M = 0.05, 0.01
"""Of its circles, and how far a smoothed motion may be from them."""
